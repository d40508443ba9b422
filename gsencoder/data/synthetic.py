"""Procedural rooms: their plan, the shapes in them, rendered photographs with depth and labels, and their files."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_bytes, write_picture
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.points import OPACITY, SIZE, THICKNESS, quats_from_normals
from gsencoder.types import Cameras, Gaussians, Scene, SceneObject, Views, sh_from_colors
from gsencoder.types.scene import OPENCV_FROM_OPENGL


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """A convex solid that is turned about the vertical axis."""

    shape: Literal["box", "ellipsoid", "cylinder"]  # box, ellipsoid, or cylinder (upright, elliptic)
    center: Float64[np.ndarray, "3"]  # metres
    half: Float64[np.ndarray, "3"]  # half extents along its own axes
    yaw: float = 0.0  # radians about +z

    @property
    def world_from_local(self) -> Float64[np.ndarray, "3 3"]:
        return _turn(self.yaw)

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
        q = replace(self, half=self.half + margin).to_unit(points)
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
            unit = _fibonacci(max(16, int(np.ceil(4 * np.pi * self.half.max() ** 2 / spacing**2))))
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


def _turn(yaw: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


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
TABLE = (0.78, 0.52, 0.72)  # Half width, half depth, height of the table in the middle
SHELF = (0.65, 0.16, 0.9)  # Half width, half depth, height of the shelf at the wall y = +1.5
GAP = 0.03  # Least distance between two objects
FLOOR_ID, WALL_ID, TABLE_ID, SHELF_ID, FIRST_ID = 1, 2, 3, 4, 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedObject:
    """A thing in a room."""

    id: int  # its value in the instance maps
    name: str | None  # an English noun of the name table; None for floor and walls
    color: str  # its word in COLORS
    parts: tuple[Solid, ...]  # what it is made of, in world coordinates
    pattern: str = "bands"  # how its color varies: plain, bands, or checks
    placed: bool = True  # False for the room and its furniture

    def aabb(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """The exact axis-aligned box of all parts."""
        boxes = [part.aabb() for part in self.parts]
        return np.min([lower for lower, _ in boxes], axis=0), np.max([upper for _, upper in boxes], axis=0)


def plan_room(seed: int = 0, *, objects: int = 8) -> tuple[PlannedObject, ...]:
    """Floor, walls, table, shelf, then `objects` things with distinct names, from the seed alone.

    Colors are distinct too for up to 8 objects.
    """
    if not 0 <= objects <= len(_CATALOGUE):
        raise InputError(f"synthetic room: objects must lie between 0 and {len(_CATALOGUE)}, got {objects}")
    rng = np.random.default_rng(seed)
    furniture = _furniture()
    names = [list(_CATALOGUE)[row] for row in rng.permutation(len(_CATALOGUE))[:objects]]
    # Each color once before any comes again.
    rounds = -(-objects // len(OBJECT_COLORS))
    colors = [OBJECT_COLORS[row] for _ in range(rounds) for row in rng.permutation(len(OBJECT_COLORS))]
    circles: list[tuple[float, np.ndarray]] = []
    placed_objects = []
    # Wide things first: small ones fit between them.
    order = sorted(range(objects), key=lambda row: -_radius(_CATALOGUE[names[row]][1]()))
    homes = {}
    for row in order:
        on_floor, build = _CATALOGUE[names[row]]
        homes[row] = _find_home(rng, _radius(build()), on_floor, circles)
    for row in range(objects):
        parts = _CATALOGUE[names[row]][1]()
        yaw = float(rng.uniform(-np.pi, np.pi))
        turn = _turn(yaw)
        stood = tuple(replace(part, center=homes[row] + turn @ part.center, yaw=part.yaw + yaw) for part in parts)
        placed_objects.append(PlannedObject(id=FIRST_ID + row, name=names[row], color=colors[row], parts=stood))
    return (*furniture, *placed_objects)


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
        if all(np.hypot(*(spot - other)[:2]) > radius + reach + GAP for reach, other in circles):
            circles.append((radius, spot))
            return spot
    raise InputError("synthetic room: no free place for all objects; ask for fewer")


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


def _cylinder(radius: float, height: float, at: tuple[float | int, ...] = (0, 0, 0)) -> Solid:
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
    # Name: (stands on the floor, parts around the origin with their feet at z = 0)
    "mug": (False, lambda: (_cylinder(0.05, 0.11), _box(0.04, 0.02, 0.06, (0.065, 0, 0.025)))),
    "book": (False, lambda: (_box(0.24, 0.17, 0.045, (0, 0, 0)),)),
    "ball": (False, lambda: (_ball(0.09, 0.09, 0.09),)),
    "lamp": (
        False,
        lambda: (_cylinder(0.08, 0.03), _cylinder(0.015, 0.2, (0, 0, 0.03)), _cylinder(0.11, 0.15, (0, 0, 0.23))),
    ),
    "chair": (
        True,
        lambda: (
            *_legs(0.17, 0.17, 0.42, 0.04),
            _box(0.4, 0.4, 0.05, (0, 0, 0.42)),
            _box(0.4, 0.05, 0.4, (0, 0.175, 0.47)),
        ),
    ),
    "pillow": (False, lambda: (_ball(0.17, 0.12, 0.06),)),
    "bottle": (False, lambda: (_cylinder(0.045, 0.19), _cylinder(0.02, 0.07, (0, 0, 0.19)))),
    "apple": (False, lambda: (_ball(0.055, 0.055, 0.05),)),
    "box": (False, lambda: (_box(0.22, 0.16, 0.14, (0, 0, 0)),)),
    "candle": (False, lambda: (_cylinder(0.035, 0.16),)),
    "vase": (False, lambda: (_ball(0.075, 0.075, 0.09), _cylinder(0.04, 0.1, (0, 0, 0.15)))),
    "lemon": (False, lambda: (_ball(0.065, 0.045, 0.045),)),
    "bowl": (False, lambda: (_cylinder(0.045, 0.02), _cylinder(0.1, 0.05, (0, 0, 0.02)))),
    "plate": (False, lambda: (_cylinder(0.13, 0.025),)),
    "clock": (False, lambda: (_box(0.16, 0.05, 0.17, (0, 0, 0)),)),
    "stool": (True, lambda: (*_legs(0.12, 0.12, 0.4, 0.04), _cylinder(0.2, 0.05, (0, 0, 0.4)))),
    "barrel": (True, lambda: (_cylinder(0.2, 0.55),)),
    "basket": (True, lambda: (_box(0.36, 0.28, 0.24, (0, 0, 0)),)),
}


def write_room(scene: Scene, folder: str | Path) -> None:
    """Writes a scene with images, depth and instance maps as a new folder that `load_scene` reads.

    images/*.png, depth/*.png (uint16 millimetres, 0 = none), instance/*.png (uint16), objects.json and, last,
    transforms.json (nerfstudio: OpenGL axes, camera to world).
    """
    folder, views = Path(folder), scene.views
    if views is None or not len(views) or views.images is None or views.depths is None or views.instances is None:
        raise InputError(f"{folder}: a room to write needs views with images, depth and instance maps")
    if scene.metres_per_unit is None:
        raise InputError(f"{folder}: depth files are in millimetres, but the scene's metres_per_unit is unknown")
    cameras = views.cameras
    if (cameras.Ks != cameras.Ks[0]).any() or len(set(zip(cameras.widths, cameras.heights, strict=True))) > 1:
        raise InputError(f"{folder}: the views of a room to write must share one camera")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists and is not an empty folder; choose another name")
    for name in ("images", "depth", "instance"):
        (folder / name).mkdir(parents=True)
    world_from_cam = cameras.world_from_cam
    world_from_cam[:, :3, 3] += scene.origin
    frames = []
    for view in range(len(views)):
        stem = f"{view:03d}.png"
        millimetres = np.rint(views.depths[view].astype(np.float64) * (1000 * scene.metres_per_unit))
        if millimetres.max(initial=0) > 65535:
            raise InputError(f"view {views.names[view]!r}: depth above 65.535 m does not fit in uint16 millimetres")
        write_picture(folder / "images" / stem, views.images[view])
        write_picture(folder / "depth" / stem, millimetres.astype(np.uint16))
        write_picture(folder / "instance" / stem, views.instances[view].astype(np.uint16))
        frames.append(
            {
                "file_path": f"images/{stem}",
                "depth_file_path": f"depth/{stem}",
                "instance_file_path": f"instance/{stem}",
                "transform_matrix": (world_from_cam[view] @ OPENCV_FROM_OPENGL).tolist(),
            }
        )
    objects = [
        {
            "id": each.id,
            "category": each.name or "room",
            "name": each.name,
            "aabb_min": each.aabb_min.tolist(),
            "aabb_max": each.aabb_max.tolist(),
            "views": each.views,
            "max_pixels": each.max_pixels,
            "placed": each.placed,
        }
        for each in scene.objects
    ]
    K = cameras.Ks[0].astype(float)
    transforms = {
        "camera_model": "PINHOLE",
        "w": int(cameras.widths[0]),
        "h": int(cameras.heights[0]),
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "depth_unit_scale_factor": 0.001,
        "frames": frames,
    }
    for name, content in (("objects.json", objects), ("transforms.json", transforms)):
        write_bytes(folder / name, json.dumps(content, indent=1).encode())


__all__ = ["color_words", "make_room", "plan_room", "write_room"]

FOCAL = 0.7  # Focal length as a share of the width: 71° from side to side
AMBIENT = 0.6
LIGHT = np.array([0.35, -0.5, 0.79])
CELLS_ACROSS = 6
"""A part of an object has at least this many Gaussians across its middle extent, however coarse the spacing is."""
FINEST = 0.008  # … but none closer than this, metres
CONTACT = 1e-4


def make_room(
    seed: int = 0, *, objects: int = 8, views: int = 16, width: int = 160, height: int = 120, spacing: float = 0.04
) -> Scene:
    """A room of 3.4 × 3 m with a table, a shelf and named objects on them, in metres with z up.

    Images are ray-cast without noise: flat colors with a pattern, one light, no shadows. Depth is exact z. Instance
    maps hold the objects' ids (floor 1, walls 2, table 3, shelf 4, the others from 5). Boxes are exact and full. The
    Gaussians are flat discs on the visible surfaces with the colors of the images, `spacing` apart, closer on small
    things, twice as far on the plain walls; what touches another surface is left out. The same arguments give the
    same bits on the same machine.

    Args:
        objects: named things, with distinct names, and distinct colors up to 8.
        views: cameras on a ring around the table, looking at it.
        width: of the images, pixels.
        spacing: between Gaussians, metres.
    """
    plan = plan_room(seed, objects=objects)
    cameras = _cameras(seed, views, width, height)
    surfaces = [_Surface(part, planned) for planned in plan for part in planned.parts]
    pictures = [_cast(surfaces, cameras, view) for view in range(views)]
    scene_objects = []
    for planned in plan:
        lower, upper = planned.aabb()
        scene_objects.append(
            SceneObject(
                id=planned.id, name=planned.name, aabb_min=lower, aabb_max=upper, placed=planned.placed,
                views=None, max_pixels=None,
            )
        )  # fmt: skip
    scene = Scene(
        name=f"room_{seed:03d}",
        gaussians=_gaussians(surfaces, spacing),
        views=Views(
            cameras=cameras,
            names=tuple(f"images/{view:03d}.png" for view in range(views)),
            images=[image for image, _, _ in pictures],
            depths=[depth for _, depth, _ in pictures],
            instances=[labels for _, _, labels in pictures],
        ),
        metres_per_unit=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        objects=tuple(scene_objects),
    )
    return with_counted_views(scene)


def color_words(seed: int = 0, *, objects: int = 8) -> dict[int, str]:
    """The color word of each object of `make_room(seed, objects=objects)`, by id."""
    return {planned.id: planned.color for planned in plan_room(seed, objects=objects)}


@dataclass(frozen=True, slots=True)
class _Surface:
    """A part with the object that it belongs to."""

    solid: Solid
    planned: PlannedObject

    def shade(
        self, points: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """RGB in [0, 1] at points of the surface: the same for pixels and Gaussians."""
        light = AMBIENT + (1 - AMBIENT) * np.maximum(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0)
        base = np.array(COLORS[self.planned.color]) / 255
        return base * (light * _pattern(self.planned.pattern, points, self.solid))[:, None]


def _pattern(kind: str, points: np.ndarray, solid: Solid) -> np.ndarray:
    """A factor in [0.85, 1]. Patterns are fixed to the solid, wide enough for the Gaussians to carry them."""
    if kind == "checks":
        return np.where(np.floor(points[:, 0] / 0.3) % 2 == np.floor(points[:, 1] / 0.3) % 2, 1.0, 0.85)
    if kind == "bands":
        return 0.95 + 0.05 * np.sin(3 * np.pi * solid.to_unit(points)[:, :2].sum(axis=1) / 2)
    return np.ones(len(points))


def _cameras(seed: int, views: int, width: int, height: int) -> Cameras:
    """On an ellipse above the furniture, each looking near the middle of the table."""
    rng = np.random.default_rng([seed, 1])
    turn = 2 * np.pi * (np.arange(views) + rng.uniform()) / max(views, 1)
    centers = np.stack([1.35 * np.cos(turn), 1.1 * np.sin(turn), np.where(np.arange(views) % 2, 1.35, 1.7)], axis=1)
    targets = np.array([0, 0.1, TABLE[2] - 0.1]) + rng.uniform(-1, 1, (views, 3)) * [0.15, 0.15, 0.05]
    forward = targets - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return looking_cameras(centers, forward, np.array([0.0, 0.0, 1.0]), FOCAL * width, width, height)


def _cast(
    surfaces: list[_Surface], cameras: Cameras, view: int
) -> tuple[UInt8[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
    """Image, depth and instance map of one view. The rays have z = 1 in the camera, so that t is depth."""
    rays, origin = cameras.rays(view), cameras.centers[view]
    size = rays.shape[:2]
    depth, owner = np.full(size, np.inf), np.full(size, -1)
    for row, surface in enumerate(surfaces):
        window = _window(surface.solid, cameras, view)
        hits = surface.solid.hits(origin, rays[window])
        nearer = hits < depth[window]
        depth[window] = np.where(nearer, hits, depth[window])
        owner[window] = np.where(nearer, row, owner[window])
    image = np.full((*size, 3), 200, np.uint8)  # Above the walls.
    labels = np.zeros(size, np.int32)
    for row in np.unique(owner[owner >= 0]):
        pixels = owner == row
        points = origin + rays[pixels] * depth[pixels][:, None]
        colors = surfaces[row].shade(points, surfaces[row].solid.normals(points))
        image[pixels] = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
        labels[pixels] = surfaces[row].planned.id
    return image, np.where(np.isfinite(depth), depth, 0).astype(np.float32), labels


def _window(solid: Solid, cameras: Cameras, view: int) -> tuple[slice, slice]:
    """The pixels that can see the solid: around its projected corners, or all where it reaches behind the camera."""
    lower, upper = solid.aabb()
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
    size = np.array([cameras.widths[view], cameras.heights[view]])
    pixels, depths = cameras.project(corners, view)
    first, last = np.zeros(2, int), size
    if depths.min() >= 1e-3:
        first = np.clip(np.floor(pixels.min(axis=0)).astype(int), 0, size)
        last = np.clip(np.ceil(pixels.max(axis=0)).astype(int), 0, size)
    return slice(first[1], last[1]), slice(first[0], last[0])


def _gaussians(surfaces: list[_Surface], spacing: float) -> Gaussians:
    """Discs on the parts of all surfaces that are inside the room and not covered by another solid."""
    means, normals, colors, sizes = [], [], [], []
    for row, surface in enumerate(surfaces):
        step = 2 * spacing if surface.planned.pattern == "plain" else spacing
        if surface.planned.placed:
            step = min(spacing, max(FINEST, 2 * float(np.median(surface.solid.half)) / CELLS_ACROSS))
        points = surface.solid.lattice(step)
        inside = (np.abs(points[:, :2]) <= np.array(HALF_ROOM) + CONTACT).all(axis=1) & (points[:, 2] >= -CONTACT)
        for other, cover in enumerate(surfaces):
            if other != row:
                lower, upper = cover.solid.aabb()
                near = inside & (points > lower - 2 * CONTACT).all(axis=1) & (points < upper + 2 * CONTACT).all(axis=1)
                rows = np.flatnonzero(near)
                if rows.size:
                    inside[rows] &= ~cover.solid.contains(points[rows], CONTACT)
        points = points[inside]
        facing = surface.solid.normals(points)
        means.append(points)
        normals.append(facing)
        colors.append(surface.shade(points, facing))
        sizes.append(np.full(len(points), SIZE * step))
    size = np.concatenate(sizes).astype(np.float32)
    return Gaussians(
        means=np.concatenate(means).astype(np.float32),
        quats=quats_from_normals(np.concatenate(normals).astype(np.float32)),
        scales=np.stack([size, size, size * np.float32(THICKNESS)], axis=1),
        opacities=np.full(len(size), OPACITY, np.float32),
        sh=sh_from_colors(np.concatenate(colors)).astype(np.float32),
    )
