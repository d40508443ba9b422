"""Inputs that several commands read: scenes to fuse, features to query, words, and questions about scenes."""

import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from gsencoder.app.run import Run
from gsencoder.app.scenes import load_words, memory_of, queried_scene, shown_scene, with_reported_up
from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.data.check.scene_check import warn_of_faults
from gsencoder.data.scenes import DistinctPaths, SceneConfig, kind_of_path, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.cameras import INSIDE, CamerasOfSplat, with_explained_views
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.fusion.folder import holds_features, load_features, table_path
from gsencoder.infer.ask.ask import AskConfig, Asker
from gsencoder.infer.ask.questions import SetQuestion, caption_question
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.views.targets import ViewsConfig, best_boxes
from gsencoder.render import BlendConfig
from gsencoder.text.vocabulary import (
    TableTextConfig,
    TextConfig,
    Words,
    closed_table,
)
from gsencoder.types import GaussianFeatures, QueryMemory, Scene


@runtime_checkable
class AskerSettings(Protocol):
    """The settings of an asker, which are those options of `ask`."""

    @property
    def words(self) -> str: ...
    @property
    def space(self) -> str: ...
    @property
    def head(self) -> str: ...
    @property
    def ask(self) -> AskConfig: ...
    @property
    def choose(self) -> ViewsConfig: ...
    @property
    def localize(self) -> LocalizeConfig: ...
    @property
    def data(self) -> SceneConfig: ...
    @property
    def text(self) -> TextConfig: ...
    @property
    def vlm(self) -> VlmConfig: ...


def load_asker(settings: AskerSettings, folder: Path, photos: str) -> Asker:
    """The scene of a folder of features, and what is asked about it is looked up with.

    Args:
        photos: the scene that was fused, whose photographs are shown; empty = renders are.
    """
    return asker_of(settings, shown_scene(folder, photos, settings.data), folder)


def asker_of(settings: AskerSettings, scene: Scene, folder: Path) -> Asker:
    """The asker of a scene that was loaded from a folder of features. A box can be asked about without words."""
    words: Words | None
    if settings.head:
        scene, words = queried_scene(
            scene, folder, head=settings.head, space=settings.space, words_file=settings.words, text=settings.text
        )
    else:
        space = select_features(scene, settings.space or None)[1].space
        has_own_words = settings.words or not isinstance(settings.text, TableTextConfig)
        has_words = has_own_words or table_path(folder, space.text_encoder) is not None
        words = load_words(folder, space, settings.words, settings.text) if has_words else None
    return Asker(
        scene,
        words,
        space=None if settings.head else settings.space or None,
        config=settings.ask,
        localization=settings.localize,
        views=settings.choose,
        vlm=settings.vlm,
    )


def folder_of(features: str, scene: str) -> Path:
    """The folder of a scene's features: the one of its name in a folder of several, else the folder itself."""
    inner = Path(features) / scene
    return inner if inner.is_dir() else Path(features)


def stored_words(
    features: str, scene: str, *, head: str = "", space: str = "", text: TextConfig = TableTextConfig()
) -> Words:
    """The words that lead into stored features: those beside the features of a scene, or of `text`.

    Args:
        features: their folder, or one with a folder for each scene.
        head: adapter head whose outputs are asked; empty = the features.
        space: name of the features where there are several.
    """
    folder = folder_of(features, scene)
    return queried_scene(load_features(folder), folder, head=head, space=space, text=text)[1]


def with_stored_features(
    scenes: Iterable[tuple[Scene, float]],
    features: str,
    *,
    head: str = "",
    space: str = "",
    text: TextConfig = TableTextConfig(),
) -> Iterator[tuple[Scene, float]]:
    """Labeled scenes with the Gaussians and features of a folder, as `load_scenes` yields scenes.

    The features may have been made from other views of the scene, such as all but those that are evaluated; the origin,
    which is the mean of the cameras, is then another one.
    """
    for scene, seconds in scenes:
        folder = folder_of(features, scene.name)
        stored = load_features(folder)
        if stored.name != scene.name:
            raise InputError(
                f"features: {folder} holds those of scene {stored.name}, and {scene.name} is evaluated; give a folder "
                f"that has the features of each scene in a folder of its name"
            )
        queried, _ = queried_scene(stored, folder, head=head, space=space, text=text)
        assert queried.gaussians is not None
        means = (queried.gaussians.means + (stored.origin - scene.origin)).astype(np.float32)
        gaussians = replace(queried.gaussians, means=means)
        yield replace(scene, gaussians=gaussians, features=queried.features), seconds


def stored_source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
    """The source of features that came with the scene."""
    return next(iter(scene.features.values())), {}


def stored_memory(features: str, scene: Scene) -> QueryMemory | None:
    """The memory that the features of a scene were read from; None where features are stored themselves."""
    return memory_of(folder_of(features, scene.name), scene)


def scene_folders(paths: Sequence[str], scenes: Collection[str]) -> list[Path]:
    """The folders of features at paths: each path, or the folders in it that are called like one of the scenes."""
    folders = DistinctPaths()
    for path in map(Path, paths):
        inner = [path] if holds_features(path) else []
        if not inner and path.is_dir():
            inner = sorted(filter(holds_features, path.iterdir()))
        if not inner:
            raise InputError(
                f"{path}: {kind_of_path(path)}; expected a folder of features, which `gsencoder fuse`, `encode`, "
                "`memory` and `pack` write, or a folder of such folders"
            )
        folders.add(folder for folder in inner if folder is path or folder.name in scenes)
    return list(folders.paths)


def photos_of(photos: str, features: Path) -> str:
    """The scene with the photographs of a folder of features: of a folder of scenes the one that is called like it."""
    return str(folder_of(photos, features.name)) if photos else ""


def localized_captions(asker: Asker, names: Sequence[str]) -> tuple[SetQuestion, ...]:
    """Questions for captions of the best boxes of names, `ask.boxes` for each; names that no table knows have none.

    Warns:
        SceneWarning: names that no table knows, or none of which has a box.
    """
    if asker.words is None:
        raise InputError(f"proposals=localize: no words lead into the features of {asker.scene.name}; give words=")
    table = closed_table(asker.words)
    known_names = [name for name in names if table is None or table.find(name) is not None]
    if len(known_names) < len(names):
        unknown = [name for name in names if name not in known_names]
        warnings.warn(
            f"proposals=localize: {asker.scene.name}: the text table lacks {len(unknown)} of {len(names)} names of "
            f"objects, of which there are no captions: {listed(unknown)}; give a text tower (text=)",
            SceneWarning,
            stacklevel=2,
        )
    if not known_names:
        return ()
    localization = localize(asker.scene, known_names, asker.words, asker.localization, space=asker.space)
    questions = []
    for number, box in enumerate(best_boxes(localization, asker.config.boxes)):
        low, high = box.aabb_min.tolist(), box.aabb_max.tolist()
        aabb = ((low[0], low[1], low[2]), (high[0], high[1], high[2]))
        keys = {"obj_prob": [1 - float(box.probability), float(box.probability)]}
        if (box.aabb_min < box.aabb_max).all():
            questions.append(caption_question(asker.scene.name, str(number), aabb, keys))
    if not questions:
        warnings.warn(
            f"proposals=localize: {asker.scene.name}: no name of an object has a box there ({listed(known_names)}), so "
            "that there is nothing to caption",
            SceneWarning,
            stacklevel=2,
        )
    return tuple(questions)


def load_fusable(
    path: Path,
    run: Run,
    *,
    splat: str,
    data: SceneConfig,
    seeds: SeedConfig,
    orbits: int,
    cameras: CamerasOfSplat,
    blend: BlendConfig,
    labels: bool,
) -> Scene:
    """Loads a scene with Gaussians and views: seeds if it has no splat, orbit cameras if it has no views.

    Args:
        path: of the scene.
        run: takes the seconds of the steps.
        splat: file of the Gaussians, or empty.
        data: how the scene is read.
        seeds: how Gaussians are made.
        orbits: largest number of cameras placed in a bare splat.
        cameras: where they stand.
        blend: how a bare splat is rendered.
        labels: whether a teacher needs labels, which a bare splat has not.
    """
    with run.step("load"):
        scene = load_scene(path, splat=splat or None, options=data)
    with run.step("check"):
        warn_of_faults(scene)
        scene = with_fitting_splat(scene, splat, data)
    if scene.views is None and labels:
        raise InputError(
            f"{path}: a splat without views has no labels for teacher=labels; give a teacher that looks at pictures, "
            "such as teacher=mosaic text=minilm, or teacher=palette"
        )
    if scene.gaussians is None:
        with run.step("seeds"):
            scene = with_gaussians(scene, seeds, track=run.track)
    scene = with_reported_up(scene, run)
    if scene.views is not None:
        return scene
    with run.step("cameras"):
        scene, reason = with_explained_views(scene, orbits, blend, cameras=cameras)
    assert scene.views is not None
    where = "inside" if scene.views.names[0].startswith(INSIDE) else "around"
    run.results["cameras"] = where
    run.print(f"{scene.name}: a bare splat; rendered from {len(scene.views)} cameras {where} it, because {reason}")
    return scene
