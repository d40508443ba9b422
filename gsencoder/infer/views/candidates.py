"""Candidate views of a target: the scene's own frames, close-ups cut from their photographs, which show a small thing
as large as a camera near it would and sharper than any render, and cameras on shells in free space."""

import math
import warnings
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Integer

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.threads import parallel
from gsencoder.data.orbits import looking_cameras, orbit_cameras, spiral_directions
from gsencoder.data.seeding.points import NEIGHBOR
from gsencoder.geometry import covariances, rotmats_from_quats
from gsencoder.infer.views.photographs import photograph_cameras
from gsencoder.infer.views.targets import CONSTANTS, Target, ViewsConfig
from gsencoder.render import blend
from gsencoder.types import Cameras, Gaussians, Scene
from gsencoder.types.scene import concatenate_cameras, look_rotation


def closeups(
    frames: Cameras, gaussians: Gaussians, target: Target, *, width: int, height: int
) -> tuple[Cameras, Int64[np.ndarray, " n"]]:
    """The frames' cameras with windows around a target, where these are clearly smaller than the frame, in the size and
    shape of the pictures; and which frames these are, ascending. Half of the target's size is left on every side."""
    points = gaussians.means[target.rows[even_indices(len(target.rows), CONSTANTS.closeup_sample)]].astype(np.float64)
    rows: list[int] = []
    Ks: list[Float64[np.ndarray, "3 3"]] = []
    for view in range(len(frames)):
        pixels, depths = frames.project(points, view)
        shown = frames.in_image(pixels, depths, view)
        if shown.mean() < CONSTANTS.min_closeup_inside:
            continue
        low, high = pixels[shown].min(axis=0), pixels[shown].max(axis=0)
        wide, tall = (high - low) * (1 + 2 * CONSTANTS.frame_margin)
        window = np.array([1, height / width]) * max(wide, tall * width / height, CONSTANTS.min_closeup_width)
        size = np.array([frames.widths[view], frames.heights[view]], np.float64)
        if (window > CONSTANTS.max_closeup_share * size).any():
            continue
        corner = np.clip((low + high) / 2 - window / 2, 0, size - window)
        K = frames.Ks[view].astype(np.float64)
        K[:2, 2] -= corner
        K[:2] *= (np.array([width, height]) / window)[:, None]
        rows.append(view)
        Ks.append(K)
    chosen_rows = np.array(rows, np.int64)
    return (
        Cameras(
            cam_from_world=frames.cam_from_world[chosen_rows],
            Ks=np.array(Ks, np.float32).reshape(-1, 3, 3),
            widths=np.full(len(chosen_rows), width, np.int32),
            heights=np.full(len(chosen_rows), height, np.int32),
        ),
        chosen_rows,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches:
    """Parts of Gaussians, each an ellipsoid of the same turn; scales are standard deviations along its axes."""

    centers: Float64[np.ndarray, "P 3"]
    rows: Int64[np.ndarray, " P"]
    scales: Float32[np.ndarray, "P 3"]


def patches(gaussians: Gaussians, edge: float) -> Patches:
    """A splat as patches. Where a Gaussian, up to its surface, is longer than `ViewConstants.max_uncut_edges` edges, it
    is cut along that axis into equal parts of an edge at most; those are kept whose middles lie in its ellipsoid."""
    most = CONSTANTS.max_patches_per_gaussian
    parts = _parts(gaussians, edge, most)
    while parts.prod(axis=1).sum() > max(CONSTANTS.max_patches, len(parts)) and most > 1:
        most //= 2
        parts = _parts(gaussians, edge, most)
    large = np.flatnonzero(parts.prod(axis=1) > 1)
    turn_of = np.zeros(len(parts), np.int64)
    turn_of[large] = np.arange(len(large))
    turns = rotmats_from_quats(torch.from_numpy(gaussians.quats[large]).double()).numpy()
    kinds, kind_of = np.unique(parts, axis=0, return_inverse=True)
    centers, rows, scales = [], [], []
    for number, kind in enumerate(kinds):
        chosen = np.flatnonzero(kind_of.reshape(-1) == number)
        offsets = _middles(kind)
        means = gaussians.means[chosen].astype(np.float64)
        if len(offsets) > 1:
            reach = CONSTANTS.surface_sigmas * gaussians.scales[chosen].astype(np.float64)
            offsets_rotated = np.einsum("nij,nkj->nki", turns[turn_of[chosen]], offsets[None] * reach[:, None])
            means = (means[:, None] + offsets_rotated).reshape(-1, 3)
        centers.append(means)
        rows.append(np.repeat(chosen, len(offsets)))
        scales.append(np.repeat(gaussians.scales[chosen] / kind.astype(np.float32), len(offsets), axis=0))
    return Patches(centers=np.concatenate(centers), rows=np.concatenate(rows), scales=np.concatenate(scales))


def _parts(gaussians: Gaussians, edge: float, most: int) -> Int64[np.ndarray, "N 3"]:
    """Into how many parts each axis is cut."""
    length = 2 * CONSTANTS.surface_sigmas * gaussians.scales.astype(np.float64) / edge
    cuts = np.where(length > CONSTANTS.max_uncut_edges, np.ceil(length), 1)
    axes = np.maximum((cuts > 1).sum(axis=1), 1)
    shrink = np.minimum((most / cuts.prod(axis=1)) ** (1 / axes), 1)
    return np.maximum(cuts * shrink[:, None], 1).astype(np.int64)


def _middles(parts: Int64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 3"]:
    """The middles of the parts that lie in the unit ball; at least that of the whole."""
    axes = [(2 * np.arange(count) + 1) / count - 1 for count in parts]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= 1] if len(grid) > 1 else grid


class FreeSpace:
    """The empty part of a scene, as its Gaussians and cameras that saw it tell.

    Attributes:
        cell: edge of the cells in which rays are followed, world units.
        blend: accuracy of small renders of it, whose near plane is not beyond a cell.
        observers: the cameras that tell what is empty; None where there are none.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        from scipy.spatial import cKDTree

        solid = np.flatnonzero(gaussians.opacities >= CONSTANTS.min_obstacle_opacity)
        if not len(solid):
            solid = np.arange(len(gaussians))
        obstacles = gaussians.select(solid)
        self._gaussians, self._quats = gaussians, obstacles.quats
        means = obstacles.means.astype(np.float64)
        sample = means[even_indices(len(means), CONSTANTS.spacing_sample)]
        distances = cKDTree(means).query(sample, k=[min(NEIGHBOR + 1, len(means))])[0]
        # Of a single Gaussian, and of many in one place, the size is known.
        self.cell = CONSTANTS.cell_spacings * (float(np.median(distances)) or float(np.median(obstacles.scales)))
        self.blend = replace(CONSTANTS.score_blend, near=min(CONSTANTS.score_blend.near, self.cell / 2))
        self._patches = patches(obstacles, self.cell)
        self._tree = cKDTree(self._patches.centers)
        # Floaters may be any distance away: what is beyond the middle's million cells on a side is met by no ray.
        self._low = np.floor(np.median(means, axis=0) / self.cell) - CONSTANTS.grid_cells // 2
        self._met, self._cell_of = solid[self._patches.rows], self._codes(self._patches.centers)
        self._occupied = np.unique(self._cell_of[self._cell_of >= 0])
        self.observers: Cameras | None = None
        self._depths: list[Float32[np.ndarray, "h w"]] = []

    def seen_by(self, cameras: Cameras) -> "FreeSpace":
        """The same space, of which cameras tell what they looked through, by a depth map of each."""
        if not len(cameras):
            return self
        other = copy(self)
        small = other.observers = cameras.resized(CONSTANTS.free_space_side)

        def depth_map(view: int) -> Float32[np.ndarray, "h w"]:
            # Rays that end nowhere have looked through nothing that is known.
            return blend(self._gaussians, small, view, config=self.blend).depth_map(CONSTANTS.min_depth_alpha)

        other._depths = list(parallel(depth_map, range(len(small))))
        return other

    def _codes(self, points: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """The cell of each point as a number; −1 far outside the splat."""
        cells = np.floor(points / self.cell) - self._low
        inside = ((cells >= 0) & (cells < CONSTANTS.grid_cells)).all(axis=1)
        x, y, z = np.where(inside[:, None], cells, 0).astype(np.int64).T
        return np.where(inside, (x * CONSTANTS.grid_cells + y) * CONSTANTS.grid_cells + z, -1)

    def without(self, rows: Integer[np.ndarray, " n"]) -> "FreeSpace":
        """The same space, in which rays go through these Gaussians."""
        other = copy(self)
        codes = self._cell_of[~np.isin(self._met, rows)]
        other._occupied = np.unique(codes[codes >= 0])
        return other

    def occupied(self, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether a Gaussian lies in the cell of each point."""
        codes = self._codes(points)
        if not len(self._occupied):
            return np.zeros(len(points), bool)
        slots = np.searchsorted(self._occupied, codes).clip(max=len(self._occupied) - 1)
        return np.asarray(self._occupied[slots] == codes)

    def first_hit(
        self,
        starts: Float64[np.ndarray, "n 3"],
        directions: Float64[np.ndarray, "n 3"],
        lengths: Float64[np.ndarray, " n"],
    ) -> Float64[np.ndarray, " n"]:
        """How far each ray goes before the first cell that holds a Gaussian; +inf where it meets none within its
        length, or within `ViewConstants.max_ray_cells` cells."""
        steps = int(np.clip(np.ceil(2 * lengths.max(initial=0) / self.cell), 1, 2 * CONSTANTS.max_ray_cells))
        along = self.cell / 2 * np.arange(steps + 1)
        points = starts[:, None] + along[:, None] * directions[:, None]
        hit = self.occupied(points.reshape(-1, 3)).reshape(len(starts), -1) & (along <= lengths[:, None])
        return np.where(hit.any(axis=1), along[hit.argmax(axis=1)], np.inf)

    def clearance(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """World units from each point to the nearest surface, less than zero inside a Gaussian.

        A surface lies two standard deviations from the center of a patch. The plane that touches it there, across
        the line from the center to the point, is no farther away than the surface; of the nearest patches.
        """
        parts = self._patches
        count = min(CONSTANTS.clearance_neighbors, len(parts.rows))
        distances, near = self._tree.query(points, k=[*range(1, count + 1)])
        offsets = points[:, None] - parts.centers[near]
        directions = offsets / np.maximum(distances, 1e-12)[..., None]
        quats, scales = self._quats[parts.rows[near]], parts.scales[near]
        spread = covariances(torch.from_numpy(quats).double(), torch.from_numpy(scales).double())
        variances = np.einsum("nki,nkij,nkj->nk", directions, spread.numpy(), directions)
        reach = CONSTANTS.surface_sigmas * np.sqrt(variances)
        return np.asarray((distances - reach).min(axis=1))

    def seen_empty(self, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether some watcher looked through each point, at a surface at least a cell behind it."""
        free = np.zeros(len(points), bool)
        for view, depth in enumerate(self._depths):
            assert self.observers is not None
            pixels, z = self.observers.project(points, view)
            shown = self.observers.in_image(pixels, z, view)
            column, row = (np.where(shown, part, 0).astype(np.int64) for part in pixels.T)
            free |= shown & (depth[row, column] >= z + self.cell)
        return free


def frames_on(
    cameras: Cameras, gaussians: Gaussians, targets: Sequence[Target], count: int, spaces: Sequence[FreeSpace]
) -> Int64[np.ndarray, " n"]:
    """The frames that show most of the targets as far as a few rays tell, ascending; at most `count`.

    Targets take turns. Each takes its best frames for half of the places, and for the others some from all along the
    recording, so that the frames of a film are not all neighbors. Spaces are what rays meet, one for each target, which
    is itself left out."""
    ranked = [
        _rank_frames(cameras, gaussians, target, count, free) for target, free in zip(targets, spaces, strict=True)
    ]
    turns = np.stack(ranked, axis=1).reshape(-1)
    first = np.sort(np.unique(turns, return_index=True)[1])[:count]
    return np.sort(turns[first])


def _rank_frames(
    cameras: Cameras, gaussians: Gaussians, target: Target, count: int, free: FreeSpace
) -> Int64[np.ndarray, " n"]:
    """Frames in the order in which they are taken for a target, as many as are wanted."""
    count = min(count, len(cameras))
    half = (count + 1) // 2
    filled = _fill_shares(cameras, target)
    rows = target.rows[even_indices(len(target.rows), CONSTANTS.frame_rays)]
    points = gaussians.means[rows].astype(np.float64)
    shown = np.full(len(cameras), -1.0)
    blocked = CONSTANTS.blocked_frame_weight

    def judge(views: Int64[np.ndarray, " n"]) -> None:
        for start in range(0, len(views), CONSTANTS.frame_batch):
            block = views[start : start + CONSTANTS.frame_batch]
            shown[block] = filled[block] * (blocked + (1 - blocked) * _open_fraction(cameras, block, points, free))

    order = np.argsort(-filled, kind="stable")
    for start in range(0, len(order), CONSTANTS.frame_batch):
        block = order[start : start + CONSTANTS.frame_batch]
        # No frame shows more than it would if nothing stood between: the rest is not better than what there is.
        if start >= half and filled[block[0]] <= np.sort(shown)[-half]:
            break
        judge(block)
    best = np.argsort(-shown, kind="stable")
    enough = CONSTANTS.min_spread_share * shown[best[0]]
    others = np.setdiff1d(np.flatnonzero(filled >= enough), best[:half])
    others = others[even_indices(len(others), CONSTANTS.spread_frames * count)]
    judge(others[shown[others] < 0])
    others = others[shown[others] >= enough]
    photograph_at = np.concatenate([best[:half], others[even_indices(len(others), count - half)]])
    # Whatever is missing comes from those that show less, and at last from those that no ray was sent to.
    rest = np.lexsort((-filled, -shown))
    return np.concatenate([photograph_at, rest[~np.isin(rest, photograph_at)]])[:count]


def _fill_shares(cameras: Cameras, target: Target) -> Float64[np.ndarray, " V"]:
    """The share of each picture that a target's ball fills."""
    pixels, depths = (part[:, 0] for part in cameras.project(target.center[None], min_depth=CONSTANTS.min_frame_depth))
    radius = target.radius * cameras.Ks[:, 0, 0] / np.maximum(depths, CONSTANTS.min_frame_depth)
    radius = np.minimum(radius, cameras.widths + cameras.heights)
    filled = np.ones(len(cameras))
    for position, size in zip(pixels.T, (cameras.widths, cameras.heights), strict=True):
        filled *= np.clip(np.minimum(position + radius, size) - np.maximum(position - radius, 0), 0, None) / size
    return np.where(depths > -target.radius, filled, 0)


def _open_fraction(
    cameras: Cameras, views: Int64[np.ndarray, " n"], points: Float64[np.ndarray, "p 3"], free: FreeSpace
) -> Float64[np.ndarray, " n"]:
    """The share of points that are in each picture with nothing between."""
    chosen = cameras.select(views)
    inside = chosen.in_image(*chosen.project(points))
    towards = chosen.centers[:, None] - points
    distance = np.linalg.norm(towards, axis=-1)
    towards /= np.maximum(distance, 1e-12)[..., None]
    # Rays begin beyond the cells of what the target lies on, and end before those in which the camera is.
    begins = 2 * free.cell
    starts = points + begins * towards
    hits = free.first_hit(
        starts.reshape(-1, 3), towards.reshape(-1, 3), np.maximum(distance - begins - free.cell, 0).reshape(-1)
    )
    return np.asarray((inside & np.isinf(hits).reshape(inside.shape)).mean(axis=1))


def shell_cameras(
    gaussians: Gaussians,
    target: Target,
    count: int,
    free: FreeSpace,
    *,
    up: Float64[np.ndarray, "3"] | None = None,
    width: int = 640,
    height: int = 480,
) -> Cameras:
    """Cameras around a target from which nothing stands between: SplatDistill sec. 3.4, "viewpoints around".

    Directions lie on a spiral. Along each the distance is the one at which the target's outline fills a share of the
    picture, its frame permitting, or nearer where a surface would stand between. Directions are left out from which the
    camera would be too near to a surface, where no known camera has looked, or so near that little else is seen. Of
    the others, the directions with most of the scene behind and around the target are kept, evenly spread; none where
    there is no room."""
    focal = width / (2 * math.tan(math.radians(CONSTANTS.fov_degrees) / 2))
    outward, vertical = spiral_directions(max(CONSTANTS.tried_directions * count, CONSTANTS.min_tried_directions), up)
    rotations = look_rotation(outward, vertical)
    preferred, least, reach = _distances(gaussians, target, rotations, focal, width, height)
    # Up to the first surface beyond the target itself and the cells of what it lies on, with room to stand before it.
    begins = reach + 2 * free.cell
    starts = target.center + begins[:, None] * outward
    clearance = CONSTANTS.clearance_share
    open_until = begins + free.first_hit(starts, outward, np.maximum(preferred * (1 + clearance) - begins, 0))
    distance = np.minimum(preferred, open_until / (1 + clearance))
    centers = target.center + distance[:, None] * outward
    good = (distance >= least) & (free.clearance(centers) >= clearance * np.minimum(distance, target.radius))
    if free.observers is not None:
        good &= free.seen_empty(centers)
    tried = np.flatnonzero(good)
    if not len(tried):
        return looking_cameras(centers[tried], -outward[tried], vertical, focal, width, height)
    background = _background_fraction(target, centers[tried], vertical, free)
    enough = np.sort(background)[::-1][min(count, len(background)) - 1]
    chosen = tried[background >= enough]
    chosen = chosen[even_indices(len(chosen), count)]
    return looking_cameras(centers[chosen], -outward[chosen], vertical, focal, width, height)


def _background_fraction(
    target: Target, centers: Float64[np.ndarray, "n 3"], vertical: Float64[np.ndarray, "3"], free: FreeSpace
) -> Float64[np.ndarray, " n"]:
    """Share of the rays through a target, and next to it, that end at something, for each camera."""
    forward = target.center - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right, down, _ = np.moveaxis(look_rotation(forward, vertical), 1, 0)
    hits = np.zeros(len(centers))
    length = np.full(len(centers), CONSTANTS.max_ray_cells * free.cell)
    offset = CONSTANTS.background_radii * target.radius
    for across in (-1.0, 0.0, 1.0):
        for along in (-1.0, 0.0, 1.0):
            through = target.center + offset * (across * right + along * down)
            ray = through - centers
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            # They begin before the target, so that what it hangs on or lies on counts from either side.
            hits += np.isfinite(free.first_hit(through - offset * ray, ray, length))
    return hits / 9


def _distances(
    gaussians: Gaussians,
    target: Target,
    rotations: Float64[np.ndarray, "n 3 3"],
    focal: float,
    width: int,
    height: int,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Along each direction how far a camera should be, how far at least, and how far the target itself reaches."""
    rows = target.rows[even_indices(len(target.rows), CONSTANTS.outline_sample)]
    offsets = gaussians.means[rows].astype(np.float64) - target.center
    # A Gaussian fills a cell of its own size.
    margin = CONSTANTS.fill_margin
    shares = np.clip(CONSTANTS.fill_shares, CONSTANTS.least_share * margin, CONSTANTS.most_share / margin)
    cell = max(target.radius / CONSTANTS.outline_cells, 2 * float(np.median(gaussians.scales[rows].max(axis=1))))
    preferred, least, reach = (np.empty(len(rotations)) for _ in range(3))
    for index, (right, down, direction) in enumerate(rotations):
        plane = np.stack((offsets @ right, offsets @ down), axis=1)
        area = len(np.unique(np.floor(plane / cell).astype(np.int64), axis=0)) * cell**2
        reach[index] = max(float((offsets @ direction).max()), 0.0)
        # Distance at which an area fills a share of the picture: area · focal² / distance² = share · pixels.
        fills = [
            focal * math.sqrt(area / (share * width * height))
            for share in (shares[index % len(shares)], CONSTANTS.max_fill_share, CONSTANTS.thin_fill_share)
        ]
        wide, high = np.abs(plane).max(axis=0)
        framed = 2 * focal / CONSTANTS.framed_share * max(wide / width, high / height)
        preferred[index] = reach[index] + max(fills[0], min(framed, fills[2]))
        least[index] = reach[index] + fills[1]
    return preferred, least, reach


def up_of(scene: Scene) -> Float64[np.ndarray, "3"] | None:
    """The scene's up, else the mean of the upward directions of its views where these agree, else None."""
    if scene.up is not None or scene.views is None:
        return scene.up
    mean = -scene.views.cameras.cam_from_world[:, 1, :3].astype(np.float64).mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.5 else None


Placed = tuple[Cameras, list[str], list[int | None]]
"""Cameras, their names, and which frames they are."""


def uniform_candidates(scene: Scene, gaussians: Gaussians, config: ViewsConfig) -> Placed:
    """Evenly spread frames, or cameras around a splat that has none."""
    if scene.views is None:
        around = orbit_cameras(
            gaussians,
            count=config.count,
            width=config.width,
            height=config.height,
            fov_degrees=CONSTANTS.fov_degrees,
            up=scene.up,
        )
        return around, [f"orbit {number:02d}" for number in range(len(around))], [None] * len(around)
    chosen = even_indices(len(scene.views), config.count)
    cameras = scene.views.cameras.select(chosen).resized(config.frame_side, enlarge=False)
    return cameras, [scene.views.names[view] for view in chosen], chosen.tolist()


def target_candidates(
    scene: Scene,
    gaussians: Gaussians,
    targets: Sequence[Target],
    free: FreeSpace,
    config: ViewsConfig,
) -> Placed:
    """Frames that show the targets, close-ups cut from them, and cameras on shells around the targets."""
    total = max(config.candidates, config.count)
    views = scene.views
    if config.source == "frames" and views is None:
        raise InputError(f"views: scene {scene.name} has no cameras; use choose.source=shells")
    names: list[str] = []
    frames: list[int | None] = []
    parts: list[Cameras] = []
    spaces = [free.without(target.rows) for target in targets]
    if config.source != "shells" and views is not None:
        room = total if config.source == "frames" else total // 2
        if views.images is not None and room >= 2 * len(targets):
            large = photograph_cameras(views)
            for target, space, part in zip(targets, spaces, _split_evenly(room // 2, len(targets)), strict=True):
                best = frames_on(views.cameras, gaussians, [target], part, [space])
                near, rows = closeups(large.select(best), gaussians, target, width=config.width, height=config.height)
                parts.append(near)
                names += [f"{views.names[view]} near {target.name}" for view in best[rows]]
                frames += best[rows].tolist()
        whole = frames_on(views.cameras, gaussians, targets, room - len(frames), spaces)
        parts.append(views.cameras.select(whole).resized(config.frame_side, enlarge=False))
        names += [views.names[view] for view in whole]
        frames += whole.tolist()
    if config.source != "frames":
        if views is not None:
            count = max(CONSTANTS.free_space_cameras, len(targets))
            observers = frames_on(views.cameras, gaussians, targets, count, spaces)
            free = free.seen_by(views.cameras.select(observers))
        up = up_of(scene)
        for target, room in zip(targets, _split_evenly(total - len(frames), len(targets)), strict=True):
            space = free.without(target.rows)
            around = shell_cameras(gaussians, target, room, space, up=up, width=config.width, height=config.height)
            if not len(around):
                warnings.warn(f"views: there is no room for a camera around {target.name}", SceneWarning, stacklevel=4)
            parts.append(around)
            names += [f"around {target.name} {number:02d}" for number in range(len(around))]
            frames += [None] * len(around)
    if not names:
        remedy = "choose.method=uniform looks at all of the splat" if views is None else "take choose.source=frames"
        raise InputError(
            f"views: there is no room for a camera around {', '.join(target.name for target in targets)} "
            f"(pictures of {config.width} x {config.height} pixels); {remedy}"
        )
    return concatenate_cameras(parts), names, frames


def _split_evenly(total: int, parts: int) -> list[int]:
    """Whole numbers of one or more that come to a total, as equal as can be."""
    return [max(1, total // parts + (part < total % parts)) for part in range(parts)]
