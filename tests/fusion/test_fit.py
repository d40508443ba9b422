"""Splats against the photographs of their scenes: wrong frames are found, and splats that fit are left alone."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from field_scenes import FieldRoom, write_transforms
from scipy.spatial.transform import Rotation
from splats import random_gaussians

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.splats.files import load_splat, save_splat
from gsencoder.fusion import fit
from gsencoder.fusion.fit import (
    DATAPARSER,
    FITS,
    SmallViews,
    SplatFrame,
    agreement,
    frames_of_files,
    identity_frame,
    moved,
    usual_frames,
    with_fitting_splat,
)
from gsencoder.geometry import colors_from_sh
from gsencoder.types import Gaussians, Scene

TURN = Rotation.from_euler("xyz", (0.2, -0.4, 0.6)).as_matrix()
NERFSTUDIO = SplatFrame(name="s", rotation=TURN, shift=np.array([0.3, -0.2, 1.1]), scale=1 / 0.37)
ORIGIN = np.zeros(3)


def inverse(frame: SplatFrame) -> SplatFrame:
    """From the cameras' world to that of the splat."""
    rotation, scale = frame.rotation.T, 1 / frame.scale
    return replace(frame, rotation=rotation, scale=scale, shift=-scale * rotation @ frame.shift)


FRAMES = [list(usual_frames())[number] for number in (7, 20, 30)]


@pytest.fixture(autouse=True)
def fewer_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of the room's Gaussians are rendered, in three of the usual frames: a search looks at ten pictures."""
    monkeypatch.setattr(fit, "MAX_GAUSSIANS", 8000)
    monkeypatch.setattr(fit, "usual_frames", lambda: iter(FRAMES))


@pytest.fixture(scope="module")
def scene(field_room: FieldRoom) -> Scene:
    return load_scene(field_room.room, splat=field_room.splat)


def gaussians_of(scene: Scene) -> Gaussians:
    return scene.gaussians


def checked(scene: Scene, splat: Path, **options: bool) -> tuple[Scene, list[str]]:
    """The scene after the check, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = with_fitting_splat(scene, str(splat), SceneConfig(**options))
    return result, [str(each.message) for each in caught if issubclass(each.category, SceneWarning)]


def capture(field_room: FieldRoom, folder: Path, frame: SplatFrame, **content: object) -> tuple[Scene, Path]:
    """The room's photographs, with a splat that `frame` moves into their world."""
    folder.mkdir(parents=True, exist_ok=True)
    write_transforms(folder, {**field_room.copy_photographs(folder), **content})
    splat = folder / "splat.ply"
    save_splat(splat, moved(load_splat(field_room.splat), inverse(frame), ORIGIN))
    return load_scene(folder, splat=splat), splat


def test_a_splat_in_the_world_of_its_cameras_is_left_alone(scene: Scene, field_room: FieldRoom) -> None:
    result, messages = checked(scene, field_room.splat)
    assert result is scene
    assert messages == []
    # Without a splat that is given there is nothing to compare.
    assert checked(scene, Path())[0] is scene


def test_moving_the_cameras_shows_what_moving_the_splat_does(scene: Scene) -> None:
    views, splat, origin = SmallViews(scene.views), gaussians_of(scene), np.array([1000.0, -2000.0, 0.0])
    for frame in (NERFSTUDIO, replace(NERFSTUDIO, intrinsics_factor=0.5)):
        there = moved(splat, inverse(frame), ORIGIN)
        turned = replace(frame, intrinsics_factor=1.0)
        expected = agreement(moved(there, turned, ORIGIN), views, replace(identity_frame(), name="K"), ORIGIN)
        if frame.intrinsics_factor == 1:
            assert agreement(there, views, frame, ORIGIN).correlation == pytest.approx(expected.correlation, abs=1e-3)
            assert expected.correlation > FITS
        else:
            assert agreement(there, views, frame, ORIGIN).correlation < FITS
    # Positions that count from an origin, as far from the world's as cities are.
    world = replace(NERFSTUDIO, shift=origin - NERFSTUDIO.scale * NERFSTUDIO.rotation @ origin + NERFSTUDIO.shift)
    there = moved(splat, inverse(world), origin)
    assert agreement(there, views, world, origin).correlation > FITS


@pytest.mark.parametrize("degree", [0, 3])
def test_a_moved_splat_has_the_colors_that_it_had_from_there(degree: int) -> None:
    splat = random_gaussians(20, degree=degree, center=(0, 0, 0))
    splat = replace(splat, sh=np.float32(0.1) * splat.sh)
    placed = moved(splat, NERFSTUDIO, ORIGIN)
    eye = np.array([4.0, 1.0, -2.0])
    seen_from = NERFSTUDIO.scale * NERFSTUDIO.rotation @ eye + NERFSTUDIO.shift

    def colors(each: Gaussians, center: np.ndarray) -> np.ndarray:
        values = (torch.as_tensor(value) for value in (each.sh, each.means, center.astype(np.float32)))
        return colors_from_sh(*values).numpy()

    np.testing.assert_allclose(colors(placed, seen_from), colors(splat, eye), atol=2e-6)
    back = moved(placed, inverse(NERFSTUDIO), ORIGIN)
    for name in ("means", "scales", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(splat, name), atol=1e-5)
    assert np.abs((back.quats * splat.quats).sum(axis=1)) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("number", [0, 2])
def test_a_usual_frame_is_refused_and_its_advice_mends_it(scene, field_room, tmp_path, number):
    frame = FRAMES[number]
    if frame.intrinsics_factor != 1:
        content = field_room.transforms()
        keys = {key: content[key] / frame.intrinsics_factor for key in ("fl_x", "fl_y", "cx", "cy")}
        other, splat = capture(field_room, tmp_path, identity_frame(), **keys)
    else:
        other, splat = capture(field_room, tmp_path, frame)
    with pytest.raises(InputError, match="the splat does not fit the photographs") as caught:
        checked(other, splat)
    message = str(caught.value)
    assert frame.name in message
    assert "data.check_fit=false" in message
    if frame.intrinsics_factor == 1:
        text = message.split("save ")[1].split(" as ")[0]
        (tmp_path / DATAPARSER).write_text(text)
        result, messages = checked(other, splat)
        assert len(messages) == 1
        np.testing.assert_allclose(gaussians_of(result).means, gaussians_of(scene).means, atol=1e-5)
        # What the file says is no reason to move a splat that fits.
        assert checked(scene, field_room.splat)[0] is scene
    else:
        assert "data.intrinsics=[112,112,80,60]" in message
    other_result, messages = checked(other, splat, check_fit=False) if frame.intrinsics_factor != 1 else (other, [""])
    assert other_result is other
    assert len(messages) == 1


def test_a_splat_in_the_world_of_nerfstudio_is_moved_as_its_file_says(scene, field_room, tmp_path):
    """nerfstudio's transform leads from the world before `applied_transform`, which that of the cameras is after."""
    turn = SplatFrame(name="t", rotation=np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), shift=np.zeros(3))
    applied = (turn.rotation[:, [0, 1, 2, 2]] * [1, 1, 1, 0]).tolist()
    rotation, shift = turn.rotation @ NERFSTUDIO.rotation, turn.rotation @ NERFSTUDIO.shift
    frame = replace(NERFSTUDIO, rotation=rotation, shift=shift)
    other, splat = capture(field_room, tmp_path, frame, applied_transform=applied)
    (tmp_path / DATAPARSER).write_text(json.dumps(NERFSTUDIO.as_dataparser()))
    result, messages = checked(other, splat)
    assert [DATAPARSER in message and "is moved" in message for message in messages] == [True]
    for name in ("means", "scales"):
        np.testing.assert_allclose(
            getattr(gaussians_of(result), name), getattr(gaussians_of(scene), name), rtol=1e-4, atol=1e-5
        )
    # Where nothing states it, only the user knows.
    (tmp_path / DATAPARSER).unlink()
    result, messages = checked(other, splat)
    assert result is other
    assert ["no usual frame fits better" in message for message in messages] == [True]


def test_files_that_state_no_frame_are_refused_by_name(tmp_path: Path) -> None:
    for content, match in (
        ({"transform": np.eye(4)[:3].tolist()}, "positive scale"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": -1}, "positive scale"),
        ([1], "positive scale"),
        ({"transform": [[1]], "scale": 1}, "three rows of four numbers"),
        ({"transform": (2 * np.eye(4)[:3]).tolist(), "scale": 1}, "uniform scale"),
    ):
        (tmp_path / DATAPARSER).write_text(json.dumps(content))
        with pytest.raises(InputError, match=match) as caught:
            frames_of_files(None, tmp_path / "splat.ply")
        assert DATAPARSER in str(caught.value)


def test_what_cannot_be_told_is_a_warning(scene: Scene, field_room: FieldRoom) -> None:
    # Another exposure is no other world.
    dark = replace(scene, gaussians=replace(gaussians_of(scene), sh=gaussians_of(scene).sh * np.float32(0.3) - 0.6))
    assert checked(dark, field_room.splat) == (dark, [])
    grey = tuple(np.full_like(image, 128) for image in scene.views.images)
    plain = replace(scene, views=replace(scene.views, images=grey))
    far = replace(gaussians_of(scene), means=gaussians_of(scene).means + np.float32(500))
    for other in (plain, replace(scene, gaussians=far)):
        result, messages = checked(other, field_room.splat)
        assert result is other
        assert ["they show too little of it to tell" in message for message in messages] == [True]
    masked = replace(scene.views, masks=tuple(np.zeros(image.shape[:2], bool) for image in grey))
    assert checked(replace(scene, views=masked), field_room.splat)[1] != []
