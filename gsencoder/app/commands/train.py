"""`gsencoder train SCENE… out=FOLDER`: distil a teacher into an encoder that needs neither photographs nor the
teacher."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.output import prepared_folder
from gsencoder.app.run import Run
from gsencoder.core.logs import EVENTS_FOLDER, LOG_FILE
from gsencoder.core.process import Device, retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.scenes import find_scenes
from gsencoder.fusion.basis import basis_figures, describe_basis, total_fit
from gsencoder.fusion.measured_heads import HeadSet, save_heads
from gsencoder.models.encoder import save_weights
from gsencoder.models.output_space import HEADS_FILE, WEIGHTS_FILE, OutputSpace
from gsencoder.text.table import save_tables
from gsencoder.train.distributed import fail_together, join_processes
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE
from gsencoder.train.prepare import dataset_heads, required_heads, teacher_of_heads
from gsencoder.train.prepare_scenes import split_scenes
from gsencoder.train.prepared import PreparedScene
from gsencoder.train.run import SceneValidator, TrainConfig, Training, check_start, fit, prepare


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainCommandConfig(TrainConfig, CommonConfig):
    """Settings of `train`."""

    has_experiments: ClassVar[bool] = True

    paths: tuple[str, ...] = option((), "scenes, or folders of scenes", metavar="SCENE", required=True)
    holdout: tuple[str, ...] = option(
        (),
        "names of scenes for validation, with * and ? as in file names; [] = none, where an experiment has some",
        names=True,
    )
    split: Path | None = option(
        None,
        "file of the names of the scenes to train on, one a line, such as scannetv2_train.txt; empty = all "
        "that are not held out",
        metavar="PATH",
    )
    holdout_split: Path | None = option(
        None, "file of the names of scenes for validation, in place of holdout=", metavar="PATH"
    )
    prepared: Path | None = option(
        None, "folder of prepared scenes, created if missing; empty = OUT.prepared", metavar="PATH"
    )
    prepare_only: bool = option(False, "prepare the scenes and stop")
    resume: bool = option(True, "continue an interrupted run; false = start again")
    store: Literal["float16", "float32"] = option("float16", "type of the written weights and words")
    device: Device = option("auto", "where scenes are prepared and the encoder computes")


def run(config: TrainCommandConfig, run: Run) -> None:
    """Prepares scenes, trains, and writes weights, log and scores into out=."""
    retain_freed_memory()
    out = run.out("train")
    prepared = prepared_folder(config.prepared, out)
    training, held_out = split_scenes(find_scenes(config.paths), config.holdout, config.split, config.holdout_split)
    words = config.load_words()
    with run.processes(join_processes, config.device, out, state="training") as group:
        process, device, folder = group.process, group.device, None
        with fail_together():
            if not config.prepare_only:
                folder = group.folder()
                if folder is not None:
                    check_start(config, group.work.path / TRAINING_CHECKPOINT_FILE if config.resume else None)
        with run.step("prepare"):
            datasets = prepare(
                training, held_out, words, config, prepared, process=process, device=device, track=run.track
            )
            heads_asked = required_heads(config.heads, config.teachers_by_name)
            heads = dataset_heads(datasets[teacher_of_heads(config.teachers_by_name, heads_asked)], heads_asked)
        if config.prepare_only:
            run.print(f"{prepared}: {len(training)} scenes to train on, {len(held_out)} for validation")
            run.print(*(f"{prepared}: {head.describe()}" for head in heads.heads))
            return
        with fail_together():
            group.take(resume=config.resume)
        with run.step("train"):
            result = fit(
                datasets,
                training,
                held_out,
                words,
                config,
                work=group.work.path,
                process=process,
                device=device,
                validate=validator(config) if held_out else None,
                track=run.track,
            )
        if folder is None:
            return
        figures = {
            name: encoder_basis_figures(
                result.outputs.by_teacher[name], dataset.scenes([path.name for path in held_out])
            )
            for name, dataset in datasets.items()
        }
        write_results(folder, group.work.path, result, figures, heads, config, run)
    scores = ", ".join(f"{name} {value:.3f}" for name, value in result.scores.items()) or "not validated"
    run.print(f"{out}: {result.state.step} steps in {result.state.seconds / 60:.1f} minutes; {scores}")
    for name, of_teacher in figures.items():
        of = f" for {name}" if len(figures) > 1 else ""
        run.print(f"{out}: basis{of}: {describe_basis(of_teacher, 'held-out scenes')}")
    run.print(*(f"{out}: {head.describe()}" for head in heads.heads))


def validator(config: TrainCommandConfig) -> SceneValidator:
    """The accuracy of names, by an encoder that computes as the training does."""
    from gsencoder.evaluate.validation import validate_names
    from gsencoder.infer.encode import EncodeConfig

    return partial(validate_names, config=EncodeConfig(precision=config.train.precision, device=config.device))


def encoder_basis_figures(outputs: OutputSpace, held_out: Sequence[PreparedScene]) -> dict[str, int | float]:
    """The figures of an encoder's basis, with those of the teacher's vectors in held-out scenes."""
    sums = [each for scene in held_out if (each := scene.projections()) is not None]
    of_others = total_fit(sums).figures() if sums and outputs.basis is not None else {}
    return {**basis_figures(outputs.basis, outputs.channels), **of_others}


def write_results(
    folder: Path,
    work: Path,
    result: Training,
    figures: dict[str, dict[str, int | float]],
    heads: HeadSet,
    config: TrainCommandConfig,
    run: Run,
) -> None:
    """Writes weights, words, heads, log and pictures; scores and the figures of each basis go into weights and
    summary."""
    steps, seconds = result.state.step, result.state.seconds
    parameters = sum(value.numel() for value in result.encoder.parameters())
    provenance = {"settings": settings(config), "steps": steps, "seconds": seconds, "validation": result.scores}
    provenance["basis"] = figures if len(figures) > 1 else next(iter(figures.values()))
    save_weights(folder / WEIGHTS_FILE, result.encoder, result.outputs, provenance, dtype=config.store)
    save_tables(folder, result.tables, result.outputs.by_teacher, dtype=config.store)
    if heads.heads:
        save_heads(folder / HEADS_FILE, heads)
    shutil.copy(work / LOG_FILE, folder / LOG_FILE)
    for name in (EVENTS_FOLDER, "validation"):
        if (work / name).is_dir():
            shutil.copytree(work / name, folder / name)
    run.results.update(
        steps=steps,
        seconds=seconds,
        parameters=parameters,
        validation=result.scores,
        basis=provenance["basis"],
        heads={head.name: head.figures() for head in heads.heads},
        weights=WEIGHTS_FILE,
        log=LOG_FILE,
    )
