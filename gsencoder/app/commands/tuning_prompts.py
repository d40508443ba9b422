"""The questions that `tune` trains on, and their prompts, prepared once in a folder that runs can share."""

import json
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from typing import Any

from gsencoder.app.commands.asker import asker_of
from gsencoder.app.commands.shown_scene import shown_scene
from gsencoder.core.errors import BusyError, InputError, SceneWarning, about, listed
from gsencoder.core.files import lock_folder, plain
from gsencoder.core.process import Track
from gsencoder.data.labels.questions import Question as TruthQuestion
from gsencoder.data.labels.questions import read_questions
from gsencoder.data.prompts import PROMPTS_FILE, PromptStore
from gsencoder.data.scenes import SceneConfig
from gsencoder.infer.ask.ask import AskConfig, Asker, Question
from gsencoder.infer.ask.batch import store_prompt
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.localize import LocalizeConfig, select_features
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.text.vocabulary import TextConfig
from gsencoder.train.tune import TuningPair
from gsencoder.train.vlm import TowerLayout
from gsencoder.types import GaussianFeatures


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptRecipe:
    """How questions become prompts: the settings of `ask`, and the tower whose output rendered features replace.

    Attributes:
        words, space, head: see the options of `ask`.
        ask, choose, localize, data, text, vlm: sections of `ask`.
        tokens: name of the features that are rendered on the tower's grid; empty = none.
        layout: of the tower's output, with `tokens`.
    """

    words: str
    space: str
    head: str
    ask: AskConfig
    choose: ViewsConfig
    localize: LocalizeConfig
    data: SceneConfig
    text: TextConfig
    vlm: VlmConfig
    tokens: str
    layout: TowerLayout | None

    def to_json(self) -> dict[str, Any]:
        """All that prompts depend on besides scene and question."""
        names = ("words", "space", "head", "ask", "choose", "localize", "data", "text", "tokens", "layout")
        values = {name: plain(getattr(self, name)) for name in names}
        return values | {"image_side": self.vlm.image_side, "image_format": self.vlm.image_format}


def read_dataset(path: Path, split: str, scenes: Sequence[str]) -> tuple[TruthQuestion, ...]:
    """Questions with answers of ScanQA or SQA3D, by their scenes, of one file or of the one in a folder.

    Args:
        path: file or folder.
        split: a part of the file's name in a folder with several.
        scenes: names of scenes, with * and ?; empty = all.

    Raises:
        InputError: no such file, several, no questions about these scenes, or answers that are missing or empty.
    """
    questions = read_questions(_dataset_file(path, split))
    if scenes:
        for pattern in scenes:
            if not any(fnmatchcase(each.scene, pattern) for each in questions):
                raise InputError(f"scenes: {path} has no question about a scene called {pattern}")
        questions = tuple(each for each in questions if any(fnmatchcase(each.scene, name) for name in scenes))
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
    """The folder of each scene that is asked about.

    Raises:
        InputError: scenes without one.
    """
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
    features: Path,
    photos: str,
    recipe: PromptRecipe,
    folder: Path,
    *,
    track: Track,
) -> None:
    """Writes the prompts that are not in the folder yet; it is locked meanwhile.

    Args:
        questions: by their scenes.
        features: with a folder for each scene.
        photos: the same for photographs; empty = renders are shown.
        recipe: how questions become prompts.
        folder: created if it does not exist.
        track: progress.

    Raises:
        InputError: a scene or question that cannot be used, or the folder holds something else or is used by another
            run.

    Warns:
        SceneWarning: questions that name nothing, once with their number.
    """
    folders = scene_folders(questions, features, "features")
    photo_folders = scene_folders(questions, Path(photos), "photos") if photos else {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / PROMPTS_FILE).is_file() and any(
            each.name not in ("pictures", "tokens") for each in folder.iterdir()
        ):
            raise InputError(f"prepared: {folder} holds something else; give another folder")
        lock = lock_folder(folder)
    except BlockingIOError:
        raise BusyError(f"prepared: {folder}: another run prepares prompts here now; wait for it") from None
    except OSError as error:
        raise InputError(f"prepared: {folder} cannot be written: {error.strerror or error}") from error
    try:
        store = PromptStore(folder)
        keys = prompt_keys(questions, features, photos, recipe)
        current: tuple[str, Asker, GaussianFeatures | None] | None = None
        messages: list[str] = []
        for each, key in track(list(zip(questions, keys, strict=True)), "preparing prompts"):
            if key in store.prompts:
                continue
            with about(f"question {each.id}"):
                if current is None or current[0] != each.scene:
                    current = (each.scene, *_asker(folders[each.scene], str(photo_folders.get(each.scene, "")), recipe))
                messages += _store(store, key, current[1], each, current[2], recipe)
        if messages:
            warnings.warn(f"{len(messages)} of {len(questions)} questions: {messages[0]}", SceneWarning, stacklevel=2)
    finally:
        if lock is not None:
            os.close(lock)


def tuning_pairs(
    questions: Sequence[TruthQuestion], features: Path, photos: str, recipe: PromptRecipe, store: PromptStore
) -> list[TuningPair]:
    """Questions with their prompts and answers; arguments are those of `prepare_prompts`.

    Raises:
        InputError: a prompt is missing.
    """
    pairs = []
    for each, key in zip(questions, prompt_keys(questions, features, photos, recipe), strict=True):
        if key not in store.prompts:
            raise InputError(f"{store.folder}: has no prompt of question {each.id}; another run has changed the folder")
        name = f"question {each.id} ({each.scene})"
        pairs.append(TuningPair(name=name, prompt=store.prompts[key], answers=each.answers))
    return pairs


def prompt_keys(questions: Sequence[TruthQuestion], features: Path, photos: str, recipe: PromptRecipe) -> list[str]:
    """A key for each question, of all that its prompt is made from; changed files of a scene are noticed by their sizes
    and times."""
    of_recipe = json.dumps(recipe.to_json(), sort_keys=True)
    scenes = {}
    for name in {each.scene for each in questions}:
        folders = [features / name, *([Path(photos) / name] if photos else [])]
        scenes[name] = [_state(folder) for folder in folders]
    made_from = ([each.situated_text, scenes[each.scene], of_recipe] for each in questions)
    return [sha256(json.dumps(values).encode()).hexdigest()[:32] for values in made_from]


def _state(folder: Path) -> list[list[Any]]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [[str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns] for path in files]


def _asker(folder: Path, photos: str, recipe: PromptRecipe) -> tuple[Asker, GaussianFeatures | None]:
    """What asks about a scene, and the features that are rendered as tokens."""
    scene = shown_scene(folder, photos, recipe.data)
    features = None
    if recipe.tokens:
        with about(f"tokens={recipe.tokens}"):
            features = select_features(scene, recipe.tokens)[1]
    return asker_of(recipe, scene, folder), features


def _store(
    store: PromptStore,
    key: str,
    asker: Asker,
    question: TruthQuestion,
    features: GaussianFeatures | None,
    recipe: PromptRecipe,
) -> list[str]:
    """Writes one prompt; what was warned of."""
    layout = recipe.layout
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        store_prompt(
            store,
            key,
            asker,
            Question(text=question.situated_text),
            features=features,
            grid=(1, 1) if layout is None else layout.grid,
            fit="stretch" if layout is None else layout.fit,
        )
    for each in caught:
        if not issubclass(each.category, SceneWarning):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return [str(each.message) for each in caught if issubclass(each.category, SceneWarning)][:1]
