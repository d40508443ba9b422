"""`evaluate features=FOLDER`: features that were written by fuse, encode, pack or memory, on the scenes' labels."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.app.commands.from_poses import memory_of
from gsencoder.app.commands.query_words import queried_scene
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import load_features
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import GaussianFeatures, QueryMemory, Scene


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
        scene: name of a scene.
        head: adapter head whose outputs are asked; empty = the features.
        space: name of the features where there are several.
        text: a text tower.

    Raises:
        InputError: there are no such features or words.
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

    Raises:
        InputError: features of another scene, or none.
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
