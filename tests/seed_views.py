"""Views of planes and spheres whose depth is exact, to make seeds from, and what seeds look like."""

import numpy as np

from gsencoder.types import Cameras, Gaussians, Views

K = np.array([[260.0, 0, 160], [0, 260, 120], [0, 0, 1]], np.float32)


def camera(center=(0.0, 0.0, 0.0), target=(0.0, 0.0, 1.0), size=(320, 240), K=K) -> Cameras:
    """One camera that looks from `center` to `target`; image down is world +y where that is possible."""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ center
    return Cameras(
        cam_from_world=pose[None].astype(np.float32), Ks=K[None], widths=np.array([size[0]], np.int32),
        heights=np.array([size[1]], np.int32),
    )  # fmt: skip


def rays(cameras: Cameras) -> np.ndarray:
    v, u = np.mgrid[: cameras.heights[0], : cameras.widths[0]] + 0.5
    M = cameras.Ks[0]
    local = np.stack([(u - M[0, 2]) / M[0, 0], (v - M[1, 2]) / M[1, 1], np.ones_like(u)], axis=-1)
    return local @ cameras.cam_from_world[0, :3, :3].astype(np.float64)


def plane_depth(cameras: Cameras, normal, offset: float) -> np.ndarray:
    """z of the plane n·x = offset."""
    t = (offset - cameras.centers[0] @ normal) / (rays(cameras) @ normal)
    return np.where(t > 0, t, 0).astype(np.float32)


def sphere_depth(cameras: Cameras, center, radius: float) -> np.ndarray:
    d, o = rays(cameras), cameras.centers[0] - np.asarray(center)
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


def frames(*parts: tuple[Cameras, np.ndarray], color=(200, 100, 50)) -> Views:
    stacked = {
        name: np.concatenate([getattr(cameras, name) for cameras, _ in parts])
        for name in ("cam_from_world", "Ks", "widths", "heights")
    }
    return Views(
        cameras=Cameras(**stacked),
        names=tuple(f"view {row}" for row in range(len(parts))),
        images=[np.broadcast_to(np.array(color, np.uint8), (*depth.shape, 3)).copy() for _, depth in parts],
        depths=[depth for _, depth in parts],
    )


def normals_of(g: Gaussians) -> np.ndarray:
    """Third axis of each rotation, which is the thin one."""
    w, x, y, z = g.quats.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def colors_of(g: Gaussians) -> np.ndarray:
    return 0.5 + 0.28209479177387814 * g.sh[:, 0]


def same(a: Gaussians, b: Gaussians) -> bool:
    names = ("means", "quats", "scales", "opacities", "sh")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


TILTED = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
