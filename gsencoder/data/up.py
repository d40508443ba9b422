"""Which way is up in a scene whose files do not say: from its cameras, and from its surfaces, most of which stand or
lie.

In rooms, floors, tables and ceilings have normals parallel to up, and walls and furniture perpendicular to it (a
Manhattan world, Coughlan and Yuille 1999). People hold cameras level: their right axes are horizontal, and their own
up directions say which end of the axis is up. Of a bare splat that end is the one from which the largest flat surface
at an end of the scene is seen, since things stand on floors.

Seeds have the normals of the surfaces that they come from. Photographs determine the colors of a fitted splat, and the
orientation of its Gaussians hardly: there planes through neighboring means say more.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError
from gsencoder.data.enclosure import (
    FLAT,
    Surfaces,
    enclosure_of,
    planes_of_gaussians,
    surfaces_of_depth,
    surfaces_of_gaussians,
)
from gsencoder.types import Cameras, Gaussians, Scene
from gsencoder.types.orientation import upright_views

ALIGNED = float(np.deg2rad(6.0))  # Width of the bell by which normals count as parallel or perpendicular; float32 stays
STANDING_WEIGHT = 0.5  # A wall says less about up than a floor: it is perpendicular to many directions
MAX_TILT = np.deg2rad(40.0)  # Up lies within this angle of what the cameras say
DIRECTIONS = 4000  # Candidates on the sphere, about 3° apart
REFINEMENTS = 10
MIN_CONFIDENCE = 0.1  # Below this, surfaces alone say nothing about up
MIN_CONFIDENCE_NEAR_USUAL = 0.05
"""The same within `MAX_TILT` of -y, which is up in the worlds of COLMAP and of most splats, and what is assumed where
surfaces say nothing."""
ENOUGH_CONFIDENCE = 0.3
"""With this confidence in the normals of Gaussians, planes through their means are not looked at."""
FLOOR_THICKNESS = 0.01  # Thickness of the slices in which floors are sought, as a share of the scene's extent along up
NEAR_USUAL_WEIGHT = 2.0
"""Factor of the floor of an axis of a bare splat within `MAX_TILT` of -y. In rooms the true floor has more than three
times the area of the largest wall at an end; where hardly any floor was photographed, this decides."""

LOW_WEIGHT, BETWEEN = 0.3, 0.44
"""Weight of what lies low beside the floor's area, and half of the part of the extent in which it is looked at, without
floor and ceiling. Of 56 made rooms and homes of which z is up, 0.62 come out right without and 0.82 with it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Up:
    """An estimated direction."""

    direction: Float64[np.ndarray, "3"]  # unit vector in the world
    source: str  # files, cameras, surfaces, or cameras and surfaces
    # From 0 to 1: the share of the surfaces that lie or stand under it, above what a random direction would have; of
    # cameras alone, how level they stand.
    confidence: float

    def describe(self) -> str:
        """The direction and how it is known, for people."""
        direction = ", ".join(f"{value + 0.0:.3f}" for value in self.direction)
        if self.source == "files":
            return f"({direction}), of the files"
        return f"({direction}), estimated from {self.source}, confidence {self.confidence:.2f}"


def up_of_cameras(cameras: Cameras) -> Float64[np.ndarray, "3"]:
    """The direction that is most nearly perpendicular to all right axes, on the side of the cameras' own up axes.

    If all right axes are nearly parallel, as of a camera that moves ahead, it is the mean of the up axes.
    """
    right = cameras.cam_from_world[:, 0, :3].astype(np.float64)
    mean_up = -cameras.cam_from_world[:, 1, :3].astype(np.float64).mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    axis = vectors[:, 0]
    if values[1] < 0.02 or abs(axis @ mean_up) < 0.3:
        axis = mean_up if np.linalg.norm(mean_up) > 1e-6 else vectors[:, 0]
    axis = axis / np.linalg.norm(axis)
    return axis if axis @ mean_up >= 0 else -axis


def up_of_scene(scene: Scene) -> Up | None:
    """Up of a scene, as its files state it or estimated from what it holds; None where nothing says.

    Surfaces are those of the depth images, else those of the Gaussians. Where the normals of these agree on little,
    planes through their means are looked at as well, and the estimate with more confidence is taken. Where these agree
    on nothing either (`MIN_CONFIDENCE`), as on one soft object, level cameras alone say more.
    """
    if scene.up is not None:
        return Up(direction=scene.up, confidence=1.0, source="files")
    cameras = upright_views(scene.views).cameras if scene.views is not None else None
    surfaces = None
    if scene.views is not None and scene.views.depths is not None:
        surfaces = surfaces_of_depth(scene.views)
    elif scene.gaussians is not None:
        surfaces = surfaces_of_gaussians(scene.gaussians)
    up = None
    if cameras is not None or (surfaces is not None and surfaces.areas.sum() > 0):
        up = estimate_up(surfaces, cameras)
    if scene.gaussians is None or (up is not None and up.confidence >= ENOUGH_CONFIDENCE):
        return up
    planes = planes_of_gaussians(scene.gaussians)
    if planes.areas.sum() > 0:
        other = estimate_up(planes, cameras)
        up = other if up is None or other.confidence > up.confidence else up
    if up is not None and cameras is not None and up.confidence < MIN_CONFIDENCE:
        level = estimate_up(None, cameras)
        return level if level.confidence > up.confidence else up
    return up


def with_up(scene: Scene) -> tuple[Scene, Up | None]:
    """The scene with `up` filled in where its files do not state it, and how it is known.

    It is None, and the scene is as it was, where nothing says, where the surfaces of a bare splat lean nowhere
    (`MIN_CONFIDENCE`), or where it is no room: the largest flat surface of a table or a cupboard is no floor.
    """
    up = up_of_scene(scene)
    if up is None:
        return scene, None
    if up.source == "surfaces":
        near_usual = -up.direction[1] >= np.cos(MAX_TILT)
        if up.confidence < (MIN_CONFIDENCE_NEAR_USUAL if near_usual else MIN_CONFIDENCE):
            return scene, None
        if scene.gaussians is not None and not enclosure_of(scene.gaussians).is_room:
            return scene, None
    return (scene if scene.up is not None else replace(scene, up=up.direction)), up


def estimate_up(surfaces: Surfaces | None, cameras: Cameras | None) -> Up:
    """Up from surfaces, from cameras, or from both."""
    prior = None if cameras is None or not len(cameras) else up_of_cameras(cameras)
    if surfaces is None or not surfaces.areas.sum() > 0:
        if prior is None:
            raise InputError("up: there are neither cameras nor flat surfaces to estimate it from; give up=")
        assert cameras is not None
        # How level they stand: 1 if all right axes are horizontal, 0 if they have any direction.
        right = cameras.cam_from_world[:, 0, :3].astype(np.float64)
        level = float(np.clip(1 - 3 * np.square(right @ prior).mean(), 0, 1)) if len(cameras) > 2 else 0.0
        return Up(direction=prior, confidence=level, source="cameras")
    means, normals, areas, rest = surfaces
    # A few huge Gaussians, such as a sky's, must not outvote the scene.
    areas = np.minimum(areas, np.quantile(areas, 0.95))
    areas = areas / (areas.sum() + rest)
    candidates = _sphere(DIRECTIONS)
    if prior is None:
        # An axis and its opposite have the same support.
        candidates = candidates[: DIRECTIONS // 2]
    else:
        candidates = np.concatenate((prior[None], candidates[candidates @ prior >= np.cos(MAX_TILT)]))
    scores = _support(candidates, normals, areas)
    best = _refine(candidates[scores.argmax()], normals, areas)
    if prior is not None and best @ prior < np.cos(MAX_TILT):
        best = prior
    if prior is None:
        best = _upright_axis(best, means, normals, areas)
    elif best @ prior < 0:
        best = -best
    typical = float(np.median(_support(_sphere(200), normals, areas)))
    support = float(_support(best[None], normals, areas)[0])
    confidence = float(np.clip((support - typical) / (1 - typical), 0, 1))
    source = "surfaces" if prior is None else "cameras and surfaces"
    return Up(direction=best, confidence=confidence, source=source)


def _sphere(count: int) -> Float64[np.ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack((radius * np.cos(turn), radius * np.sin(turn), z), axis=1)


def _bells(cosine: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """How far normals at these cosines lie (parallel to up) and stand (perpendicular), each from 0 to 1."""
    angle = np.arccos(np.minimum(np.abs(cosine), 1))
    return np.exp(-np.square(angle / ALIGNED)), np.exp(-np.square((np.pi / 2 - angle) / ALIGNED))


def _support(
    directions: Float64[np.ndarray, "d 3"], normals: Float64[np.ndarray, "n 3"], areas: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " d"]:
    """The share of the surfaces that lie, and half of that which stands, for each direction."""
    support = []
    for block in np.array_split(directions, max(1, len(directions) // 256)):
        lying, standing = _bells((block @ normals.T).astype(np.float32))
        support.append((lying + STANDING_WEIGHT * standing) @ areas)
    return np.concatenate(support)


def _refine(
    direction: Float64[np.ndarray, "3"], normals: Float64[np.ndarray, "n 3"], areas: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "3"]:
    """The direction that normals near it and normals across it agree on, by reweighted least squares."""
    for _ in range(REFINEMENTS):
        lying, standing = _bells(normals @ direction)
        lie, stand = lying * areas, STANDING_WEIGHT * standing * areas
        # Σ w |n × d|² + Σ w (n · d)² is smallest for the eigenvector of the smallest eigenvalue.
        outer = np.einsum("n,ni,nj->ij", stand - lie, normals, normals) + lie.sum() * np.eye(3)
        nearest = np.linalg.eigh(outer)[1][:, 0]
        direction = nearest if nearest @ direction >= 0 else -nearest
    return direction


def _upright_axis(
    direction: Float64[np.ndarray, "3"],
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "3"]:
    """Of the axes of a Manhattan world, both ways, the one with the largest floor and things that stand on it; see
    `NEAR_USUAL_WEIGHT`."""
    across = np.linalg.svd(direction[None])[2][1:]
    turns = np.deg2rad(np.arange(0, 90, 3.0))
    circle = np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1]
    second = _refine(circle[_support(circle, normals, areas).argmax()], normals, areas)
    third = np.cross(direction, second)
    axes = [sign * axis for axis in (direction, second, third / np.linalg.norm(third)) for sign in (1.0, -1.0)]
    sides = [float(np.ptp(np.quantile(means @ axis, (0.01, 0.99)))) for axis in axes[::2]]
    # Of what is flat, such as land or a large home, the floor says enough, and things lie to one side by chance.
    low_weight = LOW_WEIGHT if min(sides) > FLAT * max(sides) else 0.0

    def support(axis: Float64[np.ndarray, "3"]) -> float:
        area = _floor_area(axis, means, normals, areas)
        weighted = area * NEAR_USUAL_WEIGHT if area > 0 and -axis[1] >= np.cos(MAX_TILT) else area
        return weighted + low_weight * _lowness(axis, means, normals, areas)

    return max(axes, key=support)


def _relative_heights(
    up: Float64[np.ndarray, "3"], means: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"] | None:
    """Heights from 0 at the lower end of the scene to 1 at its upper one; None where all are the same."""
    heights = means @ up
    low, high = np.quantile(heights, (0.01, 0.99))
    return (heights - low) / (high - low) if high > low else None


def _floor_area(
    up: Float64[np.ndarray, "3"],
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, " n"],
) -> float:
    """The area that lies in the fullest slice of the lowest fifth of the scene, less that in its highest fifth / 2."""
    heights = _relative_heights(up, means)
    if heights is None:
        return 0.0
    lying = _bells(normals @ up)[0] * areas
    slices = (heights / FLOOR_THICKNESS).astype(np.int64)
    count = round(1 / FLOOR_THICKNESS)
    area = np.bincount(slices.clip(0, count), lying, count + 1)
    fifth = count // 5
    return float(area[:fifth].max() - 0.5 * area[-fifth:].max())


def _lowness(
    up: Float64[np.ndarray, "3"],
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, " n"],
) -> float:
    """How far below the middle of the scene lies what is between its ends: all of it, and that of it which lies, each
    from −½ to ½ of the extent, 0 where there is none. Things stand on floors."""
    heights = _relative_heights(up, means)
    if heights is None:
        return 0.0
    between = np.abs(heights - 0.5) < BETWEEN
    lying = _bells(normals[between] @ up)[0] * areas[between]
    weights = [each for each in (areas[between], lying) if each.sum() > 1e-12]
    return float(sum(0.5 - heights[between] @ each / each.sum() for each in weights))


FLOOR_QUANTILE = 0.01
"""Share of the Gaussians below the floor: strays, and what shows through windows."""
FLOOR_SAMPLE = 50_000


def upright_gaussians(
    gaussians: Gaussians, up: Float[np.ndarray, "3"] | None, *, floor_of: Float32[np.ndarray, "M 3"] | None = None
) -> Gaussians:
    """The splat, with colors of degree 0, turned so that up is z and walls lie along x and y, and moved so that the
    floor is at 0. Cells cut walls alike then in all rooms.

    Args:
        up: None = z.
        floor_of: means of the scene that the Gaussians are a part of; None = they are all of it.
    """
    means = gaussians.means if floor_of is None else floor_of
    axis = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, np.float64) / np.linalg.norm(up)
    heights = means[:: max(1, len(means) // FLOOR_SAMPLE)].astype(np.float64) @ axis
    upright = np.eye(3)
    if axis[2] < 1 - 1e-9:
        upright = Rotation.align_vectors([[0, 0, 1]], [axis])[0].as_matrix()
    angle = wall_angle(gaussians, upright)
    if angle or axis[2] < 1 - 1e-9:
        gaussians = turn(gaussians, Rotation.from_euler("z", -angle).as_matrix() @ upright, 1.0)
    shift = np.array([0, 0, np.quantile(heights, FLOOR_QUANTILE)], np.float32)
    return replace(gaussians, means=gaussians.means - shift)


WALL_SAMPLE = 8192
LEAST_MOMENT = 0.1
"""Smallest moment by which surfaces that stand have directions; of random ones it is 0, of a clean room 1."""


def wall_angle(gaussians: Gaussians, upright: Float64[np.ndarray, "3 3"]) -> float:
    """The angle about z, −π/4 to π/4, at which walls stand after a rotation that turns up to z, 0 where they have no
    direction: a quarter of that of Σ area · (n_x + i n_y)⁴ over normals n, since walls stand at right angles."""
    rows = slice(None, None, max(1, len(gaussians) // WALL_SAMPLE))
    scales = gaussians.scales[rows].astype(np.float64)
    axes = Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
    normals = np.take_along_axis(axes, scales.argmin(axis=1)[:, None, None], axis=2)[..., 0] @ upright.T
    weights = gaussians.opacities[rows] * np.sort(scales, axis=1)[:, 1:].prod(axis=1)
    powers = (normals[:, 0] + 1j * normals[:, 1]) ** 4
    total = float(weights @ np.abs(powers))
    moment = weights @ powers / total if 0 < total < np.inf else 0.0
    return float(np.angle(moment)) / 4 if abs(moment) > LEAST_MOMENT else 0.0


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    """The splat in another unit of length."""
    if factor == 1:
        return gaussians
    means, scales = (values.astype(np.float64) * factor for values in (gaussians.means, gaussians.scales))
    return replace(gaussians, means=means.astype(np.float32), scales=scales.astype(np.float32))


def turn(gaussians: Gaussians, to_from: Float64[np.ndarray, "3 3"], scale: float) -> Gaussians:
    """The splat, with colors of degree 0, after x → scale · to_from · x, where `to_from` is a rotation, or one with a
    mirror."""
    mirrored = np.linalg.det(to_from) < 0
    # A Gaussian looks the same mirrored through its center, so −M turns its axes as M does, and is a rotation.
    rotation = Rotation.from_matrix(-to_from if mirrored else to_from)
    # A product of quaternions is linear in each: those with 1, i, j and k make its matrix. For many Gaussians that is
    # ten times faster than scipy's product with each.
    units = Rotation.from_quat(np.eye(4), scalar_first=True)
    quats = gaussians.quats @ (rotation * units).as_quat(scalar_first=True)
    return Gaussians(
        means=(gaussians.means.astype(np.float64) @ (scale * to_from.T)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(gaussians.scales * np.float32(scale)).astype(np.float32),
        opacities=gaussians.opacities,
        sh=gaussians.sh,
    )
