"""Fusion within a budget: the choice, the fusion, and the check of what was promised."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Track, untracked
from gsencoder.fusion.budget.choose import Choice, choose
from gsencoder.fusion.budget.config import BudgetConfig, check_budget, exact_config
from gsencoder.fusion.checkpoint import open_checkpoint
from gsencoder.fusion.feature_error import FieldError, judge
from gsencoder.fusion.fuse import FuseConfig, Fusion, checked_scene, fuse
from gsencoder.fusion.lift import FeatureSums, view_matrix
from gsencoder.fusion.teacher_maps import CachedTeacher, WrappedTeacher, upright
from gsencoder.fusion.visibility import resolve
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

DEPTH_CACHE_BYTES = 1 << 28
"""Depth maps that the choice reads stay in memory up to this size, for the fusion."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetFusion:
    """A fusion within a budget.

    Attributes:
        fusion: the features.
        choice: the setting, and what was predicted of it.
        choosing: seconds of the choice.
        seconds: from its beginning to the features.
        scene: with the views that the fusion read, some of whose depth maps are in memory.
        teacher: whose maps of some views are, too.
    """

    fusion: Fusion
    choice: Choice
    choosing: float
    seconds: float
    scene: Scene
    teacher: Teacher


def fuse_within(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig,
    budget: BudgetConfig,
    *,
    work: Path | None = None,
    sample_cells: bool = False,
    device: Device | torch.device = "auto",
    track: Track = untracked,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetFusion:
    """Lifts a teacher's maps by the setting that keeps a budget.

    Args:
        scene: with Gaussians and views.
        teacher: whose maps are lifted.
        config: options that the budget does not choose.
        budget: at least one promise.
        work: folder for the maps of a costly teacher, which are then made once, in interrupted runs too.
        sample_cells: see `fuse`.
        device: see `fuse`.
        track: see `fuse`.
        clock: seconds.

    Raises:
        InputError: no budget, one that cannot be combined with the options, megabytes into which not even one
            coordinate of each Gaussian fits, or what `fuse` refuses.
    """
    if not budget.promised:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")
    check_budget(budget, config)
    start, teacher = clock(), upright(teacher)
    gaussians, views = checked_scene(scene, teacher)
    if views.depths is not None:
        views = replace(views, depths=_CachedDepths(views.depths))
    if work is not None and not teacher.cheap:
        settings = {"budget": "maps", "lift": config.lift}
        teacher = open_checkpoint(work, settings, teacher, gaussians, views, range(len(views)), None).cached(teacher)
    maps: dict[int, FeatureMap] = {}

    def map_of(view: int) -> FeatureMap:
        maps[view] = teacher.feature_map(views, view)
        return maps[view]

    def measure(view: int) -> tuple[float, float]:
        visibility = resolve(config.visibility, views, config.lift)
        blend = exact_config(config).blend
        begun = clock()
        # The time of a map is measured even where it is in memory.
        maker = teacher.teacher if isinstance(teacher, CachedTeacher) else teacher
        feature_map = maker.feature_map(views, view) if view in maps else map_of(view)
        between = clock()
        matrix = view_matrix(gaussians, views, view, feature_map, lift=config.lift, visibility=visibility, config=blend)
        FeatureSums(len(gaussians), 1, None, None).add(matrix, _one_channel(feature_map), None)
        return between - begun, clock() - between

    choice = choose(
        gaussians,
        views,
        teacher,
        config,
        budget,
        map_of=map_of,
        measure=measure,
        elapsed=lambda: clock() - start,
    )
    choice_end = clock()
    scene = replace(scene, views=views)
    cached = _CachedMaps(teacher, maps)
    fusion = fuse(scene, cached, choice.config, rows=choice.rows, sample_cells=sample_cells, device=device, track=track)
    return BudgetFusion(
        fusion=fusion,
        choice=choice,
        choosing=choice_end - start,
        seconds=clock() - start,
        scene=scene,
        teacher=cached,
    )


def _one_channel(feature_map: FeatureMap) -> FeatureMap:
    """A map of the same grid with one channel."""
    space = FeatureSpace(name="ones", channels=1)
    ones = np.ones((feature_map.height, feature_map.width, 1), np.float32)
    return FeatureMap(features=ones, grid_from_image=feature_map.grid_from_image, space=space)


def realised_error(
    fused: BudgetFusion,
    config: FuseConfig,
    *,
    seed: int = 0,
    device: Device | torch.device = "auto",
    track: Track = untracked,
) -> FieldError:
    """The error of the features against those of the exact settings, on a tenth of the Gaussians that these see, drawn
    now. Maps of views that the setting left out are made for it."""
    exact = fuse(fused.scene, fused.teacher, exact_config(config), device=device, track=track).features
    return judge(fused.fusion.features, exact, seed=seed)


class _CachedDepths(Sequence[Float32[np.ndarray, "_ _"]]):
    """Depth maps that are read once, up to a limit of memory."""

    def __init__(self, depths: Sequence[Float32[np.ndarray, "_ _"]]) -> None:
        self._depths, self._read, self._bytes = depths, dict[int, np.ndarray](), 0

    def __len__(self) -> int:
        return len(self._depths)

    def __getitem__(self, index: Any) -> Any:
        if index in self._read:
            return self._read[index]
        depth = self._depths[index]
        if self._bytes + depth.nbytes <= DEPTH_CACHE_BYTES:
            self._read[index] = depth
            self._bytes += depth.nbytes
        return depth


class _CachedMaps(WrappedTeacher):
    """A teacher some of whose maps are in memory."""

    def __init__(self, teacher: Teacher, maps: dict[int, FeatureMap]) -> None:
        super().__init__(teacher)
        self._maps = maps

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The map of a view, from memory where the choice made it."""
        return self._maps[view] if view in self._maps else self.teacher.feature_map(views, view)
