"""`gsencoder memory SCENE teacher=…`: principal queries of Gaussians and the banks that they attend to (M3)."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from shutil import copyfile
from typing import Any

import torch

from gsencoder.app.inputs import load_fusable
from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, counted, error_hint, error_prefix
from gsencoder.core.files import write_picture
from gsencoder.core.logs import LOG_FILE
from gsencoder.core.process import Device, retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.scenes import find_scenes
from gsencoder.data.seeding.points import unit_of
from gsencoder.evaluate.sources import RenderedErrors, RenderedTally
from gsencoder.fusion.folder import MEMORY_FILE, save_memories
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.memory.bank import BankConfig
from gsencoder.models.output_space import check_distinct, name_of_space
from gsencoder.teachers.build import stored_words, words_by_teacher
from gsencoder.text.table import TextTable, file_of_teacher, save_tables
from gsencoder.train.distributed import fail_together, join_processes
from gsencoder.train.loop import TrainerConfig
from gsencoder.train.memory import (
    MemoryConfig,
    MemoryScene,
    memory_training,
    open_memory_scene,
    open_raw_sample,
    prepare_memory,
    train_memory,
    untrained_memory,
)
from gsencoder.train.prepare_scenes import SourceConfig
from gsencoder.train.samples import sample_rows
from gsencoder.types import FeatureSpace, GaussianFeatures, QueryMemory, Scene

DRAWN_FEATURES = 20_000
"""Raw features in a scatter plot, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryCommandConfig(SourceConfig, CommonConfig):
    """Settings of `memory`."""

    paths: tuple[str, ...] = option((), "a scene: views, or a bare splat", metavar="SCENE", required=True, one="scene")
    bank: BankConfig = field(default_factory=BankConfig)
    memory: MemoryConfig = field(default_factory=MemoryConfig)
    train: TrainerConfig = field(default_factory=memory_training)
    weights: str = option(
        "",
        "an encoder whose predictions take the place of fused features; with optimize=false the memory of "
        "an unseen scene is made in one pass; empty = features are fused",
    )
    optimize: bool = option(True, "optimize the queries; false = those of the fused features, without training")
    joint: bool = option(True, "optimize for all teachers at once; false = for one after the other")
    pictures: int = option(
        4,
        "number of views, evenly spaced, of which a pixel and the components that it attends to are drawn, "
        "next to a scatter plot of components and raw features; 0 = no pictures",
        ge=0,
    )
    umap: bool = option(False, "draw the scatter plot by UMAP, too; needs the package umap-learn")
    resume: bool = option(True, "continue an interrupted run; false = start again")
    device: Device = option("auto", "where the scene is prepared and queries are optimized")

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        SourceConfig.__post_init__(self)
        if self.umap:
            if not self.pictures:
                raise InputError("umap: expected pictures=1 or more with umap=true; there is no scatter plot without")
            from gsencoder.infer.memory_pictures import check_umap

            check_umap()
        if not self.optimize and self.memory.init == "random":
            raise InputError("optimize=false: random queries mean nothing without training; give memory.init=fused")


def run(config: MemoryCommandConfig, run: Run) -> None:
    """Prepares a scene for each teacher, optimizes its queries, and writes memories that other commands take as
    features."""
    retain_freed_memory()
    (path,) = find_scenes(config.paths)
    out = run.out(path.name, "memory")
    words = words_by_teacher(config.teachers_by_name, config.text, members=bool(config.teachers))
    with run.processes(join_processes, config.device, out, state="training") as group:
        process, device, work = group.process, group.device, group.work.path
        tables: dict[str, TextTable] = {}
        folder, scene = None, None
        with fail_together():
            folder = group.folder()
            if folder is not None:
                group.take(resume=config.resume)
                unfinished = [path for path in work.glob("queries*") if path.is_dir()]
                if unfinished and not config.optimize:
                    raise InputError(
                        f"optimize=false: {unfinished[0]} holds an optimization that is not finished and would be "
                        "lost; leave optimize=false out to continue it, or give resume=false to start again"
                    )
                scene = load_fusable(
                    path,
                    run,
                    splat=config.splat,
                    data=config.data,
                    seeds=config.seeds,
                    orbits=config.orbits,
                    cameras=config.cameras,
                    blend=config.prepare.fusion.blend,
                    labels=any(each.needs_labels for each in config.teachers_by_name.values()),
                )
                tables = _prepare(scene, words, config, work, device, run)
        scenes = {name: open_memory_scene(work / name) for name in config.teachers_by_name}
        with run.step("train"):
            memories: dict[str, QueryMemory] = {}
            groups = [list(scenes)] if config.joint else [[name] for name in scenes]
            for names in groups if config.optimize else []:
                state = work / ("queries" if config.joint else f"queries.{names[0]}")
                state.mkdir(exist_ok=True)
                group_scenes = {name: scenes[name] for name in names}
                optimized, training = train_memory(
                    group_scenes,
                    config.memory,
                    config.train,
                    work=state,
                    process=process,
                    device=device,
                    track=run.track,
                )
                memories |= optimized
                run.results["steps"] = training.step
                if folder is not None:
                    copyfile(state / LOG_FILE, folder / (LOG_FILE if config.joint else f"log.{names[0]}.csv"))
        if folder is None or scene is None:
            return
        if not config.optimize:
            memories = {name: untrained_memory(each, config.memory, config.train.seed) for name, each in scenes.items()}
        with run.step("score"):
            errors = {name: fit_errors(memories[name], each, config.memory.min_alpha) for name, each in scenes.items()}
        with run.step("write"):
            save_memories(folder, scene, memories, settings(config))
            save_tables(folder, tables, memories)
        if config.pictures:
            from gsencoder.infer.memory_pictures import attention_pictures, component_scatter

            blend = config.prepare.fusion.blend
            with run.step("pictures"), error_hint("give pictures=0 to write the memory without pictures"):
                for name, memory in memories.items():
                    scatter = component_scatter(memory.bank, open_raw_sample(work / name), umap=config.umap)
                    write_picture(folder / f"components.{name}.png", scatter)
                    for view, picture in attention_pictures(memory, scene, views=config.pictures, config=blend):
                        write_picture(folder / f"attention.{name}.view{view:03d}.png", picture)
        files = {name: file_of_teacher(MEMORY_FILE, name if len(memories) > 1 else None) for name in memories}
        figures = {name: _figures(folder / files[name], each, errors[name]) for name, each in memories.items()}
        run.results.update(gaussians=len(next(iter(memories.values()))), teachers=figures)
    for name, each in memories.items():
        run.print(f"{out}: {name}: {_describe(each, errors[name], figures[name]['bytes'])}")


def _prepare(
    scene: Scene,
    words: Mapping[str, Any],
    config: MemoryCommandConfig,
    work: Path,
    device: torch.device,
    run: Run,
) -> dict[str, TextTable]:
    """Prepares a scene for all teachers in folders of their own; the text tables of their spaces."""
    tables, spaces = {}, {}
    with run.step("encode"):
        predicted = predicted_features(scene, config) if config.weights else {}
    for name, teacher_config in config.teachers_by_name.items():
        with error_prefix(f"teacher {name}") if config.teachers else nullcontext(), config.typed_options(name):
            with run.step("teacher"):
                teacher = teacher_config.build(scene, words.get(name))
            spaces[name] = teacher.space
            check_distinct(spaces)
            with run.step("prepare"):
                features = in_space(predicted, teacher.space, config.weights) if config.weights else None
                prepare_memory(
                    scene,
                    teacher,
                    work / name,
                    config.bank,
                    config.prepare,
                    predicted=features,
                    sample=DRAWN_FEATURES if config.pictures else 0,
                    device=device,
                    track=run.track,
                )
            if (table := stored_words(teacher, words.get(name))) is not None:
                tables[name] = table
    return tables


def predicted_features(scene: Scene, config: MemoryCommandConfig) -> dict[str, GaussianFeatures]:
    """The features that an encoder predicts for a scene, by its teachers."""
    assert scene.gaussians is not None
    encoder = Encoder.load(config.weights, config.device)
    encoding = EncodeConfig(device=config.device)
    return encoder.encode_spaces(scene.gaussians, encoding, metres_per_unit=unit_of(scene), up=scene.up)


def in_space(predicted: Mapping[str, GaussianFeatures], space: FeatureSpace, weights: str) -> GaussianFeatures:
    """The predicted features of a teacher's space."""
    name = name_of_space({each: features.space for each, features in predicted.items()}, space, f"weights={weights}")
    return predicted[name]


def fit_errors(memory: QueryMemory, scene: MemoryScene, min_alpha: float) -> RenderedErrors:
    """How far the features that a memory renders in the prepared views are from the teacher's there."""
    prepared, outputs = scene.prepared, scene.outputs
    tally, queries = RenderedTally(memory.mean), torch.from_numpy(memory.queries)
    for view in range(len(prepared.view_names)):
        rows = sample_rows(prepared.view(view), memory.weights > 0, min_alpha)
        b = rows.blend(len(memory))
        rendered = (b.render(queries) / b.alpha[:, None]).numpy()
        target = outputs.restore(rows.targets.numpy())
        if outputs.basis is not None:
            target = target @ outputs.basis.components + outputs.basis.mean
        tally.add(memory.attend(rendered), target)
    return tally.errors()


def _figures(file: Path, memory: QueryMemory, errors: RenderedErrors) -> dict[str, Any]:
    bank, with_features = memory.bank, int((memory.weights > 0).sum())
    return {
        "space": memory.space.describe(),
        "seen": with_features,
        "channels": memory.channels,
        "components": len(bank),
        "threshold": bank.threshold,
        "coverage": bank.coverage,
        "bank_cosine": bank.cosine,
        "fit": asdict(errors),
        "bytes": file.stat().st_size,
        "query_bytes": 2 * memory.channels,
        "features": file.name,
    }


def _describe(memory: QueryMemory, errors: RenderedErrors, size: int) -> str:
    bank = memory.bank
    covered = "every feature has" if bank.coverage == 1 else f"{bank.coverage:.3f} of the features have"
    return (
        f"{counted(len(bank), 'component')} ({covered} one within a cosine of {bank.threshold:.3f}), queries of "
        f"{counted(memory.channels, 'channel')} for {int((memory.weights > 0).sum()):,} Gaussians, {size / 1e6:.3g} "
        f"MB; rendered features have a cosine of {errors.cosine:.3f} with the teacher's, centered {errors.centered:.3f}"
    )
