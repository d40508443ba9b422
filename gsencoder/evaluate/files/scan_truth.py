"""Truth of instances and of semantic labels from the labels of scans of ScanNet or ScanNet++, without files in between.

It is what `gsencoder.data.labels.expressions` writes, and what ScanNet's own export writes: class id · 1000 + objectId
+ 1, and class ids.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from gsencoder.data.labels.classes import ClassTable, ids_of_names, vertex_classes
from gsencoder.data.labels.expressions import instance_truth
from gsencoder.data.labels.scans import (
    find_scannet_files,
    find_scannetpp_files,
    read_scannet_labels,
    read_scannetpp_labels,
)
from gsencoder.evaluate.scores.instance_masks import InstanceTruth
from gsencoder.types import MeshLabels

NONE = -1
"""Of vertices of no class."""


def instances_of_scan(folder: Path, raw_ids: Mapping[str, int], classes: ClassTable) -> InstanceTruth:
    """The instance of each vertex of a scan's mesh; the scene is named as its folder.

    Args:
        folder: of the scan.
        raw_ids: class id of each raw name, of `read_label_map`.
        classes: that are scored; objects of others do not count.

    Raises:
        InputError: label files that are missing or wrong, or a class with the id 0.
    """
    classes.check_instance_ids()
    labels = _labels(folder, raw_ids)
    names = dict(labels.objects)
    class_of = ids_of_names(names.values(), raw_ids, classes)
    return InstanceTruth(scene=folder.name, ids=instance_truth(labels.instances, names, class_of))


def classes_of_scan(folder: Path, raw_ids: Mapping[str, int], classes: ClassTable) -> Int64[np.ndarray, " V"]:
    """The class id of each vertex of a scan's mesh, −1 = none; arguments and errors as of `instances_of_scan`."""
    labels = _labels(folder, raw_ids)
    names = dict(labels.objects)
    ids = ids_of_names(names.values(), raw_ids, classes)
    # 0 stands for none there, unless a raw name leads to it.
    class_of = {name: number for name, number in ids.items() if number or (raw_ids.get(name) == 0 and 0 in classes.ids)}
    return vertex_classes(labels.instances, names, class_of, none=NONE).astype(np.int64)


def _labels(folder: Path, raw_ids: Mapping[str, int]) -> MeshLabels:
    """The labels of a scan; of ScanNet++ those of the objects that have a class, as its toolkit takes them."""
    if find_scannet_files(folder) is None and find_scannetpp_files(folder) is not None:
        return read_scannetpp_labels(folder, names=raw_ids)
    return read_scannet_labels(folder)
