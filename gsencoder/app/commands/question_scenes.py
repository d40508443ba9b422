"""The scenes that a question set is asked about: their folders of features, photographs, and boxes to be captioned."""

import warnings
from collections.abc import Collection, Sequence
from pathlib import Path

from gsencoder.app.commands.evaluated_features import folder_of
from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.data.scenes import DistinctPaths, kind_of_path
from gsencoder.fusion.folder import holds_features
from gsencoder.infer.ask.ask import Asker
from gsencoder.infer.ask.questions import SetQuestion, caption_question
from gsencoder.infer.localize import localize
from gsencoder.infer.views.targets import best_boxes
from gsencoder.text.vocabulary import closed_table


def scene_folders(paths: Sequence[str], scenes: Collection[str]) -> list[Path]:
    """The folders of features at paths: each path, or the folders in it that are called like one of the scenes.

    Raises:
        InputError: a path that is no folder, that holds neither features nor any such folder, or that is given twice.
    """
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

    Raises:
        InputError: no words lead into the features.

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
