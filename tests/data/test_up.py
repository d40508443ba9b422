"""Up is estimated from cameras and surfaces, turns with the scene, and rights photographs that are stored sideways."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from field_scenes import FieldRoom, cam_from_world, store_turned, write_colmap_text, write_transforms
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps
from scene_files import photograph
from scipy.spatial.transform import Rotation
from splats import front_camera, gaussians_at, random_gaussians
from textured_box import box_cameras, box_views, write_box

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.enclosure import Surfaces, surfaces_of_gaussians
from gsencoder.data.readers.images import picture_info, read_rgba
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import quats_from_normals
from gsencoder.data.synthetic import make_room
from gsencoder.data.up import (
    Up,
    _floor_area,
    _refine,
    _support,
    estimate_up,
    turn,
    up_of_cameras,
    up_of_scene,
    upright_gaussians,
    wall_angle,
    with_up,
)
from gsencoder.fusion.checkpoint import upright
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.geometry import covariances
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.teachers.labels import PaletteTeacher
from gsencoder.teachers.masks import FileMasks
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views
from gsencoder.types.orientation import INVERSE, TURNS, turned, upright_scene, upright_views

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def room():
    return replace(make_room(1, objects=6, views=10, width=96, height=72, spacing=0.08), up=None)


def turned_by(scene: Scene, rotation: np.ndarray) -> Scene:
    gaussians, views = scene.gaussians, scene.views
    if gaussians is not None:
        quats = Rotation.from_matrix(rotation) * Rotation.from_quat(gaussians.quats, scalar_first=True)
        means = (gaussians.means @ rotation.T).astype(np.float32)
        gaussians = replace(gaussians, means=means, quats=quats.as_quat(scalar_first=True).astype(np.float32))
    if views is not None:
        poses = views.cameras.cam_from_world.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ rotation.T
        views = replace(views, cameras=replace(views.cameras, cam_from_world=poses))
    return replace(scene, gaussians=gaussians, views=views)


def degrees(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1, 1))))


def test_up_of_a_turned_room_turns_with_it(room):
    rotation = Rotation.random(random_state=1).as_matrix()
    other = turned_by(room, rotation)
    for scene, source in (
        (other, "cameras and surfaces"),
        (replace(other, gaussians=None), "cameras and surfaces"),
        (replace(other, gaussians=None, views=replace(other.views, depths=None)), "cameras"),
        (replace(other, views=None), "surfaces"),
    ):
        up = up_of_scene(scene)
        assert up.source == source
        assert degrees(up.direction, rotation @ UP) < 1.0
        assert up.confidence > 0.4


def test_a_camera_that_moves_ahead_has_the_mean_of_its_own_up():
    ahead = front_camera(64, 48).select([0] * 5)
    ahead.cam_from_world[:, 2, 3] = np.arange(5)
    np.testing.assert_allclose(up_of_cameras(ahead), (0, -1, 0), atol=1e-6)


def test_what_is_stated_is_not_estimated(room):
    stated = replace(room, up=np.array([0.0, 1.0, 0.0]))
    scene, up = with_up(stated)
    assert scene is stated
    assert (up.source, up.describe()) == ("files", "(0.000, 1.000, 0.000), of the files")


def test_a_splat_without_directions_has_no_up():
    """Flat Gaussians that face everywhere, and round ones."""
    made = np.random.default_rng(0)
    count = 3000
    quats = Rotation.random(count, random_state=0).as_quat(scalar_first=True).astype(np.float32)
    ball = replace(gaussians_at(made.normal(size=(count, 3)), (0.1, 0.1, 0.001), 0.9), quats=quats)
    scene, up = with_up(Scene(name="ball", gaussians=ball))
    assert (scene.up, up) == (None, None)
    balls = replace(ball, scales=np.full((count, 3), 0.1, np.float32))
    assert len(surfaces_of_gaussians(balls).areas) == 0
    # Planes through means that fill a volume are accidents.
    by_planes = up_of_scene(Scene(name="balls", gaussians=balls))
    assert by_planes is None or by_planes.confidence < 0.05
    assert with_up(Scene(name="balls", gaussians=balls))[1] is None
    with pytest.raises(InputError, match="neither cameras nor flat surfaces"):
        estimate_up(None, None)


def test_up_can_be_stated_when_a_scene_is_read(tmp_path):
    write_box(tmp_path / "box", box_views(box_cameras(2, width=64, height=48, focal=44.8)))
    scene = load_scene(tmp_path / "box", options=SceneConfig(up=(0.0, -3.0, 4.0)))
    np.testing.assert_allclose(scene.up, (0, -0.6, 0.8))
    with pytest.raises(InputError, match="up: expected three finite numbers"):
        SceneConfig(up=(0.0, 0.0, 0.0))


def test_support_is_the_area_that_lies_and_half_of_what_stands():
    """Within a bell of six degrees; many directions at once have the same."""
    leaning = np.deg2rad([0, 6, 45, 84, 90, 180])
    normals = np.stack((np.sin(leaning), 0 * leaning, np.cos(leaning)), axis=1)
    expected = [1, np.exp(-1), 0, 0.5 * np.exp(-1), 0.5, 1]
    for row, normal in enumerate(normals):
        np.testing.assert_allclose(_support(np.tile(UP, (600, 1)), normal[None], np.ones(1)), expected[row], atol=1e-4)
    areas = np.array([0.2, 0.1, 0.4, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(_support(UP[None], normals, areas), areas @ expected, atol=1e-4)


def test_a_refined_direction_is_what_floors_and_walls_agree_on():
    made = np.random.default_rng(0)
    tilt = Rotation.from_rotvec(np.deg2rad([3.0, -2.0, 0])).as_matrix()
    exact = np.concatenate([np.tile(axis, (200, 1)) for axis in np.eye(3)]) @ tilt.T
    noisy = exact + 0.02 * made.normal(size=exact.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    direction = _refine(UP, noisy, np.full(600, 1 / 600))
    assert degrees(direction, tilt @ UP) < 0.2
    # Floors and walls that contradict each other by 2°: one floor counts as much as two walls of its area.
    leaning = Rotation.from_rotvec(np.deg2rad([0, 2.0, 0])).as_matrix()
    normals = np.array([[0.0, 0, 1], leaning @ [1.0, 0, 0]])
    assert degrees(_refine(UP, normals, np.array([1.0, 2.0])), UP) == pytest.approx(1.0, abs=0.02)
    assert degrees(_refine(UP, normals, np.array([1.0, 1.0])), UP) == pytest.approx(2 / 3, abs=0.02)


def test_the_side_of_a_bare_splat_with_the_floor_is_down():
    """A floor, a smaller table top and walls on all sides, upside down or not."""
    made = np.random.default_rng(0)
    floor = np.concatenate((made.uniform(-2, 2, (800, 2)), np.zeros((800, 1))), axis=1)
    ceiling = np.concatenate((made.uniform(-1, 1, (300, 2)), np.full((300, 1), 2.5)), axis=1)
    wall = np.stack((np.full(400, 2.0), made.uniform(-2, 2, 400), made.uniform(0, 2.5, 400)), axis=1)
    means = np.concatenate((floor, ceiling, wall))
    normals = np.repeat([[0.0, 0, 1], [0, 0, 1], [1, 0, 0]], (800, 300, 400), axis=0)
    areas = np.full(1500, 1.0)
    for number in range(3):
        rotation = Rotation.random(random_state=number).as_matrix()
        up = estimate_up(Surfaces(means @ rotation.T, normals @ rotation.T, areas), None)
        assert degrees(up.direction, rotation @ UP) < 0.5
    area = _floor_area(UP, means, normals, areas / 1500)
    assert area == pytest.approx((800 - 0.5 * 300) / 1500, abs=0.01)
    assert _floor_area(-UP, means, normals, areas / 1500) == pytest.approx((300 - 0.5 * 800) / 1500, abs=0.01)
    assert _floor_area(UP, means[:1], normals[:1], areas[:1]) == 0


def test_a_fitted_splat_whose_gaussians_are_turned_anyhow_has_the_up_of_its_surfaces():
    """Photographs determine colors, and the orientation of small Gaussians hardly."""
    bare = replace(make_room(1, objects=6, views=0, spacing=0.06), up=None, views=None)
    count = len(bare.gaussians)
    anyhow = Rotation.random(count, random_state=0).as_quat(scalar_first=True).astype(np.float32)
    scales = np.tile(np.array([0.03, 0.03, 0.003], np.float32), (count, 1))
    fitted = replace(bare, gaussians=replace(bare.gaussians, quats=anyhow, scales=scales))
    rotation = Rotation.random(random_state=1).as_matrix()
    _, up = with_up(turned_by(fitted, rotation))
    assert degrees(up.direction, rotation @ UP) < 1


def test_level_cameras_decide_where_gaussians_lean_nowhere(room):
    """As around one soft object: neither normals nor planes through means agree on anything."""
    made = np.random.default_rng(0)
    ball = made.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    gaussians = room.gaussians
    anyhow = Rotation.random(3000, random_state=1).as_quat(scalar_first=True).astype(np.float32)
    soft = replace(gaussians.select(np.arange(3000)), means=ball.astype(np.float32), quats=anyhow)
    up = up_of_scene(replace(room, gaussians=soft, views=replace(room.views, depths=None)))
    assert up.source == "cameras"
    assert up.confidence > 0.99
    np.testing.assert_allclose(up.direction, up_of_cameras(room.views.cameras), atol=1e-9)


def test_of_two_floors_the_one_below_the_usual_up_counts_twice_as_much():
    """A floor across -y, and across z one of 1.5 or 3 times its area."""
    made = np.random.default_rng(0)
    usual = np.stack((made.uniform(0, 2, 300), np.full(300, 2.0), made.uniform(0, 2, 300)), axis=1)
    ceiling = np.array([[0.0, -1.0, 5.0]])
    for factor, direction in ((1.5, (0, -1, 0)), (3.0, (0, 0, 1))):
        count = round(300 * factor)
        other = np.stack((made.uniform(0, 2, count), made.uniform(0, 1.5, count), np.zeros(count)), axis=1)
        means = np.concatenate((usual, other, ceiling))
        normals = np.repeat([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], (300, count, 1), axis=0)
        up = estimate_up(Surfaces(means, normals, np.ones(len(means))), None)
        assert degrees(up.direction, np.array(direction)) < 1


def test_confidence_is_how_level_cameras_stand_and_what_surfaces_support(room):
    cameras = room.views.cameras
    level = estimate_up(None, cameras)
    assert level.source == "cameras"
    assert level.confidence > 0.99
    rolled = cameras.cam_from_world.astype(np.float64)
    for view, angle in enumerate(np.linspace(-0.5, 0.5, len(rolled))):
        rolled[view, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix() @ rolled[view, :3]
    right = rolled[:, 0, :3]
    other = estimate_up(None, replace(cameras, cam_from_world=rolled.astype(np.float32)))
    assert other.confidence == pytest.approx(1 - 3 * np.mean(np.square(right @ other.direction)), abs=1e-5)
    assert estimate_up(None, cameras.select([0, 1])).confidence == 0
    estimate = up_of_scene(room)
    assert estimate.describe().endswith(f"estimated from cameras and surfaces, confidence {estimate.confidence:.2f}")


def test_surfaces_that_lie_far_from_what_cameras_say_do_not_count(room):
    """Only a wall is seen: its normal is no up, though it has all the area."""
    prior = up_of_cameras(room.views.cameras)
    across = np.array([1.0, 0, 0])
    up = estimate_up(Surfaces(np.zeros((50, 3)), np.tile(across, (50, 1)), np.ones(50)), room.views.cameras)
    assert degrees(up.direction, prior) <= 40.0
    assert abs(up.direction @ across) < 0.1


@pytest.mark.parametrize(
    ("direction", "confidence", "used"),
    [((0, -1, 0), 0.06, True), ((0, -0.8, -0.6), 0.06, True), ((0, 0, 1), 0.06, False), ((0, -1, 0), 0.04, False),
     ((0, 0, 1), 0.11, True), ((0, 1, 0), 0.06, False)],
)  # fmt: skip
def test_surfaces_of_a_bare_splat_need_less_where_they_say_what_is_assumed(monkeypatch, direction, confidence, used):
    estimate = Up(direction=np.array(direction, np.float64), confidence=confidence, source="surfaces")
    monkeypatch.setattr("gsencoder.data.up.up_of_scene", lambda scene: estimate)
    scene, up = with_up(Scene(name="bare"))
    assert (up is estimate) == used
    assert (scene.up is not None) == used


PORTRAIT, LANDSCAPE = "PINHOLE 120 160 112 112 60 80", "PINHOLE 160 120 112 112 80 60"
MIXED = (6, 1, 8, 3, 6, 8, 1, 3)


def turned_scene(field_room: FieldRoom, folder: Path, orientations: tuple[int, ...]) -> tuple[Path, list[np.ndarray]]:
    """The room as COLMAP registers photographs that are stored turned, and the poses of their stored pixels."""
    content = field_room.copy_photographs(folder)
    poses = store_turned(folder, content, orientations)
    cameras = [PORTRAIT if orientation > 4 else LANDSCAPE for orientation in orientations]
    return write_colmap_text(folder, content, camera=cameras, poses=poses), poses


def degrees_from_z(scene: Scene) -> tuple[float, float]:
    up = up_of_scene(scene)
    return float(np.degrees(np.arccos(np.clip(up.direction[2], -1, 1)))), up.confidence


@pytest.mark.parametrize("orientation", TURNS)
def test_turning_is_what_pillow_does_and_its_inverse_undoes_it(orientation, tmp_path):
    pixels = photograph(0)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for suffix in ("png", "webp"):
        path = tmp_path / f"stored.{suffix}"
        Image.fromarray(pixels).save(path, exif=exif, lossless=True)
        assert picture_info(path) == ((32, 24), False, orientation)
        stored = read_rgba(path)[0]
        assert (stored == pixels).all()
        with Image.open(path) as picture:
            assert (turned(stored, orientation) == np.asarray(ImageOps.exif_transpose(picture))).all()
    assert (turned(turned(pixels, orientation), INVERSE[orientation]) == pixels).all()
    exif[0x0112] = 9
    Image.fromarray(pixels).save(tmp_path / "odd.jpg", exif=exif)
    assert picture_info(tmp_path / "odd.jpg")[2] == 1


@pytest.mark.parametrize("orientations", [(6,) * 8, MIXED])
def test_up_is_that_of_upright_pictures_and_poses_are_of_the_stored_pixels(orientations, field_room, tmp_path):
    folder, poses = turned_scene(field_room, tmp_path / "turned", orientations)
    scene = load_scene(folder)
    angle, confidence = degrees_from_z(scene)
    assert angle < 2
    assert confidence > 0.95
    views = scene.views
    assert views.orientations == orientations
    assert np.allclose(views.cameras.cam_from_world, poses, atol=1e-6)
    for row, orientation in enumerate(orientations):
        shape = (160, 120, 3) if orientation > 4 else (120, 160, 3)
        assert views.images[row].shape == shape
        assert views.cameras.Ks[row, :2, 2].tolist() == [shape[1] / 2, shape[0] / 2]


def test_upright_views_are_those_of_the_room(field_room, tmp_path):
    folder, _ = turned_scene(field_room, tmp_path / "turned", MIXED)
    views = upright_scene(load_scene(folder)).views
    plain = load_scene(field_room.room).views
    assert views.orientations is plain.orientations is None
    assert upright_views(plain) is plain
    assert np.allclose(views.cameras.cam_from_world, plain.cameras.cam_from_world, atol=1e-6)
    assert np.allclose(views.cameras.Ks, plain.cameras.Ks)
    assert all(np.abs(views.images[row].astype(int) - plain.images[row]).mean() < 4 for row in range(len(views)))
    assert np.array_equal(views.images[2:4][1], views.images[3])


class _Seen:
    """A teacher whose vectors are the color of a cell and how high in the picture it is; it keeps what it was shown."""

    table, mean, needs_images, cheap = None, None, True, True
    space = FeatureSpace(name="seen", channels=4)

    def __init__(self) -> None:
        self.pictures: dict[str, np.ndarray] = {}

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        picture = views.images[view]
        self.pictures[views.names[view]] = picture
        cells = picture[::4, ::4].astype(np.float32) / 255
        height = np.broadcast_to(np.linspace(0, 1, len(cells), dtype=np.float32)[:, None, None], (*cells.shape[:2], 1))
        affine = np.array([[0.25, 0, 0], [0, 0.25, 0]])
        features = np.concatenate((cells, height), axis=2)
        return FeatureMap(features=features, grid_from_image=affine, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {}


def fused(scene: Scene) -> tuple[np.ndarray, _Seen]:
    teacher = _Seen()
    return fuse(scene, teacher, FuseConfig(views=4)).features.features, teacher


def test_a_teacher_sees_upright_pictures_and_its_maps_lie_on_the_stored_pixels(field_room, tmp_path):
    folder, _ = turned_scene(field_room, tmp_path / "turned", MIXED)
    plain_folder = tmp_path / "plain"
    content = field_room.copy_photographs(plain_folder)
    for frame, orientation in zip(content["frames"], MIXED, strict=True):
        stored = (folder / frame["file_path"]).with_suffix(".jpg")
        pixels = np.asarray(ImageOps.exif_transpose(Image.open(stored)))
        Image.fromarray(pixels).save(plain_folder / frame["file_path"])
        assert pixels.shape == (120, 160, 3), orientation
    sideways = load_scene(folder, splat=field_room.splat)
    upright = load_scene(write_transforms(plain_folder, content), splat=field_room.splat)
    features, teacher = fused(sideways)
    expected, plain_teacher = fused(upright)
    for name, picture in plain_teacher.pictures.items():
        assert np.array_equal(picture, teacher.pictures[Path(name).with_suffix(".jpg").name])
    assert np.abs(features - expected).max() < 1e-3


@pytest.mark.parametrize("orientation", [2, 5])
def test_mirrored_photographs_are_named_and_teachers_see_them_as_people_do(orientation, field_room, tmp_path):
    folder, _ = turned_scene(field_room, tmp_path / "turned", (orientation,) * 8)
    with pytest.warns(SceneWarning, match="8 of 8 photographs are stored mirrored"):
        scene = load_scene(folder, splat=field_room.splat)
    assert degrees_from_z(replace(scene, gaussians=None))[0] < 2
    teacher = _Seen()
    upright(teacher).feature_map(scene.views, 0)
    stored = folder / "images" / "000.jpg"
    with Image.open(stored) as picture:
        assert np.array_equal(teacher.pictures["000.jpg"], np.asarray(ImageOps.exif_transpose(picture)))


def test_intrinsics_of_the_upright_picture_turn_the_pixels_of_a_file_that_is_stored_sideways(field_room, tmp_path):
    folder = tmp_path / "upright"
    content = field_room.copy_photographs(folder)
    store_turned(folder, content, (6, 8, 6, 8, 5, 7, 6, 1))
    mask = np.zeros((120, 160), np.uint8)
    mask[:, 80:] = 255
    (folder / "masks").mkdir()
    stored = turned(mask, INVERSE[6])
    # A mask may lie as the picture is stored, or upright, also at half the size.
    for name, pixels in (("0.png", stored), ("1.png", mask), ("2.png", stored[::2, ::2]), ("3.png", mask[::2, ::2])):
        Image.fromarray(pixels).save(folder / "masks" / name)
        content["frames"][int(name[0])]["mask_path"] = f"masks/{name}"
    scene = load_scene(write_transforms(folder, content))
    views, plain = scene.views, load_scene(field_room.room).views
    assert views.orientations is None
    assert np.array_equal(views.cameras.cam_from_world, plain.cameras.cam_from_world)
    assert all(np.abs(views.images[row].astype(int) - plain.images[row]).mean() < 4 for row in range(len(views)))
    assert all(np.array_equal(views.masks[row], mask > 0) for row in range(4))
    stated = load_scene(folder, options=SceneConfig(intrinsics=(112.0, 112.0, 80.0, 60.0))).views
    assert np.allclose(stated.cameras.Ks, views.cameras.Ks)
    # Without a stated size the principal point tells.
    content.pop("w")
    content.pop("h")
    guessed = load_scene(write_transforms(folder, content)).views
    assert np.array_equal(guessed.cameras.Ks, views.cameras.Ks)


def test_intrinsics_of_the_stored_pixels_leave_them_as_they_are(field_room, tmp_path):
    folder = tmp_path / "stored"
    content = field_room.copy_photographs(folder)
    poses = store_turned(folder, content, (6,) * 8)
    content.update(w=120, h=160, cx=60.0, cy=80.0)
    for frame, pose in zip(content["frames"], poses, strict=True):
        frame["transform_matrix"] = (np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])).tolist()
        assert np.allclose(cam_from_world(frame), pose)
    scene = load_scene(write_transforms(folder, content))
    assert scene.views.orientations == (6,) * 8
    assert degrees_from_z(scene)[0] < 2


def test_files_of_regions_lie_as_photographs_are_stored(field_room, tmp_path):
    folder, _ = turned_scene(field_room, tmp_path / "turned", MIXED)
    labels = np.zeros((120, 160), np.uint8)
    labels[:40, :100] = 7
    (folder / "labels").mkdir()
    for row, orientation in enumerate(MIXED):
        Image.fromarray(turned(labels, INVERSE[orientation])).save(folder / f"labels/{row:03d}.png")
    scene = load_scene(folder)
    masks = FileMasks(scene, "labels")
    shown = upright_views(scene.views, unmirror=True)
    for row in range(len(MIXED)):
        assert np.array_equal(masks.labels(shown, row), labels)
        assert np.array_equal(turned(masks.labels(scene.views, row), MIXED[row]), labels)


def test_views_for_people_and_models_are_upright(field_room, tmp_path):
    folder, _ = turned_scene(field_room, tmp_path / "turned", MIXED)
    scene = load_scene(folder, splat=field_room.splat)
    assert scene.gaussians is not None
    features = fuse(scene, PaletteTeacher(), FuseConfig(views=2)).features
    save_features(tmp_path / "features", scene, features)
    loaded = load_features(tmp_path / "features")
    # What is stored are the poses of the photographs as they are stored, and how these are turned.
    assert loaded.views.orientations == MIXED
    assert np.array_equal(loaded.views.cameras.cam_from_world, scene.views.cameras.cam_from_world)
    photographed = with_photographs(loaded, load_scene(folder))
    config = ViewsConfig(method="uniform", count=3)
    views = choose_views(photographed, [], config)
    pictures, _ = view_pictures(photographed, views)
    for chosen, picture in zip(views.chosen, pictures, strict=True):
        with Image.open(folder / "images" / chosen.name) as stored:
            assert np.array_equal(picture, np.asarray(ImageOps.exif_transpose(stored)))
    rendered, _ = view_pictures(loaded, choose_views(loaded, [], config))
    assert all(np.abs(each.astype(int) - picture).mean() < 25 for each, picture in zip(rendered, pictures, strict=True))


@given(st.floats(-np.pi, np.pi), st.integers(0, 9))
@settings(max_examples=20)
def test_walls_of_an_upright_splat_lie_along_its_axes_however_it_stood(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    normals = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)[rng.integers(0, 3, 500)]
    normals += rng.normal(0, 0.2, normals.shape).astype(np.float32)
    room = random_gaussians(500)
    room = replace(room, quats=quats_from_normals(normals), scales=np.tile(np.float32([0.05, 0.05, 0.001]), (500, 1)))
    rotated = turn(room, Rotation.from_euler("z", angle).as_matrix(), 1.0)
    off = wall_angle(rotated, np.eye(3)) - wall_angle(room, np.eye(3)) - angle
    assert abs((off + np.pi / 4) % (np.pi / 2) - np.pi / 4) < 1e-4
    assert abs(wall_angle(room, np.eye(3))) < 0.05
    assert abs(wall_angle(upright_gaussians(rotated, None), np.eye(3))) < 1e-4
    lying = turn(rotated, Rotation.from_euler("x", 90, degrees=True).as_matrix(), 1.0)
    assert abs(wall_angle(upright_gaussians(lying, np.array([0.0, -1.0, 0.0])), np.eye(3))) < 1e-4


def test_a_splat_without_walls_is_not_turned() -> None:
    one = random_gaussians(4000)
    assert wall_angle(one, np.eye(3)) == 0.0
    assert wall_angle(one.select(np.zeros(0, int)), np.eye(3)) == 0.0


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.3, -0.5, 0.8)])
def test_an_upright_splat_has_its_floor_at_zero_whichever_way_up_was(up: tuple[float, float, float] | None) -> None:
    one = random_gaussians(400, center=(0, 0, 0))
    axis = np.array((0.0, 0.0, 1.0) if up is None else up) / np.linalg.norm((0.0, 0.0, 1.0) if up is None else up)
    standing = upright_gaussians(one, None if up is None else np.array(up))
    heights = one.means.astype(np.float64) @ axis
    np.testing.assert_allclose(standing.means[:, 2], heights - np.quantile(heights, 0.01), atol=1e-4)
    distances = np.linalg.norm(one.means[:, None] - one.means[None], axis=-1)
    np.testing.assert_allclose(
        np.linalg.norm(standing.means[:, None] - standing.means[None], axis=-1), distances, atol=1e-3
    )
    part = upright_gaussians(one.select(np.arange(7)), None if up is None else np.array(up), floor_of=one.means)
    # A part is turned by its own walls.
    np.testing.assert_allclose(part.means[:, 2], standing.means[:7, 2], atol=1e-5)
    apart = np.linalg.norm(part.means[:, None] - part.means[None], axis=-1)
    np.testing.assert_allclose(apart, distances[:7, :7], atol=1e-3)
    before, after = (
        covariances(torch.from_numpy(each.quats), torch.from_numpy(each.scales)).numpy() for each in (one, standing)
    )
    lengths = np.einsum("i,nij,j->n", axis, before, axis)
    np.testing.assert_allclose(after[:, 2, 2], lengths, rtol=1e-3, atol=1e-6)


def test_of_flat_land_the_ground_says_what_is_up_and_not_the_side_on_which_houses_stand():
    rng = np.random.default_rng(0)
    ground = rng.uniform([0, 0, 0], [10, 10, 0.01], (1500, 3))
    fronts = rng.uniform([0.7, 0, 0], [1.5, 10, 2], (8500, 3))
    normals = np.repeat(np.eye(3)[[2, 0]], [1500, 8500], axis=0)
    surfaces = Surfaces(np.concatenate([ground, fronts]), normals, np.ones(10_000), 0.0)
    np.testing.assert_allclose(estimate_up(surfaces, None).direction, [0, 0, 1], atol=0.02)
