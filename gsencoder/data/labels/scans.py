"""Labels of scans from the files of ScanNet and ScanNet++.

Both write two JSON files: one gives each vertex of the mesh the number of its segment (`segIndices`), the other lists
objects as groups of segments (`segGroups`: objectId, label, segments).

A ScanNet scan ID has ID_vh_clean_2.ply (the mesh), ID_vh_clean_2.0.010000.segs.json, ID.aggregation.json, and ID.txt,
whose line `axisAlignment` turns the world of the poses and of the mesh into the frame of ScanNet's benchmarks of boxes
(ScanRefer and its kin). Ids are objectId + 1, as in ScanNet's own scripts, so that 0 can mean no object; ScanRefer's
object_id is objectId (Dai et al. 2017; BenchmarkScripts/3d_helpers/export_train_mesh_for_evaluation.py).

A ScanNet++ scene has scans/ with mesh_aligned_0.05.ply, segments.json and segments_anno.json. The world is that of the
laser scan, which is also the frame of the poses and of the boxes. Ids are the objectIds of the annotation. Objects
overlap: a vertex can belong to several, of which ScanNet++'s toolkit (semantic/transforms/mesh.py) keeps the smallest
(Yeshwanth et al. 2023).
"""

import warnings
from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, SceneWarning, counted
from gsencoder.data.labels.files import brief, check_file, entries_of, read_checked_text
from gsencoder.data.labels.mesh import MeshInstances, read_mesh
from gsencoder.data.readers.masks import label_files, members_by_stem, read_member
from gsencoder.data.readers.posed import rigid_pose
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.types import MeshLabels, Scene, SceneObject, Views

MAX_BYTES = 512 << 20
"""Of JSON files, which take tens of times as much memory."""
MAX_NAME = 1000
"""Characters of a name, as in a text table."""
MAX_ID = 2**31 - 2


class SegmentGroup(NamedTuple):
    """One object of an annotation."""

    id: int
    label: str
    segments: Int64[np.ndarray, " S"]  # their numbers, ascending and unique


def read_segments(path: Path) -> Int64[np.ndarray, " V"]:
    """The segment of each vertex."""
    numbers = _integers(_read(path, "segIndices", "the segment of each vertex"), f"{path}: segIndices")
    if not len(numbers):
        raise InputError(f"{path}: segIndices is empty; expected the segment of each vertex of the mesh")
    return numbers


def read_groups(path: Path, *, first_id: int) -> tuple[SegmentGroup, ...]:
    """The objects of an annotation, in the order of the file."""
    groups: list[SegmentGroup] = []
    rows = _read(path, "segGroups", "the objects")
    for row, where in entries_of(rows, path, "objectId, label and segments", key="segGroups"):
        number, label = row.get("objectId"), row.get("label")
        if isinstance(number, bool) or not isinstance(number, int) or not first_id <= number <= MAX_ID:
            raise InputError(f"{where}: objectId must be a whole number from {first_id}, got {brief(number)}")
        of_object = f"{where} (objectId {number})"
        if not isinstance(label, str):
            raise InputError(f"{of_object}: label must be a name, got {brief(label)}")
        if len(label) > MAX_NAME:
            raise InputError(f"{of_object}: label has {len(label):,} characters, expected at most {MAX_NAME:,}")
        segments = row.get("segments")
        if not isinstance(segments, list):
            raise InputError(f"{of_object}: segments must be a list of numbers of segments, got {brief(segments)}")
        if not segments:
            raise InputError(f"{of_object}: {label[:40]!r} has no segments; remove it, or get the annotation again")
        groups.append(SegmentGroup(number, label, np.unique(_integers(segments, f"{of_object}: segments"))))
    if repeated := first_repeated(group.id for group in groups):
        number, first, second = repeated
        raise InputError(f"{path}: segGroups[{second}]: objectId {number} is already that of segGroups[{first}]")
    return tuple(groups)


def _read(path: Path, key: str, subject: str) -> list[Any]:
    """The list at a key of the object that a JSON file holds."""
    check_file(path, max_bytes=MAX_BYTES)
    data = read_json(path)
    values = data.get(key) if isinstance(data, dict) else None
    if not isinstance(values, list):
        keys = f"an object with {', '.join(map(str, list(data)[:6]))[:80]}" if isinstance(data, dict) else "no object"
        raise InputError(f"{path}: expected an object with the list {key!r}, {subject}; got {keys}")
    return values


def _integers(values: list[Any], where: str) -> Int64[np.ndarray, " n"]:
    """A list of whole numbers as an array; the first entry that is none is named."""
    # JSON's true is not a number here, though Python and numpy would count it as 1.
    if set(map(type, values)) <= {int}:
        with suppress(OverflowError):
            return np.array(values, np.int64)
    wrong = next(row for row, each in enumerate(values) if type(each) is not int or not -(2**63) <= each < 2**63)
    raise InputError(f"{where}[{wrong}]: expected a whole number, got {brief(values[wrong])}")


AGGREGATION, SEGMENTS, MESH = ".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.ply"
ANNOTATION, SEGMENTS_PP, MESH_PP = "segments_anno.json", "segments.json", "mesh_aligned_0.05.ply"
MAX_META_BYTES = 1 << 20
MAX_OBJECTS_OF_A_VERTEX = 3
"""Objects after the third that claim a vertex of ScanNet++, in the order of the file, are not looked at, as in the
toolkit."""


class LabelFiles(NamedTuple):
    """The label files of a scan."""

    annotation: Path  # objects as groups of segments
    segments: Path  # the segment of each vertex
    mesh: Path

    @property
    def missing(self) -> Path | None:
        """The first of them that does not exist."""
        return next((path for path in self if not path.is_file()), None)


def find_scannet_files(folder: Path) -> LabelFiles | None:
    """The label files of a scan in a folder, or of a scan of the folder's or its parent's name in the parent.

    The second is for frames that were exported to a folder inside the scan's. None where there is no annotation.
    """
    folder = folder.absolute()
    # _vh_clean.aggregation.json belongs to the mesh of full resolution, which no benchmark uses.
    scans = sorted(
        path.name[: -len(AGGREGATION)]
        for path in folder.glob(f"*{AGGREGATION}")
        if path.is_file() and not path.name.endswith(f"_vh_clean{AGGREGATION}")
    )
    if len(scans) > 1 and folder.name not in scans:
        raise InputError(
            f"{folder}: holds annotations of {len(scans)} scans ({', '.join(scans)[:80]}); expected one, or one named "
            f"{folder.name}{AGGREGATION}"
        )
    stems = [folder / (folder.name if folder.name in scans else scans[0])] if scans else []
    stems += [folder.parent / name for name in (folder.name, folder.parent.name) if name]
    for stem in stems:
        files = LabelFiles(*(stem.with_name(f"{stem.name}{end}") for end in (AGGREGATION, SEGMENTS, MESH)))
        if files.annotation.is_file():
            return files
    return None


def find_scannetpp_files(folder: Path) -> LabelFiles | None:
    """The label files of a scene, given itself, its scans/, or its dslr/ or iphone/; None without an annotation."""
    folder = folder.absolute()
    homes = [folder / "scans", folder]
    if folder.name in ("dslr", "iphone"):
        homes.append(folder.parent / "scans")
    for home in homes:
        files = LabelFiles(*(home / name for name in (ANNOTATION, SEGMENTS_PP, MESH_PP)))
        if files.annotation.is_file():
            return files
    return None


def read_scannet_labels(folder: Path) -> MeshLabels:
    """The labels of a scan.

    A segment that several objects list belongs to the last of them, as ScanNet's script writes one after the other.
    """
    files = find_scannet_files(folder)
    if files is None:
        raise InputError(f"{folder}: no annotation of ScanNet; expected ID{AGGREGATION}, ID{SEGMENTS} and ID{MESH}")
    groups, vertices, faces = _annotated_mesh(files, first_id=0)
    instances = np.zeros(len(vertices), np.int32)
    for group, rows in groups:
        instances[rows] = group.id + 1
    meta = Path(str(files.annotation).removesuffix(AGGREGATION) + ".txt")
    return MeshLabels(
        vertices=vertices,
        instances=instances,
        objects=tuple((group.id + 1, group.label) for group, _ in groups),
        faces=faces,
        aligned_from_world=read_axis_alignment(meta) if meta.is_file() else None,
    )


def read_scannetpp_labels(folder: Path, *, names: Collection[str] | None = None) -> MeshLabels:
    """The labels of a scene, of all objects or of those with some raw names.

    A vertex that several objects claim belongs to the one with the fewest vertices, and of equal ones to the first in
    the file. An object whose vertices all belong to others stays in the list.
    """
    files = find_scannetpp_files(folder)
    if files is None:
        raise InputError(
            f"{folder}: no annotation of ScanNet++; expected scans/ with {ANNOTATION}, {SEGMENTS_PP}, {MESH_PP}"
        )
    # Objects count from 1: the toolkit takes 0 for the background.
    groups, vertices, faces = _annotated_mesh(files, first_id=1, names=names)
    instances = np.zeros(len(vertices), np.int32)
    claims = np.zeros(len(vertices), np.int8)
    smallest = np.full(len(vertices), np.iinfo(np.int64).max)
    for group, claimed in groups:
        rows = claimed[claims[claimed] < MAX_OBJECTS_OF_A_VERTEX]
        claims[rows] += 1
        count = len(rows)
        rows = rows[count < smallest[rows]]
        instances[rows], smallest[rows] = group.id, count
    objects = tuple((group.id, group.label) for group, _ in groups)
    return MeshLabels(vertices=vertices, instances=instances, objects=objects, faces=faces)


def _annotated_mesh(
    files: LabelFiles, *, first_id: int, names: Collection[str] | None = None
) -> tuple[list[tuple[SegmentGroup, Int64[np.ndarray, " n"]]], np.ndarray, np.ndarray | None]:
    """The objects of a scan with their vertices, and all vertices and faces of its mesh."""
    if files.missing:
        raise InputError(f"{files.missing}: no such file; the labels of the scan need it")
    groups = [
        group for group in read_groups(files.annotation, first_id=first_id) if names is None or group.label in names
    ]
    segments = read_segments(files.segments)
    vertices, faces = read_mesh(files.mesh)
    if len(segments) != len(vertices):
        raise InputError(
            f"{files.segments}: segIndices has {len(segments):,} entries, but {files.mesh} has {len(vertices):,} "
            "vertices; expected the files of one mesh"
        )
    order = np.argsort(segments, kind="stable")
    numbers, starts = np.unique(segments[order], return_index=True)
    parts = np.split(order, starts[1:])
    with_vertices = []
    for group in groups:
        rows = np.searchsorted(numbers, group.segments)
        unknown = numbers[np.minimum(rows, len(numbers) - 1)] != group.segments
        if unknown.any():
            raise InputError(
                f"{files.annotation}: objectId {group.id} ({group.label[:40]!r}) names segment "
                f"{group.segments[unknown][0]}, which no vertex has in {files.segments}; expected both of one scan"
            )
        with_vertices.append((group, np.concatenate([parts[row] for row in rows])))
    return with_vertices, vertices, faces


def read_axis_alignment(path: Path) -> Float64[np.ndarray, "4 4"] | None:
    """The transform aligned_from_world of a scan's ID.txt (`axisAlignment = ` and 16 numbers, row by row).

    None where the file has no such line, as those of test scans; the world is used as it is then.
    """
    lines = read_checked_text(path, max_bytes=MAX_META_BYTES).splitlines()
    entries = [words for words in (line.partition("=") for line in lines) if words[0].strip() == "axisAlignment"]
    if not entries:
        return None
    try:
        values = np.array(entries[-1][2].split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != 16:
        raise InputError(f"{path}: axisAlignment: expected 16 numbers, got {entries[-1][2].strip()[:60]!r}")
    rigid_pose(values.reshape(4, 4), f"{path}: axisAlignment")
    # As it is written, as benchmarks apply it, and not the nearest rotation.
    return values.reshape(4, 4)


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
        names: of ScanNet++, raw names of the objects that are labeled (`read_scannetpp_labels`); None = all.
    """
    if find_scannet_files(folder) is not None:
        return read_scannet_labels(folder)
    return None if find_scannetpp_files(folder) is None else read_scannetpp_labels(folder, names=names)


def labels_of_scan(folder: Path, raw_names: Collection[str]) -> MeshLabels:
    """The labels of a scan, which must be there; of ScanNet++ those of the objects whose raw name has a class, as its
    toolkit takes them."""
    labels = find_labels(folder, names=raw_names)
    return read_scannet_labels(folder) if labels is None else labels


def labels_of_layout(folder: Path, layout: str) -> MeshLabels | None:
    """The labels next to the photographs of a scene, in the world of its poses.

    The layout is ScanNet or ScanNet++. A warning says where an annotation lacks files that it needs.
    """
    files = find_scannet_files(folder) if layout == "ScanNet" else find_scannetpp_files(folder)
    if files is None:
        return None
    if files.missing:
        warnings.warn(
            f"{files.missing}: no such file, so that the scene has no objects; its annotation needs it",
            SceneWarning,
            stacklevel=3,
        )
        return None
    return read_scannet_labels(folder) if layout == "ScanNet" else read_scannetpp_labels(folder)


def is_placed(name: str) -> bool:
    """Whether a raw name is that of a thing that stands, lies or hangs in a room: chairs and beds are placed, too."""
    plain = " ".join(name.lower().split())
    return plain not in STRUCTURE and plain not in NAMELESS and plain != ""


def objects_of_labels(labels: MeshLabels) -> tuple[SceneObject, ...]:
    """The objects of a mesh in the world of the scene's poses, with boxes of their vertices along its axes.

    Objects whose vertices all belong to others are left out, with a warning. `with_counted_views` counts their views.
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
    where one lies next to the annotation, has a picture in the photographs' size for each view, and the views have no
    pictures of instances of their own.
    """
    scan = find_scannet_files(folder)
    archives = [] if scan is None else [Path(str(scan.annotation).removesuffix(AGGREGATION) + end) for end in ARCHIVES]
    archive = next((path for path in archives if path.is_file()), None)
    if archive is None or views.instances is not None or not len(views):
        return views
    members = members_by_stem(archive)
    stems = [PurePosixPath(name).stem for name in views.names]
    if missing := [stem for stem in stems if stem not in members]:
        fault = f"has no picture of {counted(len(missing), 'view')} of {len(stems)} (first: {missing[0]}.png)"
    else:
        maps = label_files([members[stem] for stem in stems], views, archive)
        (height, width), source = read_member(archive, members[stems[0]]).shape, maps.grids[0].source
        if (width, height) == (source.width, source.height):
            return replace(views, instances=maps)
        fault = f"has pictures of {width}×{height} pixels, and photographs have {source.width}×{source.height}"
    warnings.warn(
        f"{archive}: {fault}, so that instance maps are drawn from the labeled mesh", SceneWarning, stacklevel=3
    )
    return views


def with_mesh_instances(views: Views, labels: MeshLabels, origin: Float64[np.ndarray, "3"]) -> Views:
    """Views with instance maps drawn from a labeled mesh, where they have no pictures of instances of their own.

    Args:
        labels: in the world of the views; without faces the views stay as they are.
    """
    if views.instances is not None or labels.faces is None:
        return views
    return replace(views, instances=MeshInstances(labels, views, origin))


def count_pixels(views: Views, ids: Int64[np.ndarray, " N"]) -> Int64[np.ndarray, "V N"]:
    """The area in pixels of each object in the instance map of each view."""
    assert views.instances is not None
    order = np.argsort(ids)
    counts = np.zeros((len(views), len(ids)), np.int64)
    for view in range(len(views)):
        instances = views.instances[view]
        if views.masks is not None:
            instances = instances[views.masks[view]]
        values, areas = np.unique(instances, return_counts=True)
        rows = np.minimum(np.searchsorted(ids[order], values), len(ids) - 1)
        known = ids[order][rows] == values
        counts[view, order[rows[known]]] = areas[known]
    return counts


def with_counted_views(scene: Scene) -> Scene:
    """A scene whose objects state in how many views they show, and their largest area in one, inside the masks of the
    views. A scene whose objects state it stays as it is.
    """
    if all(each.views is not None and each.max_pixels is not None for each in scene.objects):
        return scene
    if scene.views is None or scene.views.instances is None:
        raise InputError(
            f"scene {scene.name}: in how many views its objects show is not known, and it has no instance maps to "
            "count in; expected a mesh with faces next to the annotation, or pictures of instances"
        )
    counts = count_pixels(scene.views, np.array([each.id for each in scene.objects], np.int64))
    objects = tuple(
        replace(each, views=int(np.count_nonzero(areas)), max_pixels=int(areas.max(initial=0)))
        for each, areas in zip(scene.objects, counts.T, strict=True)
    )
    return replace(scene, objects=objects)
