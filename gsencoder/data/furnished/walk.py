"""What a walk with a camera sees of a furnished home: frames with depth and labels, or a splat with labels."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int32, Int64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.data.furnished.kinds import kinds
from gsencoder.data.furnished.plan import Home
from gsencoder.data.furnished.surfaces import Surfaces
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.depth import SurfaceGrid
from gsencoder.data.seeding.points import flat_gaussians
from gsencoder.types import Cameras, Gaussians, Scene, SceneObject, Views

CLEARANCE = 0.25
"""Smallest distance of the camera from a surface, metres."""
_HIGHEST = (0.2, 0.8)
"""Height of the highest point that a walk looks at, as a share of the room's: many scans end below the ceiling."""
_GRAZING = 0.12
"""Cosine between ray and normal below which a sensor measures no depth."""
_EXPOSURE = 0.1
"""Standard deviation of the logarithm of a frame's exposure, which a camera sets for each."""
_TILT = 0.25
"""Error of the normals of a structured-light camera: of seeds of a kitchen the cosine with the plane around is 0.8."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkConfig(CheckedConfig):
    """Settings of the walk and of the sensor."""

    views: int = option(24, "number of views of a home; a room has three at least", ge=1, le=10_000)
    width: int = option(320, "width of the views in pixels; the height is three quarters of it", ge=16, le=8192)
    noise: float = option(1.0, "noise of the depth sensor, as a multiple of a structured-light camera's", ge=0, le=100)
    drift: float = option(0.01, "largest error of a pose, metres; poses drift along the walk", ge=0, le=1)


VIEWS_PER_AREA = 1.3
"""Views of a splat's walk for each square metre of floor, beyond `FIRST_VIEWS`; they see most of what stands there."""
FIRST_VIEWS, MAX_VIEWS = 14, 90
VIEW_WIDTH = 160
"""Width of these views, pixels: enough for a depth in each cell of 2 cm at 3 m."""


def splat_walk(home: Home, *, noise: float = 1.0, drift: float = 0.01) -> WalkConfig:
    """A walk from which a splat of a home is made: views by the area of its floor."""
    area = sum(floor.size for _, floor, _ in home.rooms)
    views = int(min(MAX_VIEWS, FIRST_VIEWS + VIEWS_PER_AREA * area))
    return WalkConfig(views=views, width=VIEW_WIDTH, noise=noise, drift=drift)


class Frame(NamedTuple):
    """One view: colors, noisy depth (0 = none), the number of the item in each pixel (−1 = none), and normals."""

    image: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    items: Int32[np.ndarray, "H W"]
    normals: Float32[np.ndarray, "H W 3"]


def walk_cameras(home: Home, surfaces: Surfaces, config: WalkConfig, rng: np.random.Generator) -> Cameras:
    """Cameras of a walk through all rooms, at the height of eyes or hands, away from things."""
    centers, targets, highest = [], [], rng.uniform(*_HIGHEST)
    floor = sum(area.size for _, area, _ in home.rooms)
    for _, area, height in home.rooms:
        count = max(3, round(config.views * area.size / floor))
        lower, upper = [area.x0 + 0.2, area.y0 + 0.2, 1.1], [area.x1 - 0.2, area.y1 - 0.2, min(1.8, height - 0.3)]
        candidates, places = rng.uniform(lower, upper, (6, 2 * count, 3)), np.empty((0, 3))
        for points in candidates:
            if len(places) < count:
                places = np.concatenate([places, points[surfaces.distance(points) > CLEARANCE]])[:count]
        if not len(places):
            places = np.array([[*candidates[0, 0, :2], min(height - 0.3, 2.0)]])
        centers.append(_tour(places))
        targets.append(rng.uniform([area.x0, area.y0, 0.0], [area.x1, area.y1, highest * height], places.shape))
    path = np.concatenate(centers)
    forward = np.concatenate(targets) - path
    # Not straight up or down.
    forward[:, :2] += 0.3 * np.sign(forward[:, :2] + 1e-9)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    focal = config.width * float(rng.uniform(0.65, 1.0))
    return looking_cameras(path, forward, np.array([0.0, 0.0, 1.0]), focal, config.width, config.width * 3 // 4)


def _tour(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """The points in an order in which each is near to the one before."""
    left, order = list(range(1, len(points))), [0]
    while left:
        nearest = min(left, key=lambda row: float(np.square(points[row] - points[order[-1]]).sum()))
        left.remove(nearest)
        order.append(nearest)
    return points[order]


def frame_of(surfaces: Surfaces, cameras: Cameras, view: int, config: WalkConfig, rng: np.random.Generator) -> Frame:
    """Renders a view and measures its depth."""
    rays = cameras.rays(view).astype(np.float32)
    shape = rays.shape[:2]
    directions = rays.reshape(-1, 3)
    origins = np.broadcast_to(cameras.centers[view].astype(np.float32), directions.shape)
    hits = surfaces.cast(origins, directions)
    depth = np.where(np.isfinite(hits.distances), hits.distances, 0)
    facing = -(directions * hits.normals).sum(axis=1) / np.linalg.norm(directions, axis=1)
    # Structured light: the error of depth grows with its square (Khoshelham and Elberink 2012: 1.4 mm at 1 m).
    sigma = config.noise * 0.0014 * depth**2
    noisy = depth + rng.normal(0, 1, depth.shape) * sigma
    lost = (
        (facing < _GRAZING * min(config.noise, 1.0))
        | (noisy <= 0.2)
        | (rng.random(depth.shape) < 0.01 * min(config.noise, 1.0))
    )
    measured = np.where(lost | (hits.items < 0), 0, noisy).astype(np.float32)
    return Frame(
        image=np.rint(255 * np.where(hits.items[:, None] >= 0, hits.colors, 0.85)).astype(np.uint8).reshape(*shape, 3),
        depth=measured.reshape(shape),
        items=hits.items.reshape(shape),
        normals=hits.normals.reshape(*shape, 3),
    )


def drifted(cameras: Cameras, drift: float, rng: np.random.Generator) -> Cameras:
    """Poses with an error that grows and shrinks along the walk, at most `drift` metres."""
    count = len(cameras)
    if not drift or count < 2:
        return cameras
    steps = np.cumsum(rng.normal(0, 1, (count, 3)), axis=0)
    steps -= steps.mean(axis=0)
    poses = cameras.cam_from_world.copy()
    poses[:, :3, 3] += (drift * steps / max(np.linalg.norm(steps, axis=1).max(), 1e-9)).astype(np.float32)
    return replace(cameras, cam_from_world=poses)


def objects_of(home: Home, surfaces: Surfaces) -> tuple[SceneObject, ...]:
    """The things of a home as labeled objects, whose ids are their numbers + 1; boxes are full."""
    return tuple(
        SceneObject(
            id=number + 1, name=item.kind, aabb_min=box[0], aabb_max=box[1],
            placed=kinds()[item.kind].place == "surface", views=None, max_pixels=None,
        )
        for number, (item, box) in enumerate(zip(home.items, surfaces.boxes, strict=True))
    )  # fmt: skip


def furnished_scene(home: Home, name: str, config: WalkConfig, rng: np.random.Generator) -> Scene:
    """A scene with photographs, depth, instance maps and objects."""
    surfaces = Surfaces(home, rng)
    cameras = walk_cameras(home, surfaces, config, rng)
    frames = [frame_of(surfaces, cameras, view, config, rng) for view in range(len(cameras))]
    scene = Scene(
        name=name,
        views=Views(
            cameras=drifted(cameras, config.drift, rng),
            names=tuple(f"images/{view:03d}.png" for view in range(len(cameras))),
            images=[frame.image for frame in frames],
            depths=[frame.depth for frame in frames],
            instances=[frame.items + 1 for frame in frames],
        ),
        metres_per_unit=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        objects=objects_of(home, surfaces),
    )
    return with_counted_views(scene)


class LabeledSplat(NamedTuple):
    """A splat and the item that each Gaussian shows, as samples of surfaces: a training holds hundreds of them."""

    means: Float32[np.ndarray, "N 3"]
    normals: Float16[np.ndarray, "N 3"]
    colors: Float16[np.ndarray, "N 3"]
    items: Int32[np.ndarray, " N"]
    cameras: Cameras
    voxel: float

    def gaussians(self, rows: np.ndarray | slice = slice(None)) -> Gaussians:
        normals, colors = (each[rows].astype(np.float32) for each in (self.normals, self.colors))
        return flat_gaussians(self.means[rows], normals, colors, largest=self.voxel, measured=False)


def furnished_splat(
    home: Home, config: WalkConfig, voxel: float, rng: np.random.Generator, *, walked: float = 1.0
) -> LabeledSplat:
    """A splat of what a walk, or the first part of it, sees, as seeds from depth, with labels."""
    surfaces = Surfaces(home, rng)
    cameras = walk_cameras(home, surfaces, config, rng)
    cameras = cameras.select(slice(math.ceil(walked * len(cameras))))
    believed = drifted(cameras, config.drift, rng)
    grid = SurfaceGrid(voxel, np.zeros(3))
    keys = []
    for view in range(len(cameras)):
        frame = frame_of(surfaces, cameras, view, config, rng)
        measured = frame.depth > 0
        rays = believed.rays(view)[measured]
        seen = (believed.centers[view] + rays * frame.depth[measured][:, None]).astype(np.float32)
        tilted = frame.normals[measured] + rng.normal(0, _TILT * config.noise, (len(seen), 3))
        normals = (tilted / np.linalg.norm(tilted, axis=1, keepdims=True)).astype(np.float32)
        exposure = np.exp(rng.normal(0, _EXPOSURE))
        grid.add(seen, normals, np.minimum(frame.image[measured] * exposure, 255).astype(np.uint8))
        keys.append(_voxel_keys(seen, voxel) * len(home.items) + frame.items[measured])
    samples = grid.samples()
    if not len(samples.points):
        raise InputError("furnished: the walk sees nothing")
    items = _commonest(np.concatenate(keys), len(home.items), _voxel_keys(samples.points, voxel))
    normals, colors = samples.normals.astype(np.float16), samples.colors.astype(np.float16)
    return LabeledSplat(samples.points, normals, colors, items, believed, voxel)


_AXIS = 1 << 14
"""Voxels along each axis, as many as fit into keys with the numbers of items."""


def _voxel_keys(points: Float32[np.ndarray, "n 3"], voxel: float) -> Int64[np.ndarray, " n"]:
    x, y, z = (np.floor(points / np.float32(voxel)).astype(np.int64) + _AXIS // 2).T
    return (x * _AXIS + y) * _AXIS + z


def _commonest(keys: Int64[np.ndarray, " n"], count: int, voxels: Int64[np.ndarray, " m"]) -> Int32[np.ndarray, " m"]:
    """The commonest item in each of some voxels, given voxel · count + item of all pixels."""
    pairs, pixels = np.unique(keys, return_counts=True)
    voxel_of, item_of = np.divmod(pairs, count)
    first = np.flatnonzero(np.diff(voxel_of, prepend=-1))
    # Of equally common items the one with the smallest number.
    best = np.maximum.reduceat(pixels * count + count - 1 - item_of, first)
    rows = np.searchsorted(voxel_of[first], voxels).clip(max=len(first) - 1)
    return (count - 1 - best[rows] % count).astype(np.int32)
