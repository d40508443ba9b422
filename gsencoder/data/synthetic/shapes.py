"""Boxes, ellipsoids and upright cylinders: exact ray hits, normals, boxes, and lattices of points on them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """A convex solid that is turned about the vertical axis.

    Attributes:
        shape: box, ellipsoid, or cylinder (upright, elliptic).
        center: metres.
        half: half extents along its own axes.
        yaw: radians about +z.
    """

    shape: Literal["box", "ellipsoid", "cylinder"]
    center: Float64[np.ndarray, "3"]
    half: Float64[np.ndarray, "3"]
    yaw: float = 0.0

    @property
    def world_from_local(self) -> Float64[np.ndarray, "3 3"]:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def aabb(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """The exact axis-aligned box."""
        turn = np.abs(self.world_from_local)
        reach = turn @ self.half
        if self.shape != "box":
            reach[:2] = np.sqrt(turn[:2, :2] ** 2 @ self.half[:2] ** 2)
        return self.center - reach, self.center + reach

    def to_unit(self, points: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Points in the frame where the solid is the unit cube [−1, 1]³, ball or cylinder."""
        return (points - self.center) @ self.world_from_local / self.half

    def contains(self, points: Float64[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, " n"]:
        """Points inside the solid grown by `margin` metres."""
        grown = Solid(shape=self.shape, center=self.center, half=self.half + margin, yaw=self.yaw)
        q = grown.to_unit(points)
        if self.shape == "box":
            return (np.abs(q) <= 1).all(axis=-1)
        if self.shape == "ellipsoid":
            return (q * q).sum(axis=-1) <= 1
        return (np.abs(q[..., 2]) <= 1) & ((q[..., :2] ** 2).sum(axis=-1) <= 1)

    def hits(
        self, origin: Float64[np.ndarray, "3"], directions: Float64[np.ndarray, "*n 3"]
    ) -> Float64[np.ndarray, "*n"]:
        """Smallest t > 0 with origin + t · direction on the surface, from outside; infinite where there is none."""
        o, d = self.to_unit(origin), directions @ self.world_from_local / self.half
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.shape == "box":
                near, far = _slabs(o, d)
            elif self.shape == "ellipsoid":
                near, far = _round(o, d)
            else:
                near, far = _round(o[:2], d[..., :2])
                cap_near, cap_far = _slabs(o[2:], d[..., 2:])
                near, far = np.maximum(near, cap_near), np.minimum(far, cap_far)
            return np.where((near <= far) & (near > 0), near, np.inf)

    def normals(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Outward unit normals at points on the surface."""
        q = self.to_unit(points)
        if self.shape == "ellipsoid":
            local = q / self.half
        elif self.shape == "box":
            axis = np.abs(q).argmax(axis=1)
            local = np.eye(3)[axis] * np.sign(q)
        else:
            cap = np.abs(q[:, 2]) >= np.sqrt((q[:, :2] ** 2).sum(axis=1))
            local = np.where(cap[:, None], np.array([0.0, 0.0, 1.0]) * np.sign(q), q / self.half * [1, 1, 0])
        world = local @ self.world_from_local.T
        return world / np.linalg.norm(world, axis=1, keepdims=True)

    def lattice(self, spacing: float) -> Float64[np.ndarray, "n 3"]:
        """Points on the surface, at most about `spacing` apart."""
        if self.shape == "box":
            unit = np.concatenate([_face(self.half, axis, spacing) for axis in range(3)])
        elif self.shape == "ellipsoid":
            radius = self.half.max()
            count = max(16, int(np.ceil(4 * np.pi * radius**2 / spacing**2)))
            unit = _fibonacci(count)
        else:
            around = max(8, int(np.ceil(2 * np.pi * self.half[:2].max() / spacing)))
            angle = 2 * np.pi * np.arange(around) / around
            levels = _cells(self.half[2], spacing)
            side = np.stack(
                [np.tile(np.cos(angle), len(levels)), np.tile(np.sin(angle), len(levels)), np.repeat(levels, around)], 1
            )
            x, y = (grid.ravel() for grid in np.meshgrid(_cells(self.half[0], spacing), _cells(self.half[1], spacing)))
            disc = np.stack([x, y], 1)[x * x + y * y < 1]
            caps = [np.column_stack([disc, np.full(len(disc), z)]) for z in (-1.0, 1.0)]
            unit = np.concatenate([side, *caps])
        return unit * self.half @ self.world_from_local.T + self.center


def _slabs(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of the cube [−1, 1]ⁿ. A ray along a face gives NaN there, which the comparisons take as a miss."""
    first, second = (-1 - o) / d, (1 - o) / d
    return np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)


def _round(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of the unit ball; NaN where the ray misses it."""
    a, b, c = (d * d).sum(axis=-1), (o * d).sum(axis=-1), (o * o).sum() - 1
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _cells(half: float, spacing: float) -> np.ndarray:
    """Centers in [−1, 1] of the fewest equal cells of at most `spacing`."""
    count = max(1, int(np.ceil(2 * half / spacing)))
    return (2 * np.arange(count) + 1) / count - 1


def _face(half: np.ndarray, axis: int, spacing: float) -> np.ndarray:
    """Cell centers on the two faces of the unit cube across `axis`."""
    first, second = (other for other in range(3) if other != axis)
    u, v = (grid.ravel() for grid in np.meshgrid(_cells(half[first], spacing), _cells(half[second], spacing)))
    points = np.empty((2 * len(u), 3))
    points[:, first], points[:, second] = np.tile(u, 2), np.tile(v, 2)
    points[:, axis] = np.repeat([-1.0, 1.0], len(u))
    return points


def _fibonacci(count: int) -> np.ndarray:
    """Evenly spread points on the unit sphere: a spiral with the golden angle."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (3 - np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
