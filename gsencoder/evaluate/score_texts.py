"""Scores of files of answers and of captions, by protocol: what `score` reports."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError, counted
from gsencoder.data.labels.expressions import read_scanrefer
from gsencoder.data.labels.questions import read_questions
from gsencoder.evaluate.files.answer_predictions import read_answer_predictions
from gsencoder.evaluate.files.caption_predictions import read_caption_predictions
from gsencoder.evaluate.result_table import table_of
from gsencoder.evaluate.score_report import ScoreReport, spread
from gsencoder.evaluate.scores.answers import AnswerMeans, score_answers
from gsencoder.evaluate.scores.dense_captions import (
    CaptionedBox,
    NamedCaption,
    captioned_objects,
    score_box_captions,
    score_named_captions,
)
from gsencoder.evaluate.scores.sentences import SentenceScores

SENTENCE_COLUMNS = ("bleu_1", "bleu_2", "bleu_3", "bleu_4", "meteor", "rouge_l", "cider")


def score_answer_files(
    predictions: Path, truth: Path, *, method: str = "predictions", java: bool = True, allow_missing: bool = False
) -> ScoreReport:
    """Scores of answers to a question set (`gsencoder.evaluate.scores.answers`).

    Args:
        predictions: ScanQA's or SQA3D's file of predicted answers.
        truth: the question set with its answers.
        method: name of the predictions' row in the table.
        java: whether Java's tokenizer and METEOR are used where they are there.
        allow_missing: count questions without a prediction as wrong, instead of refusing the file.

    Raises:
        InputError: files that cannot be used or that do not belong together.
    """
    questions = read_questions(truth)
    if not questions:
        raise InputError(f"{truth}: nothing to score: it holds no questions")
    answers = read_answer_predictions(predictions, questions)
    _refuse_missing([each.id for each in questions if each.id not in answers], "question", predictions, allow_missing)
    tools = None if java else "Java was not asked for (java=false)"
    scores = score_answers(questions, answers, tokens="auto" if java else "python", tools=tools)
    assert scores.sentences is not None
    means = _means(scores.overall)
    if "EM@10" in scores.absent:
        means["em_10"] = math.nan
    overall = means | _sentences(scores.sentences)
    by_scene = [{"scene": scene, "questions": means.count, **_means(means)} for scene, means in scores.by_scene.items()]
    by_kind = [{"kind": kind, "questions": means.count, **_means(means)} for kind, means in scores.by_kind.items()]
    notes = [f"{column} is absent: {reason}." for column, reason in scores.absent.items()]
    if scores.blank:
        notes.append(f"{counted(scores.blank, 'answer')} without a word once cleaned: right in the refined match.")
    return ScoreReport(
        results={
            "protocol": "answers",
            "questions": scores.overall.count,
            "missing": scores.overall.missing,
            "tokens": scores.sentences.tokens,
            "absent": dict(scores.absent),
            **overall,
            "kinds": {row["kind"]: row for row in by_kind},
            "spread": spread(by_scene, list(_means(scores.overall))),
        },
        table=table_of(
            "Answers",
            {method: overall},
            published="splatdistill_3_answers",
            columns=_columns(overall, ("em_1", "em_refined", "bleu_4", "meteor", "rouge_l", "cider")),
            notes=notes,
        ),
        rows={"scenes": by_scene, "kinds": by_kind, "questions": [asdict(row) for row in scores.rows]},
        line=f"{counted(scores.overall.count, 'question')}, {scores.overall.missing} without an answer: EM@1 "
        f"{overall['em_1']:.3f}, refined {overall['em_refined']:.3f}, CIDEr {100 * scores.sentences.cider:.1f}",
    )


def score_caption_files(
    predictions: Path,
    truth: Path,
    *,
    method: str = "predictions",
    min_iou: float = 0.5,
    java: bool = True,
    allow_missing: bool = False,
) -> ScoreReport:
    """Scores of captions of boxes or of given objects (`gsencoder.evaluate.scores.dense_captions`).

    Args:
        predictions: Scan2Cap's file of predicted captions.
        truth: ScanRefer's file of expressions, with boxes where captions are of boxes.
        method: name of the predictions' row in the table.
        min_iou: k of m@kIoU; captions of given objects have no boxes, and no k.
        java: whether METEOR is computed where Java is there.
        allow_missing: count given objects without a caption, and the objects of scenes without any, as empty, instead
            of refusing the file.

    Raises:
        InputError: files that cannot be used or that do not belong together.
    """
    objects = captioned_objects(read_scanrefer(truth))
    if not objects:
        raise InputError(f"{truth}: nothing to score: it holds no descriptions")
    captions = read_caption_predictions(predictions, objects)
    tools = None if java else "Java was not asked for (java=false)"
    boxes = [each for each in captions if isinstance(each, CaptionedBox)]
    if boxes:
        silent = sorted({each.scene for each in objects} - {each.scene for each in boxes})
        _refuse_missing(silent, "scene", predictions, allow_missing)
        scores = score_box_captions(objects, boxes, min_iou=min_iou, tools=tools)
    else:
        predicted = [each for each in captions if isinstance(each, NamedCaption)]
        named_keys = {(each.scene, each.object_id) for each in predicted}
        missing = [f"{o.object_id} of {o.scene}" for o in objects if (o.scene, o.object_id) not in named_keys]
        _refuse_missing(missing, "object", predictions, allow_missing)
        scores = score_named_captions(objects, predicted, tools=tools)
    ending = f"_{round(100 * min_iou)}" if boxes else ""
    overall = {f"{name}{ending}": value for name, value in _sentences(scores.sentences).items()}
    rows = [
        {
            "scene": each.scene,
            "object": each.object_id,
            "name": each.object_name,
            "iou": None if scores.ious is None else float(scores.ious[row]),
            "cider": float(scores.sentences.cider_each[row]),
            "rouge_l": float(scores.sentences.rouge_l_each[row]),
            "bleu_4": float(scores.sentences.bleu_each[row, 3]),
        }
        for row, each in enumerate(scores.objects)
    ]
    by_scene = [
        {"scene": scene, "objects": len(of_scene)}
        | {name: float(np.mean([row[name] for row in of_scene])) for name in ("cider", "rouge_l", "bleu_4")}
        for scene in dict.fromkeys(row["scene"] for row in rows)
        for of_scene in ([row for row in rows if row["scene"] == scene],)
    ]
    return ScoreReport(
        results={
            "protocol": "captions",
            "objects": len(scores.objects),
            "predictions": scores.predictions,
            "missing": scores.missing,
            "min_iou": scores.min_iou,
            "tokens": scores.sentences.tokens,
            "absent": dict(scores.sentences.absent),
            **overall,
            "spread": spread(by_scene, ["cider", "rouge_l", "bleu_4"]),
        },
        table=table_of(
            f"Captions at an IoU of {min_iou:g}" if boxes else "Captions of given objects",
            {method: overall},
            published="splatdistill_4_captions" if ending == "_50" else "",
            notes=[f"{column} is absent: {reason}." for column, reason in scores.sentences.absent.items()],
        ),
        rows={"objects": rows, "scenes": by_scene},
        line=f"{counted(len(scores.objects), 'object')}, {scores.missing} without a caption that counts: CIDEr "
        f"{100 * scores.sentences.cider:.1f}, BLEU-4 {100 * scores.sentences.bleu[3]:.1f}, ROUGE-L "
        f"{100 * scores.sentences.rouge_l:.1f}",
    )


def _means(means: AnswerMeans) -> dict[str, float]:
    return {
        "em_1": means.em1,
        "em_10": means.em10,
        "em_cleaned": means.em_cleaned,
        "em_refined": means.em_refined,
        "f_value": math.nan if means.f_value is None else means.f_value,
    }


def _sentences(scores: SentenceScores) -> dict[str, float]:
    """The figures by column; columns name their tokens where these are not those of the official script."""
    meteor = math.nan if scores.meteor is None else scores.meteor
    values = (*scores.bleu, meteor, scores.rouge_l, scores.cider)
    by_column = dict(zip(SENTENCE_COLUMNS, values, strict=True))
    return by_column if scores.official else {f"{name} ({scores.tokens})": value for name, value in by_column.items()}


def _columns(overall: Mapping[str, float], published: tuple[str, ...]) -> tuple[str, ...]:
    """Measured columns, then those of papers that rest on other tokens."""
    return tuple(dict.fromkeys((*overall, *published)))


def _refuse_missing(missing: list[str], subject: str, predictions: Path, allowed: bool) -> None:
    if missing and not allowed:
        raise InputError(
            f"{predictions}: {counted(len(missing), subject)} without a prediction, first {missing[0][:60]}; "
            "allow_missing=true counts them as wrong"
        )
