"""Shapes that no library has: walls with openings, floors, slabs and curtains, with texture coordinates in metres."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.data.furnished.library import Mesh


class Rectangle(NamedTuple):
    """An area of the floor, metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size(self) -> float:
        """Square metres."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


Quad = Float64[np.ndarray, "4 3"]


def mesh_of_quads(quads: Sequence[Quad]) -> Mesh:
    """A mesh of one material; the texture coordinates of each quad are metres along its first two edges."""
    corners = np.stack(quads)
    along, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    units = [each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9) for each in (along, up)]
    # Coordinates continue from quad to quad of one plane, since they are measured from the world's origin.
    uvs = np.stack([np.einsum("qcd,qd->qc", corners, unit) for unit in units], axis=2)
    firsts = 4 * np.arange(len(corners))[:, None, None]
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        faces=(firsts + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32),
        uvs=np.stack([uvs[:, [0, 1, 2]], uvs[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 2).astype(np.float32),
        materials=np.zeros(2 * len(corners), np.int32),
        colors=np.full((1, 3), 0.6, np.float32),
        textures=(None,),
    )


def _quad(*corners: Sequence[float]) -> Quad:
    return np.array(corners, np.float64)


def slab(width: float, depth: float, height: float, *, rounded: bool = False, skirt: float = 0.0) -> Mesh:
    """A block around the origin with its lower side at z = 0; `rounded` narrows it towards its edges like a pillow, and
    a skirt lets its sides hang down below it."""
    if rounded:
        return _cushion(width, depth, height)
    x, y, z0, z1 = width / 2, depth / 2, -skirt, height
    return mesh_of_quads(
        [
            _quad((-x, -y, z1), (x, -y, z1), (x, y, z1), (-x, y, z1)),
            _quad((-x, -y, z0), (x, -y, z0), (x, -y, z1), (-x, -y, z1)),
            _quad((x, y, z0), (-x, y, z0), (-x, y, z1), (x, y, z1)),
            _quad((x, -y, z0), (x, y, z0), (x, y, z1), (x, -y, z1)),
            _quad((-x, y, z0), (-x, -y, z0), (-x, -y, z1), (-x, y, z1)),
        ]
    )


def _cushion(width: float, depth: float, height: float) -> Mesh:
    steps = np.linspace(-1, 1, 7)
    grid_x, grid_y = np.meshgrid(steps, steps, indexing="ij")
    z = height * (0.3 + 0.7 * np.sqrt(np.clip((1 - grid_x**4) * (1 - grid_y**4), 0, 1)))
    return _sheet(np.stack([grid_x * width / 2, grid_y * depth / 2, z], axis=2))


def curtain(width: float, height: float, folds: int) -> Mesh:
    """A hanging cloth in the plane y = 0 with its lower side at z = 0."""
    x = np.linspace(-width / 2, width / 2, 6 * folds + 1)
    y = 0.035 * np.sin(np.linspace(0, 2 * np.pi * folds, len(x)))
    rows = [np.stack([x, y, np.full_like(x, z)], axis=1) for z in (0.0, height)]
    return _sheet(np.stack(rows, axis=1))


def _sheet(grid: Float64[np.ndarray, "n m 3"]) -> Mesh:
    """The quads between the points of a grid."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    return mesh_of_quads(list(corners.reshape(-1, 4, 3)))


def panels(
    area: Rectangle, height: float, openings: Sequence[tuple[int, float, float, float, float]], thickness: float
) -> tuple[Mesh, Mesh, Mesh]:
    """The walls of a room, seen from inside, with openings (side, first, last, lower, upper) and what shows of the
    wall's thickness in them; the floor, which goes on under doorways; and the ceiling."""
    walls, floors = [], [_floor(area.x0, area.y0, area.x1, area.y1, 0.0)]
    for side in range(4):
        first, last = (area.x0, area.x1) if side in (0, 2) else (area.y0, area.y1)
        holes = sorted(each[1:] for each in openings if each[0] == side)
        at = first
        for start, end, lower, upper in holes:
            walls.append(_panel(area, side, at, start, 0.0, height))
            walls.append(_panel(area, side, start, end, 0.0, lower))
            walls.append(_panel(area, side, start, end, upper, height))
            walls.extend(_reveal(area, side, start, end, lower, upper, thickness))
            if lower == 0:
                floors.append(_sill(area, side, start, end, 0.0, thickness))
            at = end
        walls.append(_panel(area, side, at, last, 0.0, height))
    walls = [quad for quad in walls if np.linalg.norm(np.cross(quad[1] - quad[0], quad[3] - quad[0])) > 1e-6]
    ceiling = _floor(area.x0, area.y0, area.x1, area.y1, height)[::-1]
    return mesh_of_quads(walls), mesh_of_quads(floors), mesh_of_quads([ceiling])


def _floor(x0: float, y0: float, x1: float, y1: float, z: float) -> Quad:
    return _quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))


def _point(area: Rectangle, side: int, along: float, out: float, z: float) -> tuple[float, float, float]:
    """A point of a wall, `out` metres behind its surface."""
    return {
        0: (along, area.y1 + out, z),
        1: (area.x1 + out, along, z),
        2: (along, area.y0 - out, z),
        3: (area.x0 - out, along, z),
    }[side]


def _face(area: Rectangle, side: int, *corners: tuple[float, float, float]) -> Quad:
    """A quad of points of a wall, given as in `_point`."""
    return _quad(*(_point(area, side, *each) for each in corners))


def _panel(area: Rectangle, side: int, start: float, end: float, lower: float, upper: float) -> Quad:
    return _face(area, side, (start, 0.0, lower), (end, 0.0, lower), (end, 0.0, upper), (start, 0.0, upper))


def _sill(area: Rectangle, side: int, start: float, end: float, z: float, thickness: float) -> Quad:
    return _face(area, side, (start, 0.0, z), (end, 0.0, z), (end, thickness, z), (start, thickness, z))


def _reveal(
    area: Rectangle, side: int, start: float, end: float, lower: float, upper: float, thickness: float
) -> list[Quad]:
    sills = [_sill(area, side, start, end, z, thickness) for z in (lower, upper) if z > 0]
    return sills + [
        _face(area, side, (at, 0.0, lower), (at, thickness, lower), (at, thickness, upper), (at, 0.0, upper))
        for at in (start, end)
    ]
