import numpy as np
import pytest
from scene_files import some_gaussians

from gsencoder.data.orbits import orbit_cameras, robust_ball
from gsencoder.types import Gaussians


def looks(gaussians: Gaussians, **options: object) -> tuple[np.ndarray, np.ndarray]:
    """Where each orbit camera sees the center, in pixels, and at what depth."""
    cameras = orbit_cameras(gaussians, **options)  # type: ignore[arg-type]
    center, _ = robust_ball(gaussians)
    pose = cameras.cam_from_world.astype(float)
    seen = pose[:, :3, :3] @ center + pose[:, :3, 3]
    pixel = np.einsum("vij,vj->vi", cameras.Ks.astype(float), seen)
    return pixel[:, :2] / pixel[:, 2:], seen[:, 2]


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.0, 1.0]), np.array([0.0, 3.0, 0.0])])
def test_orbit_cameras_see_the_center_from_one_distance(rng, up):
    ball = rng.normal(size=(4000, 3))
    ball *= (rng.random((4000, 1)) ** (1 / 3)) / np.linalg.norm(ball, axis=1, keepdims=True)
    gaussians = some_gaussians(ball + np.array([4, 5, 6]))
    pixel, depth = looks(gaussians, count=24, width=640, height=480, up=up)
    assert np.abs(pixel - [320, 240]).max() < 1e-2
    _, radius = robust_ball(gaussians)
    assert 1.0 < radius < 1.3
    half = np.arctan(240 / (320 / np.tan(np.radians(30))))
    assert np.abs(depth - radius / np.sin(half)).max() < 1e-5
    cameras = orbit_cameras(gaussians, up=up)
    for view in range(0, 24, 5):
        p = cameras.cam_from_world[view].astype(float)
        q = (gaussians.means @ p[:3, :3].T + p[:3, 3]) @ cameras.Ks[view].T
        assert ((q[:, :2] / q[:, 2:] >= 0) & (q[:, :2] / q[:, 2:] <= (640, 480))).all()
    if up is not None:
        elevation = (cameras.centers - [4, 5, 6]) @ (up / np.linalg.norm(up)) / depth
        assert -0.3 < elevation.min() < 0
        assert 0.8 < elevation.max() < 0.9
        # Up in the world is up in the picture, where y points down.
        assert (cameras.cam_from_world[:, 1, :3] @ up < 0).all()


def test_floaters_and_transparent_gaussians_do_not_move_the_orbit(rng):
    ball = rng.normal(size=(1000, 3))
    clean = robust_ball(some_gaussians(ball))
    far = np.concatenate([ball, rng.normal(size=(30, 3)) * 1e6, 50 + rng.normal(size=(5000, 3))])
    opacities = np.concatenate([np.ones(1030), np.full(5000, 1e-4)])
    dirty = robust_ball(some_gaussians(far, opacities))
    assert np.abs(clean[0] - dirty[0]).max() < 0.1
    assert 0.9 * clean[1] < dirty[1] < 1.5 * clean[1]
    # Half of the weight in floaters is bounded by the median.
    many = np.concatenate([ball, rng.normal(size=(400, 3)) * 1e6])
    assert robust_ball(some_gaussians(many))[1] < 3 * clean[1]


@pytest.mark.parametrize("count", [1, 500])
@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_one_gaussian_and_coincident_ones_have_orbits(count, opacity):
    gaussians = some_gaussians(np.tile([[1.0, 2.0, 3.0]], (count, 1)), np.full(count, opacity), scale=0.2)
    pixel, depth = looks(gaussians, count=1, width=100, height=100)
    assert np.abs(pixel - 50).max() < 1e-2
    assert depth[0] == pytest.approx(0.6 / np.sin(np.radians(30)), rel=1e-5)
    tiny = some_gaussians(np.zeros((count, 3)), scale=1e-6)
    assert looks(tiny)[1].min() > 0.04
