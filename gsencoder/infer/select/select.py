"""Words to the Gaussians of the objects that they stand for."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.seeding.points import scene_spacing
from gsencoder.fusion.cameras import with_views
from gsencoder.infer.localize.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.select.grow import grow
from gsencoder.infer.select.seeds import box_parts, labels_of_parts, threshold_parts
from gsencoder.infer.select.selection import SelectConfig, Selection
from gsencoder.text.table import TextEncoder
from gsencoder.types import Localization, Scene

MOST_WORDS = 64
"""Words that are selected at once; each needs a column of a pixel map and of a table of the Gaussians."""


def select(
    scene: Scene,
    words: Sequence[str],
    text: TextEncoder,
    config: SelectConfig = SelectConfig(),
    *,
    boxes: Sequence[int] = (),
    threshold: float | None = None,
    localization: LocalizeConfig = LocalizeConfig(),
    track: Track = untracked,
) -> tuple[Selection, Localization]:
    """Gives each Gaussian a word or none.

    A selection starts with the Gaussians of the boxes of each word (`gsencoder.infer.localize.localize.localize`), or
    with all that reach `threshold`. It grows, or shrinks, to the Gaussians around these whose features are more of the
    object than of its surroundings (`gsencoder.infer.select.shares`), and is corrected by the pixels on which the
    blending weight of Gaussians falls, in the cameras of the scene (`gsencoder.infer.select.votes`). A splat without
    views is looked at by cameras that are placed around or inside it.

    Args:
        scene: Gaussians with one feature set, or several of which one is of the space of `text`.
        words: each once.
        text: turns words into the features' space.
        config: how selections grow.
        boxes: numbers of the boxes of each word, best first from 0; empty = the most probable, and those that are
            nearly as probable.
        threshold: a relevancy instead of boxes.
        localization: how words become boxes.
        track: progress over the views.

    Returns:
        The selection, and the boxes that it started from.

    Raises:
        InputError: what `localize` raises; two words with the same vector; boxes and a threshold; a box that a word
            does not have; no Gaussian is selected, or every one.

    Warns:
        SceneWarning: words without a box; a splat without views.
    """
    if boxes and threshold is not None:
        raise InputError("box= and threshold= are two ways to choose where a selection starts; give one of them")
    if threshold is not None and not -1 <= threshold <= 1:
        raise InputError(f"threshold: expected a relevancy in [-1, 1], got {threshold}")
    if len(words) > MOST_WORDS:
        raise InputError(f"query: expected at most {MOST_WORDS} words to select, got {len(words)}")
    gaussians, features = select_features(scene, None)
    _check_distinct(words, text)
    localized = localize(scene, words, text, localization)
    if threshold is None:
        parts = box_parts(localized, boxes, probable=config.probable)
    else:
        parts = threshold_parts(words, localized.relevancy, threshold)
    seeds = labels = labels_of_parts(parts, localized.relevancy)
    view_count, placed = 0, False
    if config.grow and labels.any():
        # A part keeps what no other word took from it.
        parts = tuple(
            tuple(remaining for rows in groups if len(remaining := rows[labels[rows] == number + 1]))
            for number, groups in enumerate(parts)
        )
        seen_by, placed = _with_cameras(scene, config)
        cameras = None if seen_by.views is None else seen_by.views.cameras
        spacing = scene_spacing(gaussians.means) or float(np.median(gaussians.scales))
        labels, view_count = grow(
            gaussians, features, cameras, parts, localized.relevancy, config, spacing, track=track
        )
    _check_some(scene, localized, labels)
    return Selection(words=tuple(words), labels=labels, seeds=seeds, views=view_count, placed=placed), localized


def _check_distinct(words: Sequence[str], text: TextEncoder) -> None:
    """Refuses words with one vector, such as "chair" and "Chair": the first would take all Gaussians of both."""
    first: dict[bytes, str] = {}
    for word, vector in zip(words, text.encode(words), strict=True):
        other = first.setdefault(vector.tobytes(), word)
        if other != word:
            raise InputError(f"query: {other!r} and {word!r} stand for the same vector; give one of them")


def _with_cameras(scene: Scene, config: SelectConfig) -> tuple[Scene, bool]:
    if scene.views is not None or not config.views:
        return scene, False
    warnings.warn(
        f"scene {scene.name} has no views; the selection is checked from {config.orbits} cameras around or inside it, "
        "which may not see what real photographs would",
        SceneWarning,
        stacklevel=4,
    )
    return with_views(replace(scene, features={}), config.orbits), True


def _check_some(scene: Scene, localized: Localization, labels: np.ndarray) -> None:
    if labels.all():
        raise InputError(
            f"select: every one of the {len(labels):,} Gaussians of {scene.name} is selected, so nothing is left; give "
            "a higher threshold= or fewer words"
        )
    if not labels.any():
        listing = ", ".join(f"{word!r} (probability {value:.2f})" for word, value in localized.absent.items())
        raise InputError(
            f"select: no Gaussian of {scene.name} is selected; absent: {listing}"
            if listing
            else f"select: no Gaussian of {scene.name} is selected; lower select.share or give select.grow=false"
        )
