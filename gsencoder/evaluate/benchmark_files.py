"""Predictions of the pipeline and the truth of scenes, in the files that benchmarks are scored from.

`evaluate` runs the pipeline scene by scene, writes these files, and then scores them as `score` does. What it reports
is therefore what anyone finds who scores the same files.
"""

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsencoder.core.files.json_values import write_json
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.truth.expressions import Expression
from gsencoder.data.truth.scene_labels import find_labels
from gsencoder.evaluate.files.instances import write_instance_prediction, write_instance_truth
from gsencoder.evaluate.files.label_files import write_whole_numbers
from gsencoder.evaluate.files.recognition import write_recognition_predictions, write_recognition_truth
from gsencoder.evaluate.files.referring import write_referring_predictions, write_referring_truth
from gsencoder.evaluate.labeled_points import labeled_points
from gsencoder.evaluate.protocols.instances import InstancesProtocol, instance_truth, predict_instances
from gsencoder.evaluate.protocols.recognition import RecognitionProtocol, predict_recognition, recognition_truth
from gsencoder.evaluate.protocols.referring import (
    ReferringProtocol,
    expressions_of_objects,
    predict_referring,
    read_expressions,
    referring_truth,
)
from gsencoder.evaluate.protocols.semantics import SemanticsProtocol, predict_semantics, semantic_truth
from gsencoder.evaluate.score_files import score_instances, score_recognition, score_referring, score_semantics
from gsencoder.evaluate.score_report import ScoreReport
from gsencoder.evaluate.scores.class_table import ClassTable
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.infer.localize.localize import LocalizeConfig
from gsencoder.text.build import Words
from gsencoder.types import Scene

PREDICTIONS, TRUTH = "predictions", "truth"
"""Names of the folders, or of the JSON files, in an output folder."""
BenchmarkProtocol = InstancesProtocol | SemanticsProtocol | RecognitionProtocol | ReferringProtocol
"""Protocols whose predictions are written and scored from files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedScene:
    """A scene whose predictions were written.

    Attributes:
        scene: its name.
        gaussians: number of its Gaussians.
        seconds: seconds of each step.
    """

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
    part: int = 0,
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> list[PredictedScene]:
    """Runs the pipeline scene by scene, one in memory at a time, and writes predictions and truth.

    Args:
        scenes: labeled scenes and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: turns names into the features' space.
        classes: that can be predicted.
        folder: an existing one. Protocols on points make the folders `predictions` and `truth` in it, with a file for
            each scene; the others write lists, `predictions.PART.json` and `truth.PART.json`.
        protocol: what is predicted.
        class_names: the class of each name that objects have, where these are not class names themselves.
        part: number of the process, where several have scenes of their own; `merge_lists` joins their files.
        seeds: how Gaussians are made for scenes without.
        localization: settings of `localize`.

    Returns:
        What was done for each scene, in order.

    Raises:
        InputError: a scene without true objects, words of another space, or a class that `words` does not know.
    """
    done = []
    truths: list[Any] = []
    predictions: list[Any] = []
    given = () if not isinstance(protocol, ReferringProtocol) else _given_expressions(protocol)
    for loaded, load_seconds in scenes:
        scene, features, seconds = with_features(loaded, source, seeds)
        start = time.perf_counter()
        mesh = None if scene.folder is None else find_labels(scene.folder)
        if isinstance(protocol, ReferringProtocol):
            asked = [each for each in given if each.scene == scene.name] if given else expressions_of_objects(scene)
            # Boxes of a file are in the aligned frame of its scans, those of a scene's objects in its world.
            aligned = mesh.aligned_from_world if mesh is not None and given else None
            truths += asked
            predictions += predict_referring(
                scene, features, asked, words, protocol, localization, aligned_from_world=aligned
            )
        else:
            points = labeled_points(scene, mesh)
            if class_names is not None:
                points = points.renamed(class_names)
            if isinstance(protocol, RecognitionProtocol):
                true = recognition_truth(points, protocol)
                truths += true
                predictions += predict_recognition(points, features, true, classes.names, words)
            elif isinstance(protocol, SemanticsProtocol):
                predicted = predict_semantics(points, features, classes, words)
                for name, labels in ((TRUTH, semantic_truth(points, classes)), (PREDICTIONS, predicted)):
                    (folder / name).mkdir(exist_ok=True)
                    write_whole_numbers(folder / name / f"{scene.name}.txt", labels)
            else:
                masks = predict_instances(scene, points, features, classes, words, protocol, localization)
                for name in (TRUTH, PREDICTIONS):
                    (folder / name).mkdir(exist_ok=True)
                write_instance_truth(folder / TRUTH / f"{scene.name}.txt", instance_truth(points, classes))
                write_instance_prediction(folder / PREDICTIONS, masks, form="npz")
        seconds = {"load": load_seconds, **seconds, protocol.name: time.perf_counter() - start}
        done.append(PredictedScene(scene=scene.name, gaussians=len(features), seconds=seconds))
    if isinstance(protocol, RecognitionProtocol):
        write_recognition_truth(folder / f"{TRUTH}.{part}.json", truths)
        write_recognition_predictions(folder / f"{PREDICTIONS}.{part}.json", predictions)
    elif isinstance(protocol, ReferringProtocol):
        write_referring_truth(folder / f"{TRUTH}.{part}.json", referring_truth(truths))
        write_referring_predictions(folder / f"{PREDICTIONS}.{part}.json", predictions)
    return done


def merge_lists(folder: Path, protocol: BenchmarkProtocol, *, parts: int = 1) -> None:
    """Joins the lists that processes wrote with `write_predictions` to `predictions.json` and `truth.json`."""
    if not isinstance(protocol, (RecognitionProtocol, ReferringProtocol)):
        return
    for name in (PREDICTIONS, TRUTH):
        files = [folder / f"{name}.{part}.json" for part in range(parts)]
        rows = [row for file in files for row in json.loads(file.read_text())]
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


def _given_expressions(protocol: ReferringProtocol) -> tuple[Expression, ...]:
    return read_expressions(Path(protocol.expressions)) if protocol.expressions else ()
