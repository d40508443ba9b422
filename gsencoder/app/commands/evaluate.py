"""`gsencoder evaluate SCENE… protocol=…`: a benchmark on labeled scenes, of fused features or of an encoder's.

Several processes (torchrun, SLURM) share the scenes: each predicts its own, and the first one scores all.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.heads import words_of_head
from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Progress, Run
from gsencoder.app.scenes import folder_of, load_query, memory_of
from gsencoder.core.errors import InputError
from gsencoder.core.process import retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, check_names, find_scenes, load_scene, scene_name
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats.files import READABLE
from gsencoder.evaluate.benchmarks.absent import AbsentProtocol
from gsencoder.evaluate.benchmarks.grounding import GroundingProtocol
from gsencoder.evaluate.benchmarks.instances import InstancesProtocol
from gsencoder.evaluate.benchmarks.localization import LocalizationProtocol
from gsencoder.evaluate.benchmarks.naming import NamingProtocol
from gsencoder.evaluate.benchmarks.protocol import Evaluation, SceneResult, predict_scenes
from gsencoder.evaluate.benchmarks.recognition import RecognitionProtocol
from gsencoder.evaluate.benchmarks.referring import ReferringProtocol
from gsencoder.evaluate.benchmarks.retrieval import RetrievalProtocol
from gsencoder.evaluate.benchmarks.semantics import SemanticsProtocol
from gsencoder.evaluate.sources import (
    FeatureSource,
    encoder_source,
    find_table,
    fused_head_source,
    fusion_source,
    head_source,
    space_of_words,
)
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.fusion.folder import load_features
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.measured_heads import find_head, load_heads
from gsencoder.infer.encode import EncodeConfig, Encoder, file_of_encoder
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.models.output_space import find_heads
from gsencoder.teachers.build import TeacherConfig, words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words, with_training_names, words_of_table
from gsencoder.train.distributed import fail_together, join_processes, value_of_first, values_of_all
from gsencoder.types import QueryMemory, Scene

AnyProtocol = (
    LocalizationProtocol
    | NamingProtocol
    | AbsentProtocol
    | GroundingProtocol
    | RecognitionProtocol
    | InstancesProtocol
    | SemanticsProtocol
    | ReferringProtocol
    | RetrievalProtocol
)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig(CommonConfig):
    """Settings of `evaluate`."""

    paths: tuple[str, ...] = option((), "labeled scenes, or folders of scenes", metavar="SCENE", required=True)
    weights: str = option(
        "", "encoder whose features are evaluated (see encode); empty = the fused features of the teacher"
    )
    features: str = option(
        "",
        "features that are evaluated in place of those: a folder written by fuse, encode, pack or memory, "
        "or one with such a folder for each scene",
    )
    space: str = option(
        "", "of an encoder or features of several teachers, the one that is evaluated; empty = that of the words"
    )
    head: str = option(
        "",
        "adapter head whose outputs are evaluated, such as siglip, with the words of text=; empty = the "
        "features themselves",
    )
    protocol: AnyProtocol = field(default_factory=LocalizationProtocol)
    classes: str = option(
        "",
        "of recognition, instances and semantics: scannet20, scannet200, a CSV file with the columns id, "
        "name and group, or ScanNet++'s top100.txt; empty = the names of the scenes' objects",
    )
    label_map: str = option(
        "",
        "scannetv2-labels.combined.tsv, or ScanNet++'s map_benchmark.csv, which gives the raw names of "
        "objects a class of classes=, and of referring tells unique from multiple",
    )
    splat: str = option("", f"Gaussians of the scenes; empty = seeds. {READABLE}")
    report: bool = option(False, "write report.html, a page with pictures and figures")
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    text: TextConfig = field(default_factory=TableTextConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


def run(config: EvaluateConfig, run: Run) -> None:
    """Predicts the scenes of this process; the first process scores those of all, prints and writes the scores."""
    if config.space and not (config.weights or config.features):
        raise InputError("space: names a teacher of weights= or features=; leave it out, or give one of the two")
    paths = find_scenes(config.paths)
    check_names(paths)
    source, words = source_and_words(config)
    out = run.out("evaluate", config.protocol.name)
    method = "encoded" if config.weights else "fused"
    if config.features:
        method = Path(config.features).resolve().name
    with run.processes(join_processes, "cpu", out) as group:
        process, folder = group.process, None
        with fail_together():
            folder = group.folder()
        shared = Path(value_of_first(str(folder)))
        with fail_together():
            benchmark = config.protocol.start(
                Evaluation(
                    words=words,
                    scenes=lambda: (load_scene(path, options=config.data) for path in paths),
                    scene_names=tuple(map(scene_name, paths)),
                    folder=shared,
                    method=method,
                    classes=config.classes,
                    label_map=config.label_map,
                    fusion=config.fusion,
                    localization=config.localize,
                    memory_of=partial(stored_memory, config),
                )
            )
            scenes = scenes_of(config, paths[process.rank :: process.world_size], quiet=not process.is_first)
            predicted: list[SceneResult[Any]] = predict_scenes(benchmark, scenes, source, config.seeds)
        parts = values_of_all(predicted)
        if folder is None:
            return
        # Process k has the k-th scene, and every n-th from there on.
        results = [parts[row % len(parts)][row // len(parts)] for row in range(len(paths))]
        for each in results:
            run.add_seconds(each.seconds)
        report = benchmark.report(results)
        write_report(folder, report, run, page=config.report)
        run.results["gaussians"] = {each.scene: each.gaussians for each in results}
    print_report(out, report, run)


def source_and_words(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of the features, and the words that they are compared with."""
    if not config.features:
        return source_of_head(config) if config.head else teacher_or_encoder(config)
    if config.weights or config.splat or config.teacher != LabelsConfig():
        raise InputError("features: a folder has its own Gaussians and words; leave out weights=, splat= and teacher=")
    folder = folder_of(config.features, scene_name(find_scenes(config.paths)[0]))
    _, words = load_query(load_features(folder), folder, head=config.head, space=config.space, text=config.text)
    return lambda scene: (next(iter(scene.features.values())), {}), words


def teacher_or_encoder(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """Features of a teacher or an encoder, with the words of teacher= and text=, or where neither is given, those of
    the weights."""
    if not config.weights:
        words = _words_of_teacher(config)
        return fusion_source(config.teacher, words, config.fusion), words
    retain_freed_memory()
    encoder = Encoder.load(config.weights, config.encode.device)
    table = find_table(encoder, config.space)
    if table is not None and config.teacher == LabelsConfig() and config.text == TableTextConfig():
        words = words_of_table(table)
    else:
        words = _words_of_teacher(config)
    space = config.space or space_of_words(encoder, words)
    words = with_training_names(words, find_table(encoder, space))
    return encoder_source(encoder, config.encode, space), words


def _words_of_teacher(config: EvaluateConfig) -> Words:
    words = words_of(config.teacher, config.text)
    if words is None:
        raise InputError(f"evaluate: teacher {config.teacher.name} has no text table; give teacher.words= or text=")
    return words


def source_of_head(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """Outputs of an adapter head, and the words that they are compared with."""
    table = getattr(config.teacher, "words", "") if isinstance(config.text, TableTextConfig) else ""
    if not config.weights:
        (measured_head,) = config.teacher.read_heads([config.head], "head")
        words = words_of_head(measured_head, table, config.text)
        return fused_head_source(config.teacher, measured_head, words.space.text_encoder, config.fusion), words
    path = find_heads(file_of_encoder(config.weights))
    if path is None:
        raise InputError(
            f"head={config.head}: no adapter heads lie next to the weights {config.weights}; train with "
            f"heads=[{config.head}]"
        )
    heads = load_heads(path)
    head = find_head(heads, config.head)
    words = words_of_head(head.head, table, config.text)
    retain_freed_memory()
    encoder = Encoder.load(config.weights, config.encode.device)
    source = encoder_source(encoder, config.encode, config.space or heads.space.name)
    return head_source(source, heads, head, words.space.text_encoder), words


def scenes_of(config: EvaluateConfig, paths: Sequence[Path], *, quiet: bool) -> Iterator[tuple[Scene, float]]:
    """Scenes, with the Gaussians and features of a folder where they are stored, and the seconds of loading.

    The features may have been made from other views of the scene, such as all but those that are evaluated; the origin,
    which is the mean of the cameras, is then another one.
    """
    for path in Progress(quiet=config.quiet or quiet)(list(paths), "scenes"):
        start = time.perf_counter()
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        scene = with_fitting_splat(scene, config.splat, config.data)
        seconds = time.perf_counter() - start
        if not config.features:
            yield scene, seconds
            continue
        folder = folder_of(config.features, scene.name)
        stored = load_features(folder)
        if stored.name != scene.name:
            raise InputError(
                f"features: {folder} holds those of scene {stored.name}, and {scene.name} is evaluated; give a folder "
                f"that has the features of each scene in a folder of its name"
            )
        queried, _ = load_query(stored, folder, head=config.head, space=config.space, text=config.text)
        assert queried.gaussians is not None
        means = (queried.gaussians.means + (stored.origin - scene.origin)).astype(np.float32)
        gaussians = replace(queried.gaussians, means=means)
        yield replace(scene, gaussians=gaussians, features=queried.features), seconds


def stored_memory(config: EvaluateConfig, scene: Scene) -> QueryMemory | None:
    """The memory that the features of a scene were read from. Outputs of a head are features of their own; it holds
    those of the teacher."""
    return memory_of(folder_of(config.features, scene.name), scene) if config.features and not config.head else None
