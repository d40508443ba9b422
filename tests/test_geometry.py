"""Laws of rotations, covariances, projection and spherical harmonics."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splats import random_cameras

from gsencoder.geometry import (
    colors_from_sh,
    invert_rigid,
    normalize_quats,
    project,
    project_points,
    rotmats_from_quats,
    sh_basis,
    transform,
    unproject_points,
)
from gsencoder.types import scene as numpy_cameras


def random_quats(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(n, 4)))


def test_rotation_matrices_agree_with_scipy():
    quats = random_quats(50)
    expected = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotmats_from_quats(quats).numpy(), expected, atol=1e-12)
    torch.testing.assert_close(rotmats_from_quats(quats), rotmats_from_quats(-quats))


def test_normalising_a_zero_quaternion_has_a_finite_value_and_gradient():
    quats = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    normalize_quats(quats).sum().backward()
    assert torch.isfinite(quats.grad).all()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_pinhole_and_poses_of_tensors_are_those_of_arrays(kind):
    """The two stand apart because programs without torch project, too."""
    eps = float(np.finfo(kind).eps)
    cameras, points = random_cameras(), (3 * np.random.default_rng(0).normal(size=(40, 3))).astype(kind)
    for view in range(len(cameras)):
        pose, K = cameras.cam_from_world[view].astype(kind), cameras.Ks[view].astype(kind)
        local = numpy_cameras.transform(pose, points)
        np.testing.assert_allclose(transform(*map(torch.from_numpy, (pose, points))).numpy(), local, atol=50 * eps)
        inverse = invert_rigid(torch.from_numpy(pose))
        np.testing.assert_allclose(inverse.numpy(), numpy_cameras.invert_rigid(pose), atol=50 * eps)
        tensors = torch.from_numpy(np.ascontiguousarray(local)), torch.from_numpy(K)
        for min_depth in (None, 0.7):
            pixels = numpy_cameras.project_points(local, K, min_depth=min_depth)
            projection = project_points(*tensors, min_depth=min_depth)
            np.testing.assert_allclose(projection.numpy(), pixels, rtol=10 * eps, atol=1e4 * eps)
        back = unproject_points(torch.from_numpy(pixels.copy()), tensors[0][:, 2], tensors[1])
        again = numpy_cameras.unproject_points(pixels, local[:, 2], K)
        np.testing.assert_allclose(back.numpy(), again, rtol=10 * eps, atol=50 * eps)


def test_projection_passes_gradcheck():
    torch.manual_seed(0)
    K = torch.tensor([[50.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    inputs = [
        torch.tensor([[0.1, 0.2, 2.0], [-0.5, 0.1, 3.0]], dtype=torch.float64, requires_grad=True),
        random_quats(2).requires_grad_(),
        torch.rand(2, 3, dtype=torch.float64).add(0.1).requires_grad_(),
    ]

    def outputs(means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor) -> tuple[torch.Tensor, ...]:
        o = torch.full((2,), 0.7, dtype=torch.float64)
        return project(means, quats, scales, o, torch.eye(4, dtype=torch.float64), K, 64, 48)[:3]

    assert torch.autograd.gradcheck(outputs, inputs)


def test_spherical_harmonics_are_orthonormal_on_the_sphere():
    """Against quadrature: Gauss–Legendre in z, uniform in azimuth, exact for degree 6."""
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * math.pi / 16
    ring = np.sqrt(1 - z**2)
    directions = np.stack(
        (np.outer(ring, np.cos(phi)), np.outer(ring, np.sin(phi)), np.outer(z, np.ones(16))), axis=-1
    ).reshape(-1, 3)
    basis = sh_basis(torch.from_numpy(directions), 3)
    weights = torch.from_numpy(np.repeat(weight, 16) * 2 * math.pi / 16)
    torch.testing.assert_close(
        basis.T @ (weights[:, None] * basis), torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0
    )


def test_a_gaussian_at_the_camera_center_has_a_finite_color():
    sh = torch.randn(1, 16, 3)
    assert torch.isfinite(colors_from_sh(sh, torch.zeros(1, 3), torch.zeros(3))).all()


def test_a_color_depends_on_the_direction_from_the_camera_and_not_on_the_distance():
    rng = np.random.default_rng(0)
    sh, away, center = rng.normal(size=(20, 16, 3)), rng.normal(size=(20, 3)), np.array([3.0, -1.0, 2.0])
    basis = sh_basis(torch.from_numpy(away / np.linalg.norm(away, axis=1, keepdims=True)), 3).numpy()
    expected = np.maximum(np.einsum("nk,nkc->nc", basis, sh) + 0.5, 0)
    assert (expected == 0).any()
    for distance in (0.01, 1.0, 1000.0):
        colors = colors_from_sh(*map(torch.from_numpy, (sh, center + distance * away, center)))
        np.testing.assert_allclose(colors.numpy(), expected, atol=1e-9)


def test_the_value_of_each_harmonic_in_simple_directions():
    """Signs and order of the INRIA files: degree 1 is (−y, z, −x), degree 2 begins with xy."""
    x, y, z = torch.eye(3, dtype=torch.float64)
    c0, c1 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi))
    basis = sh_basis(torch.stack([x, y, z]), 1)
    torch.testing.assert_close(
        basis, torch.tensor([[c0, 0, 0, -c1], [c0, -c1, 0, 0], [c0, 0, c1, 0]], dtype=torch.float64)
    )
    diagonal = sh_basis(torch.stack([(x + y), (y + z), (x + z)]) / math.sqrt(2), 3)
    assert (diagonal[0, [4, 9, 15]].sign() == torch.tensor([1, -1, 1])).all()
    assert (diagonal[1, [5, 6, 11, 12]].sign() == torch.tensor([-1, 1, -1, -1])).all()
    assert (diagonal[2, [7, 8, 13, 14]].sign() == torch.tensor([-1, 1, -1, 1])).all()
    for degree in range(4):
        assert sh_basis(x[None], degree).shape == (1, (degree + 1) ** 2)
        torch.testing.assert_close(
            sh_basis(diagonal[:, :3], degree), sh_basis(diagonal[:, :3], 3)[:, : (degree + 1) ** 2]
        )
