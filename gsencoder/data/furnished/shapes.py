"""Shapes that no library has, with texture coordinates in metres: walls with openings, floors, slabs and curtains, and
makes of our own of furniture, doors, windows, lamps and vessels."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.data.furnished.kinds import kinds, listed_cell, table_rows
from gsencoder.data.furnished.library import Mesh, Model


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


def mesh_of_quads(quads: Sequence[Quad], materials: Sequence[int] = ()) -> Mesh:
    """A mesh of one material, or one for each quad; texture coordinates are metres along the first two edges."""
    corners = np.stack(quads)
    of_quads = np.array(materials, np.int32) if len(materials) else np.zeros(len(corners), np.int32)
    count = int(of_quads.max()) + 1
    along, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    units = [each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9) for each in (along, up)]
    # Coordinates continue from quad to quad of one plane, since they are measured from the world's origin.
    uvs = np.stack([np.einsum("qcd,qd->qc", corners, unit) for unit in units], axis=2)
    firsts = 4 * np.arange(len(corners))[:, None, None]
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        faces=(firsts + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32),
        uvs=np.stack([uvs[:, [0, 1, 2]], uvs[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 2).astype(np.float32),
        materials=np.repeat(of_quads, 2),
        colors=np.full((count, 3), 0.6, np.float32),
        textures=(None,) * count,
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
    return mesh_of_quads(_quads_between(grid))


def _quads_between(grid: Float64[np.ndarray, "n m 3"]) -> list[Quad]:
    """The quads between the points of a grid, row by row."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    return list(corners.reshape(-1, 4, 3))


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


# Makes of our own --------------------------------------------------------------------------------------------------

Span = tuple[float, float]
"""Lower and upper bound."""
SIDES, RINGS = 24, 9
"""Sides of a turned shape, and levels at which its profile is sampled at least."""
_TIP = 0.005
"""Radius of a turned shape on its axis, as a share of half its width."""


class Built(NamedTuple):
    """A shape that was made: what things stand on is at the height `top`, None = nowhere."""

    mesh: Mesh
    finishes: tuple[str, ...]
    top: float | None


class BlockRanges(NamedTuple):
    """How things of blocks vary: a body above feet, whose front is divided into cells, and on it a cushion, a back and
    arms. Lengths are metres, each between two bounds.

    Attributes:
        foot, height: the lower and the upper side of the body above the floor.
        legs: "legs", "table" (legs, sides or one column), "stand" (one column on a plate), or none.
        cells: what cells hold, each as often as it stands here.
        back, arms: height above the body, and thickness; None = without.
        finish: of the body, each as often as it stands here.
        hung, elevation: share of them that hangs on a wall, and how high above the floor.
    """

    width: Span
    depth: Span
    height: Span
    foot: Span
    legs: str
    cell_width: Span
    cell_height: Span
    cells: tuple[str, ...]
    cushion: Span
    back: tuple[Span, Span] | None
    arms: tuple[Span, Span] | None
    finish: tuple[str, ...]
    hung: float
    elevation: Span

    def build(self, rng: np.random.Generator) -> Built:
        blocks = _Blocks(self, rng)
        width, depth, height, foot = (float(rng.uniform(*each)) for each in self[:4])
        foot = min(foot, height - _BOARD) * (rng.random() < 0.6 or self.legs != "legs")
        x, y, is_opening = (-width / 2, width / 2), (-depth / 2, depth / 2), self.cells[0] in ("leaf", "pane")
        is_block = self.cells[0] in ("plain", "rib")
        zs = blocks.edges((foot, height), self.cell_height)
        bar = float(rng.uniform(0.03, 0.09) if is_opening else rng.uniform(0.015, 0.04))
        for number, column in enumerate(pairwise(blocks.edges(x, self.cell_width))):
            if number and not is_opening and rng.random() < 0.3:
                zs = blocks.edges((foot, height), self.cell_height)
            if not is_block:
                blocks.lattice(np.array(column), y, zs, bar, _BODY)
            for row in pairwise(zs):
                blocks.fill(str(rng.choice(self.cells)), column, row, depth)
        if not is_opening and not is_block and rng.random() < 0.9:
            blocks.add(x, (depth / 2 - 0.01, depth / 2), (foot, height), _BODY)
        if foot:
            blocks.legs(self.legs, width, depth, foot)
        cushion = float(rng.uniform(*self.cushion))
        if cushion:
            blocks.add((x[0] + 0.02, x[1] - 0.02), (y[0] + 0.01, y[1]), (height, height + cushion), _CLOTH)
        if self.back:
            rise, thick = (float(rng.uniform(*each)) for each in self.back)
            blocks.add(x, (y[1] - thick, y[1]), (foot, height + rise), _BODY)
        if self.arms and rng.random() < 0.8:
            rise, thick = (float(rng.uniform(*each)) for each in self.arms)
            for side in ((x[0], x[0] + thick), (x[1] - thick, x[1])):
                blocks.add(side, y, (foot, height + rise), _BODY)
        return Built(blocks.mesh(), blocks.finishes, height + cushion)


class TurnedRanges(NamedTuple):
    """How things with a profile around an upright axis vary, such as bowls, lamps and bathtubs.

    Attributes:
        depth: as a share of the width.
        profile: height and radius of its corners, as shares of the height and of half the width; a last radius of
            exactly 1 is a table on which things stand.
        hollow: share of them that is open above.
        corner: exponent of the superellipse that a level is: 2 is an ellipse, 12 nearly a rectangle.
        back, finish, hung, elevation: see `BlockRanges`.
    """

    width: Span
    depth: Span
    height: Span
    profile: tuple[tuple[float, Span], ...]
    hollow: float
    corner: Span
    back: tuple[Span, Span] | None
    finish: tuple[str, ...]
    hung: float
    elevation: Span

    def build(self, rng: np.random.Generator) -> Built:
        from scipy.interpolate import PchipInterpolator

        width, height = float(rng.uniform(*self.width)), float(rng.uniform(*self.height))
        half = np.array([width, width * rng.uniform(*self.depth)]) / 2
        corners = np.array([level for level, _ in self.profile])
        radii = np.array([rng.uniform(*span) for _, span in self.profile])
        gaps = np.diff(corners)
        corners[1:-1] += rng.uniform(-0.25, 0.25, len(gaps) - 1) * np.minimum(gaps[:-1], gaps[1:])
        levels = np.union1d(corners, np.linspace(0, 1, RINGS))
        is_smooth = rng.random() < 0.5
        outside = PchipInterpolator(corners, radii)(levels) if is_smooth else np.interp(levels, corners, radii)
        rings = [(0.0, _TIP), *zip(levels, outside, strict=True)]
        is_hollow = rng.random() < self.hollow
        if is_hollow:
            wall = float(rng.uniform(0.04, 0.12))
            inside = np.maximum(outside - wall, 0.3 * outside)[:0:-1]
            rings += [*zip(levels[:0:-1], inside, strict=True), (levels[1], _TIP)]
        else:
            rings.append((1.0, _TIP))
        split = int(rng.integers(1, len(rings))) if rng.random() < 0.5 else len(rings)
        angles = np.linspace(0, 2 * np.pi, SIDES + 1)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        exponent = rng.uniform(*self.corner)
        circle /= (np.abs(circle) ** exponent).sum(axis=1, keepdims=True) ** (1 / exponent)
        grid = np.array([[(*radius * half * each, height * level) for each in circle] for level, radius in rings])
        quads = _quads_between(grid)
        materials = [_BODY if number < split * SIDES else _FRONT for number in range(len(quads))]
        if self.back:
            rise, thick = (float(rng.uniform(*each)) for each in self.back)
            share, lower = rng.uniform([0.6, 0.7], [1.0, 1.0])
            lowest = (-share * half[0], half[1] - thick, lower * height)
            quads += _block(np.array(lowest), np.array([share * half[0], half[1], height + rise]))
            materials += 6 * [_BODY if rng.random() < 0.5 else _FRONT]
        finishes = tuple(rng.choice(self.finish, 2).tolist())
        is_table = not is_hollow and radii[-1] == 1
        return Built(mesh_of_quads(quads, materials), finishes, height if is_table else None)


@cache
def makes() -> Mapping[str, Sequence[BlockRanges | TurnedRanges]]:
    """The kinds of which `made_model` makes models, and how these vary."""
    cells: dict[str, Callable[[str], Any]] = {
        "legs": str,
        "cells": listed_cell,
        "back": _ranges,
        "arms": _ranges,
        "profile": _profile,
        "finish": listed_cell,
        "hollow": float,
        "hung": float,
    }
    by_kind: dict[str, list[BlockRanges | TurnedRanges]] = {}
    for table, ranges in (("makes.csv", BlockRanges), ("turned.csv", TurnedRanges)):
        for row in table_rows(table):
            values = {key: cells.get(key, _range)(cell) for key, cell in row.items() if key != "kind"}
            by_kind.setdefault(row["kind"], []).append(ranges(**values))
    return by_kind


def _range(cell: str) -> Span:
    lower, upper = cell.split("-")
    return float(lower), float(upper)


def _ranges(cell: str) -> tuple[Span, ...] | None:
    return tuple(map(_range, cell.split())) or None


def _profile(cell: str) -> tuple[tuple[float, Span], ...]:
    corners = [corner.split(":") for corner in cell.split()]
    return tuple((float(level), _range(radius)) for level, radius in corners)


@dataclass(frozen=True, kw_only=True)
class MadeModel(Model):
    """A model that is made and not read from a library."""

    made: Mesh

    @property
    def mesh(self) -> Mesh:
        return self.made


_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
_CUBE = np.stack([np.insert(_SQUARE, axis, side, axis=1) for axis in range(3) for side in (0.0, 1.0)])
"""The six quads of a block between 0 and 1."""


def _block(lower: Float64[np.ndarray, "3"], upper: Float64[np.ndarray, "3"]) -> list[Quad]:
    return list(lower + _CUBE * (upper - lower))


_BOARD = 0.015
"""Least thickness of the top of a table, metres."""
_BODY, _FRONT, _HANDLE, _CLOTH, _CONTENTS = 0, 1, 2, 3, (4, 5, 6, 7)
"""Materials of a model that is made."""


class _Blocks:
    """Blocks of which a thing is built, each with its material."""

    def __init__(self, make: BlockRanges, rng: np.random.Generator) -> None:
        self.rng, self.corners, self.materials = rng, [], []  # type: ignore[var-annotated]
        handle = rng.choice(["paint", "wood", "metal"], p=[0.2, 0.2, 0.6])
        self.finishes = (*rng.choice(make.finish, 2).tolist(), str(handle), *(5 * ["fabric"]))
        # Fronts, handles and panes of one thing are alike.
        self.front = _FRONT if rng.random() < 0.5 else _BODY
        self.framed, self.overlay = rng.random() < 0.4, 0.02 * (rng.random() < 0.5)
        self.handle = rng.uniform([0.02, 0.012, 0.015], [0.35, 0.03, 0.05])
        self.bars = (1, 1) if rng.random() < 0.4 else (1 + int(rng.integers(3)), 1 + int(rng.integers(4)))
        self.rail, self.inner = float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.3, 1.0))

    def add(self, x: Span, y: Span, z: Span, material: int) -> None:
        self.corners.append(((x[0], y[0], z[0]), (x[1], y[1], z[1])))
        self.materials.append(material)

    def edges(self, span: Span, cell: Span) -> np.ndarray:
        """Edges of cells in a span, which are equally large half of the time."""
        sizes = np.ones(max(1, round((span[1] - span[0]) / self.rng.uniform(*cell))))
        if self.rng.random() < 0.5:
            sizes = self.rng.uniform(0.6, 1.4, len(sizes))
        return span[0] + (span[1] - span[0]) * np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])

    def lattice(self, xs: np.ndarray, y: Span, zs: np.ndarray, bar: float, material: int, inner: float = 1.0) -> None:
        """Bars around and between cells; `inner` is the width of those between them as a share of the others'."""
        for edges, upright in ((xs, True), (zs, False)):
            widths = np.full(len(edges), inner * bar)
            widths[[0, -1]] = bar
            for at, width in zip(np.clip(edges, edges[0] + bar / 2, edges[-1] - bar / 2), widths, strict=True):
                across = float(at - width / 2), float(at + width / 2)
                x, z = (across, (zs[0], zs[-1])) if upright else ((xs[0], xs[-1]), across)
                self.add(x, y, z, material)

    def fill(self, cell: str, x: Span, z: Span, depth: float) -> None:
        """Fills a cell of the front, which is at y = −depth / 2."""
        if cell == "glass":
            front = -depth / 2 - self.overlay
            self.lattice(np.array(x), (front, front + 0.02), np.array(z), 0.05, self.front)
        if cell in ("door", "drawer"):
            self._closed(cell == "drawer", x, z, -depth / 2 - self.overlay)
        elif cell in ("leaf", "pane"):
            self._panes(cell == "leaf", x, z, 0.4 * depth)
        elif cell in ("plain", "rib"):
            self.add((x[0], x[1] if cell == "plain" else 0.4 * x[0] + 0.6 * x[1]), (-depth / 2, depth / 2), z, _BODY)
        elif cell == "books":
            at, end = x[0] + 0.02, x[0] + (x[1] - x[0]) * float(self.rng.uniform(0.3, 1.2))
            while at < min(end, x[1] - 0.05):
                thick, tall, deep = self.rng.uniform([0.015, 0.55, 0.6], [0.06, 0.92, 0.95])
                top = z[0] + tall * (z[1] - z[0])
                self.add((at, at + thick), (depth * (0.5 - deep), depth / 2), (z[0], top), self._content())
                at += thick
        elif self.rng.random() < 0.4:
            size = self.rng.uniform(0.05, 0.8, 3) * (x[1] - x[0], depth, z[1] - z[0])
            at = float(self.rng.uniform(x[0], x[1] - size[0]))
            self.add((at, at + size[0]), (-size[1] / 2, size[1] / 2), (z[0], z[0] + size[2]), self._content())

    def _content(self) -> int:
        return int(self.rng.choice(_CONTENTS))

    def _closed(self, is_drawer: bool, x: Span, z: Span, y: float) -> None:
        """A door or a drawer with a handle, before the body or between its boards."""
        gap = 0.004 if self.overlay else 0.012
        (x0, x1), (z0, z1) = (x[0] + gap, x[1] - gap), (z[0] + gap, z[1] - gap)
        self.add((x0, x1), (y + 0.008 * self.framed, y + 0.02), (z0, z1), self.front)
        if self.framed and min(x1 - x0, z1 - z0) > 0.15:
            self.lattice(np.array([x0, x1]), (y - 0.004, y + 0.02), np.array([z0, z1]), 0.06, self.front)
        long, thick, reach = self.handle
        size = (min(long, 0.6 * (x1 - x0)), thick) if is_drawer else (thick, min(long, 0.6 * (z1 - z0)))
        # Handles of doors are on the side of the middle of the thing, as near to the height of hands as they can be.
        side = x1 - 0.04 if x0 + x1 < 0 else x0 + 0.04
        at = ((x0 + x1) / 2, (z0 + z1) / 2) if is_drawer else (side, np.clip(1.0, (3 * z0 + z1) / 4, (z0 + 3 * z1) / 4))
        spans = [(float(c - s / 2), float(c + s / 2)) for c, s in zip(at, size, strict=True)]
        self.add(spans[0], (y - reach, y), spans[1], _HANDLE)

    def _panes(self, is_leaf: bool, x: Span, z: Span, thick: float) -> None:
        """The leaf of a door with its panels and handles, or of glass, or the sash of a window."""
        if is_leaf and self.rng.random() < 0.85:
            self.add(x, (-thick / 2, thick / 2), z, self.front)
            thick += float(self.rng.choice([0.004, 0.012, 0.02]))
        xs, zs = np.linspace(*x, self.bars[0] + 1), np.linspace(*z, self.bars[1] + 1)
        self.lattice(xs, (-thick / 2, thick / 2), zs, self.rail, self.front, self.inner)
        if is_leaf:
            at = x[1] - 0.08 if self.rng.random() < 0.5 else x[0] + 0.08
            self.add((at - 0.06, at + 0.06), (-0.07, 0.07), (1.0, 1.0 + float(self.handle[1])), _HANDLE)

    def legs(self, style: str, width: float, depth: float, foot: float) -> None:
        """What carries a body."""
        if style == "table":
            style = str(self.rng.choice(["legs", "sides", "stand"], p=[0.7, 0.15, 0.15]))
        thick = float(self.rng.uniform(0.025, 0.08))
        (x, y), z = (width / 2, depth / 2), (0.0, foot)
        if style == "stand":
            self.add((-thick, thick), (-thick / 2, thick / 2), z, _BODY)
            self.add((-x / 2, x / 2), (-0.6 * max(y, 0.15), 0.6 * max(y, 0.15)), (0.0, 0.02), _BODY)
        for at in (-x, x - thick) if style != "stand" else ():
            for front in (-y, y - thick) if style == "legs" else ():
                self.add((at, at + thick), (front, front + thick), z, _BODY)
            if style == "sides":
                self.add((at, at + thick), (-y, y), z, _BODY)

    def mesh(self) -> Mesh:
        quads = [quad for lower, upper in self.corners for quad in _block(np.array(lower), np.array(upper))]
        return mesh_of_quads(quads, np.repeat(self.materials, 6).tolist())


def made_model(kind: str, rng: np.random.Generator) -> MadeModel:
    """Makes a model of one of the kinds that `makes` has, unlike any other."""
    listed = makes()[kind]
    ranges = listed[int(rng.integers(len(listed)))]
    built = ranges.build(rng)
    lower, upper = built.mesh.extent
    middle = np.array([*(lower + upper)[:2] / 2, lower[2]])
    return MadeModel(
        id=f"made {kind}",
        name=kind,
        kind=kinds()[kind],
        size=tuple((upper - lower).tolist()),
        elevation=float(rng.uniform(*ranges.elevation)) if rng.random() < ranges.hung else 0.0,
        top=built.top,
        made=built.mesh._replace(vertices=(built.mesh.vertices - middle).astype(np.float32)),
        finishes=built.finishes,
    )
