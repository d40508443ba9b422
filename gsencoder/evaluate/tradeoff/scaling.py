"""How the cost of fusion and of the encoder grows with Gaussians, views, channels and pixels.

Power laws, cost = constant · size^exponent, are fitted by least squares of logarithms. Costs that do not grow with a
size, and what is constant, pull an exponent down at small sizes: it holds for the sizes that were measured.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import check_limits, option
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.tradeoff.measure import interleaved, timed_run
from gsencoder.evaluate.tradeoff.stages import EncoderSettings, Inputs, StageName, encoder_of, taught_scene
from gsencoder.fusion.fuse import fuse
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import text_table_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views
from gsencoder.types.orientation import upright_views

Factor = Literal["gaussians", "views", "channels", "pixels"]
SPAN = 8.0
"""The largest size as a multiple of the smallest."""
ROUNDS = 2
"""Timed runs at each size."""
DENSE_CELL = 8
"""Pixels along a cell of the labels teacher where channels are counted: maps of single pixels are codes into a table,
and cost the same whatever the table's width."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingConfig:
    """Which sizes are measured."""

    points: int = option(0, "sizes of each kind for exponents of cost (fusion, encoder); 0 = no exponents", ge=0)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.points in (1, 2):
            raise InputError(f"points: expected 0 (none) or 3 and more, got {self.points}")


class Exponent(NamedTuple):
    """A power law fitted to costs: its exponent with the 95 % confidence interval, and the cost at size 1."""

    value: float
    low: float
    high: float
    constant: float


def fit_exponent(
    sizes: Float64[np.ndarray, " n"], costs: Float64[np.ndarray, " n"], groups: Int64[np.ndarray, " n"] | None = None
) -> Exponent:
    """Fits log cost = log constant + exponent · log size.

    Args:
        groups: a number for each pair; each group has a constant of its own, and all have the same exponent. None = one
            group.
    """
    from scipy.stats import t

    if not (np.minimum(sizes, costs) > 0).all():
        raise InputError("fit_exponent: expected positive sizes and costs")
    labels = np.zeros(len(sizes), np.int64) if groups is None else np.unique(groups, return_inverse=True)[1]
    free = len(sizes) - (int(labels.max(initial=0)) + 1) - 1

    def about_means(values: np.ndarray) -> np.ndarray:
        return np.asarray(values - (np.bincount(labels, values) / np.bincount(labels))[labels])

    log_x, log_y = np.log(sizes), np.log(costs)
    x, y = about_means(log_x), about_means(log_y)
    moment = float((x**2).sum())
    if free < 1 or not moment > 1e-12:
        raise InputError(f"fit_exponent: expected three different sizes or more, got {np.unique(sizes).tolist()}")
    value = float((x * y).sum() / moment)
    half = float(t.ppf(0.975, free)) * float(np.sqrt(((y - value * x) ** 2).sum() / free / moment))
    constant = float(np.exp(log_y.mean() - value * log_x.mean()))
    return Exponent(value=value, low=value - half, high=value + half, constant=constant)


def geometric_sizes(most: int, points: int) -> list[int]:
    """Whole sizes up to `most` at equal ratios, without repeats."""
    return sorted({int(size) for size in np.geomspace(max(1, most / SPAN), most, points).round()})


class DenseTeacher:
    """A teacher with dense maps of its first channels, so that cost depends on channels and not on a table."""

    needs_images = False
    cheap = True
    table = None
    mean = None

    def __init__(self, teacher: Teacher, views: Views, channels: int) -> None:
        self.space: FeatureSpace = replace(teacher.space, channels=channels, text_encoder="")
        views = upright_views(views, unmirror=True)
        self._maps = []
        for view in range(len(views)):
            coded = teacher.feature_map(views, view)
            rows = np.ascontiguousarray(coded.rows()[:, :channels], np.float32)
            features = rows.reshape(coded.height, coded.width, channels)
            self._maps.append(FeatureMap(features=features, grid_from_image=coded.grid_from_image, space=self.space))

    def feature_map(self, views: Views, view: int) -> FeatureMap:  # noqa: ARG002
        return self._maps[view]

    def settings(self) -> dict[str, Any]:
        return {}


Runs = dict[Factor, list[tuple[float, Callable[[], Any]]]]
"""Sizes, one of which is changed at a time, and what is timed at them."""


def gaussian_sizes(scene: Scene, points: int) -> Iterator[tuple[int, Scene]]:
    """A scene with fewer of its Gaussians, evenly spread over their order."""
    gaussians = scene.gaussians
    assert gaussians is not None
    for size in geometric_sizes(len(gaussians), points):
        yield size, replace(scene, gaussians=gaussians.select(even_indices(len(gaussians), size)))


@contextmanager
def fusion_runs(path: Path, inputs: Inputs, points: int) -> Iterator[Runs]:
    """What is fused at which sizes; those that do not change are those of the scene."""
    with taught_scene(inputs, path) as taught:
        scene, teacher, fusion = taught.scene, taught.teacher, inputs.fusion
        views = scene.views
        assert views is not None
        words = text_table_of(inputs.teacher)
        coarse = inputs.teacher
        if isinstance(coarse, LabelsConfig) and coarse.cell == 1:
            coarse = replace(coarse, cell=DENSE_CELL)
        source = coarse.build(scene, words)
        runs: Runs = {
            "gaussians": [(size, partial(fuse, part, teacher, fusion)) for size, part in gaussian_sizes(scene, points)],
            "views": [
                (size, partial(fuse, scene, teacher, replace(fusion, views=size)))
                for size in geometric_sizes(len(views), points)
            ],
            "channels": [
                (size, partial(fuse, scene, DenseTeacher(source, views, size), replace(fusion, basis=False)))
                for size in geometric_sizes(teacher.space.channels, points)
            ],
            "pixels": [],
        }
        for size in np.geomspace(1 / SPAN, 1, points):
            scale = inputs.data.image_scale * float(np.sqrt(size))
            smaller = load_scene(path, options=replace(inputs.data, image_scale=scale))
            assert smaller.views is not None
            cameras = smaller.views.cameras
            smaller = replace(smaller, gaussians=scene.gaussians, objects=scene.objects)
            pixels = float((cameras.widths.astype(np.float64) * cameras.heights).mean())
            runs["pixels"].append((pixels, partial(fuse, smaller, inputs.teacher.build(smaller, words), fusion)))
        yield runs


@contextmanager
def encoder_runs(path: Path, inputs: Inputs, points: int) -> Iterator[Runs]:
    """What is encoded at which numbers of Gaussians."""
    scene = with_gaussians(load_scene(path, options=inputs.data), inputs.seeds)
    encoder = encoder_of(EncoderSettings().weights, 0.0, 0)
    encode = partial(encoder.encode_spaces, config=inputs.encode, metres_per_unit=unit_of(scene))
    yield {"gaussians": [(size, partial(encode, part.gaussians)) for size, part in gaussian_sizes(scene, points)]}


RUNS = {"fusion": fusion_runs, "encoder": encoder_runs}
"""The stages whose sizes can be changed here."""


def scaling(
    stages: Sequence[StageName], paths: Sequence[Path], inputs: Inputs, points: int, *, track: Track = untracked
) -> list[dict[str, Any]]:
    """Exponents of the CPU time of stages, as rows of a table; each scene has a constant of its own."""
    measured: dict[tuple[StageName, Factor], list[tuple[int, float, float]]] = {}
    for stage in stages:
        if stage not in RUNS:
            continue
        for number, path in enumerate(track(list(paths), f"{stage}: exponents")):
            with RUNS[stage](path, inputs, points) as by_factor:
                for factor, runs in by_factor.items():
                    for _, run in runs:
                        run()
                    for _, index in track(list(interleaved(len(runs), ROUNDS, seed=0)), factor):
                        size, run = runs[index]
                        row = number, size, timed_run(run).cpu_seconds
                        measured.setdefault((stage, factor), []).append(row)
    rows = []
    for (stage, factor), timings in measured.items():
        groups, sizes, costs = map(np.array, zip(*timings, strict=True))
        exponent = fit_exponent(sizes.astype(np.float64), costs, groups)
        rows.append(
            {
                "stage": stage,
                "size": factor,
                "scenes": len(paths),
                "smallest": float(sizes.min()),
                "largest": float(sizes.max()),
                "exponent": exponent.value,
                "low": exponent.low,
                "high": exponent.high,
                "runs": len(timings),
            }
        )
    return rows
