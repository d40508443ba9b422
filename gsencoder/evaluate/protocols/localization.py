"""The localization protocol: labeled scenes in, share of objects whose box was found out.

For every scene: Gaussians (seeds where it has none), features (fused or encoded), and one box search for the names of
its small objects that are seen well enough. Settings are the same for all scenes; a name's first box is held against
the nearest object of that name.
"""

import math
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.boxes import Hit, accuracy, asked_objects, score_boxes
from gsencoder.evaluate.sources import Source, with_features
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

LEVELS = (0.25, 0.5)
"""The IoU that a box needs to count as found."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationProtocol:
    """Which objects are asked for."""

    name: Literal["localization"] = "localization"
    min_views: int = field(default=5, metadata={"help": "objects seen in fewer views are not asked for"})
    min_pixels: int = field(default=60, metadata={"help": "nor those whose largest visible area is smaller, pixels"})

    def __post_init__(self) -> None:
        for name in ("min_views", "min_pixels"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOutcome:
    """What happened in one scene.

    Attributes:
        scene: its name.
        hits: one an object asked for.
        gaussians: how many it has.
        seen: how many have features.
        rank: columns of the features.
        boxless: asked names without any box.
        seconds: by step.
    """

    scene: str
    hits: tuple[Hit, ...]
    gaussians: int
    seen: int
    rank: int
    boxless: int
    seconds: dict[str, float]


def evaluate_localization(
    scenes: Iterable[tuple[Scene, float]],
    source: Source,
    words: TextTable,
    *,
    protocol: LocalizationProtocol = LocalizationProtocol(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> list[SceneOutcome]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: with labeled objects, as `opened` gives them.
        source: what gives a scene its features.
        words: lead into their space.
        protocol: which objects are asked for.
        seeds: how Gaussians are made for scenes without.
        localization: how words become boxes.

    Returns:
        One outcome a scene, in order.

    Warns:
        SceneWarning: asked names without a box, and scenes in which nothing is asked for; one counted warning each.

    Raises:
        InputError: no object to ask for in any scene, or whatever is wrong with a scene.
    """
    outcomes = []
    for scene, loaded in scenes:
        outcome = evaluate_scene(scene, source, words, protocol=protocol, seeds=seeds, localization=localization)
        outcomes.append(replace(outcome, seconds={"load": loaded, **outcome.seconds}))
    _warn_of_gaps(outcomes)
    return outcomes


def evaluate_scene(
    scene: Scene,
    source: Source,
    words: TextTable,
    *,
    protocol: LocalizationProtocol = LocalizationProtocol(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> SceneOutcome:
    """The protocol on one loaded scene; see `evaluate_localization`. Nothing is made where nothing is asked for."""
    if not asked_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels):
        count = len(scene.gaussians) if scene.gaussians is not None else 0
        return SceneOutcome(scene=scene.name, hits=(), gaussians=count, seen=0, rank=0, boxless=0, seconds={})
    scene, features, seconds = with_features(scene, source, seeds)
    start = time.perf_counter()
    hits, boxless = ask(scene, features, words, protocol, localization)
    return SceneOutcome(
        scene=scene.name,
        hits=tuple(hits),
        gaussians=len(features),
        seen=int(features.seen.sum()),
        rank=features.features.shape[1],
        boxless=boxless,
        seconds={**seconds, "localize": time.perf_counter() - start},
    )


def ask(
    scene: Scene,
    features: GaussianFeatures,
    words: TextTable,
    protocol: LocalizationProtocol,
    localization: LocalizeConfig,
) -> tuple[list[Hit], int]:
    """Asks for each object's name in features of the scene's Gaussians: the hits, and how many names have no box."""
    asked = asked_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
    names = list(dict.fromkeys(one.name for one in asked if one.name))
    if not names:
        return [], 0
    with warnings.catch_warnings():
        # The counts of all scenes are told once, at the end.
        warnings.filterwarnings("ignore", ".*words have no box", SceneWarning)
        found = localize(replace(scene, features={features.space.name: features}), names, words, localization)
    return score_boxes(scene, found, asked), len(set(names) - {box.query for box in found.boxes})


def _warn_of_gaps(outcomes: Sequence[SceneOutcome]) -> None:
    empty = [outcome.scene for outcome in outcomes if not outcome.hits]
    if len(empty) == len(outcomes):
        raise InputError(
            f"evaluate: none of {len(outcomes)} scenes has an object to ask for; expected an objects.json with placed, "
            "named objects that are seen well enough (protocol.min_views, protocol.min_pixels)"
        )
    if empty:
        warnings.warn(
            f"{len(empty)} of {len(outcomes)} scenes have no object to ask for (first: {empty[0]!r})",
            SceneWarning,
            stacklevel=3,
        )
    if boxless := sum(outcome.boxless for outcome in outcomes):
        asked = sum(len(outcome.hits) for outcome in outcomes)
        warnings.warn(f"{boxless} names have no box ({asked} objects were asked for)", SceneWarning, stacklevel=3)


def scores(hits: Sequence[Hit]) -> dict[str, Any]:
    """The figures of the protocol: objects, accuracies at each level and mean IoU, of the first box and of the oracle.

    The oracle takes the best of all boxes of a name, as SplatDistill's table does; no user can.
    """
    row: dict[str, Any] = {"objects": len(hits)}
    for prefix, oracle in (("", False), ("oracle_", True)):
        row |= {f"{prefix}acc_{round(level * 100)}": accuracy(hits, level, oracle=oracle) for level in LEVELS}
        ious = [hit.oracle_iou if oracle else hit.iou for hit in hits]
        row[f"{prefix}mean_iou"] = float(np.mean(ious)) if ious else math.nan
    return row


def scores_by_name(hits: Sequence[Hit]) -> dict[str, dict[str, Any]]:
    """`scores` of each name on its own, worst mean IoU first."""
    names: dict[str, list[Hit]] = {}
    for hit in hits:
        names.setdefault(hit.name, []).append(hit)
    table = {name: scores(group) for name, group in names.items()}
    return dict(sorted(table.items(), key=lambda item: (item[1]["mean_iou"], item[0])))
