"""`gsencoder tune DATASET model=FOLDER features=FOLDER`: low-rank adapters of a vision-language model, trained on
questions about scenes and their answers.
"""

import json
import os
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from typing import Any

from gsencoder.app.commands.ask import AskingConfig, build_asker
from gsencoder.app.output import prepared_folder
from gsencoder.app.run import Run
from gsencoder.app.scenes import load_feature_scene
from gsencoder.core.errors import BusyError, InputError, SceneWarning, counted, error_prefix, listed
from gsencoder.core.files import lock_folder, plain
from gsencoder.core.logs import EVENTS_FOLDER, LOG_FILE, read_log
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device, Track
from gsencoder.core.settings import option
from gsencoder.data.labels.questions import Question as TruthQuestion
from gsencoder.data.labels.questions import read_questions
from gsencoder.data.prompts import PROMPTS_FILE, PromptStore
from gsencoder.infer.ask.ask import Asker, Question
from gsencoder.infer.ask.batch import store_prompt
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.localize import select_features
from gsencoder.train.distributed import fail_together, join_processes
from gsencoder.train.tune import TuneConfig, TuningPair, open_processor, save_tuned, tune
from gsencoder.train.vlm import SERVED_FOLDER, TowerLayout, check_peft, link_served
from gsencoder.types import GaussianFeatures


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneCommandConfig(TuneConfig, AskingConfig):
    """Settings of `tune`."""

    paths: tuple[str, ...] = option(
        (),
        "ScanQA's or SQA3D's file of questions, or a folder that has it",
        metavar="DATASET",
        one="file or folder of questions",
        required=True,
    )
    model: str = option(
        "",
        "folder of a vision-language model for transformers; also looked for in GSENCODER_MODELS",
        required=True,
        like_group=True,
    )
    features: str = option(
        "", "a folder with a folder of features for each scene, written by fuse or encode", required=True
    )
    photos: str = option("", "a folder of the scenes, whose photographs are shown in place of renders")
    split: str = option("train", "which of the files of a DATASET folder, by its name")
    scenes: tuple[str, ...] = option((), "scenes to train on, with * and ?; empty = all of DATASET", names=True)
    tokens: str = option(
        "",
        "name of the feature space that is rendered on the grid of the model's vision tower and replaces "
        "its output (Idefics3, SmolVLM, LLaVA); empty = the model looks at the pictures",
    )
    image_side: int = option(768, "longer side of the pictures, as in the vlm.image_side of ask, pixels")
    prepared: Path | None = option(
        None, "folder of prepared prompts, created if missing; empty = OUT.prepared", metavar="PATH"
    )
    prepare_only: bool = option(False, "prepare the prompts and stop")
    resume: bool = option(True, "continue an interrupted run; false = start again")
    tensorboard: bool = option(False, "write TensorBoard events in addition to log.csv")
    device: Device = option("auto", "where the model computes")

    def __post_init__(self) -> None:
        AskingConfig.__post_init__(self)
        VlmConfig(image_side=self.image_side)


def run(config: TuneCommandConfig, run: Run) -> None:
    """Prepares prompts, trains adapters on their answers, and writes these as peft does."""
    check_peft()
    out = run.out("tune")
    prepared = prepared_folder(config.prepared, out)
    questions = read_dataset(Path(config.paths[0]), config.split, config.scenes)
    model = find_file(config.model, "model", folder=True)
    _, _, layout = open_processor(model, with_tokens=bool(config.tokens))
    with run.processes(join_processes, config.device, out, state="training") as group:
        folder, work = None, group.work.path
        with fail_together(), run.step("prepare"):
            if not config.prepare_only:
                folder = group.folder()
            if group.process.is_first:
                prepare_prompts(questions, config, layout, prepared, track=run.track)
        if config.prepare_only:
            run.print(f"{prepared}: prompts of {counted(len(questions), 'question')}")
            return
        with fail_together():
            group.take(resume=config.resume)
        store = PromptStore(prepared)
        pairs = []
        for each, key in zip(questions, prompt_keys(questions, config, layout), strict=True):
            if key not in store.prompts:
                raise InputError(f"{prepared}: has no prompt of question {each.id}; another run has changed the folder")
            name = f"question {each.id} ({each.scene})"
            pairs.append(TuningPair(name=name, prompt=store.prompts[key], answers=each.answers))
        with run.step("train"):
            result = tune(
                pairs,
                store,
                model,
                config,
                work=work,
                process=group.process,
                device=group.device,
                tensorboard=config.tensorboard,
                track=run.track,
            )
        if folder is None:
            return
        with run.step("write"):
            save_tuned(folder, result)
            if not config.tokens:
                # A server has no rendered features to give.
                link_served(folder, model)
            shutil.copy(work / LOG_FILE, folder / LOG_FILE)
            if (work / EVENTS_FOLDER).is_dir():
                shutil.copytree(work / EVENTS_FOLDER, folder / EVENTS_FOLDER)
        losses = [float(row["loss"]) for row in read_log(folder / LOG_FILE) if row.get("loss")]
        parameters = list(result.network.parameters())
        run.results.update(
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
    course = f"went from {losses[0]:.3f} to {losses[-1]:.3f}"
    if len(losses) == 1:
        course = f"was {losses[0]:.3f} in the log's only row (train.log_every={config.train.log_every})"
    run.print(
        f"{out}: {counted(result.state.step, 'step')} on {counted(len(questions), 'question')}, "
        f"{counted(run.results['trained'], 'parameter')} of adapters; the loss of an answer's token {course}"
    )
    if not config.tokens:
        run.print(f"{out}: transformers serve {out / SERVED_FOLDER}")


def read_dataset(path: Path, split: str, scenes: Sequence[str]) -> tuple[TruthQuestion, ...]:
    """Questions with answers of ScanQA or SQA3D, by their scenes, of a file or of that in a folder with `split` in its
    name; `scenes` are names with * and ?, none = all."""
    questions = read_questions(_dataset_file(path, split))
    for pattern in scenes:
        if not any(fnmatchcase(each.scene, pattern) for each in questions):
            raise InputError(f"scenes: {path} has no question about a scene called {pattern}")
    questions = tuple(each for each in questions if any(fnmatchcase(each.scene, name) for name in scenes or ["*"]))
    if not questions:
        raise InputError(f"{path}: holds no questions")
    for each in questions:
        if not all(answer.strip() for answer in each.answers):
            raise InputError(f"{path}: question {each.id}: an answer is empty; mend or remove it")
    return tuple(sorted(questions, key=lambda each: each.scene))


def _dataset_file(path: Path, split: str) -> Path:
    if not path.is_dir():
        return path
    files = sorted(each for each in path.glob("*.json") if "annotations" not in each.name)
    if len(files) > 1:
        files = [each for each in files if split in each.stem.lower().split("_")]
    if len(files) != 1:
        names = sorted(each.name for each in path.glob("*.json"))
        raise InputError(
            f"{path}: expected one file of ScanQA's or SQA3D's questions with {split} in its name, got "
            f"{listed([each.name for each in files]) or 'none'}"
            + (f" among {listed(names)}" if names else "")
            + "; give the file itself, or split="
        )
    return files[0]


def scene_folders(questions: Sequence[TruthQuestion], folder: Path, option: str) -> dict[str, Path]:
    """The folder of each scene that is asked about."""
    if not folder.is_dir():
        raise InputError(f"{option}: {folder} is no folder; expected one with a folder for each scene")
    names = list(dict.fromkeys(each.scene for each in questions))
    missing = [name for name in names if not (folder / name).is_dir()]
    if missing:
        raise InputError(
            f"{option}: {folder} has no folder for {len(missing)} of {len(names)} scenes that are asked about: "
            f"{listed(missing, 3)}; make them, or choose scenes with scenes="
        )
    return {name: folder / name for name in names}


def prepare_prompts(
    questions: Sequence[TruthQuestion],
    config: TuneCommandConfig,
    layout: TowerLayout | None,
    folder: Path,
    *,
    track: Track,
) -> None:
    """Writes the prompts that are not in the folder yet; it is created, and locked meanwhile.

    Warns:
        SceneWarning: questions that name nothing, once with their number.
    """
    folders = scene_folders(questions, Path(config.features), "features")
    photos = scene_folders(questions, Path(config.photos), "photos") if config.photos else {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = {each.name for each in folder.iterdir()}
        if PROMPTS_FILE not in names and names - {"pictures", "tokens"}:
            raise InputError(f"prepared: {folder} holds something else; give another folder")
        lock = lock_folder(folder)
    except BlockingIOError:
        raise BusyError(f"prepared: {folder}: another run prepares prompts here now; wait for it") from None
    except OSError as error:
        raise InputError(f"prepared: {folder} cannot be written: {error.strerror or error}") from error
    try:
        store = PromptStore(folder)
        scene, asker, features = "", None, None
        messages: list[str] = []
        keys = prompt_keys(questions, config, layout)
        for each, key in track(list(zip(questions, keys, strict=True)), "preparing prompts"):
            if key in store.prompts:
                continue
            with error_prefix(f"question {each.id}"):
                if asker is None or scene != each.scene:
                    scene = each.scene
                    asker, features = _asker(folders[scene], str(photos.get(scene, "")), config)
                messages += _store(store, key, asker, each, features, layout)
        if messages:
            warnings.warn(f"{len(messages)} of {len(questions)} questions: {messages[0]}", SceneWarning, stacklevel=2)
    finally:
        if lock is not None:
            os.close(lock)


def prompt_keys(questions: Sequence[TruthQuestion], config: TuneCommandConfig, layout: TowerLayout | None) -> list[str]:
    """A key for each question, of all that its prompt is made from; changed files of a scene are noticed by their sizes
    and times."""
    names = ("words", "space", "head", "ask", "choose", "localize", "data", "text", "tokens", "image_side")
    values = {name: plain(getattr(config, name)) for name in names} | {"layout": plain(layout)}
    recipe = json.dumps(values, sort_keys=True)
    roots = [Path(root) for root in (config.features, config.photos) if root]
    states = {scene: [_state(root / scene) for root in roots] for scene in {each.scene for each in questions}}
    made_from = ([each.situated_text, states[each.scene], recipe] for each in questions)
    return [sha256(json.dumps(values).encode()).hexdigest()[:32] for values in made_from]


def _state(folder: Path) -> list[list[Any]]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [[str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns] for path in files]


def _asker(folder: Path, photos: str, config: TuneCommandConfig) -> tuple[Asker, GaussianFeatures | None]:
    """What asks about a scene, and the features that are rendered as tokens."""
    scene = load_feature_scene(folder, photos, config.data)
    features = None
    if config.tokens:
        with error_prefix(f"tokens={config.tokens}"):
            features = select_features(scene, config.tokens)[1]
    return build_asker(config, VlmConfig(image_side=config.image_side), scene, folder), features


def _store(
    store: PromptStore,
    key: str,
    asker: Asker,
    question: TruthQuestion,
    features: GaussianFeatures | None,
    layout: TowerLayout | None,
) -> list[str]:
    """Writes one prompt; what was warned of."""
    of_tower: dict[str, Any] = {} if layout is None else {"grid": layout.grid, "fit": layout.fit}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        store_prompt(store, key, asker, Question(text=question.situated_text), features=features, **of_tower)
    for each in caught:
        if not issubclass(each.category, SceneWarning):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return [str(each.message) for each in caught if issubclass(each.category, SceneWarning)][:1]
