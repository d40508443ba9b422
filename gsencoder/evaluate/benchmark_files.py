"""Predictions of the pipeline and the truth of scenes, in the files that benchmarks are scored from.

`evaluate` runs the pipeline scene by scene, writes these files, and then scores them as `score` does. What it reports
is therefore what anyone finds who scores the same files.
"""

import json
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.files import read_foreign_text, write_json
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.expressions import Expression, boxes_from_labels, write_scanrefer
from gsencoder.data.labels.files import write_whole_numbers
from gsencoder.data.labels.scans import find_labels, find_scannet_files
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.instances import (
    InstancesProtocol,
    predict_instances,
    true_instances,
    write_instance_prediction,
)
from gsencoder.evaluate.benchmarks.recognition import (
    NamedInstance,
    RankedNames,
    RecognitionProtocol,
    predict_recognition,
    recognition_truth,
    write_recognition_predictions,
    write_recognition_truth,
)
from gsencoder.evaluate.benchmarks.referring import (
    PredictedBoxes,
    ReferringProtocol,
    expressions_of_objects,
    named_classes,
    predict_referring,
    read_expressions,
    score_referring,
    with_kinds,
    write_referring_predictions,
)
from gsencoder.evaluate.benchmarks.score import score_instances, score_recognition, score_semantics
from gsencoder.evaluate.benchmarks.semantics import SemanticsProtocol, predict_semantics, semantic_truth
from gsencoder.evaluate.sources import FeatureSource, labeled_points, with_features
from gsencoder.evaluate.tables import ScoreReport
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.text.vocabulary import Words
from gsencoder.types import MeshLabels, Scene

PREDICTIONS, TRUTH = "predictions", "truth"
"""Names of the folders, or of the JSON files, in an output folder."""
BenchmarkProtocol = InstancesProtocol | SemanticsProtocol | RecognitionProtocol | ReferringProtocol
"""Protocols whose predictions are written and scored from files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedScene:
    """A scene whose predictions were written."""

    scene: str
    gaussians: int
    seconds: dict[str, float]


def write_predictions(
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    words: Words,
    classes: ClassTable,
    folder: Path,
    *,
    protocol: BenchmarkProtocol,
    class_names: Mapping[str, str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    labeled: Collection[str] | None = None,
    part: int = 0,
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> list[PredictedScene]:
    """Runs the pipeline scene by scene, one in memory at a time, and writes predictions and truth.

    Args:
        scenes: labeled scenes and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: turns names into the features' space.
        folder: an existing one. Protocols on points make the folders `predictions` and `truth` in it, with a file for
            each scene; the others write lists, `predictions.PART.json` and `truth.PART.json`.
        class_names: the class of each name that objects have, where these are not class names themselves.
        raw_ids: nyu40id of each raw name, which tells unique sentences of a file from multiple ones.
        labeled: of ScanNet++, raw names of the objects that a vertex can belong to; None = all.
        part: number of the process, where several have scenes of their own; `merge_lists` joins their files.
        seeds: how Gaussians are made for scenes without.

    Returns:
        What was done for each scene, in order.
    """
    predictions = []
    objects: list[NamedInstance] = []
    names: list[RankedNames] = []
    sentences: list[Expression] = []
    boxes: list[PredictedBoxes] = []
    all_expressions: tuple[Expression, ...] = ()
    if isinstance(protocol, ReferringProtocol) and protocol.expressions:
        all_expressions = read_expressions(Path(protocol.expressions))
    for loaded, load_seconds in scenes:
        scene, features, seconds = with_features(loaded, source, seeds)
        start = time.perf_counter()
        mesh = None if scene.folder is None else find_labels(scene.folder, names=labeled)
        if isinstance(protocol, ReferringProtocol):
            expressions = _expressions(scene, mesh, all_expressions, raw_ids)
            # Boxes of a file are in the aligned frame of its scans, those of a scene's objects in its world.
            aligned = mesh.aligned_from_world if mesh is not None and all_expressions else None
            sentences += expressions
            boxes += predict_referring(
                scene, features, expressions, words, protocol, localization, aligned_from_world=aligned
            )
        else:
            points = labeled_points(scene, mesh)
            if class_names is not None:
                points = points.renamed(class_names)
            if isinstance(protocol, RecognitionProtocol):
                true = recognition_truth(points, protocol)
                objects += true
                names += predict_recognition(points, features, true, classes.names, words)
            else:
                for name in (TRUTH, PREDICTIONS):
                    (folder / name).mkdir(exist_ok=True)
                truth_file = folder / TRUTH / f"{scene.name}.txt"
                if isinstance(protocol, SemanticsProtocol):
                    assert scene.gaussians is not None
                    labels = predict_semantics(points, scene.gaussians, features, classes, words, protocol)
                    write_whole_numbers(truth_file, semantic_truth(points, classes))
                    write_whole_numbers(folder / PREDICTIONS / f"{scene.name}.txt", labels)
                else:
                    masks = predict_instances(scene, points, features, classes, words, protocol, localization)
                    write_whole_numbers(truth_file, true_instances(points, classes).ids)
                    write_instance_prediction(folder / PREDICTIONS, masks, form="npz")
        seconds = {"load": load_seconds, **seconds, protocol.name: time.perf_counter() - start}
        predictions.append(PredictedScene(scene=scene.name, gaussians=len(features), seconds=seconds))
    if isinstance(protocol, RecognitionProtocol):
        write_recognition_truth(folder / f"{TRUTH}.{part}.json", objects)
        write_recognition_predictions(folder / f"{PREDICTIONS}.{part}.json", names)
    elif isinstance(protocol, ReferringProtocol):
        write_scanrefer(folder / f"{TRUTH}.{part}.json", sentences)
        write_referring_predictions(folder / f"{PREDICTIONS}.{part}.json", boxes)
    return predictions


def merge_lists(folder: Path, protocol: BenchmarkProtocol, *, parts: int = 1) -> None:
    """Joins the lists that processes wrote with `write_predictions` to `predictions.json` and `truth.json`."""
    if not isinstance(protocol, (RecognitionProtocol, ReferringProtocol)):
        return
    for name in (PREDICTIONS, TRUTH):
        files = [folder / f"{name}.{part}.json" for part in range(parts)]
        rows = [row for file in files for row in json.loads(read_foreign_text(file))]
        rows.sort(key=lambda row: row["scene_id"])
        write_json(folder / f"{name}.json", rows)
        for file in files:
            file.unlink()


def score_written(folder: Path, protocol: BenchmarkProtocol, classes: ClassTable, method: str) -> ScoreReport:
    """The scores of what `write_predictions` wrote, after `merge_lists`."""
    if isinstance(protocol, InstancesProtocol):
        return score_instances(
            folder / PREDICTIONS,
            folder / TRUTH,
            classes,
            method=method,
            class_agnostic=protocol.class_agnostic,
            min_region=protocol.min_region,
        )
    if isinstance(protocol, SemanticsProtocol):
        return score_semantics(folder / PREDICTIONS, folder / TRUTH, classes, method=method, excluded=protocol.excluded)
    files = folder / f"{PREDICTIONS}.json", folder / f"{TRUTH}.json"
    if isinstance(protocol, RecognitionProtocol):
        return score_recognition(*files, classes=classes.names, method=method)
    return score_referring(*files, method=method)


def _expressions(
    scene: Scene, mesh: MeshLabels | None, sentences: Sequence[Expression], raw_ids: Mapping[str, int] | None
) -> tuple[Expression, ...]:
    """The sentences about a scene, with the boxes of a ScanNet scan's labels where they have none, and with what is
    known of their kinds: by ScanNet's label map, or by the names themselves where the names are what is asked."""
    if not sentences:
        expressions = expressions_of_objects(scene)
        return with_kinds(expressions, {each.object_name: each.object_name for each in expressions})
    expressions = tuple(each for each in sentences if each.scene == scene.name)
    lacking = any(each.aabb is None for each in expressions)
    if lacking and mesh is not None and scene.folder is not None and find_scannet_files(scene.folder) is not None:
        expressions = boxes_from_labels(expressions, mesh)
    if raw_ids is None:
        return expressions
    return with_kinds(expressions, named_classes((each.object_name for each in expressions), raw_ids))
