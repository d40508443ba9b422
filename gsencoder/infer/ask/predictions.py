"""Answers of a question set as the benchmarks' own scripts take predictions."""

from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.data.labels.captions import wrapped_caption
from gsencoder.data.labels.files import box_corners
from gsencoder.infer.ask.prompts import THOUGHT
from gsencoder.infer.ask.question_sets import Benchmark, SetQuestion

CLASSES = 18
"""Classes of ScanNet's benchmark, over which `sem_prob` of Scan2Cap's predictions is even: `ask` names none."""


def predictions(
    benchmark: Benchmark,
    answered: Sequence[tuple[SetQuestion, Mapping[str, Any]]],
    unanswered: Sequence[SetQuestion] = (),
) -> Any:
    """What a benchmark takes.

    - ScanQA: a list of {scene_id, question_id, answer_top10: [the answer], bbox}, the box being that of the best target
      where there is one.
    - SQA3D: a list of {scene_id, question_id, situation, question, answer}.
    - ScanRefer: a list of {scene_id, object_id, ann_id, bbox, bboxes}: the box of the mark that the answer names, and
      the same before those of the other marks; null and none where it names no mark, and for what is unanswered.
    - Scan2Cap: for each scene a list of {caption, box, obj_prob, sem_prob}, captions in lower case,
      between "sos" and "eos".

    Boxes are eight corners. Of an answer the case and a full stop at its end are left out (`short_answer`).

    Args:
        benchmark: whose form is wanted.
        answered: questions with the rows of `gsencoder.infer.ask.batch.ask_questions`.
        unanswered: questions without one; besides ScanRefer's they have no entry.
    """
    if benchmark == "scan2cap":
        captions: dict[str, list[dict[str, Any]]] = {}
        for question, row in answered:
            probabilities = {"obj_prob": [0.0, 1.0], "sem_prob": [1 / CLASSES] * CLASSES} | dict(question.keys)
            entry = {
                "caption": wrapped_caption(answer_text(row["answer"]).lower()),
                "box": target_corners(row["targets"][0]),
                **probabilities,
            }
            captions.setdefault(question.scene, []).append(entry)
        return captions
    if benchmark == "scanrefer":
        missing: list[tuple[SetQuestion, Mapping[str, Any]]] = [(question, {}) for question in unanswered]
        return [{**question.keys, **_referred(row)} for question, row in (*answered, *missing)]
    if benchmark == "sqa3d":
        return [{**question.keys, "answer": short_answer(row["answer"])} for question, row in answered]
    rows = []
    for question, row in answered:
        box = {"bbox": target_corners(row["targets"][0])} if row["targets"] else {}
        rows.append({**question.keys, "answer_top10": [short_answer(row["answer"])], **box})
    return rows


def _referred(row: Mapping[str, Any]) -> dict[str, Any]:
    """The box that an answer means, and after it the others that it might have meant."""
    if not row.get("mark"):
        return {"bbox": None, "bboxes": []}
    corners = [target_corners(target) for target in row["targets"]]
    meant = corners.pop(row["mark"] - 1)
    return {"bbox": meant, "bboxes": [meant, *corners]}


def target_corners(target: Mapping[str, Any]) -> list[list[float]]:
    """The eight corners of a target's axis-aligned box."""
    low, high = ([float(value) for value in target[name]] for name in ("aabb_min", "aabb_max"))
    return box_corners((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def answer_text(answer: str) -> str:
    """An answer without what a model thought before it, on one line."""
    return " ".join(THOUGHT.sub("", answer).split())


def short_answer(answer: str) -> str:
    """An answer as the benchmarks write answers: `answer_text` in lower case and without a full stop at its end."""
    return answer_text(answer).lower().rstrip(".").strip()
