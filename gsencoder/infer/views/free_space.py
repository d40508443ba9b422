"""Free space for cameras: cells that are known to be empty, distances to surfaces, ray casting."""

from collections.abc import Hashable
from copy import copy

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Integer

from gsencoder.core.arrays import even_indices
from gsencoder.core.process import parallel
from gsencoder.data.seeding.points import NEIGHBOR
from gsencoder.geometry import covariances
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.split_gaussians import patches
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, Gaussians


class FreeSpace:
    """The empty part of a scene, as its Gaussians and cameras that saw it tell.

    Attributes:
        cell: edge of the cells in which rays are followed, world units.
        observers: the cameras that tell what is empty; None where there are none.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        """Args:
        gaussians: the splat.
        """
        from scipy.spatial import cKDTree

        solid = np.flatnonzero(gaussians.opacities >= CONSTANTS.min_obstacle_opacity)
        if not len(solid):
            solid = np.arange(len(gaussians))
        self._gaussians, self._quats = gaussians, gaussians.quats[solid]
        means = gaussians.means[solid].astype(np.float64)
        sample = means[even_indices(len(means), CONSTANTS.spacing_sample)]
        distances = cKDTree(means).query(sample, k=[min(NEIGHBOR + 1, len(means))])[0]
        # Of a single Gaussian, and of many in one place, the size is known.
        self.cell = CONSTANTS.cell_spacings * (float(np.median(distances)) or float(np.median(gaussians.scales[solid])))
        self._patches = patches(gaussians.select(solid), self.cell)
        self._tree = cKDTree(self._patches.centers)
        # Floaters may be any distance away: what is beyond the middle's million cells on a side is met by no ray.
        self._low = np.floor(np.median(means, axis=0) / self.cell) - CONSTANTS.grid_cells // 2
        self._met, self._cell_of = solid[self._patches.rows], self._codes(self._patches.centers)
        self._occupied = np.unique(self._cell_of[self._cell_of >= 0])
        self.observers: Cameras | None = None
        self._depths: list[Float32[np.ndarray, "h w"]] = []
        # Shared by copies of this space: the same cameras tell of it for one target after the other.
        self._depth_maps: dict[Hashable, Float32[np.ndarray, "h w"]] = {}

    def seen_by(self, cameras: Cameras, config: BlendConfig = BlendConfig()) -> "FreeSpace":
        """The same space, of which cameras tell what they looked through.

        Args:
            cameras: in the same world; a depth map is rendered for each, once. None of them: nobody tells.
            config: accuracy of the depth maps.
        """
        if not len(cameras):
            return self
        other = copy(self)
        small = other.observers = cameras.resized(CONSTANTS.free_space_side)

        def depth_map(view: int) -> Float32[np.ndarray, "h w"]:
            b = blend(self._gaussians, small, view, config=config)
            # Rays that end nowhere have looked through nothing that is known.
            return torch.where(b.alpha >= CONSTANTS.min_depth_alpha, b.depth, 0.0).reshape(b.shape).float().numpy()

        arrays = small.cam_from_world, small.Ks, small.widths, small.heights
        keys = [(config, *(array[view].tobytes() for array in arrays)) for view in range(len(small))]
        new = {key: view for view, key in enumerate(keys) if key not in self._depth_maps}
        self._depth_maps.update(zip(new, parallel(depth_map, new.values()), strict=True))
        other._depths = [self._depth_maps[key] for key in keys]
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
        """How far each ray goes before the first cell that holds a Gaussian; +inf where it meets none.

        Args:
            starts: of the rays.
            directions: unit vectors.
            lengths: rays are followed so far, world units, or for `ViewConstants.max_ray_cells` cells.
        """
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
