"""Ground truth in the text files that ScanNet's evaluation scripts take, one line a vertex."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.files.atomic import atomic_file
from gsencoder.data.truth.label_sets import vertex_classes
from gsencoder.types import MeshLabels

INSTANCES_OF_A_CLASS = 1000
"""A line holds the class times this plus the instance."""


def instance_truth(labels: MeshLabels, class_of: Mapping[str, int]) -> Int64[np.ndarray, " V"]:
    """label_id · 1000 + instance of each vertex, and 0 of vertices without an object.

    An object without a class has its instance alone, which evaluation takes for a region that does not count.

    Args:
        labels: of a mesh.
        class_of: class of each raw name, as `ids_of_names` gives it.

    Raises:
        InputError: an instance of 1000 or more, which would read as another class.
    """
    largest = int(labels.instances.max(initial=0))
    if largest >= INSTANCES_OF_A_CLASS:
        name = dict(labels.objects)[largest]
        raise InputError(
            f"object {largest} ({name[:40]!r}): ids up to {INSTANCES_OF_A_CLASS - 1} fit into label_id·1000 + instance"
        )
    return vertex_classes(labels, class_of).astype(np.int64) * INSTANCES_OF_A_CLASS + labels.instances


def write_instance_truth(path: Path, labels: MeshLabels, class_of: Mapping[str, int]) -> None:
    """Writes SCENE.txt of the instance task: `instance_truth`, one a line.

    Raises:
        InputError: as `instance_truth`, or the file cannot be written.
    """
    write_numbers(path, instance_truth(labels, class_of))


def write_semantic_truth(path: Path, labels: MeshLabels, class_of: Mapping[str, int]) -> None:
    """Writes SCENE.txt of the semantic task: the class of each vertex, 0 = none.

    Raises:
        InputError: the file cannot be written.
    """
    write_numbers(path, vertex_classes(labels, class_of))


def write_numbers(path: Path, numbers: Int[np.ndarray, " n"]) -> None:
    """Writes whole numbers, one a line.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_file(path) as stream:
        for start in range(0, len(numbers), 1 << 20):
            stream.write(("\n".join(map(str, numbers[start : start + (1 << 20)].tolist())) + "\n").encode("ascii"))
