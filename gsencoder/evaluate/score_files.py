"""Scores of files of instances, labels and recognized objects: what `score` and `evaluate` both report."""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from gsencoder.core.errors import InputError, counted
from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.files.instances import match_instance_files
from gsencoder.evaluate.files.recognition import read_recognition_truth, recognize_files
from gsencoder.evaluate.files.semantics import count_label_files
from gsencoder.evaluate.result_table import table_of
from gsencoder.evaluate.score_report import ScoreReport, spread
from gsencoder.evaluate.scores.instance_matches import MIN_REGION, OVERLAPS
from gsencoder.evaluate.scores.instances import InstanceAverages, instance_scores
from gsencoder.evaluate.scores.recognition import recognition_scores
from gsencoder.evaluate.scores.semantics import BACKGROUND, SemanticAverages, check_excluded, semantic_scores

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
    """Average precision of masks (`gsencoder.evaluate.scores.instances`).

    Args:
        predictions: folder of SCENE.txt or SCENE.npz.
        truth: folder of SCENE.txt, or of ScanNet's scans.
        classes: that are scored.
        method: name of the predictions' row in the table.
        scenes: names of those to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
        class_agnostic: leave the classes of masks out of account.
        min_region: smallest number of vertices of a true object and of a mask that count.

    Raises:
        InputError: files that cannot be used or that do not belong together.
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
    """IoU and accuracy of the labels of vertices (`gsencoder.evaluate.scores.semantics`).

    Args:
        predictions: folder of SCENE.txt.
        truth: folder of SCENE.txt, or of ScanNet's scans.
        classes: that are scored.
        method: name of the predictions' row in the table.
        scenes: names of those to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
        excluded: classes that are not of the foreground.

    Raises:
        InputError: files that cannot be used or that do not belong together.
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
    """Accuracy of the classes of given objects (`gsencoder.evaluate.scores.recognition`).

    Args:
        predictions: JSON of ranked names by object.
        truth: JSON of the name of each object.
        classes: that are scored; empty = all of the truth.
        method: name of the predictions' row in the table.
        ks: numbers of names of which one has to be right.
        allow_missing: count objects without a prediction as wrong, instead of refusing them.

    Raises:
        InputError: files that cannot be used or that do not belong together.
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
