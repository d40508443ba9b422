"""Answers of a question set as the benchmarks' own scripts take predictions."""

from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.data.truth.write_sets import box_corners
from gsencoder.infer.ask.prompts import THOUGHT
from gsencoder.infer.ask.question_sets import Benchmark, SetQuestion

CLASSES = 18
"""Classes of ScanNet's benchmark, over which `sem_prob` of Scan2Cap's predictions is even: `ask` names none."""


def predictions(benchmark: Benchmark, answered: Sequence[tuple[SetQuestion, Mapping[str, Any]]]) -> Any:
    """What a benchmark takes.

    - ScanQA and SQA3D: a list of {scene_id, question_id, answer_top10: [the answer]} and, for ScanQA, the box of the
      best target as bbox, where there is one.
    - ScanRefer: a list of {scene_id, object_id, ann_id, bbox}; an answer that names no mark gives no entry.
    - Scan2Cap: for each scene a list of {caption, box, obj_prob, sem_prob}.

    Boxes are eight corners. Of an answer the case and a full stop at its end are left out (`short_answer`).

    Args:
        benchmark: whose form is wanted.
        answered: questions with the rows of `gsencoder.infer.ask.batch.ask_questions`.
    """
    if benchmark == "scan2cap":
        captions: dict[str, list[dict[str, Any]]] = {}
        for question, row in answered:
            probabilities = {"obj_prob": [0.0, 1.0], "sem_prob": [1 / CLASSES] * CLASSES} | dict(question.keys)
            entry = {"caption": said(row["answer"]), "box": target_corners(row["targets"][0]), **probabilities}
            captions.setdefault(question.scene, []).append(entry)
        return captions
    if benchmark == "scanrefer":
        return [{**question.keys, "bbox": target_corners(row["box"])} for question, row in answered if row.get("box")]
    rows = []
    for question, row in answered:
        entry = {**question.keys, "answer_top10": [short_answer(row["answer"])]}
        if benchmark == "scanqa" and row["targets"]:
            entry["bbox"] = target_corners(row["targets"][0])
        rows.append(entry)
    return rows


def target_corners(target: Mapping[str, Any]) -> list[list[float]]:
    """The eight corners of a target's axis-aligned box."""
    return box_corners(target["aabb_min"], target["aabb_max"])


def said(answer: str) -> str:
    """An answer without what a model thought before it, on one line."""
    return " ".join(THOUGHT.sub("", answer).split())


def short_answer(answer: str) -> str:
    """An answer as the benchmarks write answers: what was said, in lower case and without a full stop at its end."""
    return said(answer).lower().rstrip(".").strip()
