"""What `ask` and `tune` turn questions about a scene into prompts with."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from gsencoder.app.commands.query_words import load_words, queried_scene
from gsencoder.app.commands.shown_scene import shown_scene
from gsencoder.data.scenes import SceneConfig
from gsencoder.fusion.folder import table_path
from gsencoder.infer.ask.ask import AskConfig, Asker
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.localize import LocalizeConfig, select_features
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene


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
        settings: settings.
        folder: of the features.
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
