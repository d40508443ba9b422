"""Scores of files of the boxes of sentences: what `score` and `evaluate` both report."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, counted
from gsencoder.evaluate.files.referring import compare_box_files
from gsencoder.evaluate.result_table import table_of
from gsencoder.evaluate.score_report import ScoreReport, spread
from gsencoder.evaluate.scores.referring import IOUS, ReferringTable, referring_scores


def score_referring(
    predictions: Path,
    truth: Path,
    *,
    method: str = "predictions",
    ks: Sequence[int] = (5,),
    label_map: Path | None = None,
    scans: Path | None = None,
    allow_missing: bool = False,
) -> ScoreReport:
    """Accuracy of the boxes of sentences (`gsencoder.evaluate.scores.referring`).

    Args:
        predictions: JSON of boxes by sentence.
        truth: ScanRefer's JSON of sentences.
        method: name of the predictions' rows in the table.
        ks: numbers of boxes of which the best counts, besides the first and all.
        label_map: scannetv2-labels.combined.tsv, which tells unique from multiple where the truth does not.
        scans: folder of ScanNet's scans, whose labels have the boxes that the truth does not have.
        allow_missing: count sentences without a prediction as wrong, instead of refusing them.

    Raises:
        InputError: files that cannot be used or that do not belong together.
    """
    sentences, unscored = compare_box_files(
        predictions, truth, label_map=label_map, scans=scans, allow_missing=allow_missing
    )
    if not sentences:
        raise InputError(f"{truth}: nothing to score: it holds no sentence about an object with a box")
    scores = referring_scores(sentences, ks=ks)
    by_scene_name = defaultdict(list)
    for each in sentences:
        by_scene_name[each.scene].append(each)
    by_scene = [
        {"scene": scene, "sentences": len(each), **_accuracies(referring_scores(each, ks=ks).top1)}
        for scene, each in by_scene_name.items()
    ]
    kinds = {method: scores.top1}
    kinds |= {f"{method}, best of {k}": scores.best_of[k] for k in ks}
    kinds |= {f"{method}, best of all": scores.best}
    measured = {name: _accuracies(table) | _by_uniqueness(table) for name, table in kinds.items()}
    overall, best = measured[method], measured[f"{method}, best of all"]
    notes = [f"{counted(count, 'sentence')} not scored: {reason}." for reason, count in unscored.items()]
    if unknown := sum(each.multiple is None for each in sentences):
        notes.append(
            f"{counted(unknown, 'sentence')} in the overall columns alone: neither file says what is unique and what "
            "multiple, which ScanNet's label map tells (label_map=)."
        )
    return ScoreReport(
        results={
            "protocol": "referring",
            "sentences": scores.sentences,
            "without_box": scores.without_box,
            "not_scored": unscored,
            "thresholds": list(IOUS),
            **overall,
            "best_of": {str(k): _accuracies(scores.best_of[k]) for k in ks} | {"all": _accuracies(scores.best)},
            "tables": {"top_1": _plain(scores.top1), "best": _plain(scores.best)},
            "spread": spread(by_scene, ["acc_25", "acc_50"]),
        },
        table=table_of("Referring", measured, published="splatdistill_5_referring", notes=notes),
        rows={
            "scenes": by_scene,
            "sentences": [
                {
                    "scene": each.scene,
                    "object": each.object,
                    "annotation": each.annotation,
                    "iou": each.ious[0] if each.ious else 0.0,
                    "best_iou": max(each.ious, default=0.0),
                    "multiple": each.multiple,
                }
                for each in sentences
            ],
        },
        line=f"{counted(scores.sentences, 'sentence')}: Acc@0.25 {overall['acc_25']:.3f}, Acc@0.5 "
        f"{overall['acc_50']:.3f}; "
        f"{scores.without_box} without a box; of all boxes the best: {best['acc_25']:.3f}, {best['acc_50']:.3f}",
    )


def _accuracies(table: ReferringTable) -> dict[str, float]:
    cell = table["overall"]["overall"]
    return {"acc_25": cell.acc25, "acc_50": cell.acc50}


def _by_uniqueness(table: ReferringTable) -> dict[str, float]:
    return {
        f"{kind}_{name}": getattr(table[kind]["overall"], field)
        for kind in ("unique", "multiple")
        for name, field in (("25", "acc25"), ("50", "acc50"))
    }


def _plain(table: ReferringTable) -> dict[str, Any]:
    return {kind: {subset: asdict(cell) for subset, cell in cells.items()} for kind, cells in table.items()}
