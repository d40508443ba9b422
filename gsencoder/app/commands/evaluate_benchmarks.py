"""Protocols of `gsencoder evaluate` that write predictions in the formats of benchmarks, and score these files.

Several processes (torchrun, SLURM) share the scenes: each writes the files of its own, and the first one scores all.
"""

import warnings
from collections.abc import Collection
from pathlib import Path

import numpy as np

from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.evaluate_settings import EvaluateConfig, method_name, scenes_of, stored_memory
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, SceneWarning, about, advised, counted, listed
from gsencoder.data.labels.captions import read_texts, read_view_captions, write_view_captions
from gsencoder.data.labels.classes import COLUMNS, DEFAULT_COLUMN, ClassTable, ids_of_benchmark, read_label_map
from gsencoder.data.scenes import find_scenes, load_scene, scene_name
from gsencoder.evaluate.benchmark_files import (
    BenchmarkProtocol,
    merge_lists,
    score_written,
    write_predictions,
)
from gsencoder.evaluate.benchmarks.files import load_classes, write_classes
from gsencoder.evaluate.benchmarks.instances import InstancesProtocol
from gsencoder.evaluate.benchmarks.referring import ReferringProtocol, read_expressions
from gsencoder.evaluate.benchmarks.retrieval import (
    RetrievalProtocol,
    ScoredPairs,
    evaluate_retrieval,
    score_retrieval,
    views_of,
    write_scored_pairs,
)
from gsencoder.evaluate.benchmarks.semantics import SemanticsProtocol, check_excluded, classes_of
from gsencoder.evaluate.protocols.absent import names_of
from gsencoder.evaluate.sources import FeatureSource
from gsencoder.text.vocabulary import Words, check_known
from gsencoder.train.distributed import fail_together, value_of_first, values_of_all
from gsencoder.types import QueryMemory, Scene

CLASS_IDS = "class_ids.csv"
"""The classes of a benchmark, as `score` takes them."""


def run_benchmark(
    config: EvaluateConfig,
    protocol: BenchmarkProtocol,
    source: FeatureSource,
    words: Words,
    out: Path,
    run: Run,
) -> None:
    """Predicts the scenes of this process, and in the first process scores those of all and prints the scores."""
    with run.processes("cpu", out) as group:
        process, folder = group.process, None
        with fail_together():
            folder = group.folder()
            classes, class_names, labeled = _classes(config)
            _check_names(protocol, classes, words)
            scene_names = {scene_name(path) for path in find_scenes(config.paths)}
            others = _other_sentences(protocol, scene_names, warn=process.is_first)
            raw_ids = None
            if isinstance(protocol, ReferringProtocol) and config.label_map:
                raw_ids = read_label_map(Path(config.label_map), COLUMNS["scannet20"])
        shared = Path(value_of_first(str(folder)))
        with fail_together():
            predictions = write_predictions(
                scenes_of(config, part=(process.rank, process.world_size)),
                source,
                words,
                classes,
                shared,
                protocol=protocol,
                class_names=class_names,
                raw_ids=raw_ids,
                labeled=labeled,
                part=process.rank,
                seeds=config.seeds,
                localization=config.localize,
            )
        every = sorted((scene for part in values_of_all(predictions) for scene in part), key=lambda scene: scene.scene)
        if folder is None:
            return
        merge_lists(folder, protocol, parts=process.world_size)
        write_classes(folder / CLASS_IDS, classes)
        for scene in every:
            run.add_seconds(scene.seconds)
        report = score_written(folder, protocol, classes, method_name(config))
        write_report(folder, report, run, page=config.report)
        if others:
            run.results["other_scenes"] = others
        run.results["gaussians"] = {scene.scene: scene.gaussians for scene in every}
    print_report(out, report, run)


def _check_names(protocol: BenchmarkProtocol, classes: ClassTable, words: Words) -> None:
    """Checks, before any scene is read, that names in settings are classes and that the words know all classes."""
    if isinstance(protocol, SemanticsProtocol):
        with about("protocol"):
            check_excluded(protocol.excluded, classes)
    if not isinstance(protocol, ReferringProtocol):
        with advised("give words that know all classes, or the classes that they know as classes=FILE"):
            check_known(words, classes.names)


def _other_sentences(protocol: BenchmarkProtocol, scenes: Collection[str], *, warn: bool) -> int:
    """The number of sentences of a given file that are about scenes which are not evaluated."""
    if not isinstance(protocol, ReferringProtocol) or not protocol.expressions:
        return 0
    sentences = read_expressions(Path(protocol.expressions))
    others = [each.scene for each in sentences if each.scene not in scenes]
    if len(others) == len(sentences):
        raise InputError(
            f"protocol.expressions: none of the {len(sentences)} sentences of {protocol.expressions} is about a scene "
            f"that is evaluated ({listed(sorted(scenes), 3)}); first {listed(others, 1)}"
        )
    if others and warn:
        warnings.warn(
            f"{len(others)} of {len(sentences)} sentences do not count: they are about {len(set(others))} scenes that "
            f"are not evaluated (first: {others[0]})",
            SceneWarning,
            stacklevel=2,
        )
    return len(others)


def _classes(config: EvaluateConfig) -> tuple[ClassTable, dict[str, str] | None, Collection[str] | None]:
    """The classes that can be predicted; with a label map the class of each raw name; and with ScanNet++'s map the raw
    names of the objects that a vertex can belong to, those of all its classes."""
    if not config.classes:
        if config.label_map and not isinstance(config.protocol, ReferringProtocol):
            raise InputError(
                "label_map: leads to the classes of a benchmark; give classes=scannet20, classes=scannet200 or, of "
                "ScanNet++, classes=top100.txt"
            )
        return classes_of(names_of(scene for scene, _ in scenes_of(config))), None, None
    classes = load_classes(config.classes, instances=isinstance(config.protocol, InstancesProtocol))
    if not config.label_map:
        return classes, None, None
    name_of, path = classes.name_of, Path(config.label_map)
    scannetpp = path.suffix.lower() == ".csv"
    if scannetpp:
        ids = ids_of_benchmark(path, load_classes(config.classes))
    else:
        ids = read_label_map(path, COLUMNS.get(config.classes, DEFAULT_COLUMN))
    names = {raw: name_of[number] for raw, number in ids.items() if number in name_of}
    return classes, names, list(ids) if scannetpp else None


PREDICTIONS, TRUTH = "predictions.npz", "truth.json"


def run_retrieval(
    config: EvaluateConfig,
    protocol: RetrievalProtocol,
    source: FeatureSource,
    words: Words,
    out: Path,
    run: Run,
) -> None:
    """Compares the views of all scenes with all texts, and scores what it wrote."""
    if not protocol.captions:
        raise InputError("protocol.captions= is missing: a JSON list of {scene_id, view, caption}")
    provided = read_view_captions(Path(protocol.captions))
    names = [scene_name(path) for path in find_scenes(config.paths)]
    captions = [each for name in names for each in provided if each.scene == name]
    if not captions:
        raise InputError(
            f"protocol.captions: none of the captions in {protocol.captions} is about a scene "
            f"that is evaluated ({listed(names, 3)}); first {provided[0].scene}"
        )
    if len(captions) < len(provided):
        warnings.warn(
            f"{len(provided) - len(captions)} of {counted(len(provided), 'caption')} do not count: they are about "
            "scenes that are not evaluated",
            SceneWarning,
            stacklevel=2,
        )
    others = read_texts(Path(protocol.distractors)) if protocol.distractors else ()
    others = tuple(text for text in others if text not in {each.caption for each in captions})
    if protocol.count > len(others):
        raise InputError(
            f"protocol.count: {protocol.count:,} distractors are asked for, and protocol.distractors= has "
            f"{len(others):,}"
        )
    texts = [*(each.caption for each in captions), *others]
    with advised("sentences need the tower that made the words (text=)"):
        check_known(words, texts)
    for path in find_scenes(config.paths):
        loaded = load_scene(path, options=config.data)
        views_of(loaded, [each for each in captions if each.scene == loaded.name])

    def memory_of(scene: Scene) -> QueryMemory | None:
        # Outputs of a head are features of their own; the memory holds those of the teacher.
        return stored_memory(config.features, scene) if config.features and not config.head else None

    with run.folder(out) as folder:
        scenes = evaluate_retrieval(
            scenes_of(config),
            source,
            words,
            captions,
            texts,
            protocol=protocol,
            seeds=config.seeds,
            memory_of=memory_of,
        )
        for scene in scenes:
            run.add_seconds(scene.seconds)
        pairs = ScoredPairs(
            queries=tuple(each.name for scene in scenes for each in scene.captions),
            scores=np.concatenate([scene.scores for scene in scenes]),
            distractors=np.zeros((0, len(captions))),
        )
        write_scored_pairs(folder / PREDICTIONS, pairs)
        write_view_captions(folder / TRUTH, captions)
        report = score_retrieval(
            folder / PREDICTIONS, folder / TRUTH, method=method_name(config), count=protocol.count, seed=protocol.seed
        )
        write_report(folder, report, run, page=config.report)
        run.results["gaussians"] = {scene.scene: scene.gaussians for scene in scenes}
    print_report(out, report, run)
