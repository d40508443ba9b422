"""Procedural rooms: exact images, depth, labels and boxes, and a splat of the same surfaces, from a seed alone."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.flat import OPACITY, SIZE, THICKNESS, quats_from_normals
from gsencoder.data.synthetic.plan import COLORS, HALF_ROOM, TABLE, PlannedObject, plan_room
from gsencoder.data.synthetic.shapes import Solid
from gsencoder.data.synthetic.write import write_room
from gsencoder.types import Cameras, Gaussians, Scene, SceneObject, Views, sh_from_colors

__all__ = ["color_words", "make_room", "plan_room", "write_room"]

FOCAL = 0.7
"""Focal length as a share of the width: 71° from side to side."""
AMBIENT = 0.6
LIGHT = np.array([0.35, -0.5, 0.79])
CELLS_ACROSS = 6
"""A part of an object has at least so many Gaussians across its middle extent, however coarse the spacing is."""
FINEST = 0.008
"""… but none closer than this, metres."""
CONTACT = 1e-4


def make_room(
    seed: int = 0,
    *,
    objects: int = 8,
    views: int = 16,
    width: int = 160,
    height: int = 120,
    spacing: float = 0.04,
) -> Scene:
    """A room of 3.4 × 3 m with a table, a shelf and named objects on them, in metres with z up.

    Images are ray-cast without noise: flat colors with a pattern, one light, no shadows. Depth is exact z. Instance
    maps hold the objects' ids (floor 1, walls 2, table 3, shelf 4, the others from 5). Boxes are exact and full. The
    Gaussians are flat discs on the visible surfaces with the colors of the images, `spacing` apart, closer on small
    things, twice as far on the plain walls; what touches another surface is left out. The same arguments give the
    same bits on the same machine.

    Args:
        seed: decides what stands where.
        objects: named things, with distinct names, and distinct colors up to 8.
        views: cameras on a ring around the table, looking at it.
        width: of the images, pixels.
        height: of the images.
        spacing: between Gaussians, metres.

    Raises:
        InputError: sizes that are not positive, or more objects than there are kinds.
    """
    if min(width, height) < 1 or views < 0:
        raise InputError(f"synthetic room: expected positive sizes and views ≥ 0, got {width}×{height} and {views}")
    if not 0 < spacing < np.inf:
        raise InputError(f"synthetic room: spacing must be a positive length, got {spacing}")
    plan = plan_room(seed, objects=objects)
    cameras = _cameras(seed, views, width, height)
    surfaces = [_Surface(part, planned) for planned in plan for part in planned.parts]
    pictures = [_cast(surfaces, cameras, view) for view in range(views)]
    instances = [labels for _, _, labels in pictures]
    return Scene(
        name=f"room_{seed:03d}",
        gaussians=_gaussians(surfaces, spacing),
        views=Views(
            cameras=cameras,
            names=tuple(f"images/{view:03d}.png" for view in range(views)),
            images=[image for image, _, _ in pictures],
            depths=[depth for _, depth, _ in pictures],
            instances=instances,
        ),
        metres_per_unit=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        objects=_objects(plan, instances),
    )


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


def _objects(plan: tuple[PlannedObject, ...], instances: list[np.ndarray]) -> tuple[SceneObject, ...]:
    largest = max(planned.id for planned in plan) + 1
    counts = np.array(
        [np.bincount(labels.ravel(), minlength=largest) for labels in instances] or np.zeros((1, largest), int)
    )
    objects = []
    for planned in plan:
        lower, upper = planned.aabb()
        objects.append(
            SceneObject(
                id=planned.id,
                name=planned.name,
                aabb_min=lower,
                aabb_max=upper,
                placed=planned.placed,
                views=int(np.count_nonzero(counts[:, planned.id])),
                max_pixels=int(counts[:, planned.id].max()),
            )
        )
    return tuple(objects)
