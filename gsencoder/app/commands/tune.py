"""`gsencoder tune DATASET model=FOLDER features=FOLDER`: low-rank adapters of a vision-language model, trained on
questions about scenes and their answers."""

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from gsencoder.app.commands.tuning_prompts import PromptRecipe, prepare_prompts, read_dataset, tuning_pairs
from gsencoder.app.commands.words_options import WordsOptions
from gsencoder.app.runs.output_folder import output_folder, refuse_to_replace_inputs
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.runs.work_folder import WorkFolder, folder_beside, prepared_folder
from gsencoder.app.settings.config import settings
from gsencoder.core.errors import InputError, counted
from gsencoder.core.logs import EVENTS_FOLDER, LOG_FILE, read_log
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device
from gsencoder.data.prompts import PromptStore
from gsencoder.data.scenes import SceneConfig
from gsencoder.infer.ask.ask import AskConfig
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.train.distributed import fail_together, join_processes
from gsencoder.train.tune import TuneConfig, open_processor, save_tuned, tune
from gsencoder.train.vlm import SERVED_FOLDER, check_peft, check_targets, link_served


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneCommandConfig(TuneConfig, WordsOptions):
    """Settings of `tune`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={
            "help": "ScanQA's or SQA3D's file of questions, or a folder that has it",
            "metavar": "DATASET",
            "required": True,
        },
    )
    model: str = field(
        default="",
        metadata={
            "help": "folder of a vision-language model for transformers; also looked for in GSENCODER_MODELS",
            "required": True,
            "like_group": True,
        },
    )
    features: str = field(
        default="",
        metadata={
            "help": "a folder with a folder of features for each scene, written by fuse or encode",
            "required": True,
        },
    )
    photos: str = field(
        default="", metadata={"help": "a folder of the scenes, whose photographs are shown in place of renders"}
    )
    split: str = field(default="train", metadata={"help": "which of the files of a DATASET folder, by its name"})
    scenes: tuple[str, ...] = field(
        default=(),
        metadata={"names": True, "help": "scenes to train on, with * and ?; empty = all of DATASET"},
    )
    tokens: str = field(
        default="",
        metadata={
            "help": "name of the feature space that is rendered on the grid of the model's vision tower and replaces "
            "its output (Idefics3, SmolVLM, LLaVA); empty = the model looks at the pictures"
        },
    )
    project: bool | None = field(
        default=None,
        metadata={
            "help": "with tokens=: train a linear layer from the features to the tower's channels; left out: where "
            "their numbers differ"
        },
    )
    image_side: int = field(
        default=768, metadata={"help": "longer side of the pictures, as in the vlm.image_side of ask, pixels"}
    )
    image_format: Literal["jpeg", "png"] = field(
        default="jpeg", metadata={"help": "of the pictures, as in the vlm.image_format of ask"}
    )
    prepared: Path | None = field(
        default=None,
        metadata={"help": "folder of prepared prompts, created if missing; empty = OUT.prepared", "metavar": "PATH"},
    )
    prepare_only: bool = field(default=False, metadata={"help": "prepare the prompts and stop"})
    resume: bool = field(default=True, metadata={"help": "continue an interrupted run; false = start again"})
    tensorboard: bool = field(default=False, metadata={"help": "write TensorBoard events in addition to log.csv"})
    device: Device = field(default="auto", metadata={"help": "where the model computes"})
    ask: AskConfig = field(default_factory=AskConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        TuneConfig.__post_init__(self)
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one file or folder of questions, got {len(self.paths)}")
        if self.project is not None and not self.tokens:
            raise InputError("project: is of rendered features; give tokens=, too")
        VlmConfig(image_side=self.image_side, image_format=self.image_format)


def run(config: TuneCommandConfig, summary: Summary) -> None:
    """Prepares prompts, trains adapters on their answers, and writes these as peft does."""
    check_peft()
    out = config.out or Path("outputs") / "tune"
    work = folder_beside(out, "training")
    prepared = prepared_folder(config.prepared, out, work)
    questions = read_dataset(Path(config.paths[0]), config.split, config.scenes)
    model, features = find_file(config.model, "model", folder=True), Path(config.features)
    model_config, _, layout = open_processor(model, with_tokens=bool(config.tokens))
    check_targets(model_config, config.lora.targets)
    recipe = PromptRecipe(
        words=config.words,
        space=config.space,
        head=config.head,
        ask=config.ask,
        choose=config.choose,
        localize=config.localize,
        data=config.data,
        text=config.text,
        vlm=VlmConfig(image_side=config.image_side, image_format=config.image_format),
        tokens=config.tokens,
        layout=layout,
    )
    with (
        WorkFolder(work) as state,
        join_processes(config.device, settings=settings(config)) as (process, device),
        ExitStack() as results,
    ):
        track = Progress(quiet=config.quiet or not process.is_first)
        folder = None
        with fail_together(), summary.step("prepare"):
            if process.is_first:
                if not config.prepare_only:
                    folder = results.enter_context(output_folder(out, overwrite=config.overwrite, summary=summary))
                prepare_prompts(questions, features, config.photos, recipe, prepared, track=track)
        if config.prepare_only:
            console(config.quiet or not process.is_first).print(
                f"{prepared}: prompts of {counted(len(questions), 'question')}"
            )
            return
        with fail_together():
            if process.is_first:
                refuse_to_replace_inputs(work, settings(config))
                state.take(anew=not config.resume)
        store = PromptStore(prepared)
        pairs = tuning_pairs(questions, features, config.photos, recipe, store)
        with summary.step("train"):
            result = tune(
                pairs,
                store,
                model,
                config,
                project=config.project,
                work=state.path,
                process=process,
                device=device,
                tensorboard=config.tensorboard,
                track=track,
            )
        if folder is None:
            return
        with summary.step("write"):
            save_tuned(folder, result)
            if not config.tokens:
                # A server has no rendered features to give.
                link_served(folder, model)
            shutil.copy(state.path / LOG_FILE, folder / LOG_FILE)
            if (state.path / EVENTS_FOLDER).is_dir():
                shutil.copytree(state.path / EVENTS_FOLDER, folder / EVENTS_FOLDER)
        losses = [float(row["loss"]) for row in read_log(folder / LOG_FILE) if row.get("loss")]
        parameters = list(result.network.parameters())
        summary.results.update(
            questions=len(questions),
            scenes=len({each.scene for each in questions}),
            steps=result.state.step,
            seconds=result.state.seconds,
            parameters=sum(each.numel() for each in parameters),
            trained=sum(each.numel() for each in parameters if each.requires_grad),
            first_loss=losses[0],
            last_loss=losses[-1],
            adapters="adapter_model.safetensors",
            log=LOG_FILE,
        )
    screen = console(config.quiet)
    trained = summary.results["trained"]
    screen.print(
        f"{out}: {counted(result.state.step, 'step')} on {counted(len(questions), 'question')}, "
        f"{counted(trained, 'parameter')} of adapters; {_told_losses(losses, config.train.log_every)}"
    )
    if not config.tokens:
        screen.print(f"{out}: transformers serve {out / SERVED_FOLDER}")


def _told_losses(losses: Sequence[float], log_every: int) -> str:
    """How the loss of an answer's token went, by the rows of the log."""
    if len(losses) == 1:
        return f"the loss of an answer's token was {losses[0]:.3f} in the log's only row (train.log_every={log_every})"
    return f"the loss of an answer's token went from {losses[0]:.3f} to {losses[-1]:.3f}"
