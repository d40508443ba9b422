"""Scores of files of retrieval between views and their captions: what `score` and `evaluate` both report."""

from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError, counted, listed
from gsencoder.data.labels.captions import read_view_captions
from gsencoder.evaluate.files.retrieval import read_scored_pairs
from gsencoder.evaluate.result_table import table_of
from gsencoder.evaluate.retrieval import RECALLS, Pooling, Retrieval, ScoredPairs, retrieve
from gsencoder.evaluate.score_report import ScoreReport, spread

NAMES = tuple(f"{direction}_{k}" for direction in ("i2t", "t2i") for k in RECALLS)


def score_retrieval(
    predictions: Path,
    truth: Path,
    *,
    method: str = "predictions",
    count: int = 0,
    seed: int = 0,
    pooling: Pooling = "max",
) -> ScoreReport:
    """Recall at 1, 5 and 10 of texts for views and of views for texts (M3 table 2; `gsencoder.evaluate.retrieval`).

    Args:
        predictions: .npz of scores or features (`gsencoder.evaluate.files.retrieval`).
        truth: JSON of captions of views.
        method: name of the predictions' row in the table.
        count: distractors in a query's pool; 0 = all.
        seed: of their draw.
        pooling: over the cells of a view, where predictions are features.

    Raises:
        InputError: files that cannot be used or that do not belong together.
    """
    captions = read_view_captions(truth)
    pairs = read_scored_pairs(predictions, pooling=pooling)
    row_of = {name: row for row, name in enumerate(pairs.queries)}
    missing = [each.name for each in captions if each.name not in row_of]
    if missing:
        raise InputError(
            f"{predictions}: no query of {counted(len(missing), 'view')} with a caption: {listed(missing, 3)}"
        )
    foreign = sorted(set(pairs.queries) - {each.name for each in captions})
    if foreign:
        raise InputError(
            f"{predictions}: {counted(len(foreign), 'query', 'queries')} of no view with a caption in {truth}: "
            f"{listed(foreign, 3)}"
        )
    rows = np.array([row_of[each.name] for each in captions])
    number = len(captions)
    columns = np.concatenate([rows, np.arange(number, pairs.scores.shape[1])])
    ordered = ScoredPairs(
        queries=tuple(each.name for each in captions),
        scores=pairs.scores[np.ix_(rows, columns)],
        distractors=pairs.distractors[:, rows],
    )
    sides = dict(
        zip(("i2t", "t2i"), retrieve(ordered, [each.caption for each in captions], count=count, seed=seed), strict=True)
    )
    overall = {f"{name}_{k}": side.recall(k) for name, side in sides.items() for k in RECALLS}
    ranks = [
        {"scene": each.scene, "view": each.view, "i2t_rank": int(there), "t2i_rank": int(back)}
        for each, there, back in zip(captions, sides["i2t"].ranks, sides["t2i"].ranks, strict=True)
    ]
    by_scene = []
    for scene in dict.fromkeys(each.scene for each in captions):
        of_scene = np.array([each.scene == scene for each in captions])
        recalls = {
            f"{name}_{k}": float((side.ranks[of_scene] <= k).mean()) for name, side in sides.items() for k in RECALLS
        }
        by_scene.append({"scene": scene, "views": int(of_scene.sum()), **recalls})
    candidates = {"i2t": pairs.scores.shape[1] - number, "t2i": len(pairs.distractors)}
    same = number - len({each.caption for each in captions})
    notes = [_pool(name, side, candidates[name]) for name, side in sides.items()]
    if same and not all(candidates.values()):
        notes.append("Views with the same text are no rivals of each other.")
    not_finite = sum(side.not_finite for side in sides.values())
    if not_finite:
        notes.append(f"{counted(not_finite, 'score')} of a view with its own text not finite: last in its pool.")
    return ScoreReport(
        results={
            "protocol": "retrieval",
            "views": number,
            "pools": {
                name: {"distractors": side.distractors, "of": "distractors" if candidates[name] else "queries"}
                for name, side in sides.items()
            },
            "not_finite": not_finite,
            **overall,
            "spread": spread(by_scene, NAMES),
        },
        table=table_of(
            "Retrieval", {method: overall}, published="m3_2_grounding_and_retrieval", columns=NAMES, notes=notes
        ),
        rows={"scenes": by_scene, "ranks": ranks},
        line=f"{counted(number, 'view')} in {counted(len(by_scene), 'scene')}: image to text R@1 "
        f"{overall['i2t_1']:.3f}, "
        f"R@5 {overall['i2t_5']:.3f}, R@10 {overall['i2t_10']:.3f}; text to image {overall['t2i_1']:.3f}, "
        f"{overall['t2i_5']:.3f}, {overall['t2i_10']:.3f}",
    )


def _pool(name: str, side: Retrieval, others: int) -> str:
    media = "texts" if name == "i2t" else "pictures"
    if others:
        return f"Pools of {name}: {side.distractors:,} of {others:,} {media} of others (M3: 1,999 of COCO)."
    return f"Pools of {name}: the {media} of the other queries, and none of COCO as in M3, so that they are smaller."
