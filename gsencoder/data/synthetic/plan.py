"""The plan of a procedural room: furniture, and named objects in named colors on top of it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.synthetic.shapes import Solid

COLORS: dict[str, tuple[int, int, int]] = {
    "red": (205, 30, 35),
    "orange": (245, 128, 28),
    "yellow": (245, 218, 45),
    "green": (42, 155, 62),
    "blue": (35, 80, 200),
    "purple": (122, 52, 162),
    "pink": (246, 150, 182),
    "black": (28, 28, 30),
    "white": (238, 238, 236),
    "grey": (150, 150, 152),
    "brown": (122, 78, 42),
}
"""sRGB of the color words that the rooms use."""
OBJECT_COLORS = ("red", "blue", "yellow", "green", "purple", "pink", "orange", "black")
HALF_ROOM = (1.7, 1.5)
WALL_HEIGHT = 1.8
TABLE = (0.78, 0.52, 0.72)
"""Half width, half depth, height of the table in the middle."""
SHELF = (0.65, 0.16, 0.9)
"""Half width, half depth, height of the shelf at the wall y = +1.5."""
GAP = 0.03
"""Least distance between two objects."""
FLOOR_ID, WALL_ID, TABLE_ID, SHELF_ID, FIRST_ID = 1, 2, 3, 4, 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedObject:
    """A thing in a room.

    Attributes:
        id: its value in the instance maps.
        name: an English noun of the name table; None for floor and walls.
        color: its word in COLORS.
        parts: what it is made of, in world coordinates.
        pattern: how its color varies: plain, bands, or checks.
        placed: False for the room and its furniture.
    """

    id: int
    name: str | None
    color: str
    parts: tuple[Solid, ...]
    pattern: str = "bands"
    placed: bool = True

    def aabb(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """The exact axis-aligned box of all parts."""
        boxes = [part.aabb() for part in self.parts]
        return np.min([lower for lower, _ in boxes], axis=0), np.max([upper for _, upper in boxes], axis=0)


def plan_room(seed: int = 0, *, objects: int = 8) -> tuple[PlannedObject, ...]:
    """Floor, walls, table, shelf, then `objects` things with distinct names, from the seed alone.

    Colors are distinct too for up to 8 objects.

    Raises:
        InputError: `objects` is below 0 or above the number of known things.
    """
    if not 0 <= objects <= len(_CATALOGUE):
        raise InputError(f"synthetic room: objects must lie between 0 and {len(_CATALOGUE)}, got {objects}")
    rng = np.random.default_rng(seed)
    furniture = _furniture()
    names = [list(_CATALOGUE)[row] for row in rng.permutation(len(_CATALOGUE))[:objects]]
    colors = [OBJECT_COLORS[row % len(OBJECT_COLORS)] for row in _shuffled(rng, objects)]
    circles: list[tuple[float, np.ndarray]] = []
    placed_objects = []
    # Wide things first: small ones fit between them.
    order = sorted(range(objects), key=lambda row: -_radius(_CATALOGUE[names[row]][1]()))
    homes = {}
    for row in order:
        on_floor, build = _CATALOGUE[names[row]]
        parts = build()
        homes[row] = _find_home(rng, _radius(parts), on_floor, circles)
    for row in range(objects):
        parts = _CATALOGUE[names[row]][1]()
        yaw = float(rng.uniform(-np.pi, np.pi))
        stood = tuple(_stand(part, homes[row], yaw) for part in parts)
        placed_objects.append(PlannedObject(id=FIRST_ID + row, name=names[row], color=colors[row], parts=stood))
    return (*furniture, *placed_objects)


def _shuffled(rng: np.random.Generator, count: int) -> list[int]:
    """`count` color numbers, each color once before any comes again."""
    rounds = -(-count // len(OBJECT_COLORS))
    return [int(row) for _ in range(rounds) for row in rng.permutation(len(OBJECT_COLORS))][:count]


def _find_home(
    rng: np.random.Generator, radius: float, on_floor: bool, circles: list[tuple[float, np.ndarray]]
) -> Float64[np.ndarray, "3"]:
    """A free spot of a support, where a disc of `radius` touches no other and does not stick out."""
    table = (np.zeros(2), np.array(TABLE[:2]), TABLE[2])
    shelf = (np.array([0, HALF_ROOM[1] - SHELF[1]]), np.array(SHELF[:2]), SHELF[2])
    floor = [
        (np.array([side * (HALF_ROOM[0] + TABLE[0]) / 2, 0.0]), np.array([(HALF_ROOM[0] - TABLE[0]) / 2, 1.1]), 0.0)
        for side in (-1.0, 1.0)
    ]
    supports = floor if on_floor else [table] * 3 + [shelf] + floor
    for attempt in range(3000):
        # After many failures only the floor is left.
        center, half, height = floor[attempt % 2] if attempt > 1500 else supports[rng.integers(len(supports))]
        if not on_floor and height == 0 and attempt <= 500:
            continue
        room = half - radius - 0.01
        if (room < 0).any():
            continue
        spot = np.append(center + rng.uniform(-room, room), height)
        clear = all(np.hypot(*(spot - other)[:2]) > radius + reach + GAP for reach, other in circles)
        if clear:
            circles.append((radius, spot))
            return spot
    raise InputError("synthetic room: no free place for all objects; ask for fewer")


def _stand(part: Solid, home: np.ndarray, yaw: float) -> Solid:
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Solid(shape=part.shape, center=home + turn @ part.center, half=part.half, yaw=part.yaw + yaw)


def _radius(parts: tuple[Solid, ...]) -> float:
    """Radius about the vertical axis of the disc that holds the parts at any turn."""
    reach = [
        np.hypot(*part.center[:2]) + (np.hypot(*part.half[:2]) if part.shape == "box" else part.half[:2].max())
        for part in parts
    ]
    return float(max(reach))


def _box(x: float | int, y: float | int, z: float | int, at: tuple[float | int, ...]) -> Solid:
    """A box of full sizes x y z whose lower face is centered at `at`."""
    return Solid(shape="box", center=np.array([at[0], at[1], at[2] + z / 2]), half=np.array([x, y, z]) / 2)


def _round(radius: float, height: float, at: tuple[float | int, ...] = (0, 0, 0)) -> Solid:
    return Solid(
        shape="cylinder",
        center=np.array([at[0], at[1], at[2] + height / 2]),
        half=np.array([radius, radius, height / 2]),
    )


def _ball(x: float, y: float, z: float) -> Solid:
    """An ellipsoid of half axes x y z that touches the ground."""
    return Solid(shape="ellipsoid", center=np.array([0.0, 0.0, z]), half=np.array([x, y, z]))


def _legs(x: float, y: float, height: float, thick: float) -> tuple[Solid, ...]:
    return tuple(_box(thick, thick, height, (sx * x, sy * y, 0.0)) for sx in (-1, 1) for sy in (-1, 1))


def _furniture() -> tuple[PlannedObject, ...]:
    x, y, wall = *HALF_ROOM, WALL_HEIGHT
    floor = (_box(2 * x, 2 * y, 0.1, (0, 0, -0.1)),)
    walls: tuple[Solid, ...] = tuple(_box(0.1, 2 * y + 0.2, wall, (side * (x + 0.05), 0, 0)) for side in (-1, 1))
    walls += tuple(_box(2 * x, 0.1, wall, (0, side * (y + 0.05), 0)) for side in (-1, 1))
    tx, ty, tz = TABLE
    table: tuple[Solid, ...] = (
        _box(2 * tx, 2 * ty, 0.04, (0, 0, tz - 0.04)),
        *_legs(tx - 0.06, ty - 0.06, tz - 0.04, 0.06),
    )
    sx, sy, sz = SHELF
    at = y - sy
    shelf: tuple[Solid, ...] = (
        _box(2 * sx, 2 * sy, 0.03, (0, at, sz - 0.03)),
        _box(2 * sx, 2 * sy, 0.03, (0, at, 0.35)),
    )
    shelf += tuple(_box(0.03, 2 * sy, sz - 0.03, (side * (sx - 0.015), at, 0)) for side in (-1, 1))
    return (
        PlannedObject(id=FLOOR_ID, name=None, color="grey", parts=floor, pattern="checks", placed=False),
        PlannedObject(id=WALL_ID, name=None, color="white", parts=walls, pattern="plain", placed=False),
        PlannedObject(id=TABLE_ID, name="table", color="brown", parts=table, placed=False),
        PlannedObject(id=SHELF_ID, name="shelf", color="brown", parts=shelf, placed=False),
    )


_CATALOGUE: dict[str, tuple[bool, Callable[[], tuple[Solid, ...]]]] = {
    # name: (stands on the floor, parts around the origin with their feet at z = 0)
    "mug": (False, lambda: (_round(0.05, 0.11), _box(0.04, 0.02, 0.06, (0.065, 0, 0.025)))),
    "book": (False, lambda: (_box(0.24, 0.17, 0.045, (0, 0, 0)),)),
    "ball": (False, lambda: (_ball(0.09, 0.09, 0.09),)),
    "lamp": (False, lambda: (_round(0.08, 0.03), _round(0.015, 0.2, (0, 0, 0.03)), _round(0.11, 0.15, (0, 0, 0.23)))),
    "chair": (
        True,
        lambda: (
            *_legs(0.17, 0.17, 0.42, 0.04),
            _box(0.4, 0.4, 0.05, (0, 0, 0.42)),
            _box(0.4, 0.05, 0.4, (0, 0.175, 0.47)),
        ),
    ),
    "pillow": (False, lambda: (_ball(0.17, 0.12, 0.06),)),
    "bottle": (False, lambda: (_round(0.045, 0.19), _round(0.02, 0.07, (0, 0, 0.19)))),
    "apple": (False, lambda: (_ball(0.055, 0.055, 0.05),)),
    "box": (False, lambda: (_box(0.22, 0.16, 0.14, (0, 0, 0)),)),
    "candle": (False, lambda: (_round(0.035, 0.16),)),
    "vase": (False, lambda: (_ball(0.075, 0.075, 0.09), _round(0.04, 0.1, (0, 0, 0.15)))),
    "lemon": (False, lambda: (_ball(0.065, 0.045, 0.045),)),
    "bowl": (False, lambda: (_round(0.045, 0.02), _round(0.1, 0.05, (0, 0, 0.02)))),
    "plate": (False, lambda: (_round(0.13, 0.025),)),
    "clock": (False, lambda: (_box(0.16, 0.05, 0.17, (0, 0, 0)),)),
    "stool": (True, lambda: (*_legs(0.12, 0.12, 0.4, 0.04), _round(0.2, 0.05, (0, 0, 0.4)))),
    "barrel": (True, lambda: (_round(0.2, 0.55),)),
    "basket": (True, lambda: (_box(0.36, 0.28, 0.24, (0, 0, 0)),)),
}
