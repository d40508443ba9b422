"""Labels of meshes from files of ScanNet and ScanNet++, every way in which these can be wrong; instance maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labeled_scans import group, write_ply, write_scannet_labels, write_scannetpp_labels
from sklearn.neighbors import KNeighborsClassifier
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.data.labels import mesh as nearest_vertices
from gsencoder.data.labels.mesh import MeshInstances, draw_instances, labels_of_vertices, nearest_rows, read_mesh
from gsencoder.data.labels.scans import (
    find_scannet_files,
    find_scannetpp_files,
    read_axis_alignment,
    read_scannet_labels,
    read_scannetpp_labels,
    with_counted_views,
)
from gsencoder.types import MeshLabels, Scene, SceneObject, Views

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [4, 4, 4], [5, 5, 5]], np.float32)
SEGMENTS = np.array([7, 7, 2, 9, 9, 4])
FACES = np.array([[0, 1, 2], [3, 4, 5]])
GROUPS = [group(0, "couch", [7]), group(3, "office chair", [9, 2])]
NAME = "scene0000_00"
SUFFIXES = {"anno": ".aggregation.json", "segs": "_vh_clean_2.0.010000.segs.json", "mesh": "_vh_clean_2.ply"}


def scan(folder: Path, **changes: Any) -> Path:
    """The small scan, with some of its parts changed."""
    parts = {"vertices": VERTICES, "segments": SEGMENTS, "groups": GROUPS, "faces": FACES} | changes
    return write_scannet_labels(folder / NAME, NAME, **parts)


def test_the_segments_of_an_object_are_its_vertices_and_ids_are_counted_from_one(tmp_path: Path) -> None:
    labels = read_scannet_labels(scan(tmp_path))
    # Segment 7 holds vertices 0 and 1, 2 vertex 2, 9 vertices 3 and 4; segment 4 is nobody's.
    assert labels.instances.tolist() == [1, 1, 4, 4, 4, 0]
    assert labels.objects == ((1, "couch"), (4, "office chair"))
    assert np.array_equal(labels.vertices, VERTICES)
    assert np.array_equal(labels.faces, FACES)
    assert labels.aligned_from_world is None
    boxes = labels.boxes()
    assert list(boxes) == [1, 4]
    assert [corner.tolist() for corner in boxes[1]] == [[0, 0, 0], [1, 0, 0]]
    assert [corner.tolist() for corner in boxes[4]] == [[0, 0, 0], [4, 4, 4]]


def test_boxes_of_the_aligned_frame_follow_axisAlignment(tmp_path: Path) -> None:
    # A quarter turn about z takes (x, y) to (−y, x); then 10 are added to x.
    turn = np.array([[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]], float)
    labels = read_scannet_labels(scan(tmp_path, alignment=turn))
    assert np.array_equal(labels.aligned_from_world, turn)
    aligned, world = labels.boxes(aligned=True), labels.boxes()
    # Of the chair: (0, 2, 0) → (8, 0, −2), (0, 0, 3) → (10, 0, 1), (4, 4, 4) → (6, 4, 2).
    assert [corner.tolist() for corner in aligned[4]] == [[6, 0, -2], [10, 4, 2]]
    assert [corner.tolist() for corner in world[4]] == [[0, 0, 0], [4, 4, 4]]


def test_of_two_objects_with_one_segment_the_later_one_has_it_as_in_scannets_script(tmp_path: Path) -> None:
    groups = [group(0, "table", [7, 9]), group(1, "book", [9]), group(2, "wall", [2, 2, 2])]
    labels = read_scannet_labels(scan(tmp_path, groups=groups))
    assert labels.instances.tolist() == [1, 1, 3, 2, 2, 0]
    # An object without a vertex left has no box.
    labels = read_scannet_labels(scan(tmp_path, groups=[group(0, "table", [9]), group(1, "book", [9])]))
    assert labels.objects == ((1, "table"), (2, "book"))
    assert list(labels.boxes()) == [2]
    nothing = read_scannet_labels(scan(tmp_path, groups=[]))
    assert (nothing.objects, nothing.boxes(), nothing.instances.any()) == ((), {}, False)


def test_files_are_found_in_the_folder_or_above_exported_frames(tmp_path: Path) -> None:
    folder = scan(tmp_path)
    (folder / f"{NAME}_vh_clean.aggregation.json").write_text("{}")
    files = find_scannet_files(folder)
    assert files.annotation == folder / f"{NAME}.aggregation.json"
    (folder / "exported").mkdir()
    assert find_scannet_files(folder / "exported") == files
    assert find_scannet_files(tmp_path) is None
    renamed = folder.rename(tmp_path / "room")
    assert find_scannet_files(renamed) is not None
    (renamed / "scene0001_00.aggregation.json").write_text("{}")
    with pytest.raises(InputError, match="annotations of 2 scans"):
        find_scannet_files(renamed)
    assert find_scannetpp_files(renamed) is None
    with pytest.raises(InputError, match="no annotation of ScanNet; expected ID.aggregation.json"):
        read_scannet_labels(tmp_path)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_meshes_of_every_encoding_keep_the_order_of_vertices(tmp_path: Path, text: bool, order: str) -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)).astype(np.float32)
    vertices[7] = vertices[3]
    faces = rng.integers(0, 50, (80, 3))
    nyu40 = rng.integers(0, 41, 50)
    path = write_ply(tmp_path / "a.ply", vertices, faces, labels=nyu40, text=text, order=order)
    read, triangles = read_mesh(path)
    assert np.array_equal(read, vertices)
    assert np.array_equal(triangles, faces)
    faces[1, 2] = -1
    write_ply(path, vertices, faces, text=text, order=order)
    with pytest.raises(InputError, match=r"face 1 names vertex -1 of 50"):
        read_mesh(path)


def error_of(folder: Path) -> str:
    with pytest.raises(InputError) as error:
        read_scannet_labels(folder)
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("changes", "file", "problem"),
    [
        ({"groups": [group(0, "a", [7]), group(1, "b", [8])]}, "anno", "objectId 1 ('b') names segment 8, which no"),
        ({"groups": [group(0, "a", [7]), group(0, "b", [9])]}, "anno", "segGroups[1]: objectId 0 is already that of"),
        ({"groups": [group(5, "a", [])]}, "anno", "segGroups[0] (objectId 5): 'a' has no segments"),
        ({"groups": [group(-1, "a", [7])]}, "anno", "segGroups[0]: objectId must be a whole number from 0, got -1"),
        ({"groups": [group(0, "a", [7, True])]}, "anno", "segments[1]: expected a whole number, got True"),
        ({"groups": [{**group(0, "a", [7]), "label": None}]}, "anno", "label must be a name, got nothing"),
        ({"groups": [group(0, "x" * 1001, [7])]}, "anno", "label has 1,001 characters"),
        ({"segments": SEGMENTS[:5]}, "segs", "segIndices has 5 entries, but"),
        ({"segments": [7, 7, 2, 9, 9, "4"]}, "segs", "segIndices[5]: expected a whole number, got '4'"),
        ({"vertices": np.where(np.arange(6)[:, None] == 4, np.inf, VERTICES)}, "mesh", "vertex 4 is not finite (1 of"),
        ({"vertices": VERTICES[:0], "faces": None}, "mesh", "holds no vertices"),
        ({"faces": np.array([[0, 1, 2], [3, 4, 6]])}, "mesh", "face 1 names vertex 6 of 6"),
    ],
)
def test_a_wrong_entry_is_one_line_that_names_file_and_entry(tmp_path, changes, file, problem):
    folder = scan(tmp_path, **changes)
    message = error_of(folder)
    assert message.startswith(str(folder / f"{NAME}{SUFFIXES[file]}"))
    assert problem in message


@pytest.mark.parametrize("content", ["[]", '{"segGroups": {}, "segIndices": 3}', "", "NaN", "[" * 200_000])
@pytest.mark.parametrize("file", ["anno", "segs"])
def test_json_of_the_wrong_kind_is_refused(tmp_path: Path, content: str, file: str) -> None:
    folder = scan(tmp_path)
    path = folder / f"{NAME}{SUFFIXES[file]}"
    path.write_text(content)
    assert str(path) in error_of(folder)


@pytest.mark.parametrize("file", SUFFIXES)
def test_a_missing_file_is_named(tmp_path: Path, file: str) -> None:
    folder = scan(tmp_path)
    path = folder / f"{NAME}{SUFFIXES[file]}"
    path.unlink()
    assert (str(path) if file != "anno" else "no annotation of ScanNet") in error_of(folder)


@pytest.mark.parametrize("keep", [0, 40, -5, -30])
def test_truncated_meshes_are_refused(tmp_path: Path, keep: int) -> None:
    folder = scan(tmp_path)
    path = folder / f"{NAME}{SUFFIXES['mesh']}"
    path.write_bytes(path.read_bytes()[:keep])
    assert str(path) in error_of(folder)


def test_a_cloud_has_no_triangles_and_what_is_no_mesh_is_refused(tmp_path: Path) -> None:
    for number, faces in enumerate((None, FACES[:0])):
        assert read_mesh(write_ply(tmp_path / f"{number}.ply", VERTICES, faces))[1] is None
    path = write_ply(tmp_path / "a.ply", VERTICES, FACES)
    good = path.read_bytes()
    for content in (b"PK\x03\x04", good.replace(b"element vertex 6", b"element vertex 9999999999")):
        path.write_bytes(content)
        with pytest.raises(InputError, match="not a mesh that trimesh can read"):
            read_mesh(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_mesh(tmp_path / "missing.ply")


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("axisAlignment = 1 0 0", "expected 16 numbers, got '1 0 0'"),
        ("axisAlignment = " + "x " * 16, "expected 16 numbers"),
        ("axisAlignment = " + "nan " * 16, "not finite"),
        ("axisAlignment = " + " ".join(map(str, np.diag([2.0, 2, 2, 1]).ravel())), "uniform scale of 2"),
    ],
)
def test_a_wrong_alignment_is_refused(tmp_path: Path, line: str, problem: str) -> None:
    path = tmp_path / "s.txt"
    path.write_text(f"colorWidth = 1296\n{line}\n")
    with pytest.raises(InputError, match=problem):
        read_axis_alignment(path)
    path.write_text("colorWidth = 1296\n")
    assert read_axis_alignment(path) is None


def test_of_overlapping_objects_of_scannetpp_the_smallest_has_the_vertex(tmp_path: Path) -> None:
    # Four vertices of segment 1, two of 2, one of 3.
    segments = np.array([1, 1, 1, 1, 2, 2, 3])
    vertices = np.arange(21, dtype=np.float32).reshape(7, 3)
    things = ((5, "keyboard", [2]), (1, "table", [1, 2, 3]), (2, "mouse", [3]), (9, "tray", [2]), (7, "screen", [2]))
    folder = write_scannetpp_labels(tmp_path / "scene", vertices, segments, [group(*thing) for thing in things])
    labels = read_scannetpp_labels(folder)
    # Keyboard, tray and screen have two vertices each, and the first counts; screen would be the fourth on them.
    assert labels.instances.tolist() == [1, 1, 1, 1, 5, 5, 2]
    assert labels.objects == ((5, "keyboard"), (1, "table"), (2, "mouse"), (9, "tray"), (7, "screen"))
    assert read_scannetpp_labels(folder / "scans").objects == labels.objects
    assert read_scannetpp_labels(folder / "dslr").objects == labels.objects
    # Only the objects of a benchmark's classes are looked at.
    some = read_scannetpp_labels(folder, names={"table", "screen"})
    assert some.instances.tolist() == [1, 1, 1, 1, 7, 7, 1]
    assert some.objects == ((1, "table"), (7, "screen"))


def test_objects_of_scannetpp_count_from_one(tmp_path: Path) -> None:
    folder = write_scannetpp_labels(tmp_path / "s", VERTICES, SEGMENTS, [group(0, "a", [7])])
    with pytest.raises(InputError, match="objectId must be a whole number from 1, got 0"):
        read_scannetpp_labels(folder)
    (folder / "scans" / "segments.json").unlink()
    with pytest.raises(InputError, match=r"segments.json: no such file"):
        read_scannetpp_labels(folder)
    with pytest.raises(InputError, match=r"no annotation of ScanNet\+\+"):
        read_scannetpp_labels(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"instances": np.array([1, 3], np.int32)}, "instances: expected 0 or the id of an object, got 3 in row 1"),
        ({"objects": ((2, "a"), (2, "b"))}, "objects: expected unique ids, got 2 twice"),
        ({"vertices": np.full((2, 3), np.nan, np.float32)}, "vertices: expected finite"),
        ({"faces": np.array([[0, 1, 2]], np.int32)}, "faces: expected rows of 2 vertices"),
    ],
)
def test_labels_that_contradict_each_other_are_refused(no_jaxtyping, changes, message):
    parts = {"vertices": np.zeros((2, 3), np.float32), "instances": np.zeros(2, np.int32), "objects": ((1, "a"),)}
    with pytest.raises(InputError, match=message):
        MeshLabels(**(parts | changes))


def points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)).astype(np.float32)


def test_the_nearest_row_is_that_of_brute_force_and_minus_one_where_none_is_near(rng: np.random.Generator) -> None:
    some, targets = points(rng, 300), points(rng, 50)
    distances = np.linalg.norm(some[:, None].astype(float) - targets[None], axis=2)
    assert np.array_equal(nearest_rows(some, targets), distances.argmin(axis=1))
    near = distances.min(axis=1) <= 0.1
    assert 0 < near.sum() < 300
    at_it = np.array([[0.25, 0, 0], [0.2500001, 0, 0]])
    assert nearest_rows(at_it, np.zeros((1, 3)), max_distance=0.25).tolist() == [0, -1]
    assert np.array_equal(nearest_rows(some, targets, max_distance=0.1), np.where(near, distances.argmin(axis=1), -1))
    assert nearest_rows(some, targets[:0]).tolist() == [-1] * 300
    assert nearest_rows(some[:0], targets).tolist() == []


@pytest.mark.parametrize("k", [1, 4, 25])
def test_the_majority_of_the_nearest_gaussians_is_that_of_scikit_learn(rng: np.random.Generator, k: int) -> None:
    """Its classifier also takes the smallest of equally frequent labels."""
    means, vertices = points(rng, 500), points(rng, 400)
    labels = rng.integers(0, 6, 500)
    expected = KNeighborsClassifier(n_neighbors=k).fit(means, labels).predict(vertices)
    assert np.array_equal(labels_of_vertices(vertices, means, labels, k=k), expected)


def test_chunks_change_nothing(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    means, vertices = points(rng, 300), points(rng, 257)
    labels = rng.integers(0, 40, 300)
    whole = labels_of_vertices(vertices, means, labels)
    monkeypatch.setattr(nearest_vertices, "CHUNK", 16)
    assert np.array_equal(labels_of_vertices(vertices, means, labels), whole)


def test_gaussians_without_a_label_are_among_the_nearest_but_do_not_count() -> None:
    means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0], [9, 0, 1]], np.float32)
    vertex = np.zeros((1, 3), np.float32)
    labels = np.array([-1, -1, 3, 8, 8])
    # Of the three nearest, one says 3 and two nothing; the two nearest say nothing.
    assert labels_of_vertices(vertex, means, labels, k=3).tolist() == [3]
    assert labels_of_vertices(vertex, means, labels, k=2).tolist() == [-1]
    assert labels_of_vertices(vertex, means, labels, k=25).tolist() == [8]
    # Those that are not asked are not among the nearest.
    assert labels_of_vertices(vertex, means, labels, k=1, voters=labels >= 0).tolist() == [3]


def test_nothing_gives_no_labels(rng: np.random.Generator) -> None:
    none, some = np.zeros((0, 3), np.float32), points(rng, 3)
    empty = np.zeros(0, np.int32)
    assert labels_of_vertices(some, none, empty).tolist() == [-1, -1, -1]
    assert labels_of_vertices(none, some, np.arange(3)).shape == (0,)
    assert labels_of_vertices(some, some, np.arange(3), voters=np.zeros(3, bool)).tolist() == [-1, -1, -1]


@pytest.mark.parametrize(
    ("depth", "drawn", "hidden"),
    [
        # At 4 m a twentieth of the sensor's depth is more than the tenth of a metre that counts near by.
        (4.0, (0.0, 4.21, 3.81), (4.22, 3.80)),
        (1.0, (1.09, 0.91), (1.11, 0.89)),
        # Triangles nearer than a centimeter are not drawn.
        (0.02, (0.0,), ()),
        (0.009, (), (0.0,)),
    ],
)
def test_the_sensor_may_differ_by_a_twentieth_of_its_depth_and_by_a_tenth_of_a_metre(depth, drawn, hidden):
    assert [instance_of_wall(depth, sensor) for sensor in drawn] == [1] * len(drawn)
    assert 1 not in [instance_of_wall(depth, sensor) for sensor in hidden]


def square(corners: np.ndarray) -> MeshLabels:
    instances, faces = np.ones(4, np.int32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return MeshLabels(vertices=corners.astype(np.float32), instances=instances, objects=((1, "wall"),), faces=faces)


def instance_of_wall(depth: float, sensor: float) -> int:
    """At the middle pixel of a camera before a wall, away from the world's origin."""
    origin = np.array([100.0, -50.0, 7.0])
    corners = np.array([[-9, -9, depth], [9, -9, depth], [9, 9, depth], [-9, 9, depth]]) + origin
    labels = square(corners)
    views = Views(cameras=front_camera(5, 3, 4.0), names=("a",), depths=[np.full((3, 5), sensor, np.float32)])
    instances = MeshInstances(labels, views, origin)[0]
    assert instances.shape == (3, 5)
    assert (instances == instances[1, 2]).all()
    return int(instances[1, 2])


def test_views_and_areas_are_counted_by_id_in_any_order_of_objects() -> None:
    first = np.array([[9, 9, 2], [9, 5, 0]], np.int32)
    second = np.array([[5, 5, 5], [7, 7, 2]], np.int32)
    corner = np.zeros(3)
    scene = Scene(
        name="s",
        gaussians=random_gaussians(1),
        views=Views(cameras=front_camera(3, 2).select([0, 0]), names=("a", "b"), instances=[first, second]),
        objects=tuple(
            SceneObject(id=number, name="x", aabb_min=corner, aabb_max=corner, views=None, max_pixels=None)
            for number in (9, 2, 11, 5)
        ),
    )
    counts = [(each.id, each.views, each.max_pixels) for each in with_counted_views(scene).objects]
    assert counts == [(9, 1, 3), (2, 2, 1), (11, 0, 0), (5, 2, 3)]


def test_each_pixel_has_the_object_of_the_vertex_that_is_nearest_on_the_triangle_itself() -> None:
    # One edge of a slanted triangle goes from z = 1 to z = 4: its middle is at z = 2.5, which a picture shows four
    # fifths of the way to the far end.
    vertices = np.array([[-1, 0, 1], [4, 0, 4], [-1, 50, 1]], np.float32)
    instances, faces = np.array([1, 2, 3], np.int32), np.array([[0, 1, 2]], np.int32)
    labels = MeshLabels(vertices=vertices, instances=instances, objects=((1, "a"), (2, "b"), (3, "c")), faces=faces)
    K = np.array([[50, 0, 50], [0, 50, 0], [0, 0, 1]], np.float64)
    instances, depth = draw_instances(labels, np.eye(4), K, 101, 3)
    # The middle (1.5, 0, 2.5) projects to 50 + 50 · 0.6 = 80.
    assert instances[0, 1:79].tolist() == [1] * 78
    assert instances[0, 81:99].tolist() == [2] * 18
    # At pixel column c, x / z = (c + 0.5 - 50) / 50 = r on the line x = -1 + 5 s, z = 1 + 3 s.
    r = (np.arange(1, 99) + 0.5 - 50) / 50
    s = (1 + r) / (5 - 3 * r)
    np.testing.assert_allclose(depth[0, 1:99], 1 + 3 * s, rtol=0.02)


def test_triangles_with_a_common_edge_leave_no_pixel_between_them() -> None:
    """Squares cut along a diagonal that goes through many centers of pixels, and along others."""
    rng = np.random.default_rng(0)
    K = np.array([[10, 0, 10], [0, 10, 10], [0, 0, 1]], np.float64)
    for depth in (0.02, 0.7, 1.0, 3.3):
        for turn in (0, 1):
            size = 9 if turn == 0 else float(rng.uniform(5, 20))
            corners = np.array([[-size, -size, depth], [size, -size, depth], [size, size, depth], [-size, size, depth]])
            assert draw_instances(square(np.roll(corners, turn, axis=0)), np.eye(4), K, 20, 20)[0].all()
