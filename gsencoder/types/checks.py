"""Checks of the arrays that frozen dataclasses hold; their errors name the class, the field and the first bad row.

Rigid transforms as numpy arrays of any float type; gsencoder.geometry holds the same functions for torch tensors.

A transform [R | t] takes points of one frame to another, x ↦ R x + t, and its name says which: `target_from_source`.
Camera axes are OpenCV's: x right, y down, z forward.
"""

import sys

import numpy as np
from jaxtyping import Float, Float64

from gsencoder.core.errors import InputError

UNIT_TOLERANCE = 1e-3  # How far from 1 the norm of a quaternion, and from 0 an entry of RᵀR − I, may be


def fail(owner: str, name: str, expected: str, got: str) -> None:
    raise InputError(f"{owner}.{name}: expected {expected}, got {got}")


def check_array(owner: str, name: str, array: object, dtype: str, shape: tuple[int | str, ...]) -> None:
    expected = f"{dtype}[{', '.join(map(str, shape))}]"
    if not isinstance(array, np.ndarray):
        fail(owner, name, expected, type(array).__name__)
        return
    same = array.ndim == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not same:
        fail(owner, name, expected, f"{array.dtype}[{', '.join(map(str, array.shape))}]")


def check_rows(owner: str, name: str, good: np.ndarray, expected: str, values: np.ndarray) -> None:
    """Fails naming the first bad row and how many there are."""
    if not good.all():
        bad = np.flatnonzero(~good)
        fail(owner, name, expected, f"{values[bad[0]].tolist()} in row {bad[0]} ({bad.size} bad of {good.size} rows)")


def check_finite(owner: str, name: str, array: np.ndarray) -> None:
    if array.size == 0:
        return
    flat = array.reshape(len(array), -1)
    # The sum of a row is finite unless an entry is not (or it overflows): one pass, no boolean array of full size.
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = ~np.isfinite(flat.sum(axis=1, dtype=np.float64))
    if suspicious.any():
        check_rows(owner, name, np.isfinite(flat).all(axis=1), "finite values", array)


def check_unit(metres_per_unit: float, name: str) -> None:
    """Complains about what is no unit of length."""
    good = isinstance(metres_per_unit, (int, float)) and not isinstance(metres_per_unit, bool)
    if not good or not 0 < metres_per_unit <= sys.float_info.max:
        raise InputError(f"{name}: expected a positive number of metres, got {str(metres_per_unit)[:40]}")


OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes are x right, y up, z backward. The matrix is its own inverse."""


def transform(
    target_from_source: Float[np.ndarray, "*v 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "*v n 3"]:
    """R x + t for each transform and point, in the float type of both.

    The result is laid out coordinate by coordinate: long rows of x, y and z are several times faster to compute with.
    """
    moved = target_from_source[..., :3, :3] @ points.T
    moved += target_from_source[..., :3, 3:]
    return moved.mT


def invert_rigid(target_from_source: Float[np.ndarray, "*v 4 4"]) -> Float[np.ndarray, "*v 4 4"]:
    """source_from_target of rigid transforms: [Rᵀ | −Rᵀt]."""
    rotation = target_from_source[..., :3, :3].mT
    inverse = np.zeros_like(target_from_source)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -(rotation @ target_from_source[..., :3, 3:])
    inverse[..., 3, 3] = 1
    return inverse


def move_origin(
    cam_from_world: Float64[np.ndarray, "*v 4 4"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "*v 4 4"]:
    """The same camera in a world whose coordinates count from `origin`: t becomes t + R·origin.

    In float64, so that for a distant origin the large numbers cancel before anything is rounded to float32.
    """
    moved = cam_from_world.copy()
    moved[..., :3, 3] += cam_from_world[..., :3, :3] @ origin
    return moved


def perpendicular(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """A unit vector perpendicular to `direction`, which is of any length but zero.

    It is the cross product with the coordinate axis that is farthest from parallel: the result of the z axis is y.
    """
    normal = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return normal / np.linalg.norm(normal)


def look_rotation(forward: Float64[np.ndarray, "V 3"], up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "V 3 3"]:
    """Rotations cam_from_world of cameras that look along `forward`, level with `up`; rows are right, down, forward.

    Args:
        forward: unit vectors in the world.
        up: of the world, of any length; not parallel to any of them.
    """
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def look_at(
    centers: Float64[np.ndarray, "V 3"], forward: Float64[np.ndarray, "V 3"], up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "V 4 4"]:
    """cam_from_world of cameras at `centers` with the axes of `look_rotation`."""
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = look_rotation(forward, up)
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", poses[:, :3, :3], centers)
    return poses
