"""How the cost of fusion and of the encoder grows with Gaussians, views, channels and pixels."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.tradeoff.measure import Exponent, fit_exponent, interleaved, timed_run
from gsencoder.evaluate.tradeoff.stage import Inputs, StageName
from gsencoder.evaluate.tradeoff.stages import EncoderSettings, encoder_of, taught_scene
from gsencoder.fusion.fuse import fuse
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import build_teacher, text_table_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.types import FeatureMap, FeatureSpace, Gaussians, Scene, Views
from gsencoder.types.orientation import upright_views

Factor = Literal["gaussians", "views", "channels", "pixels"]
SPAN = 8.0
"""The largest size as a multiple of the smallest."""
DENSE_CELL = 8
"""Pixels along a cell of the labels teacher where channels are counted: maps of single pixels are codes into a table,
and cost the same whatever the table's width."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingConfig:
    """Which sizes are measured."""

    points: int = field(
        default=0, metadata={"help": "sizes of each kind for exponents of cost (fusion, encoder); 0 = no exponents"}
    )
    rounds: int = field(default=2, metadata={"help": "timed runs at each size"})

    def __post_init__(self) -> None:
        if self.points < 0 or self.points in (1, 2):
            raise InputError(f"points: expected 0 (none) or 3 and more, got {self.points}")
        if self.rounds < 1:
            raise InputError(f"rounds: expected 1 or more, got {self.rounds}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingResult:
    """How a stage's CPU time grows with one size.

    Attributes:
        stage: its name.
        factor: the size that was changed.
        scenes: how many were measured.
        sizes, cpu_seconds: one for each timed run, of all scenes.
        exponent: of CPU time, each scene with a constant of its own.
    """

    stage: StageName
    factor: Factor
    scenes: int
    sizes: tuple[float, ...]
    cpu_seconds: tuple[float, ...]
    exponent: Exponent

    def row(self) -> dict[str, Any]:
        """The result as a row of a table."""
        return {
            "stage": self.stage,
            "size": self.factor,
            "scenes": self.scenes,
            "smallest": min(self.sizes),
            "largest": max(self.sizes),
            "exponent": self.exponent.value,
            "low": self.exponent.low,
            "high": self.exponent.high,
            "runs": self.exponent.points,
        }


def geometric_sizes(most: int, config: ScalingConfig, least: int = 1) -> list[int]:
    """Whole sizes up to `most` at equal ratios, without repeats."""
    smallest = max(least, most / SPAN)
    return sorted({int(size) for size in np.geomspace(smallest, most, config.points).round()})


class DenseTeacher:
    """A teacher with dense maps of its first channels, so that cost depends on channels and not on a table."""

    needs_images = False
    cheap = True
    table = None
    mean = None

    def __init__(self, teacher: Teacher, views: Views, channels: int) -> None:
        self.space: FeatureSpace = replace(teacher.space, channels=channels, text_encoder="")
        views = upright_views(views, unmirror=True)
        self._maps = {view: self._dense(teacher.feature_map(views, view)) for view in range(len(views))}

    def _dense(self, coded: FeatureMap) -> FeatureMap:
        channels = self.space.channels
        if coded.features is not None:
            features = coded.features[..., :channels]
        else:
            assert coded.table is not None
            table = coded.table[:, :channels]
            if coded.codes is not None:
                features = np.where((coded.codes < 0)[..., None], np.float32(np.nan), table[coded.codes])
            else:
                assert coded.shares is not None
                features = coded.shares @ table
        return FeatureMap(
            features=np.ascontiguousarray(features, np.float32),
            grid_from_image=coded.grid_from_image,
            space=self.space,
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:  # noqa: ARG002
        return self._maps[view]

    def settings(self) -> dict[str, Any]:
        return {}


def thinned(gaussians: Gaussians, count: int) -> Gaussians:
    """So many of the Gaussians, evenly spread over their order."""
    return gaussians.select(even_indices(len(gaussians), count))


Run = tuple[float, Callable[[], Any]]
"""A size, and what is timed at it."""


class _Timed:
    """A run as a `StageScene`, for `timed_run`."""

    def __init__(self, run: Callable[[], Any]) -> None:
        self._run = run

    def run(self, settings: Any) -> Any:  # noqa: ARG002
        return self._run()

    def judge(self, product: Any, settings: Any) -> Any:
        raise NotImplementedError


@contextmanager
def fusion_runs(path: Path, inputs: Inputs, config: ScalingConfig) -> Iterator[dict[Factor, list[Run]]]:
    """What is fused at which sizes: one is changed at a time, the others are those of the scene."""
    with taught_scene(path, inputs) as taught:
        scene, teacher = taught.scene, taught.teacher
        assert scene.gaussians is not None
        assert scene.views is not None
        gaussians, views = scene.gaussians, scene.views

        def fused(scene: Scene, teacher: Teacher, **changes: Any) -> Callable[[], Any]:
            settings = replace(inputs.fusion, **changes)
            return lambda: fuse(scene, teacher, settings)

        runs: dict[Factor, list[Run]] = {
            "gaussians": [
                (size, fused(replace(scene, gaussians=thinned(gaussians, size)), teacher))
                for size in geometric_sizes(len(gaussians), config)
            ],
            "views": [(size, fused(scene, teacher, views=size)) for size in geometric_sizes(len(views), config)],
            "channels": [],
            "pixels": [],
        }
        words = text_table_of(inputs.teacher)
        coarse = inputs.teacher
        if isinstance(coarse, LabelsConfig) and coarse.cell == 1:
            coarse = replace(coarse, cell=DENSE_CELL)
        source = build_teacher(coarse, scene, words)
        for size in geometric_sizes(teacher.space.channels, config):
            dense = DenseTeacher(source, views, size)
            runs["channels"].append((size, fused(scene, dense, basis=False)))
        for size in np.geomspace(1 / SPAN, 1, config.points):
            scale = inputs.data.image_scale * float(np.sqrt(size))
            smaller = load_scene(path, options=replace(inputs.data, image_scale=scale))
            assert smaller.views is not None
            cameras = smaller.views.cameras
            smaller = replace(smaller, gaussians=gaussians, objects=scene.objects)
            pixels = float((cameras.widths.astype(np.float64) * cameras.heights).mean())
            runs["pixels"].append((pixels, fused(smaller, build_teacher(inputs.teacher, smaller, words))))
        yield runs


@contextmanager
def encoder_runs(path: Path, inputs: Inputs, config: ScalingConfig) -> Iterator[dict[Factor, list[Run]]]:
    """What is encoded at which numbers of Gaussians."""
    scene = with_gaussians(load_scene(path, options=inputs.data), inputs.seeds)
    assert scene.gaussians is not None
    encoder = encoder_of(EncoderSettings().weights, 0.0, 0)
    unit = unit_of(scene, encoder.voxel)

    def encoded(part: Gaussians) -> Callable[[], Any]:
        return lambda: encoder.encode_spaces(part, inputs.encode, metres_per_unit=unit)

    sizes = geometric_sizes(len(scene.gaussians), config)
    yield {"gaussians": [(size, encoded(thinned(scene.gaussians, size))) for size in sizes]}


RUNS = {"fusion": fusion_runs, "encoder": encoder_runs}


def scaling(
    stages: Sequence[StageName],
    paths: Sequence[Path],
    inputs: Inputs,
    config: ScalingConfig,
    *,
    seed: int = 0,
    track: Track = untracked,
) -> list[ScalingResult]:
    """Exponents of the CPU time of stages; stages whose sizes nobody can change here have none.

    Args:
        stages: names.
        paths: folders of the scenes.
        inputs: what stages start from.
        config: which sizes.
        seed: of the order of the runs.
        track: progress.

    Raises:
        InputError: a scene is too small for three different sizes.
    """
    sizes: dict[tuple[StageName, Factor], list[tuple[int, float, float]]] = {}
    for stage in stages:
        if stage not in RUNS:
            continue
        for number, path in enumerate(track(list(paths), f"{stage}: exponents")):
            with RUNS[stage](path, inputs, config) as by_factor:
                for factor, runs in by_factor.items():
                    for _, run in runs:
                        run()
                    for _, index in track(list(interleaved(len(runs), config.rounds, seed)), factor):
                        size, run = runs[index]
                        cost = timed_run(_Timed(run), None).cpu_seconds
                        sizes.setdefault((stage, factor), []).append((number, size, cost))
    results = []
    for (stage, factor), measured in sizes.items():
        groups, at, costs = zip(*measured, strict=True)
        exponent = fit_exponent(np.array(at, np.float64), np.array(costs), np.array(groups))
        results.append(
            ScalingResult(
                stage=stage,
                factor=factor,
                scenes=len(paths),
                sizes=tuple(map(float, at)),
                cpu_seconds=tuple(costs),
                exponent=exponent,
            )
        )
    return results
