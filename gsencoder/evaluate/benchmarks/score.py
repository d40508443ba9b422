"""Scores of files of instances, labels and recognized objects: what `score` and `evaluate` both report."""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError, counted
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.expressions import read_scanrefer
from gsencoder.data.labels.questions import read_questions
from gsencoder.evaluate.benchmarks.answers import AnswerMeans, read_answer_predictions, score_answers
from gsencoder.evaluate.benchmarks.captions import (
    CaptionedBox,
    NamedCaption,
    captioned_objects,
    read_caption_predictions,
    score_box_captions,
    score_named_captions,
)
from gsencoder.evaluate.benchmarks.instances import (
    MIN_REGION,
    OVERLAPS,
    InstanceAverages,
    instance_scores,
    match_instance_files,
)
from gsencoder.evaluate.benchmarks.recognition import read_recognition_truth, recognition_scores, recognize_files
from gsencoder.evaluate.benchmarks.semantics import (
    BACKGROUND,
    SemanticAverages,
    check_excluded,
    count_label_files,
    semantic_scores,
)
from gsencoder.evaluate.benchmarks.text_metrics import SentenceScores
from gsencoder.evaluate.tables import ScoreReport, spread, table_of

EQUAL_SCORES = (
    "All predictions have one score, so that their ranking is undefined, and average precision is that of one step."
)


def score_instances(
    predictions: Path,
    truth: Path,
    classes: ClassTable,
    *,
    method: str = "predictions",
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    class_agnostic: bool = False,
    min_region: int = MIN_REGION,
) -> ScoreReport:
    """Average precision of masks (`gsencoder.evaluate.benchmarks.instances`).

    Args:
        predictions: folder of SCENE.txt or SCENE.npz.
        truth: folder of SCENE.txt, or of ScanNet's scans.
        method: name of the predictions' row in the table.
        scenes: names of those to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
        class_agnostic: leave the classes of masks out of account.
        min_region: smallest number of vertices of a true object and of a mask that count.
    """
    classes.check_instance_ids()
    matches = list(
        match_instance_files(
            predictions,
            truth,
            classes,
            scenes=scenes,
            raw_ids=raw_ids,
            class_agnostic=class_agnostic,
            min_region=min_region,
        )
    )
    scores = instance_scores(matches, classes)
    if not scores.truths.any():
        raise InputError(
            f"{truth}: nothing to score: no object of the {len(classes.names)} classes has {min_region} vertices or "
            f"more in {counted(len(matches), 'scene')}; compare its ids with those of classes="
        )
    overall = _precisions(scores.overall)
    by_scene = [
        {"scene": each.scene, **_precisions(alone.overall), "truths": int(alone.truths.sum())}
        for each in matches
        for alone in (instance_scores([each], classes),)
    ]
    by_class = [
        {"class": name, **_precisions(values), "truths": int(truths), "predictions": int(count)}
        for (name, values), truths, count in zip(scores.classes.items(), scores.truths, scores.predictions, strict=True)
    ]
    groups = {f"ap_{group}": values.ap for group, values in scores.groups.items()}
    notes = [EQUAL_SCORES] if scores.equal_scores else []
    if class_agnostic:
        notes.append("All masks are of one class; published figures, which are of classes, do not stand beside it.")
    others = sum(each.other_classes for each in matches)
    if others:
        notes.append(
            f"Not counted: {counted(others, 'mask')} with a class id that is none of the {len(classes.names)} that are "
            "scored."
        )
    if scores.shared:
        notes.append(
            f"Of the masks {scores.shared:,} overlap several true objects by more than 0.25; AP at 0.25 depends on "
            "the order in which they are listed, as in ScanNet's script."
        )
    return ScoreReport(
        results={
            "protocol": "instances",
            "class_agnostic": class_agnostic,
            "min_region": min_region,
            "thresholds": [round(float(value), 2) for value in OVERLAPS],
            "truths": int(scores.truths.sum()),
            "predictions": int(scores.predictions.sum()),
            "other_classes": others,
            "equal_scores": scores.equal_scores,
            **overall,
            **groups,
            "spread": spread(by_scene, list(overall)),
        },
        table=table_of(
            "Instances",
            {method: overall | groups},
            published="" if class_agnostic else "splatdistill_2_instances",
            notes=notes,
        ),
        rows={"scenes": by_scene, "classes": by_class},
        line=f"{counted(int(scores.truths.sum()), 'object')} in {counted(scores.scenes, 'scene')}: AP "
        f"{overall['ap']:.3f}, AP50 {overall['ap_50']:.3f}, AP25 {overall['ap_25']:.3f}"
        + (" without classes" if class_agnostic else ""),
    )


def score_semantics(
    predictions: Path,
    truth: Path,
    classes: ClassTable,
    *,
    method: str = "predictions",
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    excluded: Collection[str] = BACKGROUND,
) -> ScoreReport:
    """IoU and accuracy of the labels of vertices (`gsencoder.evaluate.benchmarks.semantics`).

    Args:
        truth: folder of SCENE.txt, or of ScanNet's scans.
        method: name of the predictions' row in the table.
        scenes: names of those to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
        excluded: classes that are not of the foreground.
    """
    check_excluded(excluded, classes)
    counts = list(count_label_files(predictions, truth, classes, scenes=scenes, raw_ids=raw_ids))
    scores = semantic_scores(counts, classes, excluded=excluded)
    if not scores.vertices:
        raise InputError(
            f"{truth}: nothing to score: no vertex of {counted(len(counts), 'scene')} has one of the "
            f"{len(classes.names)} classes; compare its ids with those of classes="
        )
    overall = asdict(scores.overall) | _foreground(scores.foreground)
    by_scene = [
        {"scene": each.scene, **asdict(alone.overall), **_foreground(alone.foreground), "vertices": alone.vertices}
        for each in counts
        for alone in (semantic_scores([each], classes, excluded=excluded),)
    ]
    by_class = [{"class": name, **asdict(values)} for name, values in scores.classes.items()]
    notes = [f"Columns f_ leave out {', '.join(scores.excluded)}."] if scores.excluded else []
    if scores.unlabeled:
        notes.append(
            f"{scores.unlabeled:,} of {scores.vertices:,} vertices that count are predicted as none of the classes."
        )
    return ScoreReport(
        results={
            "protocol": "semantics",
            "vertices": scores.vertices,
            "ignored": scores.ignored,
            "unlabeled": scores.unlabeled,
            "excluded": list(scores.excluded),
            **overall,
            "spread": spread(by_scene, list(overall)),
        },
        table=table_of("Semantic labels", {method: overall}, notes=notes),
        rows={"scenes": by_scene, "classes": by_class},
        line=f"{counted(scores.vertices, 'label')} in {counted(scores.scenes, 'scene')}: mIoU {overall['miou']:.3f}, "
        f"mAcc {overall['macc']:.3f}, f-mIoU {overall['f_miou']:.3f}; {scores.unlabeled:,} without a prediction",
    )


def score_recognition(
    predictions: Path,
    truth: Path,
    *,
    classes: Sequence[str] = (),
    method: str = "predictions",
    ks: Sequence[int] = (1, 5),
    allow_missing: bool = False,
) -> ScoreReport:
    """Accuracy of the classes of given objects (`gsencoder.evaluate.benchmarks.recognition`).

    Args:
        predictions: JSON of ranked names by object.
        truth: JSON of the name of each object.
        classes: that are scored; empty = all of the truth.
        method: name of the predictions' row in the table.
        ks: numbers of names of which one has to be right.
        allow_missing: count objects without a prediction as wrong, instead of refusing them.
    """
    names = list(classes) or sorted({each.name for each in read_recognition_truth(truth)})
    instances, skipped = recognize_files(predictions, truth, names, allow_missing=allow_missing)
    scores = recognition_scores(instances, names, ks=ks)
    if not instances:
        raise InputError(f"{truth}: nothing to score: it holds no object of the {len(names)} classes")
    by_scene_name = defaultdict(list)
    for each in instances:
        by_scene_name[each.scene].append(each)
    by_scene = [
        {"scene": scene, "objects": len(each)}
        | {f"top_{k}": value for k, value in recognition_scores(each, names, ks=ks).overall.items()}
        for scene, each in by_scene_name.items()
    ]
    means = {f"mean_{k}": value for k, value in scores.mean.items()}
    overall = {f"overall_{k}": value for k, value in scores.overall.items()}
    by_class = [
        {"class": name, "objects": scores.counts.get(name, 0)} | {f"top_{k}": scores.classes[k][name] for k in ks}
        for name in names
    ]
    first = ks[0]
    columns = {"mean": scores.mean[first], **scores.classes[first]}
    return ScoreReport(
        results={
            "protocol": "recognition",
            "objects": scores.instances,
            "unanswered": scores.unanswered,
            "other_classes": skipped,
            **means,
            **overall,
            "spread": spread(by_scene, [f"top_{k}" for k in ks]),
        },
        table=table_of(
            f"Recognition of given objects, top-{first}",
            {method: columns},
            published="splatdistill_1_recognition",
            by_class=names,
        ),
        rows={"scenes": by_scene, "classes": by_class},
        line=f"{counted(scores.instances, 'object')}, averaged over classes (over objects): "
        + ", ".join(f"top-{k} {scores.mean[k]:.3f} ({scores.overall[k]:.3f})" for k in ks),
    )


def _precisions(averages: InstanceAverages) -> dict[str, float]:
    return {"ap_25": averages.ap25, "ap_50": averages.ap50, "ap": averages.ap}


def _foreground(averages: SemanticAverages) -> dict[str, float]:
    return {f"f_{name}": value for name, value in asdict(averages).items()}


SENTENCE_COLUMNS = ("bleu_1", "bleu_2", "bleu_3", "bleu_4", "meteor", "rouge_l", "cider")


def score_answer_files(
    predictions: Path, truth: Path, *, method: str = "predictions", java: bool = True, allow_missing: bool = False
) -> ScoreReport:
    """Scores of answers to a question set (`gsencoder.evaluate.benchmarks.answers`).

    Args:
        predictions: ScanQA's or SQA3D's file of predicted answers.
        truth: the question set with its answers.
        method: name of the predictions' row in the table.
        java: whether Java's tokenizer and METEOR are used where they are there.
        allow_missing: count questions without a prediction as wrong, instead of refusing the file.
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
    """Scores of captions of boxes or of given objects (`gsencoder.evaluate.benchmarks.captions`).

    Args:
        predictions: Scan2Cap's file of predicted captions.
        truth: ScanRefer's file of expressions, with boxes where captions are of boxes.
        method: name of the predictions' row in the table.
        min_iou: k of m@kIoU; captions of given objects have no boxes, and no k.
        java: whether METEOR is computed where Java is there.
        allow_missing: count given objects without a caption, and the objects of scenes without any, as empty, instead
            of refusing the file.
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
