"""Plans of furnished homes: rooms with doorways and windows, and what stands, hangs and lies in them, by a seed.

A home is a rectangle that is split into rooms. Groups come first (a bed between nightstands, chairs around a table, a
couch that faces a television, a row of kitchen cabinets), then single things of the kinds that such a room has, and
small things on what carries them. No two things overlap: each keeps a box of its own, and doors and windows one in
front of them. Axes are z up, in metres, with the floor at 0.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.data.furnished.kinds import ROOM_TYPES, RoomType, kinds
from gsencoder.data.furnished.library import Mesh, Model
from gsencoder.data.furnished.shapes import Rectangle, curtain, made_model, makes, panels, slab

THICKNESS = 0.12
"""Of the walls between rooms."""
_TRIES = 25
_AREAS: dict[RoomType, tuple[float, float]] = {
    "bedroom": (9, 20),
    "living room": (14, 36),
    "kitchen": (7, 20),
    "bathroom": (4, 10),
    "office": (9, 28),
    "corridor": (4, 9),
    "storage room": (14, 28),
}
_FREQUENCIES = (0.24, 0.26, 0.18, 0.12, 0.16, 0.04, 0.0)
"""Of the types of rooms in homes; storage rooms, which hold things of all kinds alike and have no walls, are made where
they are asked for."""
_EXTRAS: dict[RoomType, tuple[float, float]] = {
    "bedroom": (3, 9),
    "living room": (4, 12),
    "kitchen": (2, 7),
    "bathroom": (3, 8),
    "office": (3, 9),
    "corridor": (1, 4),
    "storage room": (60, 100),
}
"""Single things on floor, walls and ceiling, in addition to groups."""
_KITCHEN_ROW = ("kitchen cabinet", "stove", "kitchen cabinet", "kitchen sink", "oven", *(2 * ["kitchen cabinet"]))
_ON_DESKS = {"monitor": 0.6, "laptop": 0.4, "desk lamp": 0.3, "telephone": 0.2}
"""Things on desks, and how often."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A thing in a home: a model, or a shape of our own whose material is drawn for its `finish`.

    Attributes:
        matrix: world_from_item [3, 4], with the scale.
    """

    kind: str
    matrix: Float64[np.ndarray, "3 4"]
    model: Model | None = None
    shape: Mesh | None = None
    finish: str = ""

    @property
    def mesh(self) -> Mesh:
        """The triangles, in coordinates of the item."""
        mesh = self.shape if self.model is None else self.model.mesh
        assert mesh is not None
        return mesh


class Box(NamedTuple):
    """Space that is taken."""

    x0: float
    y0: float
    z0: float
    x1: float
    y1: float
    z1: float

    def overlaps(self, other: "Box") -> bool:
        return all(self[i] < other[i + 3] and other[i] < self[i + 3] for i in range(3))


@dataclass(slots=True, kw_only=True)
class Room:
    """A room while it is furnished; openings are (side, first, last, lower, upper), sides 0 to 3 at y1, x1, y0, x0."""

    type: RoomType
    area: Rectangle
    height: float
    openings: list[tuple[int, float, float, float, float]] = field(default_factory=list)
    taken: list[Box] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)

    def side(self, side: int) -> tuple[float, float, bool]:
        """First and last coordinate along a wall, and whether it runs along x."""
        along_x = side in (0, 2)
        return (self.area.x0, self.area.x1, True) if along_x else (self.area.y0, self.area.y1, False)

    def at_wall(self, side: int, along: float, depth: float) -> tuple[float, float]:
        """The point at a place along a wall, `depth` metres before it."""
        area = self.area
        return (
            (along, area.y1 - depth),
            (area.x1 - depth, along),
            (along, area.y0 + depth),
            (area.x0 + depth, along),
        )[side]

    def is_free(self, box: Box) -> bool:
        area = self.area
        over = (area.x0 - box.x0, area.y0 - box.y0, box.x1 - area.x1, box.y1 - area.y1, -box.z0, box.z1 - self.height)
        return bool(max(over) < 1e-6) and not any(box.overlaps(other) for other in self.taken)


@dataclass(frozen=True, slots=True, kw_only=True)
class Home:
    """A furnished home: its rooms, and the things in it."""

    rooms: tuple[tuple[RoomType, Rectangle, float], ...]
    items: tuple[Item, ...]


def plan_home(
    models: Sequence[Model], rng: np.random.Generator, types: Sequence[RoomType] = (), *, made: float = 0.0
) -> Home:
    """Plans a home of one to four rooms, or of the given types of rooms; `made` is the share of makes of our own among
    those of the kinds that have such."""
    if not types:
        count = int(rng.choice([1, 2, 3, 4], p=[0.6, 0.2, 0.12, 0.08]))
        types = [ROOM_TYPES[i] for i in rng.choice(len(ROOM_TYPES), count, p=_FREQUENCIES)]
    height = float(rng.uniform(2.35, 3.0))
    areas = [float(rng.uniform(*_AREAS[each])) for each in types]
    aspect = float(rng.uniform(1.0, 1.7))
    width = math.sqrt(sum(areas) * aspect)
    whole = Rectangle(0.0, 0.0, width, sum(areas) / width)
    rooms = [
        Room(type=kind, area=rectangle, height=height)
        for kind, rectangle in zip(types, _split(whole, areas, rng), strict=True)
    ]
    _open_doorways(rooms, rng)
    by_kind: dict[str, list[Model]] = {}
    for model in models:
        by_kind.setdefault(model.kind.name, []).append(model)
    for room in rooms:
        _Furnisher(room, by_kind, rng, made).furnish()
    items = [item for room in rooms for item in room.items]
    return Home(rooms=tuple((room.type, room.area, room.height) for room in rooms), items=tuple(items))


def _split(area: Rectangle, sizes: Sequence[float], rng: np.random.Generator) -> list[Rectangle]:
    """Splits a rectangle into one for each size, with walls between them."""
    if len(sizes) == 1:
        return [area]
    half = (len(sizes) + 1) // 2 if rng.random() < 0.5 else len(sizes) // 2
    share = sum(sizes[:half]) / sum(sizes)
    if area.x1 - area.x0 > area.y1 - area.y0:
        at = area.x0 + share * (area.x1 - area.x0)
        parts = area._replace(x1=at - THICKNESS / 2), area._replace(x0=at + THICKNESS / 2)
    else:
        at = area.y0 + share * (area.y1 - area.y0)
        parts = area._replace(y1=at - THICKNESS / 2), area._replace(y0=at + THICKNESS / 2)
    return [*_split(parts[0], sizes[:half], rng), *_split(parts[1], sizes[half:], rng)]


def _open_doorways(rooms: Sequence[Room], rng: np.random.Generator) -> None:
    """Opens doorways between rooms that share a wall, until all can be reached if walls are long enough."""
    group = list(range(len(rooms)))
    for i, j in [(one, other) for one in range(len(rooms)) for other in range(one)]:
        for side, other in ((0, 2), (1, 3), (2, 0), (3, 1)):
            a, b = rooms[i].area, rooms[j].area
            gap = {0: b.y0 - a.y1, 1: b.x0 - a.x1, 2: a.y0 - b.y1, 3: a.x0 - b.x1}[side]
            if not math.isclose(gap, THICKNESS, abs_tol=1e-6):
                continue
            first, last, _ = rooms[i].side(side)
            start, end, _ = rooms[j].side(other)
            first, last = max(first, start) + 0.15, min(last, end) - 0.15
            width = float(rng.uniform(0.75, 1.0) if rng.random() < 0.8 else rng.uniform(1.2, 2.0))
            if last - first < width or (group[i] == group[j] and rng.random() < 0.8):
                continue
            at = float(rng.uniform(first, last - width))
            upper = min(float(rng.uniform(1.98, 2.2)), rooms[i].height - 0.1)
            rooms[i].openings.append((side, at, at + width, 0.0, upper))
            rooms[j].openings.append((other, at, at + width, 0.0, upper))
            group = [group[i] if each == group[j] else each for each in group]


class _Furnisher:
    """Furnishes one room."""

    def __init__(self, room: Room, models: dict[str, list[Model]], rng: np.random.Generator, made: float = 0.0) -> None:
        self.room, self.models, self.rng, self.made = room, models, rng, made
        self.supports: list[tuple[Box, float]] = []

    def furnish(self) -> None:
        """Openings and what encloses the room, groups, single things, small things."""
        if self.room.type != "storage room":
            self._doors_and_windows()
        groups: dict[RoomType, Sequence[Callable[[], object]]] = {
            "bedroom": (self._bed, self._bed_or_desk, partial(self._wall, "wardrobe")),
            "living room": (self._seats, self._dining, partial(self._wall, "bookshelf")),
            "kitchen": (self._kitchen_rows, self._dining),
            "bathroom": tuple(partial(self._wall, kind) for kind in ("toilet", "sink", "bathtub")),
            "office": (self._desk, self._desk, self._desk, partial(self._wall, "bookshelf")),
            "corridor": (),
            "storage room": (),
        }
        for group in groups[self.room.type]:
            if self.rng.random() < 0.85:
                group()
        self._extras()
        self._small_things()
        self._enclose()

    # Placing one thing -------------------------------------------------------------------------------------------

    def _draw(self, kind: str, suits: Callable[[Model], bool] = lambda _: True) -> Model | None:
        """A model of a kind, or one of our own; None if there is none."""
        found = [each for each in self.models.get(kind, ()) if suits(each)]
        if self.made and found and kind in makes() and self.rng.random() < self.made:
            made = made_model(kind, self.rng)
            if suits(made):
                return made
        return found[int(self.rng.integers(len(found)))] if found else None

    def _put(self, model: Model, x: float, y: float, z: float, yaw: float, scale: np.ndarray) -> Box | None:
        """Puts a model where it does not overlap anything else; returns its box, None if there is no space."""
        box = box_of(model, x, y, z, yaw, scale)
        if not self.room.is_free(box):
            return None
        self.room.taken.append(box)
        self.room.items.append(Item(kind=model.kind.name, matrix=pose(x, y, z, yaw, scale), model=model))
        if model.top is not None and model.kind.place in ("wall", "free") and model.top * scale[2] < 1.5:
            self.supports.append((box, z + model.top * float(scale[2])))
        return box

    def _front(self) -> float:
        """The direction in which the thing that was placed last looks, as an angle."""
        back = self.room.items[-1].matrix[:2, 1]
        return math.atan2(-back[1], -back[0])

    def _scale(self) -> np.ndarray:
        """A size close to the catalogue's, with slightly other proportions."""
        return self.rng.uniform(0.92, 1.1) * self.rng.uniform(0.95, 1.05, 3)

    def _wall(
        self,
        kind: str,
        *,
        at: tuple[int, float] | None = None,
        scale: np.ndarray | None = None,
        model: Model | None = None,
    ) -> Box | None:
        """Puts a thing with its back to a wall: `at` is a side and the place along it, None = anywhere."""
        model = model or self._draw(kind)
        if model is None:
            return None
        size = self._scale() if scale is None else scale
        for _ in range(1 if at else _TRIES):
            side = at[0] if at else int(self.rng.integers(4))
            first, last, _ = self.room.side(side)
            half = model.size[0] * size[0] / 2
            if last - first < 2 * half:
                continue
            where = at[1] if at else self._along(first + half, last - half)
            depth = model.size[1] * size[1] / 2 + float(self.rng.uniform(0.005, 0.04))
            x, y = self.room.at_wall(side, where, depth)
            if (box := self._put(model, x, y, self._elevation(model, size), -side * math.pi / 2, size)) is not None:
                return box
        return None

    def _along(self, first: float, last: float) -> float:
        """A place along a wall, often in a corner."""
        if self.rng.random() < 0.25:
            return first if self.rng.random() < 0.5 else last
        return float(self.rng.uniform(first, last))

    def _elevation(self, model: Model, scale: np.ndarray) -> float:
        if model.kind.place == "ceiling":
            return self.room.height - model.size[2] * float(scale[2]) - 1e-3
        if model.elevation == 0 and model.kind.place == "mounted":
            return float(self.rng.uniform(1.0, max(1.01, min(1.7, self.room.height - model.size[2] * scale[2]))))
        return model.elevation

    def _anywhere(self, kind: str) -> Box | None:
        """Puts a thing anywhere on the floor, along the walls or turned."""
        model = self._draw(kind)
        if model is None:
            return None
        size = self._scale()
        for _ in range(_TRIES):
            x = float(self.rng.uniform(self.room.area.x0, self.room.area.x1))
            y = float(self.rng.uniform(self.room.area.y0, self.room.area.y1))
            yaw = math.pi / 2 * int(self.rng.integers(4)) + float(self.rng.choice([0.0, self.rng.normal(0, 0.3)]))
            if (box := self._put(model, x, y, self._elevation(model, size), yaw, size)) is not None:
                return box
        return None

    def _next_to(
        self,
        box: Box,
        kind: str,
        angle: float,
        gap: float,
        *,
        shift: float = 0.0,
        turn: float = 0.0,
        model: Model | None = None,
    ) -> Box | None:
        """Puts a thing next to a box, in the direction of an angle (a multiple of 90°), looking at it."""
        model = model or self._draw(kind)
        if model is None:
            return None
        size = self._scale()
        direction = np.array([round(math.cos(angle)), round(math.sin(angle))])
        half = np.array([box.x1 - box.x0, box.y1 - box.y0]) / 2
        center = np.array([box.x0 + box.x1, box.y0 + box.y1]) / 2
        across = np.array([-direction[1], direction[0]])
        x, y = center + direction * (abs(direction @ half) + gap + model.size[1] * size[1] / 2) + across * shift
        # Models look along −y, so a yaw of `angle` − 90° turns their front to the box.
        return self._put(model, float(x), float(y), self._elevation(model, size), angle - math.pi / 2 + turn, size)

    # Groups ------------------------------------------------------------------------------------------------------

    def _bed(self) -> None:
        bed = self._wall("bed")
        if bed is None:
            return
        facing = self.room.items[-1].matrix[:2, 1]
        angle = math.atan2(facing[1], facing[0])
        for side in (-1, 1):
            if self.rng.random() < 0.7:
                self._flank(bed, "nightstand", angle, side)
        self._bedding(bed, angle)

    def _flank(self, box: Box, kind: str, angle: float, side: int) -> Box | None:
        """Puts a thing at the wall that a box stands against, on one side of the box."""
        wall = round(1 - angle / (math.pi / 2)) % 4
        first, last = (box.x0, box.x1) if wall in (0, 2) else (box.y0, box.y1)
        model = self._draw(kind)
        if model is None:
            return None
        size = self._scale()
        half = model.size[0] * float(size[0]) / 2
        gap = float(self.rng.uniform(0.02, 0.12))
        where = first - half - gap if side < 0 else last + half + gap
        return self._wall(kind, at=(wall, where), scale=size, model=model)

    def _bedding(self, bed: Box, angle: float) -> None:
        """Pillows at the head of a bed and a blanket on it; none on a loft bed."""
        is_support = bool(self.supports) and self.supports[-1][0] == bed
        if not is_support and bed.z1 > 1.2:
            return
        z = min(self.supports[-1][1], bed.z1) if is_support else bed.z0 + 0.5
        head = np.array([round(math.cos(angle)), round(math.sin(angle))])
        center = np.array([bed.x0 + bed.x1, bed.y0 + bed.y1]) / 2
        half = np.array([bed.x1 - bed.x0, bed.y1 - bed.y0]) / 2
        across = np.abs([head[1], head[0]])
        width = float(across @ half)
        for each in np.linspace(-0.5, 0.5, 2 if width > 0.6 else 1) if self.rng.random() < 0.7 else ():
            spot = center + head * (abs(head @ half) - 0.35) + across * width * (each if width > 0.6 else 0.0)
            size = np.abs(head) * 0.38 + across * min(0.6, 0.8 * width)
            self._shape("pillow", slab(size[0], size[1], 0.12, rounded=True), spot[0], spot[1], z, "fabric")
        if self.rng.random() < 0.5:
            share = float(self.rng.uniform(0.35, 0.75))
            spot = center - head * abs(head @ half) * (1 - share)
            size = 2 * (np.abs(head) * abs(head @ half) * share + across * width) + 0.04
            self._shape("blanket", slab(size[0], size[1], 0.03, skirt=0.2), spot[0], spot[1], z, "fabric")

    def _shape(self, kind: str, shape: Mesh, x: float, y: float, z: float, finish: str) -> None:
        matrix = pose(x, y, z, 0.0, np.ones(3))
        self.room.items.append(Item(kind=kind, matrix=matrix, shape=shape, finish=finish))

    def _bed_or_desk(self) -> None:
        self._desk() if self.rng.random() < 0.5 else self._wall("dresser")

    def _desk(self) -> None:
        desk = self._wall("desk") if self.rng.random() < 0.8 else self._anywhere("desk")
        if desk is None:
            return
        angle = self._front()
        chair = "office chair" if self.rng.random() < 0.6 else "chair"
        gap, turn = float(self.rng.uniform(-0.35, 0.25)), float(self.rng.normal(0, 0.4))
        if self._next_to(desk, chair, angle, gap, turn=turn) is None:
            self._next_to(desk, chair, angle, 0.05)
        for kind, share in _ON_DESKS.items():
            if self.rng.random() < share:
                self._on(desk, kind, angle)

    def _seats(self) -> None:
        couch = self._wall("couch") if self.rng.random() < 0.75 else self._anywhere("couch")
        if couch is None:
            return
        angle = self._front()
        table = self._next_to(couch, "coffee table", angle, float(self.rng.uniform(0.25, 0.5)))
        if table is not None:
            for turn in (-math.pi / 2, math.pi / 2):
                if self.rng.random() < 0.5:
                    self._next_to(table, "armchair", angle + turn, float(self.rng.uniform(0.2, 0.5)))
        stand = self._wall("tv stand")
        if stand is not None:
            self._on(stand, "tv", self._front())
        if self.rng.random() < 0.6:
            self._rug(table or couch)

    def _rug(self, around: Box) -> None:
        """A rug of our own, around a thing."""
        x, y = (around.x0 + around.x1) / 2, (around.y0 + around.y1) / 2
        half = np.array([around.x1 - around.x0, around.y1 - around.y0]) / 2 + self.rng.uniform(0.2, 0.8, 2)
        area = self.room.area
        half = np.minimum(half, [min(x - area.x0, area.x1 - x), min(y - area.y0, area.y1 - y)]) - 0.02
        if half.min() > 0.3:
            self._shape("rug", slab(2 * half[0], 2 * half[1], 0.012), x, y, 0.0, "rug")

    def _dining(self) -> None:
        table = self._anywhere("table") if self.rng.random() < 0.7 else self._wall("table")
        if table is None:
            return
        chair = self._draw("chair")
        if chair is None:
            return
        for angle in (0.0, math.pi / 2, math.pi, -math.pi / 2):
            long = (table.y1 - table.y0) if abs(math.cos(angle)) > 0.5 else (table.x1 - table.x0)
            count = max(1, int(long / 0.62))
            for number in range(count):
                if self.rng.random() < 0.75:
                    shift = (number - (count - 1) / 2) * long / count
                    gap = float(self.rng.uniform(-0.25, 0.2))
                    turn = float(self.rng.normal(0, 0.15))
                    if self._next_to(table, "chair", angle, gap, shift=shift, turn=turn, model=chair) is None:
                        self._next_to(table, "chair", angle, 0.03, shift=shift, model=chair)

    def _kitchen_rows(self) -> None:
        """Rows along one wall, or along two or three that meet, of one height and one make of cabinets."""
        side, height, depth = int(self.rng.integers(4)), self.rng.uniform(0.82, 0.92), self.rng.uniform(0.55, 0.65)
        cabinet = self._draw("kitchen cabinet", _is_low)
        high = self._draw("kitchen cabinet", lambda each: each.elevation > 0.8)
        for number in range(int(self.rng.choice([1, 2, 3], p=[0.5, 0.35, 0.15]))):
            self._kitchen_row((side + number) % 4, float(height), float(depth), cabinet, high)

    def _kitchen_row(self, side: int, height: float, depth: float, cabinet: Model | None, high: Model | None) -> None:
        """Cabinets, a stove, a sink and an oven along a wall, with a counter on them and cabinets above."""
        first, last, along_x = self.room.side(side)
        at, end = first + 0.02, last - 0.02
        runs: list[tuple[float, float]] = []
        start = at
        for kind in ("refrigerator", *self.rng.permutation(_KITCHEN_ROW).tolist()):
            low = kind != "refrigerator"
            if not low and self.rng.random() < 0.3:
                continue
            model = cabinet if kind == "kitchen cabinet" and self.rng.random() < 0.8 else self._draw(kind, _is_low)
            if model is None:
                continue
            scale = np.array([1.0, depth / model.size[1] if low else 1.0, height / model.size[2] if low else 1.0])
            width = model.size[0]
            if at + width > end:
                break
            placed = self._wall(kind, at=(side, at + width / 2), scale=scale, model=model)
            if placed is None or not low:
                if at > start and low:
                    runs.append((start, at))
                start = at + width
            at += width
        if at > start:
            runs.append((start, at))
        for begin, finish in runs:
            middle, length = (begin + finish) / 2, finish - begin
            x, y = self.room.at_wall(side, middle, depth / 2 + 0.02)
            size = (length, depth + 0.03) if along_x else (depth + 0.03, length)
            self._shape("counter", slab(size[0], size[1], 0.035), x, y, height, "stone")
            box = Box(x - size[0] / 2, y - size[1] / 2, height, x + size[0] / 2, y + size[1] / 2, height + 0.035)
            self.supports.append((box, height + 0.036))
            where = begin
            while high is not None and where + high.size[0] < finish + 0.05 and self.rng.random() < 0.85:
                self._wall("kitchen cabinet", at=(side, where + high.size[0] / 2), scale=np.ones(3), model=high)
                where += high.size[0]

    # Single and small things ---------------------------------------------------------------------------------------

    def _weights(self, places: Sequence[str]) -> tuple[list[str], np.ndarray]:
        """The kinds with models that this room may have at some places, and how often."""
        names, weights = [], []
        for name, kind in kinds().items():
            frequency = 1.0 if self.room.type == "storage room" else kind.rooms.get(self.room.type, 0.0)
            if kind.place in places and frequency > 0 and self.models.get(name):
                names.append(name)
                weights.append(frequency)
        total = np.array(weights)
        return names, total / max(total.sum(), 1e-9)

    def _extras(self) -> None:
        stored = self.room.type == "storage room"
        names, weights = self._weights(("wall", "free", "mounted", "ceiling", "floor", *(["surface"] * stored)))
        area = self.room.area.size
        lower, upper = _EXTRAS[self.room.type]
        count = round(float(self.rng.uniform(lower, upper)) * min(2.0, max(0.5, area / 14)))
        for name in self.rng.choice(names, count, p=weights).tolist() if names else ():
            place = kinds()[name].place
            if place == "mounted" or (place == "wall" and not (stored and self.rng.random() < 0.5)):
                self._wall(name)
            else:
                self._anywhere(name)
        for _ in range(int(self.rng.integers(6))):
            self._picture()
        if self.rng.random() < 0.6:
            self._anywhere("ceiling light")

    def _picture(self) -> None:
        """A picture or a mirror of our own on a wall."""
        side, size = int(self.rng.integers(4)), 0.15 * (1.1 / 0.15) ** self.rng.random(2)
        first, last, along_x = self.room.side(side)
        if last - first < size[0] + 0.2:
            return
        at = float(self.rng.uniform(first + size[0] / 2, last - size[0] / 2))
        z = float(self.rng.uniform(1.1, max(1.11, min(1.6, self.room.height - size[1] - 0.05))))
        depth = 0.03
        x, y = self.room.at_wall(side, at, depth / 2)
        half = (size[0] / 2, depth / 2) if along_x else (depth / 2, size[0] / 2)
        box = Box(x - half[0], y - half[1], z, x + half[0], y + half[1], z + size[1])
        if self.room.is_free(box):
            self.room.taken.append(box)
            mirror = self.room.type in ("bathroom", "bedroom", "corridor") and self.rng.random() < 0.4
            kind = "mirror" if mirror else "picture"
            self._shape(kind, slab(2 * half[0], 2 * half[1], float(size[1])), x, y, z, kind)

    def _on(self, box: Box, kind: str, angle: float | None = None) -> Box | None:
        """Puts a thing on another, that looks in the direction of an angle."""
        model = self._draw(kind)
        support = next((each for each in self.supports if each[0] == box), None)
        if model is None or support is None:
            return None
        size = self._scale()
        for _ in range(6):
            turn = self.rng.uniform(-math.pi, math.pi) if angle is None else self.rng.normal(angle + math.pi / 2, 0.15)
            yaw = float(turn)
            x, y = float(self.rng.uniform(box.x0, box.x1)), float(self.rng.uniform(box.y0, box.y1))
            place = box_of(model, x, y, support[1], yaw, size)
            over = (box.x0 - place.x0, place.x1 - box.x1, box.y0 - place.y0, place.y1 - box.y1)
            if max(over) > 0.03:
                continue
            others = [other for other in self.room.taken if other != box]
            if place.z1 > self.room.height or any(place.overlaps(other) for other in others):
                continue
            self.room.taken.append(place)
            self.room.items.append(Item(kind=kind, matrix=pose(x, y, support[1], yaw, size), model=model))
            return place
        return None

    def _small_things(self) -> None:
        names, weights = self._weights(("surface",))
        for box, _ in list(self.supports) if names else ():
            mean = min(8.0, 3 * max(box.x1 - box.x0, box.y1 - box.y0))
            for name in self.rng.choice(names, int(self.rng.poisson(mean)), p=weights).tolist():
                self._on(box, name)

    # Openings and what encloses a room --------------------------------------------------------------------------

    def _doors_and_windows(self) -> None:
        room = self.room
        doors = list(room.openings)
        windows = int(self.rng.integers(0, 4)) if room.type != "corridor" else 0
        for number in range(windows + (not doors or self.rng.random() < 0.3)):
            is_door = number == windows
            side = int(self.rng.integers(4))
            first, last, _ = room.side(side)
            width = float(self.rng.uniform(0.8, 1.0) if is_door else self.rng.uniform(0.6, 2.4))
            lower = 0.0 if is_door or self.rng.random() < 0.2 else float(self.rng.uniform(0.5, 1.1))
            upper = min(room.height - 0.1, float(self.rng.uniform(2.0, 2.3)))
            if last - first < width + 0.3:
                continue
            at = float(self.rng.uniform(first + 0.15, last - 0.15 - width))
            same = (each for each in room.openings if each[0] == side)
            if any(at < each[2] + 0.2 and each[1] < at + width + 0.2 for each in same):
                continue
            opening = (side, at, at + width, lower, upper)
            room.openings.append(opening)
            self._fill(opening, "door" if is_door else "window")
            if not is_door and self.rng.random() < 0.5:
                self._curtains(opening)
        for opening in doors:
            if self.rng.random() < 0.5:
                self._fill(opening, "door")
        for side, first, last, lower, upper in room.openings:
            deep = 0.8 if lower == 0 else 0.12
            room.taken.append(self._before(side, first, last, lower, upper, deep))

    def _before(self, side: int, first: float, last: float, lower: float, upper: float, deep: float) -> Box:
        """The space before a part of a wall."""
        area = self.room.area
        return {
            0: Box(first, area.y1 - deep, lower, last, area.y1, upper),
            1: Box(area.x1 - deep, first, lower, area.x1, last, upper),
            2: Box(first, area.y0, lower, last, area.y0 + deep, upper),
            3: Box(area.x0, first, lower, area.x0 + deep, last, upper),
        }[side]

    def _fill(self, opening: tuple[int, float, float, float, float], kind: str) -> None:
        """Puts a door or a window into an opening, scaled to it."""
        model = self._draw(kind)
        if model is None:
            return
        side, first, last, lower, upper = opening
        depth = min(model.size[1], 0.1)
        scale = np.array([(last - first) / model.size[0], depth / model.size[1], (upper - lower) / model.size[2]])
        at = (first + last) / 2
        x, y = self.room.at_wall(side, at, -THICKNESS / 2)
        matrix = pose(x, y, lower, -side * math.pi / 2, scale)
        self.room.items.append(Item(kind=kind, matrix=matrix, model=model))

    def _curtains(self, opening: tuple[int, float, float, float, float]) -> None:
        """Curtains at both sides of a window, or drawn before it."""
        side, first, last, lower, _ = opening
        start, end, _ = self.room.side(side)
        top = self.room.height - float(self.rng.uniform(0.02, 0.25))
        bottom = float(self.rng.uniform(0.02, 0.1)) if self.rng.random() < 0.7 else max(0.02, lower - 0.1)
        width = (last - first) * float(self.rng.uniform(0.2, 0.5))
        for begin, finish in ((first - 0.15, first - 0.15 + width), (last + 0.15 - width, last + 0.15)):
            begin, finish = max(begin, start + 0.02), min(finish, end - 0.02)
            if finish - begin < 0.1:
                continue
            x, y = self.room.at_wall(side, (begin + finish) / 2, 0.1)
            folds = int(self.rng.integers(3, 9))
            matrix = pose(x, y, bottom, -side * math.pi / 2, np.ones(3))
            shape = curtain(finish - begin, top - bottom, folds)
            self.room.items.append(Item(kind="curtain", matrix=matrix, shape=shape, finish="fabric"))
            self.room.taken.append(self._before(side, begin, finish, bottom, top, 0.15))

    def _enclose(self) -> None:
        """Walls with their openings, floor and ceiling."""
        walls, floor, ceiling = panels(self.room.area, self.room.height, self.room.openings, THICKNESS)
        identity = pose(0.0, 0.0, 0.0, 0.0, np.ones(3))
        around = (("wall", walls), ("ceiling", ceiling)) if self.room.type != "storage room" else ()
        for kind, shape in (("floor", floor), *around):
            self.room.items.append(Item(kind=kind, matrix=identity, shape=shape, finish=kind))


def _is_low(model: Model) -> bool:
    """Whether a model stands on the floor and reaches about the height of a counter."""
    return model.elevation < 0.2 and model.size[2] > 0.5


def pose(x: float, y: float, z: float, yaw: float, scale: np.ndarray) -> Float64[np.ndarray, "3 4"]:
    """world_from_item of a thing that is scaled, turned about z and moved."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return np.column_stack([turn * scale, [x, y, z]])


def box_of(model: Model, x: float, y: float, z: float, yaw: float, scale: np.ndarray) -> Box:
    """The space that a model takes."""
    half = np.array(model.size[:2]) * scale[:2] / 2
    cos, sin = abs(math.cos(yaw)), abs(math.sin(yaw))
    dx, dy = cos * half[0] + sin * half[1], sin * half[0] + cos * half[1]
    return Box(x - dx, y - dy, z, x + dx, y + dy, z + model.size[2] * float(scale[2]))
