"""A room as a scan of ScanNet or ScanNet++: its objects, its instance maps, and `evaluate` on it."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labeled_scans import group, write_scannet_labels, write_scannet_scan, write_scannetpp_scan
from PIL import Image
from rgbd_layouts import write_scannet_frames

from gsencoder.app.commands.inspect import scene_facts
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.mesh import MeshInstances, draw_instances
from gsencoder.data.labels.scans import find_labels, is_placed, with_counted_views
from gsencoder.data.scenes import SceneConfig, load_scene, read_posed
from gsencoder.data.synthetic import make_room
from gsencoder.evaluate.benchmarks.localization import queryable_objects
from gsencoder.types import MeshLabels, Scene

VIEWS = 8


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room(3, objects=5, views=VIEWS, width=96, height=72)


@pytest.fixture(scope="module")
def scan(room: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scannet_scan(room, tmp_path_factory.mktemp("scans") / "scene0000_00")


def test_objects_of_a_scan_have_the_boxes_of_the_room(room: Scene, scan: Path) -> None:
    scene = load_scene(scan)
    things, true = ({each.id: each for each in objects} for objects in (scene.objects, room.objects))
    assert set(things) == set(true)
    assert (things[1].name, things[2].name, things[1].placed, things[2].placed) == ("floor", "wall", False, False)
    for number, thing in true.items():
        assert things[number].name == (thing.name or things[number].name)
        # A scan has what views see of a surface, to half a vertex: inside the true box, and most of it.
        inside = thing.aabb_max - thing.aabb_min
        assert (things[number].aabb_min >= thing.aabb_min - 0.01).all()
        assert (things[number].aabb_max <= thing.aabb_max + 0.01).all()
        assert (things[number].aabb_max - things[number].aabb_min >= inside - np.maximum(0.5 * inside, 0.12)).all()


def test_instance_maps_drawn_from_the_mesh_are_those_of_the_room(room: Scene, scan: Path) -> None:
    scene = load_scene(scan)
    assert isinstance(scene.views.instances, MeshInstances)
    agree = [np.mean(scene.views.instances[view] == room.views.instances[view]) for view in range(VIEWS)]
    # What differs are outlines, and where no view sees far sides well enough for a mesh.
    assert min(agree) > 0.95
    assert np.array_equal(scene.views.instances[-1], scene.views.instances[VIEWS - 1])
    assert np.array_equal(scene.views.instances[2:4][1], scene.views.instances[3])
    assert np.array_equal(scene.views.select([3]).instances[0], scene.views.instances[3])  # type: ignore[index]


def test_views_and_pixels_of_objects_are_counted_as_in_objects_json(room: Scene, scan: Path) -> None:
    loaded = load_scene(scan)
    assert all(each.views is None and each.max_pixels is None for each in loaded.objects)
    with pytest.raises(InputError, match="the views that show it were not counted; with_counted_views of"):
        queryable_objects(loaded.objects)
    scene = with_counted_views(loaded)
    true = {each.id: each for each in room.objects}
    for thing in scene.objects:
        if thing.id in true and (true[thing.id].max_pixels or 0) > 60:
            assert thing.views is not None
            assert abs(thing.views - (true[thing.id].views or 0)) <= 1
            assert thing.max_pixels == pytest.approx(true[thing.id].max_pixels, rel=0.25)
    asked, clear = queryable_objects(scene.objects), queryable_objects(room.objects, min_pixels=90)
    assert {each.id for each in asked} >= {each.id for each in clear}
    assert with_counted_views(scene) is scene


def test_masked_pixels_do_not_count(room: Scene, scan: Path) -> None:
    scene = load_scene(scan)
    hidden = [np.zeros((72, 96), bool)] * (VIEWS - 1) + [np.ones((72, 96), bool)]
    counted = with_counted_views(replace(scene, views=replace(scene.views, masks=hidden)))
    assert max(each.views or 0 for each in counted.objects) == 1


def test_a_scannetpp_scene_without_depth_has_objects_in_the_world_of_its_scan(room: Scene, tmp_path: Path) -> None:
    folder = write_scannetpp_scan(room, tmp_path / "8b5caf3398")
    scene = with_counted_views(load_scene(folder))
    assert scene.views.depths is None
    agree = [np.mean(scene.views.instances[view] == room.views.instances[view]) for view in range(VIEWS)]
    assert min(agree) > 0.95
    true = {each.id: each for each in room.objects}
    things = {each.id: each for each in scene.objects}
    # The floor claims every vertex, and keeps those that no smaller object claims.
    assert set(things) == set(true)
    for number, thing in true.items():
        np.testing.assert_array_less(thing.aabb_min - 0.01, things[number].aabb_min)
        np.testing.assert_array_less(things[number].aabb_max, thing.aabb_max + 0.01)
    dslr = load_scene(folder / "dslr")
    assert [each.id for each in dslr.objects] == list(things)


def pack(path: Path, inner: str, maps: list[np.ndarray]) -> None:
    """An archive of instance maps as ScanNet's: a folder of 8-bit pictures, named as the frames."""
    with zipfile.ZipFile(path, "w") as archive:
        for view, values in enumerate(maps):
            data = io.BytesIO()
            Image.fromarray(values.astype(np.uint8)).save(data, format="PNG")
            archive.writestr(f"{inner}/{view}.png", data.getvalue())


def source_of_maps(folder: Path) -> str:
    """What `inspect` says of a scene's instance maps."""
    posed, _, layout = read_posed(folder, SceneConfig())
    assert posed is not None
    return str(scene_facts(load_scene(folder), posed, layout, None)["instances"])


def test_archives_of_instances_come_before_maps_of_the_mesh_and_the_filtered_one_first(room, tmp_path):
    folder = write_scannet_scan(room, tmp_path / "scene0000_00")
    assert source_of_maps(folder) == "drawn from the labeled mesh"
    pack(folder / "scene0000_00_2d-instance.zip", "instance", [np.full((72, 96), 7)] * VIEWS)
    scene = load_scene(folder)
    assert np.unique(scene.views.instances[2]).tolist() == [7]
    pictures = [room.views.instances[view] for view in range(VIEWS)]
    pack(folder / "scene0000_00_2d-instance-filt.zip", "instance-filt", pictures)
    assert source_of_maps(folder) == "pictures in scene0000_00_2d-instance-filt.zip"
    scene = load_scene(folder)
    for view in range(VIEWS):
        np.testing.assert_array_equal(scene.views.instances[view], pictures[view])
    half = scene.views.instances[1:2]
    np.testing.assert_array_equal(half[0], pictures[1])
    # Unpacked ones come first.
    (folder / "instance-filt").mkdir()
    for view in range(VIEWS):
        Image.fromarray(np.full((72, 96), 5, np.uint8)).save(folder / "instance-filt" / f"{view}.png")
    assert source_of_maps(folder) == "pictures"


@pytest.mark.parametrize(
    ("maps", "problem"),
    [
        ([np.ones((72, 96))] * (VIEWS - 1), f"has no picture of 1 view of {VIEWS} \\(first: {VIEWS - 1}.png\\)"),
        ([np.ones((36, 48))] * VIEWS, "has pictures of 48×36 pixels, and photographs have 96×72"),
    ],
)
def test_an_archive_that_does_not_fit_is_named_and_maps_are_drawn(maps, problem, room, tmp_path):
    folder = write_scannet_scan(room, tmp_path / "scene0000_00")
    pack(folder / "scene0000_00_2d-instance-filt.zip", "instance-filt", maps)
    with pytest.warns(SceneWarning, match=f"{problem}, so that instance maps are drawn from the labeled mesh"):
        assert source_of_maps(folder) == "drawn from the labeled mesh"


def test_a_damaged_archive_is_an_error(room: Scene, tmp_path: Path) -> None:
    folder = write_scannet_scan(room, tmp_path / "scene0000_00")
    archive = folder / "scene0000_00_2d-instance-filt.zip"
    archive.write_bytes(b"PK no")
    with pytest.raises(InputError, match=r"_2d-instance-filt.zip: cannot be read as .zip"):
        load_scene(folder)
    pack(archive, "instance-filt", [np.ones((72, 96))] * VIEWS)
    scene = load_scene(folder)
    data = archive.read_bytes()
    start = data.index(b"IDAT", data.index(b"IDAT") + 4)
    archive.write_bytes(data[:start] + bytes(byte ^ 255 for byte in data[start : start + 9]) + data[start + 9 :])
    with pytest.raises(InputError, match=r"instance-filt.zip/instance-filt/1.png: cannot be read"):
        _ = scene.views.instances[1]


def test_an_annotation_without_its_files_leaves_the_photographs(room: Scene, tmp_path: Path) -> None:
    folder = write_scannet_scan(room, tmp_path / "scene0000_00")
    (folder / "scene0000_00_vh_clean_2.ply").unlink()
    with pytest.warns(SceneWarning, match=r"_vh_clean_2.ply: no such file, so that the scene has no objects"):
        scene = load_scene(folder)
    assert scene.objects == ()
    with pytest.raises(InputError, match=r"_vh_clean_2.ply: no such file"):
        find_labels(folder)
    assert find_labels(tmp_path) is None


def test_objects_that_others_cover_are_left_out_with_a_warning(room: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "scene0000_00"
    write_scannet_frames(room, folder)
    groups = [group(0, "table", [1]), group(1, " book ", [1]), group(2, " ", [0])]
    write_scannet_labels(folder, folder.name, np.eye(3, dtype=np.float32), np.array([1, 1, 0]), groups)
    with pytest.warns(SceneWarning, match=r"1 of 3 labeled objects have no vertex of their own .* \(first: 'table'\)"):
        scene = load_scene(folder)
    assert [(each.id, each.name, each.placed) for each in scene.objects] == [(2, "book", True), (3, None, False)]
    # A cloud of points draws no maps.
    assert scene.views.instances is None
    with pytest.raises(InputError, match="no instance maps to count in; expected a mesh with faces"):
        with_counted_views(scene)


def test_parts_of_the_building_and_names_that_say_nothing_are_not_placed() -> None:
    assert not any(map(is_placed, ("Floor", " ceiling", "door", "door  frame", "window", "object", "REMOVE", "")))
    assert all(map(is_placed, ("office chair", "table", "wall clock", "trash can", "ceiling fan")))


def test_the_nearer_triangle_hides_the_other_and_pixels_have_the_nearest_vertex() -> None:
    """Two squares parallel to the picture: at z = 2 half as large in it as at z = 1, and behind."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    vertices = np.concatenate([np.c_[2 * square, np.full(4, 2.0)], np.c_[0.25 * square, np.ones(4)]]).astype(np.float32)
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    labels = MeshLabels(
        vertices=vertices,
        instances=np.array([1, 1, 1, 1, 2, 2, 3, 3], np.int32),
        objects=((1, "a"), (2, "b"), (3, "c")),
        faces=np.concatenate([quads, quads + 4]).astype(np.int32),
    )
    K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
    instances, depth = draw_instances(labels, np.eye(4), K, 16, 16)
    expected = np.ones((16, 16), int)
    expected[6:8, 6:10], expected[8:10, 6:10] = 2, 3
    # On the diagonal of the square the nearest vertex is that of its end; the middle four pixels belong to both.
    assert np.array_equal(instances[[6, 9]], expected[[6, 9]])
    assert np.array_equal(np.isin(instances, (2, 3)), expected > 1)
    np.testing.assert_allclose(depth, np.where(expected > 1, 1.0, 2.0), rtol=1e-6)
    # From the other side nothing is in front of the camera.
    behind, far = draw_instances(labels, np.diag([-1.0, 1, -1, 1]), K, 16, 16)
    assert not behind.any()
    assert np.isinf(far).all()
