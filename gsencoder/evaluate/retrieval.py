"""Retrieval between rendered views and texts, as M3 measures it (sec. 4.1, table 2): recall at 1, 5 and 10.

A query is one view or one text. Its pool is what belongs to it and distractors, which M3 takes from COCO. The score of
a view with a text is the largest cosine of one of its rendered cells with it.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError

Pooling = Literal["max", "mean"]
DISTRACTORS = 1999
"""Number of distractors of M3's released code."""
RECALLS = (1, 5, 10)
TIE = 1e-9
"""Cosines of float32 vectors that differ by less are the same but for rounding."""
CHUNK_VALUES = 1 << 22
"""Cosines that are in memory at a time."""
EPS = 1e-60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Retrieval:
    """The results of queries.

    Attributes:
        ranks: rank of what belongs to each query in its pool, from 1, where it comes after all that score the same.
        distractors: in each pool.
        not_finite: queries whose own score was not finite, which put them last.
    """

    ranks: Int64[np.ndarray, " Q"]
    distractors: int
    not_finite: int

    def recall(self, k: int) -> float:
        """The share of the queries whose own is among the first k; NaN without queries."""
        return float((self.ranks <= k).mean()) if len(self.ranks) else math.nan

    def recalls(self) -> dict[str, float]:
        """Recall at 1, 5 and 10, by "recall_1" and so on."""
        return {f"recall_{k}": self.recall(k) for k in RECALLS}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredPairs:
    """Scores of views with texts, however a method makes them; higher ones fit better.

    Attributes:
        queries: names of the views that have a text, each once.
        scores: of each view with the texts of the queries, in their order, then with M texts of other pictures.
        distractors: scores of M' other pictures with the texts of the queries.
    """

    queries: tuple[str, ...]
    scores: Float64[np.ndarray, "Q Q_M"]
    distractors: Float64[np.ndarray, "M2 Q"]

    def __post_init__(self) -> None:
        count = len(self.queries)
        if self.scores.shape[0] != count or self.scores.shape[1] < count or self.distractors.shape[1] != count:
            raise InputError(
                f"retrieval: {count} queries need scores of {count} × {count} or more, and scores of other pictures of "
                f"any × {count}; got {self.scores.shape[0]} × {self.scores.shape[1]} and "
                f"{self.distractors.shape[0]} × {self.distractors.shape[1]}"
            )
        if repeated := first_repeated(self.queries):
            raise InputError(f"retrieval: the query {repeated[0][:80]!r} is there twice; expected each once")


def retrieve(pairs: ScoredPairs, texts: Sequence[str], *, count: int = 0, seed: int = 0) -> tuple[Retrieval, Retrieval]:
    """The ranks of texts for views, and of views for texts.

    The pool of a query is what belongs to it and distractors, where there are any (M3); else what belongs to the other
    queries. Views with the same text are no rivals of each other.

    Args:
        pairs: scores.
        texts: of the queries.
        count: distractors in a pool, drawn by the query's name; 0 = all.
        seed: of the draws.

    Raises:
        InputError: another number of texts than of queries, or fewer distractors than `count`.
    """
    number = len(pairs.queries)
    if len(texts) != number:
        raise InputError(f"retrieval: {number} queries and {len(texts)} texts; expected as many of both")
    _, code = np.unique(np.array(texts, dtype=np.str_), return_inverse=True)
    rivals = [np.flatnonzero(code != code[query]) for query in range(number)]
    sides = []
    for scores, others in (
        (pairs.scores[:, :number], pairs.scores[:, number:]),
        (pairs.scores[:, :number].T, pairs.distractors.T),
    ):
        available = others.shape[1]
        if available and count > available:
            raise InputError(
                f"retrieval: {count:,} distractors are asked for, and there are {available:,}; ask for fewer"
            )
        ranks = []
        for query, name in enumerate(pairs.queries):
            pool = (
                others[query, draw(name, available, count or available, seed)]
                if available
                else scores[query, rivals[query]]
            )
            ranks.append(rank_of_first(np.concatenate([scores[query, query : query + 1], pool])))
        sides.append(
            Retrieval(
                ranks=np.array(ranks, np.int64),
                distractors=(count or available) if available else max(number - 1, 0),
                not_finite=int((~np.isfinite(np.diagonal(scores))).sum()),
            )
        )
    return sides[0], sides[1]


def view_scores(
    cells: Float32[np.ndarray, "n _channels"], texts: Float32[np.ndarray, "T D"], pooling: Pooling = "max"
) -> Float64[np.ndarray, " T"]:
    """The score of one view with each text: the largest cosine of its cells, as in M3, or their mean.

    Vectors are compared as they are. For centered cosines subtract the mean of each side before.

    Args:
        cells: rendered features; a view of one vector has one cell.
        texts: vectors of any length above 0.
        pooling: over the cells.

    Returns:
        Scores in [−1, 1]; NaN where a cell is not finite.

    Raises:
        InputError: no cells, other channels, or an unknown pooling.
    """
    if not len(cells) or cells.shape[1] != texts.shape[1] or pooling not in ("max", "mean"):
        raise InputError(
            f"retrieval: expected cells of {texts.shape[1]} channels and pooling max or mean, got cells {cells.shape} "
            f"and {pooling!r}"
        )
    directions = _unit(texts)
    step = max(1, CHUNK_VALUES // max(len(texts), 1))
    largest, total = np.full(len(texts), -np.inf), np.zeros(len(texts))
    for start in range(0, len(cells), step):
        cosines = _unit(cells[start : start + step]) @ directions.T
        # NaN stays NaN in a maximum and in a sum.
        largest, total = np.maximum(largest, cosines.max(axis=0)), total + cosines.sum(axis=0)
    return largest if pooling == "max" else total / len(cells)


def image_to_text(
    names: Sequence[str],
    views: Sequence[Float32[np.ndarray, "_n _channels"]],
    texts: Float32[np.ndarray, "Q D"],
    distractors: Float32[np.ndarray, "M _channels"],
    *,
    count: int = DISTRACTORS,
    seed: int = 0,
    pooling: Pooling = "max",
) -> Retrieval:
    """For each view the rank of its text among the texts of its pool.

    Args:
        names: of the queries, each once. They decide, with the seed, which distractors are drawn, so that a query has
            the same pool in any order of queries, and for any method.
        views: rendered features of each query's view.
        texts: the text of each view.
        distractors: texts of other pictures.
        count: distractors in a pool.
        seed: of the draws.
        pooling: over the cells of a view.

    Raises:
        InputError: fewer distractors than `count`, distractors or texts that are not finite, or sizes that differ.
    """
    _check(names, len(views), texts, distractors, count)
    ranks, not_finite = [], 0
    for name, cells, text in zip(names, views, texts, strict=True):
        picks = draw(name, len(distractors), count, seed)
        scores = view_scores(cells, np.concatenate([text[None], distractors[picks]]), pooling)
        ranks.append(rank_of_first(scores))
        not_finite += not np.isfinite(scores[0])
    return Retrieval(ranks=np.array(ranks, np.int64), distractors=count, not_finite=not_finite)


def text_to_image(
    names: Sequence[str],
    texts: Float32[np.ndarray, "Q D"],
    views: Sequence[Float32[np.ndarray, "_n _channels"]],
    distractors: Float32[np.ndarray, "M *cells _channels"],
    *,
    count: int = DISTRACTORS,
    seed: int = 0,
    pooling: Pooling = "max",
) -> Retrieval:
    """For each text the rank of its view among the pictures of its pool.

    Args:
        names: of the queries; see `image_to_text`.
        texts: the queries.
        views: rendered features of the view that belongs to each text.
        distractors: other pictures: one vector each, as in M3, or the cells of each. The maximum over many cells is
            larger than the cosine of one vector, so that one vector each favors the views.
        count: distractors in a pool.
        seed: of the draws.
        pooling: over the cells of a picture.

    Raises:
        InputError: as in `image_to_text`.
    """
    pictures = distractors.reshape(len(distractors), math.prod(distractors.shape[1:-1]), distractors.shape[-1])
    _check(names, len(views), texts, pictures, count)
    others = np.stack([view_scores(cells, texts, pooling) for cells in pictures]) if len(pictures) and names else None
    ranks, not_finite = [], 0
    for number, (name, text, cells) in enumerate(zip(names, texts, views, strict=True)):
        scores = view_scores(cells, text[None], pooling)
        picks = draw(name, len(pictures), count, seed)
        ranks.append(rank_of_first(scores if others is None else np.concatenate([scores, others[picks, number]])))
        not_finite += not np.isfinite(scores[0])
    return Retrieval(ranks=np.array(ranks, np.int64), distractors=count, not_finite=not_finite)


def rank_of_first(scores: Float64[np.ndarray, " n"]) -> int:
    """The rank of the first of some scores, from 1. All that are as high come before it, and all that are NaN, or all
    others where it is NaN itself: a method that gives everything one score finds nothing."""
    return 1 + int((~(scores[1:] < scores[0] - TIE)).sum())


def draw(name: str, available: int, count: int, seed: int) -> Int64[np.ndarray, " count"]:
    """Different numbers below `available`, which depend on the query's name and on the seed alone."""
    digest = hashlib.blake2b(name.encode(), digest_size=16).digest()
    rng = np.random.default_rng([seed, int.from_bytes(digest, "little")])
    return rng.choice(available, size=count, replace=False).astype(np.int64)


def _check(names: Sequence[str], views: int, texts: np.ndarray, distractors: np.ndarray, count: int) -> None:
    if not len(names) == views == len(texts) or len(set(names)) != len(names):
        raise InputError(
            f"retrieval: expected a name, a view and a text for each query and no name twice, got {len(names)} names "
            f"({len(set(names))} different), {views} views and {len(texts)} texts"
        )
    if texts.shape[-1] != distractors.shape[-1]:
        raise InputError(f"retrieval: expected distractors of {texts.shape[-1]} channels, got {distractors.shape[-1]}")
    if not 0 <= count <= len(distractors):
        raise InputError(
            f"retrieval: {count:,} distractors are asked for, and there are {len(distractors):,}; give more, or ask "
            "for fewer (count=)"
        )
    for noun, vectors in (("texts", texts), ("distractors", distractors)):
        if not np.isfinite(vectors).all():
            raise InputError(f"retrieval: expected finite {noun}, got NaN or Inf")


def _unit(vectors: Float32[np.ndarray, "n D"]) -> Float64[np.ndarray, "n D"]:
    rows = vectors.astype(np.float64)
    # The largest entry is taken out of the root, so that short vectors have directions as well.
    rows = rows / np.maximum(np.abs(rows).max(axis=1, initial=0, keepdims=True), np.finfo(np.float64).tiny)
    return np.asarray(rows / np.sqrt((rows**2).sum(axis=1, keepdims=True) + EPS))
