"""Ground truth in the text files that ScanNet's evaluation scripts take, one line a vertex."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.truth.label_sets import vertex_classes
from gsencoder.data.truth.number_files import write_whole_numbers
from gsencoder.types import MeshLabels

IDS_PER_CLASS = 1000
"""A line of the truth of instances holds the class id times this plus the number of the instance."""


def instance_truth(
    instances: Int32[np.ndarray, " V"], names: Mapping[int, str], class_of: Mapping[str, int]
) -> Int64[np.ndarray, " V"]:
    """Class id · 1000 + number of the instance, and 0 of vertices without an object.

    The number is the id of the object, as ScanNet's script has it. Where an id is 1000 or more, which would read as
    another class, objects are numbered from 1 within their class, in the order of their ids: scores are the same. An
    object without a class has its number alone, which evaluation takes for a region that does not count.

    Args:
        instances: the object of each vertex, 0 = none.
        names: the name of each object, such as `dict(MeshLabels.objects)`.
        class_of: class id of each name, as `ids_of_names` gives it.

    Raises:
        InputError: a class has 1000 objects or more, which the format cannot hold.
    """
    classes = vertex_classes(instances, names, class_of).astype(np.int64)
    objects, first, codes = np.unique(instances, return_index=True, return_inverse=True)
    numbers = objects.astype(np.int64)
    if int(numbers.max(initial=0)) >= IDS_PER_CLASS:
        classes_of_objects = classes[first]
        for number in np.unique(classes_of_objects):
            rows = np.flatnonzero((classes_of_objects == number) & (objects > 0))
            if len(rows) >= IDS_PER_CLASS and number:
                name = names[int(objects[rows[0]])]
                raise InputError(
                    f"{name[:40]!r}: {len(rows):,} objects are of its class; up to {IDS_PER_CLASS - 1} fit into class "
                    "id · 1000 + number"
                )
            # The numbers of objects without a class mean nothing.
            numbers[rows] = np.arange(1, len(rows) + 1) if number else 0
    return classes * IDS_PER_CLASS + numbers[codes]


def write_instance_truth(path: Path, labels: MeshLabels, class_of: Mapping[str, int]) -> None:
    """Writes SCENE.txt of the instance task: `instance_truth`, one a line.

    Raises:
        InputError: as `instance_truth`, or the file cannot be written.
    """
    write_whole_numbers(path, instance_truth(labels.instances, dict(labels.objects), class_of))


def write_semantic_truth(path: Path, labels: MeshLabels, class_of: Mapping[str, int]) -> None:
    """Writes SCENE.txt of the semantic task: the class of each vertex, 0 = none.

    Raises:
        InputError: the file cannot be written.
    """
    write_whole_numbers(path, vertex_classes(labels.instances, dict(labels.objects), class_of))
