"""Initial Gaussians of a scene without optimization (SplatDistill, section 3.1: surface samples on a 2 cm grid).

One flat Gaussian stands on each piece of surface in each voxel, as wide as its neighbors are apart, in the color
that the photographs show. Such a splat renders well enough for features to be lifted onto it at once.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import file_of_scene
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import check_limits, option
from gsencoder.data.seeding.depth import read_rgbd, seed_from_depth
from gsencoder.data.seeding.mesh import mesh_bounds, seed_from_mesh, seed_from_tsdf
from gsencoder.data.seeding.points import SEED_VOXEL, seed_from_points, typical_spacing
from gsencoder.types import Gaussians, Scene, Views

TYPICAL_DEPTH_IN_VOXELS = 100
"""Depth images without a unit: their median depth is taken to be this many voxels, as 2 m are of 2 cm."""
EXTENT_IN_VOXELS = 300
"""A mesh without a unit and without cameras: the diagonal of its box is taken to be this many voxels."""


SAMPLED_VIEWS = 8  # Depth images that are read for that estimate

SMALLEST_VOXEL, LARGEST_VOXEL = 1e-12, 1e12  # In units of the scene


Source = Literal["depth", "points", "photographs", "mesh", "tsdf"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedConfig:
    """How Gaussians are made from what a scene holds."""

    source: Literal["auto"] | Source = option(
        "auto",
        "depth = RGB-D frames; points = structure-from-motion points; photographs = matched features and plane sweeps; "
        "mesh = a file; tsdf = RGB-D frames fused to a mesh first; auto = depth if the views have it, else points if "
        "the scene has them, else photographs",
    )
    voxel: float = option(SEED_VOXEL, "edge of the grid in metres", gt=0, lt=math.inf)
    mesh: str = option("", "the file of source=mesh, in world coordinates: in each scene's folder, else from here")

    def __post_init__(self) -> None:
        check_limits(self)
        if self.source == "mesh" and not self.mesh:
            raise InputError("source=mesh needs the mesh's file (mesh=PATH)")


def choose_source(scene: Scene, config: SeedConfig = SeedConfig()) -> Source:
    """The source of seeds that `config` names or, for "auto", the first of depth, points and photographs there is."""
    if config.source != "auto":
        return config.source
    if scene.views is not None and scene.views.depths is not None:
        return "depth"
    if scene.sfm_points is not None:
        return "points"
    if scene.views is not None and scene.views.images is not None:
        return "photographs"
    raise InputError(
        f"seeds: scene {scene.name!r} has neither photographs nor points; give a mesh (seeds.mesh=) or a splat"
    )


def seed(scene: Scene, config: SeedConfig = SeedConfig(), *, track: Track = untracked) -> Gaussians:
    """Initial Gaussians of a scene, relative to its origin; the scene's own Gaussians are not looked at.

    The voxel is `config.voxel` metres. Where the scene's unit is unknown it is, with a warning, for depth images one
    hundredth of the median depth, for points their median nearest-neighbor distance, for a mesh one hundredth of the
    median distance from the cameras to its middle, or one 300th of its diagonal. Seeds of photographs are as far apart
    as a few pixels (`gsencoder.data.seeding.from_photographs`).
    """
    source, views = choose_source(scene, config), scene.views
    if source == "points":
        points = scene.sfm_points
        if points is None:
            raise InputError(f"seeds: scene {scene.name!r} has no structure-from-motion points")
        voxel = _voxel(scene, config, lambda: typical_spacing(points), "the points' median nearest-neighbor distance")
        return seed_from_points(points, scene.sfm_colors, views=views, voxel=voxel)
    if source == "mesh":
        mesh = config.mesh if scene.folder is None else file_of_scene("seeds.mesh", config.mesh, scene.folder)
        voxel = _voxel(scene, config, lambda: _mesh_voxel(scene, mesh), "by the mesh's size and the cameras")
        return seed_from_mesh(mesh, voxel=voxel, origin=scene.origin)
    if views is None:
        inputs = "photographs" if source == "photographs" else "RGB-D frames"
        raise InputError(f"seeds: scene {scene.name!r} has no views; source={source} needs posed {inputs}")
    if source == "photographs":
        # Sweeps need torch, which seeding from depth does without.
        from gsencoder.data.seeding.from_photographs import seed_from_photographs

        return seed_from_photographs(views, track=track)
    voxel = _voxel(scene, config, lambda: _depth_voxel(views), "one hundredth of the median depth")
    return seed_from_tsdf(views, voxel=voxel) if source == "tsdf" else seed_from_depth(views, voxel=voxel)


def _voxel(scene: Scene, config: SeedConfig, estimate: Callable[[], float], how: str) -> float:
    """The voxel in scene units; InputError where float32 cannot count in it, which tells of a wrong unit."""
    if scene.metres_per_unit is not None:
        voxel = config.voxel / scene.metres_per_unit
    else:
        voxel = estimate()
        warnings.warn(
            f"seeds: the unit of scene {scene.name!r} is unknown, so the voxel is {voxel:.4g} of its units, {how}; "
            "give data.metres_per_unit= to choose",
            SceneWarning,
            stacklevel=3,
        )
    if not SMALLEST_VOXEL <= voxel <= LARGEST_VOXEL:
        raise InputError(
            f"seeds: a voxel of {voxel:g} units of scene {scene.name!r} is outside {SMALLEST_VOXEL:g} to "
            f"{LARGEST_VOXEL:g}; check voxel and metres_per_unit"
        )
    return voxel


def _depth_voxel(views: Views) -> float:
    if not len(views) or views.depths is None or views.images is None:
        raise InputError("seeds: the scene has no posed views with depth and images; use source=points or source=mesh")
    some = even_indices(len(views), SAMPLED_VIEWS)
    depths = [depth[depth > 0] for depth in (read_rgbd(views, int(view))[0] for view in some)]
    values = np.concatenate(depths)
    if not values.size:
        raise InputError(f"seeds: none of {len(some)} depth images that were looked at has a depth above 0")
    return float(np.median(values)) / TYPICAL_DEPTH_IN_VOXELS


def _mesh_voxel(scene: Scene, path: str | Path) -> float:
    lower, upper = mesh_bounds(path)
    if scene.views is not None and len(scene.views):
        middle = (lower + upper) / 2 - scene.origin
        return float(np.median(np.linalg.norm(scene.views.cameras.centers - middle, axis=1))) / TYPICAL_DEPTH_IN_VOXELS
    return float(np.linalg.norm(upper - lower)) / EXTENT_IN_VOXELS


def with_gaussians(scene: Scene, config: SeedConfig = SeedConfig(), *, track: Track = untracked) -> Scene:
    """The scene, with seeds where it has no splat."""
    return scene if scene.gaussians is not None else replace(scene, gaussians=seed(scene, config, track=track))
