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
from gsencoder.types import checks as numpy_poses
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
        local = numpy_poses.transform(pose, points)
        np.testing.assert_allclose(transform(*map(torch.from_numpy, (pose, points))).numpy(), local, atol=50 * eps)
        inverse = invert_rigid(torch.from_numpy(pose))
        np.testing.assert_allclose(inverse.numpy(), numpy_poses.invert_rigid(pose), atol=50 * eps)
        tensors = torch.from_numpy(np.ascontiguousarray(local)), torch.from_numpy(K)
        for min_depth in (None, 0.7):
            pixels = numpy_cameras.project_points(local, K, min_depth=min_depth)
            projection = project_points(*tensors, min_depth=min_depth)
            np.testing.assert_allclose(projection.numpy(), pixels, rtol=10 * eps, atol=1e4 * eps)
        back = unproject_points(torch.from_numpy(pixels.copy()), tensors[0][:, 2], tensors[1])
        again = numpy_cameras.unproject_points(pixels, local[:, 2], K)
        np.testing.assert_allclose(back.numpy(), again, rtol=10 * eps, atol=50 * eps)


@pytest.mark.parametrize("aspect", [1e3, 1e6])
def test_needles_have_a_positive_definite_conic(aspect):
    scales = torch.tensor([[1.0, 1 / aspect, 1 / aspect]])
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    quats = random_quats(1, 3).float()
    result = project(torch.tensor([[0.0, 0, 2]]), quats, scales, torch.ones(1), torch.eye(4), K, 640, 480)
    a, b, c = result.conics[0].double()
    assert a > 0
    assert c > 0
    assert a * c - b * b > 0


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


def test_projection_is_ewa_splatting_with_the_jacobian_clamped_beyond_the_image():
    """Written out for one Gaussian after another, in front of, beside and behind a camera."""
    rng = np.random.default_rng(1)
    n, width, height, near, eps2d = 300, 64, 48, 0.5, 0.3
    K = np.array([[50.0, 0, 25], [0, 60, 30], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=3).as_matrix(), [0.1, -0.2, 0.3]
    local = rng.normal(size=(n, 3)) * [2, 2, 1.5] + [0, 0, 2]
    means = (local - pose[:3, 3]) @ pose[:3, :3]
    quats, scales = rng.normal(size=(n, 4)), rng.uniform(0.01, 0.3, (n, 3))
    opacities = rng.choice([0.001, 1 / 255 + 1e-6, 0.3, 1.0], n)
    arrays = (torch.from_numpy(array) for array in (means, quats, scales, opacities, pose, K))
    projection = project(*arrays, width, height, eps2d=eps2d, near=near)
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    for i, (x, y, z) in enumerate(local):
        if z <= near:
            assert not projection.valid[i]
            continue
        slack = 0.15 * width / 50, 0.15 * height / 60
        tx = np.clip(x / z, -25 / 50 - slack[0], (width - 25) / 50 + slack[0])
        ty = np.clip(y / z, -30 / 60 - slack[1], (height - 30) / 60 + slack[1])
        half = np.array([[50, 0, -50 * tx], [0, 60, -60 * ty]]) / z @ pose[:3, :3] @ turns[i] * scales[i]
        covariance = half @ half.T + eps2d * np.eye(2)
        a, b, c = projection.conics[i].tolist()
        np.testing.assert_allclose([[a, b], [b, c]], np.linalg.inv(covariance), rtol=1e-9)
        mean = np.array([50 * x / z + 25, 60 * y / z + 30])
        np.testing.assert_allclose(projection.means2d[i].numpy(), mean)
        assert projection.depths[i].item() == pytest.approx(z)
        # At the ellipse's rim a Gaussian's alpha is just what still marks a pixel.
        radius2 = 2 * np.log(max(opacities[i] * 255, 1))
        assert projection.mahalanobis2[i].item() == pytest.approx(radius2, abs=1e-12)
        extent = np.sqrt(radius2 * np.diag(covariance))
        np.testing.assert_allclose(projection.extents[i].numpy(), extent, atol=1e-9)
        touches = (mean + extent > 0).all() and (mean - extent < [width, height]).all()
        assert projection.valid[i].item() == (touches and opacities[i] > 1 / 255)
    assert 0.1 < projection.valid.double().mean() < 0.9


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
