"""Random changes: everything about a splat turns together, and nothing changes that should not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError
from gsencoder.geometry import colors_from_sh, covariances
from gsencoder.train.samples import Augmentation, augment, turn
from gsencoder.types import SH_C0, Gaussians

NOTHING = Augmentation(turn=0.0, tilt=0.0, mirror=0.0, scale=0.0, jitter=0.0, drop=0.0, light=0.0, tint=0.0, noise=0.0)


def splat(count: int = 30, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(0.01, 0.3, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def orthonormal(seed: int, mirrored: bool) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    return q @ np.diag([1, 1, -1]) if mirrored else q


def seen_colors(splat: Gaussians, center: np.ndarray) -> torch.Tensor:
    return colors_from_sh(torch.from_numpy(splat.sh), torch.from_numpy(splat.means), torch.from_numpy(center).float())


@given(st.integers(0, 1000), st.booleans(), st.floats(0.2, 5), st.integers(0, 3))
def test_a_turned_splat_looks_from_a_turned_place_as_it_did(
    seed: int, mirrored: bool, scale: float, degree: int
) -> None:
    one, matrix = splat(degree=degree), orthonormal(seed, mirrored)
    turned = turn(one, matrix, scale)
    center = np.array([2.0, -1.0, 3.0])
    torch.testing.assert_close(
        seen_colors(turned, scale * matrix @ center), seen_colors(one, center), rtol=1e-3, atol=1e-3
    )
    before = covariances(torch.from_numpy(one.quats), torch.from_numpy(one.scales)).double().numpy()
    after = covariances(torch.from_numpy(turned.quats), torch.from_numpy(turned.scales)).double().numpy()
    np.testing.assert_allclose(after, scale**2 * matrix @ before @ matrix.T, rtol=1e-3, atol=1e-4 * scale**2)
    np.testing.assert_allclose(turned.means, scale * one.means @ matrix.T, rtol=1e-4, atol=1e-4)


@given(st.integers(0, 1000))
def test_quaternions_are_turned_as_scipy_multiplies_rotations(seed: int) -> None:
    one, matrix = splat(), orthonormal(seed, mirrored=False)
    each = Rotation.from_quat(one.quats.astype(np.float64), scalar_first=True)
    expected = (Rotation.from_matrix(matrix) * each).as_quat(scalar_first=True)
    np.testing.assert_allclose(turn(one, matrix).quats, expected, atol=1e-6)


@given(st.integers(0, 100), st.booleans())
def test_turning_back_gives_the_splat_again(seed: int, mirrored: bool) -> None:
    one, matrix = splat(), orthonormal(seed, mirrored)
    back = turn(turn(one, matrix, 2.0), matrix.T, 0.5)
    np.testing.assert_allclose(back.means, one.means, atol=1e-5)
    np.testing.assert_allclose(back.sh, one.sh, atol=1e-4)
    np.testing.assert_allclose(np.abs((back.quats * one.quats).sum(axis=1)), 1, atol=1e-5)


def test_with_every_amount_at_zero_nothing_changes_but_the_place_on_the_grid() -> None:
    one = splat(degree=1)
    same = augment(one, np.random.default_rng(0), NOTHING, voxel=0.02)
    np.testing.assert_allclose(same.sh, one.sh, atol=1e-6)
    np.testing.assert_allclose(same.scales, one.scales)
    shift = same.means - one.means
    assert (np.abs(shift - shift[0]) < 1e-6).all()
    assert (shift >= -1e-6).all()
    assert (shift <= 0.02 + 1e-6).all()


def test_up_stays_up_but_for_the_tilt() -> None:
    up = np.array([0.0, 0.6, 0.8])
    one = replace(splat(), means=np.stack([(i * up).astype(np.float32) for i in range(30)]))
    turned = augment(one, np.random.default_rng(3), replace(NOTHING, turn=180.0, mirror=1.0), voxel=0.0, up=up)
    np.testing.assert_allclose(turned.means, one.means, atol=1e-4)


def test_the_same_random_numbers_give_the_same_splat() -> None:
    one, config = splat(), Augmentation()
    first, second = (augment(one, np.random.default_rng(5), config, voxel=0.1) for _ in range(2))
    for name in ("means", "quats", "scales", "sh"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


def test_light_changes_brightness_and_black_stays_near_black() -> None:
    black = replace(splat(), sh=np.full((30, 1, 3), -0.5 / SH_C0, np.float32))
    lit = augment(black, np.random.default_rng(0), replace(NOTHING, light=0.9), voxel=0.1)
    np.testing.assert_allclose(lit.sh * SH_C0 + 0.5, 0, atol=1e-6)


@pytest.mark.parametrize("matrix", [np.eye(3) * 2, np.zeros((3, 3)), np.array([[1.0, 1, 0], [0, 1, 0], [0, 0, 1]])])
def test_what_is_no_rotation_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError, match="orthonormal"):
        turn(splat(), matrix)
