"""Protocols of `gsencoder evaluate` that write predictions in the formats of benchmarks, and score these files.

Several processes (torchrun, SLURM) share the scenes: each writes the files of its own, and the first one scores all.
"""

from contextlib import ExitStack
from pathlib import Path

from torch import distributed

from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluate_sources import scenes_of
from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError
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
from gsencoder.evaluate.protocols.referring import ReferringProtocol
from gsencoder.evaluate.protocols.semantics import classes_of
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
        merge_lists(folder, protocol, parts=process.world_size)
        write_classes(folder / CLASS_IDS, classes)
        for scene in every:
            summary.add_seconds(scene.seconds)
        report = score_written(folder, protocol, classes, "encoded" if config.weights else "fused")
        write_report(folder, report, summary)
        summary.results["gaussians"] = {scene.scene: scene.gaussians for scene in every}
    print_report(out, report, quiet=config.quiet)


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
    classes = load_classes(config.classes)
    if not config.label_map:
        return classes, None
    name_of = classes.name_of
    ids = read_label_map(Path(config.label_map), COLUMNS.get(config.classes, DEFAULT_COLUMN))
    return classes, {raw: name_of[number] for raw, number in ids.items() if number in name_of}
