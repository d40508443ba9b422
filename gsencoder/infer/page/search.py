"""Answers to what is typed and clicked on a page: relevancy of words, boxes, and the words of Gaussians."""

import io
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int16, Int64, UInt8, UInt16

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.splats.packed import write_spz
from gsencoder.data.splats.ply import RawSplat, logits_from_opacities, logs_from_scales
from gsencoder.infer.draw import fit_pca_colors, pca_picture
from gsencoder.infer.localize import LocalizeConfig, box_to_json, localize, select_features, spacing_of
from gsencoder.infer.relevancy import GaussianProducts, ThresholdConfig, threshold, word_directions
from gsencoder.text.table import TextTable, check_space
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.types import GaussianFeatures, Gaussians, Scene, SceneObject

GREY = 90
"""Color of Gaussians that were never seen, in red, green and blue."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisplayScene:
    """A scene with one feature set, as it is drawn, of `total` Gaussians; the notes say what was left out."""

    scene: Scene
    title: str
    total: int
    notes: tuple[str, ...]

    @property
    def gaussians(self) -> Gaussians:
        assert self.scene.gaussians is not None
        return self.scene.gaussians

    @property
    def features(self) -> GaussianFeatures:
        return next(iter(self.scene.features.values()))


def thin_for_display(scene: Scene, title: str, *, max_gaussians: int, advice: str = "") -> DisplayScene:
    """A scene with at most `max_gaussians`, evenly chosen and enlarged so that surfaces stay closed; a note about that
    ends with `advice`."""
    gaussians, features = select_features(scene, None)
    total = len(gaussians)
    notes: list[str] = []
    if total > max_gaussians:
        rows = even_indices(total, max_gaussians)
        # The area that a Gaussian covers grows as fast as their number falls.
        factor = np.float32(np.sqrt(total / len(rows)))
        gaussians = gaussians.select(rows)
        gaussians = replace(gaussians, scales=gaussians.scales * factor)
        features = features.select(rows)
        notes.append(
            f"{len(rows):,} of {total:,} Gaussians are drawn and searched: evenly chosen, and enlarged {factor:.2f} "
            f"times. {advice or f'max_gaussians={total} takes all, a smaller number draws faster'}."
        )
    unseen = int((~features.seen).sum())
    if unseen:
        notes.append(f"{unseen:,} Gaussians were seen by no view and have no features; they are grey.")
    chosen = replace(scene, gaussians=gaussians, features={features.space.name: features})
    return DisplayScene(scene=chosen, title=title, total=total, notes=tuple(notes))


def spz_bytes(gaussians: Gaussians, *, sh_degree: int = 3) -> bytes:
    """The splat as a file of .spz version 3, in the order of its rows, without the scene's origin."""
    degree = min(sh_degree, gaussians.sh_degree)
    raw = RawSplat(
        means=gaussians.means.astype(np.float64),
        quats=gaussians.quats,
        log_scales=logs_from_scales(gaussians.scales),
        logit_opacities=logits_from_opacities(gaussians.opacities),
        sh=gaussians.sh[:, : (degree + 1) ** 2],
        format="memory",
    )
    stream = io.BytesIO()
    write_spz(Path("the page's splat"), stream, raw, version=3)
    return stream.getvalue()


def pca_bytes(features: GaussianFeatures) -> UInt8[np.ndarray, "N 3"]:
    """The first three principal components as colors; Gaussians that were never seen are grey."""
    colors = np.full((len(features), 3), GREY, np.uint8)
    seen = np.flatnonzero(features.seen)
    if len(seen):
        stored = features.stored(seen)
        colors[seen] = pca_picture(stored[None], fit_pca_colors(stored))[0]
    return colors


def weight_bytes(weights: Float32[np.ndarray, " N"]) -> tuple[UInt8[np.ndarray, " N"], float, float]:
    """Visibility weights on a logarithmic scale: 0 = never seen, 1 = the smallest weight, 255 = the largest; and these
    two weights, 1 and 1 where nothing was seen."""
    seen = weights > 0
    if not seen.any():
        return np.zeros(len(weights), np.uint8), 1.0, 1.0
    low, high = float(weights[seen].min()), float(weights[seen].max())
    codes = np.zeros(len(weights), np.uint8)
    shares = np.log(weights[seen].astype(np.float64) / low) / max(np.log(high / low), 1e-12)
    codes[seen] = 1 + np.rint(254 * shares.clip(0, 1)).astype(np.uint8)
    return codes, low, high


def object_numbers(
    means: Float32[np.ndarray, "N 3"], objects: Sequence[SceneObject], origin: np.ndarray, margin: float
) -> UInt16[np.ndarray, " N"]:
    """For each Gaussian the place, from 1, of the smallest object whose box, enlarged by `margin`, holds its mean; 0 =
    none. Boxes are in world coordinates."""
    if len(objects) >= 1 << 16:
        raise InputError(f"expected fewer than {1 << 16:,} objects, got {len(objects):,}")
    numbers = np.zeros(len(means), np.uint16)
    volumes = [float(np.prod(each.aabb_max - each.aabb_min)) for each in objects]
    for row in np.argsort(volumes, kind="stable")[::-1]:
        low, high = objects[row].aabb_min - origin - margin, objects[row].aabb_max - origin + margin
        numbers[((means >= low) & (means <= high)).all(axis=1)] = row + 1
    return numbers


RELEVANCY_STEP = 1 / 32767
"""Relevancies are sent in such steps, as 16-bit integers."""
UNSEEN = -32768
"""What is sent for a Gaussian without a feature."""
NO_LABEL = 65535
LABELS = 40
"""Words that Gaussians are labeled with: those that are the best word of the most weight."""
LEAST_LABEL = 0.3
"""A Gaussian whose best word has a smaller cosine than this is like none of them."""
BEST_WORDS = 5
WORD_BLOCK = 32
"""Words that are localized at once."""
LABEL_BLOCK = 4096
"""Gaussians whose words are compared at once."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """Relevancy of every Gaussian for a word, in steps of `RELEVANCY_STEP`, `UNSEEN` where there is no feature, and the
    relevancy from which on Gaussians are taken, None where nothing was seen."""

    relevancy: Int16[np.ndarray, " N"]
    threshold: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels:
    """Words, most weight first, and for each Gaussian the place of its best one, or `NO_LABEL` where none is near."""

    names: tuple[str, ...]
    numbers: UInt16[np.ndarray, " N"]


@dataclass(kw_only=True, eq=False)
class SceneSearch:
    """A scene that is asked many times; what does not depend on the word is computed once. May be asked from threads.

    Attributes:
        words: words in the space of its features; None where there are none.
        config: how words become boxes; the cosines are centered.
        track: wraps the loop over all known words to show progress.
    """

    display: DisplayScene
    words: Words | None
    config: LocalizeConfig
    track: Track = untracked
    products: GaussianProducts = field(init=False)
    spacing: float = field(init=False)
    _lock: threading.Lock = field(init=False, default_factory=threading.Lock)
    _boxes_lock: threading.Lock = field(init=False, default_factory=threading.Lock)

    def __post_init__(self) -> None:
        if self.words is not None:
            check_space(self.display.features.space, self.words.space)
        self.products = GaussianProducts(self.display.features)
        self.spacing = spacing_of(self.display.gaussians)

    @property
    def table(self) -> TextTable | None:
        """The known words; None where there are none."""
        return None if self.words is None else closed_table(self.words)

    def _encoder(self) -> Words:
        if self.words is None:
            raise InputError(
                f"there is no text table for these features ({self.display.features.space.describe()}); they can be "
                "looked at"
            )
        return self.words

    def ask(self, word: str) -> Answer:
        """The relevancy of a word."""
        # A tower is loaded when the first phrase needs it.
        words = self._encoder()
        with self._lock:
            vector = words.encode([word])
        scores = self.products.cosines(word_directions(vector, words.mean))[0]
        cutoff = threshold(scores, self.config.threshold)
        steps = np.full(len(scores), UNSEEN, np.int16)
        seen = np.isfinite(scores)
        steps[seen] = np.rint(scores[seen] / np.float32(RELEVANCY_STEP)).astype(np.int16)
        return Answer(relevancy=steps, threshold=cutoff if np.isfinite(cutoff) else None)

    def boxes(self, word: str, cutoff: float | None = None) -> dict[str, Any]:
        """The boxes of a word with their probabilities, as `gsencoder localize` writes them, and that of the word; at
        a threshold, or at the default one."""
        config = self.config
        if cutoff is not None:
            config = replace(config, threshold=ThresholdConfig(kind="fixed", fixed=cutoff))
        # What is asked meanwhile does not wait.
        with self._boxes_lock:
            (found,) = self._localized([word], self._encoder(), config)
        return {"boxes": found["boxes"], "probability": found["probability"]}

    @cached_property
    def answers(self) -> list[dict[str, Any]]:
        """For each known word its boxes, its probability and its threshold, None where nothing was seen."""
        names, table = ((), None) if self.table is None else (self.table.names, self.table)
        blocks = [list(names[start : start + WORD_BLOCK]) for start in range(0, len(names), WORD_BLOCK)]
        tracked = self.track(blocks, "boxes of the known words")
        return [found for block in tracked if table for found in self._localized(block, table, self.config)]

    def _localized(self, names: list[str], words: Words, config: LocalizeConfig) -> list[dict[str, Any]]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)
            # The spacing takes most of the time.
            localized = localize(self.display.scene, names, words, config, spacing=self.spacing)
        return [
            {
                "boxes": [box_to_json(box) for box in localized.boxes if box.query == name],
                "probability": float(localized.probabilities[row]),
                "threshold": float(localized.thresholds[row]),
            }
            for row, name in enumerate(names)
        ]

    def best_words(self, rows: Sequence[int]) -> list[tuple[str, float]]:
        """The known words nearest to the mean direction of some Gaussians, best first, with their cosines."""
        features = self.display.features
        chosen = np.asarray(rows, np.int64)
        chosen = chosen[features.seen[chosen]]
        table = self.table
        if table is None or not len(chosen):
            return []
        weights = features.weights[chosen].astype(np.float64)
        mean = (weights / weights.sum()) @ self.products.axes.directions_of(features.stored(chosen))
        cosines = self.products.axes.project(word_directions(table.embeddings, table.mean)) @ mean
        best = np.argsort(-cosines, kind="stable")[:BEST_WORDS]
        return [(table.names[row], float(cosines[row])) for row in best]

    @cached_property
    def labels(self) -> Labels:
        """The best known word of every Gaussian, of the `LABELS` words that are the best of most weight."""
        features, table = self.display.features, self.table
        if table is None:
            return Labels(names=(), numbers=np.full(len(features), NO_LABEL, np.uint16))
        targets = self.products.axes.project(word_directions(table.embeddings, table.mean)).astype(np.float32)
        rows = np.flatnonzero(features.seen)
        best, cosines = self._best_of(rows, targets)
        totals = np.bincount(best, features.weights[rows] * (cosines >= LEAST_LABEL), len(table))
        named = np.argsort(-totals, kind="stable")[:LABELS]
        named = named[totals[named] > 0]
        numbers = np.full(len(features), NO_LABEL, np.uint16)
        if len(named):
            best, cosines = self._best_of(rows, targets[named])
            numbers[rows] = np.where(cosines >= LEAST_LABEL, best, NO_LABEL)
        return Labels(names=tuple(table.names[row] for row in named), numbers=numbers)

    def _best_of(
        self, rows: Int64[np.ndarray, " n"], targets: Float32[np.ndarray, "C S"]
    ) -> tuple[Int64[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """For each Gaussian which word is nearest, and its cosine."""
        best, cosines = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.float32)
        for start in range(0, len(rows), LABEL_BLOCK):
            block = slice(start, start + LABEL_BLOCK)
            local = self.products.axes.directions_of(self.display.features.stored(rows[block])).astype(np.float32)
            products = local @ targets.T
            best[block], cosines[block] = products.argmax(axis=1), products.max(axis=1)
        return best, cosines
