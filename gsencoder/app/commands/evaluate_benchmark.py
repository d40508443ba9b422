"""Protocols of `gsencoder evaluate` that write predictions in the formats of benchmarks, and score these files.

Several processes (torchrun, SLURM) share the scenes: each writes the files of its own, and the first one scores all.
"""

import warnings
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path

from torch import distributed

from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluate_sources import scenes_of
from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.data.truth.class_table import ClassTable
from gsencoder.data.truth.label_sets import COLUMNS, DEFAULT_COLUMN, read_label_map
from gsencoder.evaluate.benchmark_files import (
    BenchmarkProtocol,
    PredictedScene,
    merge_lists,
    score_written,
    write_predictions,
)
from gsencoder.evaluate.files.class_files import load_classes, write_classes
from gsencoder.evaluate.protocols.absent import names_of
from gsencoder.evaluate.protocols.instances import InstancesProtocol
from gsencoder.evaluate.protocols.referring import ReferringProtocol, read_expressions
from gsencoder.evaluate.protocols.semantics import SemanticsProtocol, classes_of
from gsencoder.evaluate.sources import FeatureSource
from gsencoder.text.build import Words
from gsencoder.train.distributed import ProcessRank, fail_together, join_processes

CLASS_IDS = "class_ids.csv"
"""The classes of a benchmark, as `score` takes them."""


def run_benchmark(
    config: EvaluateConfig,
    protocol: BenchmarkProtocol,
    source: FeatureSource,
    words: Words,
    out: Path,
    summary: Summary,
) -> None:
    """Predicts the scenes of this process, and in the first process scores those of all and prints the scores."""
    with join_processes("cpu") as (process, _), ExitStack() as results:
        folder = None
        with fail_together():
            if process.is_first:
                folder = results.enter_context(output_folder(out, overwrite=config.overwrite, summary=summary))
            classes, class_names = _classes(config)
            raw_ids = None
            if isinstance(protocol, ReferringProtocol) and config.label_map:
                raw_ids = read_label_map(Path(config.label_map), COLUMNS["scannet20"])
        shared = _from_first(folder, process)
        with fail_together():
            done = write_predictions(
                scenes_of(config, part=(process.rank, process.world_size)),
                source,
                words,
                classes,
                shared,
                protocol=protocol,
                class_names=class_names,
                raw_ids=raw_ids,
                part=process.rank,
                seeds=config.seeds,
                localization=config.localize,
            )
        every = _from_all(done, process)
        if folder is None:
            return
        others = _other_sentences(protocol, {scene.scene for scene in every})
        merge_lists(folder, protocol, parts=process.world_size)
        write_classes(folder / CLASS_IDS, classes)
        for scene in every:
            summary.add_seconds(scene.seconds)
        report = score_written(folder, protocol, classes, _method(config))
        write_report(folder, report, summary)
        if others:
            summary.results["other_scenes"] = others
        summary.results["gaussians"] = {scene.scene: scene.gaussians for scene in every}
    print_report(out, report, quiet=config.quiet)


def _other_sentences(protocol: BenchmarkProtocol, scenes: Collection[str]) -> int:
    """The number of sentences of a given file that are about scenes which are not evaluated.

    Raises:
        InputError: all of them are.

    Warns:
        SceneWarning: some are.
    """
    if not isinstance(protocol, ReferringProtocol) or not protocol.expressions:
        return 0
    asked = read_expressions(Path(protocol.expressions))
    others = [each.scene for each in asked if each.scene not in scenes]
    if len(others) == len(asked):
        raise InputError(
            f"protocol.expressions: none of the {len(asked)} sentences of {protocol.expressions} is about a scene that "
            f"is evaluated ({listed(sorted(scenes), 3)}); first {listed(others, 1)}"
        )
    if others:
        warnings.warn(
            f"{len(others)} of {len(asked)} sentences do not count: they are about {len(set(others))} scenes that are "
            f"not evaluated (first: {others[0]})",
            SceneWarning,
            stacklevel=2,
        )
    return len(others)


def _method(config: EvaluateConfig) -> str:
    """What the row of the table is called."""
    if config.features:
        return Path(config.features).resolve().name
    return "encoded" if config.weights else "fused"


def _from_first(folder: Path | None, process: ProcessRank) -> Path:
    """The folder that the first process opened, in every process."""
    held = [str(folder)]
    if process.world_size > 1:
        distributed.broadcast_object_list(held, src=0)
    return Path(held[0])


def _from_all(done: list[PredictedScene], process: ProcessRank) -> list[PredictedScene]:
    """What all processes did, by the name of the scene."""
    if process.world_size == 1:
        return done
    parts: list[list[PredictedScene]] = [[] for _ in range(process.world_size)]
    distributed.all_gather_object(parts, done)
    return sorted((scene for part in parts for scene in part), key=lambda scene: scene.scene)


def _classes(config: EvaluateConfig) -> tuple[ClassTable, dict[str, str] | None]:
    """The classes that can be predicted, and where a label map is given the class of each raw name."""
    if not config.classes:
        if config.label_map and not isinstance(config.protocol, ReferringProtocol):
            raise InputError("label_map: leads to the ids of a benchmark; give classes=scannet20 or classes=scannet200")
        return classes_of(names_of(scene for scene, _ in scenes_of(config))), None
    classes = load_classes(config.classes, instances=isinstance(config.protocol, InstancesProtocol))
    if isinstance(config.protocol, InstancesProtocol | SemanticsProtocol):
        classes.check_zero_is_free()
    if not config.label_map:
        return classes, None
    name_of = classes.name_of
    ids = read_label_map(Path(config.label_map), COLUMNS.get(config.classes, DEFAULT_COLUMN))
    return classes, {raw: name_of[number] for raw, number in ids.items() if number in name_of}
