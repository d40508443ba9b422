"""Speed against accuracy: one scene fused with many settings, in one run.

Each setting is held against a reference that is as exact as the knobs go. Teacher maps are made once and kept, so that
what is timed is what the knobs change: blending, visibility, basis and lift. Rounds alternate between the settings
(A B C, A B C), so that whatever else the machine does falls on all of them alike.
"""

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.peak_memory import memory_growth
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.evaluate.boxes import Hit, accuracy
from gsencoder.evaluate.protocols.localization import LocalizationProtocol, ask
from gsencoder.fusion.feature_error import FieldError, field_error
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.teacher_maps import CachedTeacher
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher, text_table_of
from gsencoder.infer.localize.localize import LocalizeConfig
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

REFERENCE = "reference"
"""The label of what all others are held against; it is neither on the front nor picked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Which values each knob takes. Every value is tried with the others at their defaults, or all with all."""

    rays_per_patch: tuple[int, ...] = field(default=(1, 4, 16), metadata={"help": "rays averaged into one patch"})
    min_weight: tuple[float, ...] = field(default=(0.001, 0.01, 0.1), metadata={"help": "smallest weight kept"})
    stop_transmittance: tuple[float, ...] = field(
        default=(0.001, 0.01, 0.1), metadata={"help": "transmittance at which a ray ends"}
    )
    energy: tuple[float, ...] = field(default=(0.9, 0.95, 0.99), metadata={"help": "share of energy a basis keeps"})
    max_rank: tuple[int, ...] = field(default=(8, 16, 32, 64), metadata={"help": "largest rank of the basis"})
    views: tuple[int, ...] = field(default=(4, 8, 16), metadata={"help": "views used, evenly spaced"})
    grid: bool = field(default=False, metadata={"help": "try all combinations, not one knob at a time"})
    rounds: int = field(default=3, metadata={"help": "timed runs of each setting; the median counts"})
    reference_rays: int = field(default=196, metadata={"help": "rays per patch of the reference"})

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise InputError(f"rounds: expected 1 or more, got {self.rounds}")


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig:
    """What may be spent; the cheapest setting that keeps to all of it is named."""

    seconds: float | None = field(default=None, metadata={"help": "for fusing one scene, without the teacher"})
    error: float | None = field(default=None, metadata={"help": "centered cosine error against the reference"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Trade:
    """One setting, over all scenes.

    Attributes:
        label: what differs from the defaults, in words.
        knobs: the same as values; empty for the defaults and the reference.
        seconds: a scene, median over rounds, mean over scenes.
        mib: growth of the process's peak memory, the largest over scenes.
        rank: columns of the features, mean over scenes.
        error: 1 − centered cosine to the reference over what it saw, mean over scenes; what was missed counts as 1.
        raw_error: the same without centering, over what both saw.
        covered: share of what the reference saw that this saw too.
        hits: objects asked for; empty where the teacher has no words or the scenes no objects.
        on_front: whether no other setting is both as fast and as exact.
    """

    label: str
    knobs: dict[str, Any]
    seconds: float
    mib: float
    rank: float
    error: float
    raw_error: float
    covered: float
    hits: tuple[Hit, ...]
    on_front: bool = False


def settings_of(sweep: SweepConfig, base: FuseConfig) -> list[tuple[dict[str, Any], FuseConfig]]:
    """The defaults first, then every setting of the sweep, each once, with what it changes.

    Raises:
        InputError: a knob out of range.
    """
    now = {
        "rays_per_patch": base.blend.rays_per_patch,
        "min_weight": base.blend.min_weight,
        "stop_transmittance": base.blend.stop_transmittance,
        "energy": base.energy,
        "max_rank": base.max_rank,
        "views": base.views,
    }
    lists = {name: list(dict.fromkeys((now[name], *getattr(sweep, name)))) for name in now}
    if sweep.grid:
        tried = [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]
    else:
        tried = [now, *({**now, name: value} for name, values in lists.items() for value in values[1:])]
    return [({k: v for k, v in knobs.items() if v != now[k]}, _with(base, knobs)) for knobs in tried]


def _with(base: FuseConfig, knobs: dict[str, Any]) -> FuseConfig:
    blend = {name: knobs[name] for name in ("rays_per_patch", "min_weight", "stop_transmittance")}
    rest = {name: knobs[name] for name in ("energy", "max_rank", "views")}
    return replace(base, blend=replace(base.blend, **blend), **rest)


def trade_off(
    paths: Sequence[str | Path],
    *,
    teacher: TeacherConfig,
    sweep: SweepConfig = SweepConfig(),
    base: FuseConfig = FuseConfig(),
    protocol: LocalizationProtocol = LocalizationProtocol(),
    data: SceneConfig = SceneConfig(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
    track: Track = untracked,
) -> list[Trade]:
    """Measures every setting of a sweep on every scene: the reference, the defaults, then the rest.

    Args:
        paths: scenes.
        teacher: what is fused; with words and labeled objects there are accuracies too.
        sweep: the values of the knobs.
        base: the defaults that the knobs leave.
        protocol: which objects are asked for.
        data: how scenes are read.
        seeds: how Gaussians are made for scenes without.
        localization: how words become boxes.
        track: wraps the loops to show progress.

    Raises:
        InputError: a knob out of range, or whatever is wrong with a scene.
    """
    settings = settings_of(sweep, base)
    exact = replace(base.blend, rays_per_patch=sweep.reference_rays, min_weight=0.0, stop_transmittance=1e-6)
    reference: tuple[dict[str, Any], FuseConfig] = ({}, replace(base, blend=exact, basis=False, views=0))
    words = text_table_of(teacher)
    per_scene: list[list[Trade]] = []
    for path in track(list(paths), "scenes"):
        scene = load_scene(path, options=data)
        if scene.gaussians is None:
            scene = replace(scene, gaussians=seed(scene, seeds))
        with tempfile.TemporaryDirectory(prefix="gsencoder_maps_") as maps:
            cached = CachedTeacher(build_teacher(teacher, scene, words), Path(maps))
            measured = _measure(scene, cached, [reference, *settings], words, protocol, localization, sweep, track)
        per_scene.append(measured)
    reference_trade, *trades = [_over_scenes([one[place] for one in per_scene]) for place in range(len(settings) + 1)]
    return [replace(reference_trade, label=REFERENCE), *mark_front(trades)]


def _measure(
    scene: Scene,
    teacher: Teacher,
    settings: list[tuple[dict[str, Any], FuseConfig]],
    words: TextTable | None,
    protocol: LocalizationProtocol,
    localization: LocalizeConfig,
    sweep: SweepConfig,
    track: Track,
) -> list[Trade]:
    """The first setting is the reference."""
    seconds: list[list[float]] = [[] for _ in settings]
    done: list[tuple[float, int, FieldError, tuple[Hit, ...]]] = []
    reference: GaussianFeatures | None = None
    for round_number in track(range(sweep.rounds), "rounds"):
        for place, (_, config) in enumerate(track(settings, "settings")):
            with memory_growth() as growth:
                fusion = fuse(scene, teacher, config)
            seconds[place].append(sum(value for step, value in fusion.seconds.items() if step != "teacher"))
            reference = fusion.features if reference is None else reference
            if round_number == 0:
                error = field_error(fusion.features, reference)
                hits = ask(scene, fusion.features, words, protocol, localization)[0] if words is not None else []
                done.append((growth.mib, fusion.features.features.shape[1], error, tuple(hits)))
    return [
        Trade(
            label=", ".join(f"{name}={value}" for name, value in knobs.items()) or "defaults",
            knobs=knobs,
            seconds=float(np.median(times)),
            mib=mib,
            rank=float(rank),
            error=error.total,
            raw_error=error.raw,
            covered=error.covered,
            hits=hits,
        )
        for (knobs, _), times, (mib, rank, error, hits) in zip(settings, seconds, done, strict=True)
    ]


def _over_scenes(trades: list[Trade]) -> Trade:
    def mean(name: str) -> float:
        return float(np.mean([getattr(trade, name) for trade in trades]))

    return Trade(
        label=trades[0].label,
        knobs=trades[0].knobs,
        mib=max(trade.mib for trade in trades),
        hits=tuple(hit for trade in trades for hit in trade.hits),
        seconds=mean("seconds"),
        rank=mean("rank"),
        error=mean("error"),
        raw_error=mean("raw_error"),
        covered=mean("covered"),
    )


def mark_front(trades: Sequence[Trade]) -> list[Trade]:
    """The same trades, with those marked that no other one beats in seconds or error without losing in the other."""

    def beaten(one: Trade) -> bool:
        return any(
            other.seconds <= one.seconds
            and other.error <= one.error
            and (other.seconds < one.seconds or other.error < one.error)
            for other in trades
        )

    return [replace(one, on_front=not beaten(one)) for one in trades]


def pick(trades: Sequence[Trade], budget: BudgetConfig) -> Trade:
    """The fastest setting within a budget of error, or, with a budget of seconds alone, the most exact one within it.

    Raises:
        InputError: no setting keeps to the budget; the nearest is named.
    """
    trades = [one for one in trades if one.label != REFERENCE]
    fitting = [
        one
        for one in trades
        if (budget.seconds is None or one.seconds <= budget.seconds)
        and (budget.error is None or one.error <= budget.error)
    ]
    if not fitting:
        fast, good = min(trades, key=lambda one: one.seconds), min(trades, key=lambda one: one.error)
        raise InputError(
            f"budget: no setting keeps to it; the fastest ({fast.label}) takes {fast.seconds:.3g} s at an error of "
            f"{fast.error:.3g}, the most exact ({good.label}) {good.seconds:.3g} s at {good.error:.3g}"
        )
    if budget.error is None:
        return min(fitting, key=lambda one: (one.error, one.seconds))
    return min(fitting, key=lambda one: (one.seconds, one.error))


def row_of(trade: Trade) -> dict[str, Any]:
    """A trade as a line of a table; accuracies are NaN where nothing was asked for."""
    return {
        "setting": trade.label,
        "seconds": trade.seconds,
        "mib": trade.mib,
        "rank": trade.rank,
        "error": trade.error,
        "raw_error": trade.raw_error,
        "covered": trade.covered,
        "acc_25": accuracy(trade.hits, 0.25),
        "acc_50": accuracy(trade.hits, 0.5),
        "objects": len(trade.hits),
        "on_front": trade.on_front,
    }
