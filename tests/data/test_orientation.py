"""Photographs that are stored sideways, with an EXIF orientation that makes them upright."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from field_scenes import FieldRoom, cam_from_world, store_turned, write_colmap_text, write_transforms
from PIL import Image, ImageOps
from scene_files import photograph

from gsencoder.core.errors import SceneWarning
from gsencoder.data.readers.images import picture_info, read_rgba
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.up import up_of_scene
from gsencoder.fusion.checkpoint import upright
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.teachers.labels import PaletteTeacher
from gsencoder.teachers.masks import FileMasks
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views
from gsencoder.types.orientation import INVERSE, TURNS, turned, upright_scene, upright_views

PORTRAIT, LANDSCAPE = "PINHOLE 120 160 112 112 60 80", "PINHOLE 160 120 112 112 80 60"
MIXED = (6, 1, 8, 3, 6, 8, 1, 3)


def camera_of(orientation: int) -> str:
    return PORTRAIT if orientation > 4 else LANDSCAPE


def turned_scene(field_room: FieldRoom, folder: Path, orientations: tuple[int, ...]) -> tuple[Path, list[np.ndarray]]:
    """The room as COLMAP registers photographs that are stored turned, and the poses of their stored pixels."""
    content = field_room.copy_photographs(folder)
    poses = store_turned(folder, content, orientations)
    cameras = [camera_of(orientation) for orientation in orientations]
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
