"""Answers to what is typed and clicked on a page: relevancy of words, boxes, and the words of Gaussians."""

import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, Int16, Int64, UInt16

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.localize.gaussian_products import GaussianProducts
from gsencoder.infer.localize.localization_json import localization_to_json
from gsencoder.infer.localize.localize import LocalizeConfig, localize, spacing_of
from gsencoder.infer.localize.relevancy import word_directions
from gsencoder.infer.localize.threshold import threshold
from gsencoder.infer.viewer.shown import ShownScene
from gsencoder.text.table import TextTable, check_space
from gsencoder.text.vocabulary import Words, closed_table

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
LABEL_BLOCK = 4096
"""Gaussians whose words are compared at once."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What the page paints for a word.

    Attributes:
        word: as it was asked.
        relevancy: of every Gaussian, in steps of `RELEVANCY_STEP`; `UNSEEN` where there is no feature.
        threshold: relevancy from which on Gaussians are taken; None where nothing was seen.
    """

    word: str
    relevancy: Int16[np.ndarray, " N"]
    threshold: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels:
    """The best word of every Gaussian that is like one.

    Attributes:
        names: the words, most weight first.
        numbers: for each Gaussian the place of its word in `names`, or `NO_LABEL` where none comes near.
    """

    names: tuple[str, ...]
    numbers: UInt16[np.ndarray, " N"]


@dataclass(slots=True, kw_only=True)
class SceneSearch:
    """A scene that is asked many times; what does not depend on the word is computed once. May be asked from threads.

    Attributes:
        shown: the scene.
        words: turn words into the space of its features; None where none lead into it.
        config: how words become boxes; the cosines are centered.
    """

    shown: ShownScene
    words: Words | None
    config: LocalizeConfig
    products: GaussianProducts = field(init=False)
    spacing: float = field(init=False)
    _lock: threading.Lock = field(init=False, default_factory=threading.Lock)
    _boxes_lock: threading.Lock = field(init=False, default_factory=threading.Lock)
    _labels: Labels | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.words is not None:
            check_space(self.shown.features.space, self.words.space)
        self.products = GaussianProducts(self.shown.features)
        self.spacing = spacing_of(self.shown.gaussians)

    @property
    def table(self) -> TextTable | None:
        """The known words; None where there are none."""
        return None if self.words is None else closed_table(self.words)

    def _encoder(self) -> Words:
        if self.words is None:
            raise InputError(
                f"no words lead into these features ({self.shown.features.space.describe()}); they can be looked at"
            )
        return self.words

    def ask(self, word: str) -> Answer:
        """The relevancy of a word.

        Raises:
            InputError: the word is empty, or unknown and there is no text tower; or no words lead into the features.
        """
        # A tower is loaded when the first phrase needs it.
        words = self._encoder()
        with self._lock:
            vector = words.encode([word])
        scores = self.products.cosines(word_directions(vector, words.mean))[0]
        cutoff = threshold(scores, self.config.threshold)
        steps = np.full(len(scores), UNSEEN, np.int16)
        seen = np.isfinite(scores)
        steps[seen] = np.rint(scores[seen] / np.float32(RELEVANCY_STEP)).astype(np.int16)
        return Answer(word=word, relevancy=steps, threshold=cutoff if np.isfinite(cutoff) else None)

    def boxes(self, word: str) -> dict[str, Any]:
        """The boxes of a word with their probabilities, as `gsencoder localize` writes them, and that of the word.

        Raises:
            InputError: as `ask` does.
        """
        words = self._encoder()
        # The spacing, which takes most of the time, is known; what is asked meanwhile does not wait.
        with self._boxes_lock, warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)
            localized = localize(self.shown.scene, [word], words, self.config, spacing=self.spacing)
        return {"boxes": localization_to_json(localized), "probability": float(localized.probabilities[0])}

    def best_words(self, rows: Sequence[int]) -> list[tuple[str, float]]:
        """The known words nearest to the mean direction of some Gaussians, best first, with their cosines."""
        features = self.shown.features
        chosen = np.asarray(rows, np.int64)
        chosen = chosen[features.seen[chosen]]
        table = self.table
        if table is None or not len(chosen):
            return []
        weights = features.weights[chosen].astype(np.float64)
        mean = (weights / weights.sum()) @ self.products.axes.directions_of(features.stored(chosen))
        cosines = word_directions(table.embeddings, table.mean) @ self._in_channels(mean)
        best = np.argsort(-cosines, kind="stable")[:BEST_WORDS]
        return [(table.names[row], float(cosines[row])) for row in best]

    def labels(self) -> Labels:
        """The best known word of every Gaussian, of the `LABELS` words that are the best of most weight."""
        with self._boxes_lock:
            if self._labels is None:
                self._labels = self._find_labels()
            return self._labels

    def _in_channels(self, local: np.ndarray) -> np.ndarray:
        axes = self.products.axes.axes
        return local if axes is None else axes @ local

    def _find_labels(self) -> Labels:
        features, table = self.shown.features, self.table
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
            local = self.products.axes.directions_of(self.shown.features.stored(rows[block])).astype(np.float32)
            products = local @ targets.T
            best[block], cosines[block] = products.argmax(axis=1), products.max(axis=1)
        return best, cosines
