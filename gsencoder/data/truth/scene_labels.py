"""The labels beside the photographs of a ScanNet or ScanNet++ scene, as objects and instance maps of the scene."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning, counted
from gsencoder.data.readers.label_archives import ArchivedLabels, archived_size, members_by_stem
from gsencoder.data.readers.label_images import label_files
from gsencoder.data.truth.mesh_instances import MeshInstances
from gsencoder.data.truth.scannet_labels import find_scannet_files, read_scannet_labels
from gsencoder.data.truth.scannetpp_labels import find_scannetpp_files, read_scannetpp_labels
from gsencoder.types import MeshLabels, Scene, SceneObject, Views

STRUCTURE = frozenset(
    """
    wall; floor; ceiling; door; doorframe; door frame; window; window frame; windowsill; window sill; pillar; column;
    beam; ledge; stairs; staircase; stair; structure; shower wall; shower floor; closet wall; closet floor;
    closet ceiling; bathroom wall; bathroom floor; suspended ceiling; roof; skylight; baseboard
    """.replace("\n", " ")
    .strip()
    .split("; ")
)
"""Parts of the building, which are not placed."""
ARCHIVES = ("_2d-instance-filt.zip", "_2d-instance.zip")
"""Endings of ScanNet's archives of instance maps: 8-bit PNGs with objectId + 1, filtered by depth or not."""
NAMELESS = frozenset(("object", "objects", "unknown", "unlabeled", "unlabelled", "remove", "split", "misc", "other"))
"""Names that say nothing: what has one is not placed either."""


def find_labels(folder: Path, *, names: Collection[str] | None = None) -> MeshLabels | None:
    """The labels of a scene's mesh in the files of ScanNet or ScanNet++; None where there is no annotation.

    Args:
        folder: of the scene (`Scene.folder`).
        names: of ScanNet++, raw names of the objects that are labeled (`read_scannetpp_labels`); None = all.

    Raises:
        InputError: a file is missing or wrong.
    """
    scannet = find_scannet_files(folder)
    if scannet is not None:
        return read_scannet_labels(scannet)
    scannetpp = find_scannetpp_files(folder)
    return None if scannetpp is None else read_scannetpp_labels(scannetpp, names=names)


def labels_of_layout(folder: Path, layout: str) -> MeshLabels | None:
    """The labels that lie beside the photographs of a scene, in the world of its poses.

    Args:
        folder: of the scene.
        layout: name of its layout; only ScanNet's and ScanNet++'s have labels.

    Raises:
        InputError: a file of the labels is wrong.

    Warns:
        SceneWarning: there is an annotation, but not the files that it needs.
    """
    if layout == "ScanNet":
        scannet = find_scannet_files(folder)
        if scannet is None:
            return None
        return None if _warn_of_missing(scannet.missing) else read_scannet_labels(scannet)
    if layout == "ScanNet++":
        scannetpp = find_scannetpp_files(folder)
        if scannetpp is None:
            return None
        return None if _warn_of_missing(scannetpp.missing) else read_scannetpp_labels(scannetpp)
    return None


def _warn_of_missing(missing: Sequence[Path]) -> bool:
    if missing:
        warnings.warn(
            f"{missing[0]}: no such file, so that the scene has no objects; its annotation needs it",
            SceneWarning,
            stacklevel=4,
        )
    return bool(missing)


def is_placed(name: str) -> bool:
    """Whether a raw name is that of a thing that stands, lies or hangs in a room.

    That is every name but those of parts of the building (`STRUCTURE`: wall, floor, ceiling, door, window, column …)
    and those that say nothing (`NAMELESS`: object, unknown, remove …); capitals do not matter. Benchmarks have no such
    notion as small objects beside furniture, so that chairs and beds are placed here.
    """
    plain = " ".join(name.lower().split())
    return plain not in STRUCTURE and plain not in NAMELESS and plain != ""


def objects_of_labels(labels: MeshLabels) -> tuple[SceneObject, ...]:
    """The objects of a labeled mesh, with boxes of their vertices along the axes of the world.

    The views that show them are not counted; `with_counted_views` does.

    Args:
        labels: in the world of the scene's poses.

    Warns:
        SceneWarning: objects whose vertices all belong to others are left out.
    """
    boxes = labels.boxes()
    if left_out := [name for number, name in labels.objects if number not in boxes]:
        warnings.warn(
            f"{len(left_out)} of {len(labels.objects)} labeled objects have no vertex of their own and are left out "
            f"(first: {left_out[0][:40]!r})",
            SceneWarning,
            stacklevel=3,
        )
    return tuple(
        SceneObject(
            id=number,
            name=name.strip() or None,
            aabb_min=boxes[number][0],
            aabb_max=boxes[number][1],
            placed=is_placed(name),
            views=None,
            max_pixels=None,
        )
        for number, name in labels.objects
        if number in boxes
    )


def with_archived_instances(views: Views, folder: Path) -> Views:
    """Views of a ScanNet scan with the instance maps of SCAN_2d-instance-filt.zip, or else of SCAN_2d-instance.zip,
    where one lies beside the annotation and the views have no pictures of instances of their own.

    Args:
        views: called as their color frames.
        folder: of the scene.

    Raises:
        InputError: the archive is damaged.

    Warns:
        SceneWarning: the archive is not used, since it lacks frames or its pictures have another size.
    """
    scan = find_scannet_files(folder)
    archives = () if scan is None else tuple(scan.aggregation.with_name(f"{scan.name}{end}") for end in ARCHIVES)
    archive = next((path for path in archives if path.is_file()), None)
    if archive is None or views.instances is not None or not len(views):
        return views
    members = members_by_stem(archive)
    stems = [PurePosixPath(name).stem for name in views.names]
    missing = [stem for stem in stems if stem not in members]
    fault = ""
    if missing:
        fault = f"has no picture of {counted(len(missing), 'view')} of {len(stems)} (first: {missing[0]}.png)"
    else:
        maps = label_files([members[stem] for stem in stems], views, ArchivedLabels)
        size, source = archived_size(members[stems[0]]), maps.grids[0].source
        if size == (source.width, source.height):
            return replace(views, instances=maps)
        fault = f"has pictures of {size[0]}×{size[1]} pixels, and photographs have {source.width}×{source.height}"
    warnings.warn(
        f"{archive}: {fault}, so that instance maps are drawn from the labeled mesh", SceneWarning, stacklevel=3
    )
    return views


def with_mesh_instances(views: Views, labels: MeshLabels, origin: Float64[np.ndarray, "3"]) -> Views:
    """Views with instance maps drawn from a labeled mesh, where they have no pictures of instances of their own.

    Args:
        views: relative to `origin`.
        labels: in the world of the views; without faces the views stay as they are.
        origin: of the scene.
    """
    if views.instances is not None or labels.faces is None:
        return views
    return replace(views, instances=MeshInstances(labels, views, origin))


def with_counted_views(scene: Scene) -> Scene:
    """A scene whose objects state in how many views they show, and their largest area in one.

    They are counted in the instance maps, inside the masks of the views. A scene whose objects state it stays as it is.

    Raises:
        InputError: objects that do not state it, and no instance maps to count them in.
    """
    if all(each.views is not None and each.max_pixels is not None for each in scene.objects):
        return scene
    if scene.views is None or scene.views.instances is None:
        raise InputError(
            f"scene {scene.name}: in how many views its objects show is not known, and it has no instance maps to "
            "count in; expected a mesh with faces beside the annotation, or pictures of instances"
        )
    ids = np.array([each.id for each in scene.objects], np.int64)
    order = np.argsort(ids)
    view_counts, largest = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.int64)
    for view in range(len(scene.views)):
        instances = scene.views.instances[view]
        if scene.views.masks is not None:
            instances = instances[scene.views.masks[view]]
        values, counts = np.unique(instances, return_counts=True)
        rows = np.minimum(np.searchsorted(ids[order], values), len(ids) - 1)
        has_row = ids[order][rows] == values
        rows, counts = order[rows[has_row]], counts[has_row]
        view_counts[rows] += 1
        largest[rows] = np.maximum(largest[rows], counts)
    return replace(
        scene,
        objects=tuple(
            replace(each, views=int(views), max_pixels=int(pixels))
            for each, views, pixels in zip(scene.objects, view_counts, largest, strict=True)
        ),
    )
