"""Where a selection starts: the Gaussians of boxes, or those above a threshold."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.infer.localize.localize import describe_absent
from gsencoder.types import Box, Localization

Parts = tuple[tuple[Int64[np.ndarray, " _"], ...], ...]
"""For each word the rows of each of its parts, ascending; a part is a box, or all that is above a threshold."""


def box_parts(localization: Localization, ranks: Sequence[int], *, probable: float) -> Parts:
    """The Gaussians of each word's boxes.

    Args:
        localization: of the words.
        ranks: numbers of the boxes of every word, as in boxes.json; empty = the boxes that are at least `probable`
            times as probable as the most probable box of their word.
        probable: see there.

    Raises:
        InputError: a word has no box of a number.
    """
    parts = []
    for word in localization.queries:
        boxes = [box for box in localization.boxes if box.query == word]
        for rank in ranks:
            if not 0 <= rank < len(boxes):
                several = f"{len(boxes)} boxes, 0 to {len(boxes) - 1}"
                has = "no box" if not boxes else "one box, number 0" if len(boxes) == 1 else several
                why = "" if boxes else f": {describe_absent(localization.absent[word])}"
                raise InputError(f"box={rank}: {word!r} has {has}{why}")
        chosen = [boxes[rank] for rank in dict.fromkeys(ranks)] if ranks else _probable(boxes, probable)
        parts.append(tuple(np.sort(box.rows).astype(np.int64) for box in chosen))
    return tuple(parts)


def _probable(boxes: Sequence[Box], share: float) -> list[Box]:
    most = max((box.probability for box in boxes), default=0.0)
    return [box for box in boxes if box.probability >= share * most]


def threshold_parts(words: Sequence[str], relevancy: Float32[np.ndarray, "Q N"], threshold: float) -> Parts:
    """All Gaussians whose relevancy for a word is at least `threshold`, a part for each word.

    Raises:
        InputError: no Gaussian reaches it for any word.
    """
    # Comparisons with NaN are false: Gaussians never seen are never taken.
    rows = [np.flatnonzero(scores >= threshold) for scores in relevancy]
    if not any(len(each) for each in rows):
        best = ", ".join(f"{word!r} {_best(scores):.7g}" for word, scores in zip(words, relevancy, strict=True))
        raise InputError(f"threshold={threshold:g}: no Gaussian is as relevant; the best are {best}")
    return tuple((each,) if len(each) else () for each in rows)


def _best(scores: Float32[np.ndarray, " N"]) -> float:
    seen = scores[np.isfinite(scores)]
    return float(seen.max()) if seen.size else float("nan")


def labels_of_parts(parts: Parts, relevancy: Float32[np.ndarray, "Q N"]) -> Int32[np.ndarray, " N"]:
    """The label of each Gaussian: of the words that take it the most relevant one, the first of equal ones; 0 = none.

    The contrast of one word with the others, as in `gsencoder.infer.localize.relevancy.relevancy`, is above one half
    for the most relevant word alone, so that no Gaussian is given to a word that loses against another one that
    takes it.
    """
    labels = np.zeros(relevancy.shape[1], np.int32)
    best = np.full(relevancy.shape[1], -np.inf, np.float32)
    for number, (groups, scores) in enumerate(zip(parts, relevancy, strict=True)):
        for rows in groups:
            better = rows[scores[rows] > best[rows]]
            labels[better], best[better] = number + 1, scores[better]
    return labels
