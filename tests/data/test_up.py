"""Up is estimated from cameras and surfaces, and turns with the scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import box_views, write_box

from gsencoder.core.errors import InputError
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.synthetic.room import make_room
from gsencoder.data.up import estimate_up, surfaces_of_gaussians, up_of_cameras, up_of_scene, with_up
from gsencoder.types import Cameras, Gaussians, Scene

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def room() -> Scene:
    return replace(make_room(1, objects=6, views=10, width=96, height=72), up=None)


def turned_cameras(cameras: Cameras, rotation: np.ndarray) -> Cameras:
    poses = cameras.cam_from_world.astype(np.float64)
    poses[:, :3, :3] = poses[:, :3, :3] @ rotation.T
    return replace(cameras, cam_from_world=poses.astype(np.float32))


def turned(scene: Scene, rotation: np.ndarray) -> Scene:
    gaussians, views = scene.gaussians, scene.views
    if gaussians is not None:
        quats = Rotation.from_matrix(rotation) * Rotation.from_quat(gaussians.quats, scalar_first=True)
        gaussians = replace(
            gaussians,
            means=(gaussians.means @ rotation.T).astype(np.float32),
            quats=quats.as_quat(scalar_first=True).astype(np.float32),
        )
    if views is not None:
        views = replace(views, cameras=turned_cameras(views.cameras, rotation))
    return replace(scene, gaussians=gaussians, views=views)


def degrees(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1, 1))))


@pytest.mark.parametrize("number", range(4))
def test_up_of_a_turned_room_turns_with_it(room: Scene, number: int) -> None:
    rotation = Rotation.random(random_state=number).as_matrix()
    other = turned(room, rotation)
    assert other.views is not None
    for scene, source in (
        (other, "cameras and surfaces"),
        (replace(other, gaussians=None), "cameras and surfaces"),
        (replace(other, gaussians=None, views=replace(other.views, depths=None)), "cameras"),
        (replace(other, views=None), "surfaces"),
    ):
        up = up_of_scene(scene)
        assert up is not None
        assert up.source == source
        assert degrees(up.direction, rotation @ UP) < 1.0
        assert up.confidence > 0.4


def test_cameras_that_are_tilted_leave_the_last_degrees_to_the_surfaces(room: Scene) -> None:
    """A photographer who rolls the camera by 10° on average."""
    assert room.views is not None
    roll = Rotation.from_rotvec(np.deg2rad(10) * np.array([0, 0, 1.0])).as_matrix()
    poses = room.views.cameras.cam_from_world.astype(np.float64)
    poses[:, :3] = roll @ poses[:, :3]
    rolled = replace(room.views, cameras=replace(room.views.cameras, cam_from_world=poses.astype(np.float32)))
    up = up_of_scene(replace(room, views=rolled))
    assert up is not None
    assert degrees(up.direction, UP) < 1.0


def test_a_camera_that_moves_ahead_has_the_mean_of_its_own_up() -> None:
    poses = np.tile(np.eye(4, dtype=np.float32), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5)
    ahead = Cameras(
        cam_from_world=poses,
        Ks=np.tile(np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1]], np.float32), (5, 1, 1)),
        widths=np.full(5, 64, np.int32),
        heights=np.full(5, 48, np.int32),
    )
    np.testing.assert_allclose(up_of_cameras(ahead), (0, -1, 0), atol=1e-6)


def test_what_is_stated_is_not_estimated(room: Scene) -> None:
    stated = replace(room, up=np.array([0.0, 1.0, 0.0]))
    scene, up = with_up(stated)
    assert scene is stated
    assert up is not None
    assert (up.source, up.describe()) == ("stated", "(0.000, 1.000, 0.000), stated")


def test_a_splat_without_directions_has_no_up() -> None:
    """Flat Gaussians that face everywhere, and round ones."""
    made = np.random.default_rng(0)
    count = 3000
    ball = Gaussians(
        means=made.normal(size=(count, 3)).astype(np.float32),
        quats=Rotation.random(count, random_state=0).as_quat(scalar_first=True).astype(np.float32),
        scales=np.tile(np.array([0.1, 0.1, 0.001], np.float32), (count, 1)),
        opacities=np.full(count, 0.9, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )
    scene, up = with_up(Scene(name="ball", gaussians=ball))
    assert (scene.up, up) == (None, None)
    balls = replace(ball, scales=np.full((count, 3), 0.1, np.float32))
    assert len(surfaces_of_gaussians(balls).areas) == 0
    assert up_of_scene(Scene(name="balls", gaussians=balls)) is None
    with pytest.raises(InputError, match="neither cameras nor flat surfaces"):
        estimate_up(None, None)


def test_up_can_be_stated_when_a_scene_is_read(tmp_path: Path) -> None:
    write_box(tmp_path / "box", box_views())
    scene = load_scene(tmp_path / "box", options=SceneConfig(up=(0.0, -3.0, 4.0)))
    assert scene.up is not None
    np.testing.assert_allclose(scene.up, (0, -0.6, 0.8))
    for wrong in ((0.0, 0.0, 0.0), (float("inf"), 0.0, 0.0)):
        with pytest.raises(InputError, match="up: expected three finite numbers"):
            SceneConfig(up=wrong)
