"""Laws of rotations, covariances, projection and spherical harmonics."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsencoder.geometry import (
    colors_from_sh,
    covariances,
    invert_rigid,
    normalize_quats,
    project,
    rotmats_from_quats,
    sh_basis,
    sh_from_colors,
    transform,
)


def random_quats(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(n, 4)))


def test_rotation_matrices_agree_with_scipy() -> None:
    quats = random_quats(50)
    expected = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotmats_from_quats(quats).numpy(), expected, atol=1e-12)


def test_opposite_quaternions_are_the_same_rotation() -> None:
    quats = random_quats(50)
    torch.testing.assert_close(rotmats_from_quats(quats), rotmats_from_quats(-quats))


def test_normalising_a_zero_quaternion_has_a_finite_value_and_gradient() -> None:
    quats = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    normalize_quats(quats).sum().backward()
    assert quats.grad is not None
    assert torch.isfinite(quats.grad).all()


def test_covariance_eigenvalues_are_the_squared_scales() -> None:
    scales = torch.rand(20, 3, dtype=torch.float64) + 0.1
    eigenvalues = torch.linalg.eigvalsh(covariances(random_quats(20), scales))
    torch.testing.assert_close(eigenvalues, (scales**2).sort(dim=1).values)


def test_inverting_a_rigid_transform_undoes_it() -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotmats_from_quats(random_quats(1))[0]
    pose[:3, 3] = torch.tensor([1.0, -2.0, 3.0])
    points = torch.randn(10, 3, dtype=torch.float64)
    torch.testing.assert_close(transform(invert_rigid(pose), transform(pose, points)), points)


def project_one(mean: torch.Tensor, scale: float = 1e-3, **options: float) -> tuple[torch.Tensor, ...]:
    K = torch.tensor([[50.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    scales, opacities = torch.full((1, 3), scale, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    return project(mean.reshape(1, 3), quats, scales, opacities, pose, K, 64, 48, **options)


def test_the_projected_covariance_is_the_first_order_image_of_the_sphere() -> None:
    """Inside the field of view J Σ Jᵀ must match a numerical Jacobian of the pinhole map."""
    mean = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    result = project_one(mean, scale=0.05, eps2d=1e-9)

    def pinhole(p: torch.Tensor) -> torch.Tensor:
        return torch.stack((50 * p[0] / p[2] + 32, 60 * p[1] / p[2] + 24))

    jacobian = torch.autograd.functional.jacobian(pinhole, mean)
    expected = torch.linalg.inv(jacobian @ jacobian.T * 0.05**2)
    a, b, c = result.conics[0]
    torch.testing.assert_close(torch.tensor([[a, b], [b, c]], dtype=torch.float64), expected, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(result.means2d[0], pinhole(mean))


def test_a_gaussian_beside_the_camera_does_not_cover_the_whole_image() -> None:
    """At x/z = 500 an unclamped Jacobian would give it a radius of thousands of pixels."""
    beside = project_one(torch.tensor([10.0, 0.0, 0.02], dtype=torch.float64), scale=0.02)
    assert not beside.valid.item()


@pytest.mark.parametrize("aspect", [1e3, 1e6])
def test_needles_have_a_positive_definite_conic(aspect: float) -> None:
    scales = torch.tensor([[1.0, 1 / aspect, 1 / aspect]])
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    quats = random_quats(1, 3).float()
    result = project(torch.tensor([[0.0, 0, 2]]), quats, scales, torch.ones(1), torch.eye(4), K, 640, 480)
    a, b, c = result.conics[0].double()
    assert a > 0
    assert c > 0
    assert a * c - b * b > 0


def test_projection_passes_gradcheck() -> None:
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


def test_spherical_harmonics_are_orthonormal_on_the_sphere() -> None:
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


def test_colours_survive_the_round_trip_through_degree_zero() -> None:
    colors = torch.rand(30, 3, dtype=torch.float64)
    means = torch.randn(30, 3, dtype=torch.float64)
    torch.testing.assert_close(
        colors_from_sh(sh_from_colors(colors), means, torch.ones(3, dtype=torch.float64)), colors
    )


def test_a_gaussian_at_the_camera_centre_has_a_finite_colour() -> None:
    sh = torch.randn(1, 16, 3)
    assert torch.isfinite(colors_from_sh(sh, torch.zeros(1, 3), torch.zeros(3))).all()


def test_a_colour_depends_on_the_direction_from_the_camera_and_not_on_the_distance() -> None:
    rng = np.random.default_rng(0)
    sh, away, center = rng.normal(size=(20, 16, 3)), rng.normal(size=(20, 3)), np.array([3.0, -1.0, 2.0])
    basis = sh_basis(torch.from_numpy(away / np.linalg.norm(away, axis=1, keepdims=True)), 3).numpy()
    expected = np.maximum(np.einsum("nk,nkc->nc", basis, sh) + 0.5, 0)
    assert (expected == 0).any()
    for distance in (0.01, 1.0, 1000.0):
        found = colors_from_sh(*map(torch.from_numpy, (sh, center + distance * away, center)))
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
