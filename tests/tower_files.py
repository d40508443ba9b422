"""Teachers and features of small vision towers, and files of theirs to be spoiled."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from splats import front_camera
from vision_towers import picture

from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.types import Views

WIDE = picture(30, 60)


def views(*images: np.ndarray) -> Views:
    cameras = front_camera(images[0].shape[1], images[0].shape[0])
    return Views(cameras=cameras, names=("left.png",), images=list(images))


def teacher(folder: Path, **settings: Any) -> TransformersTeacher:
    return TransformersTeacher(TransformersConfig(model=str(folder), device="cpu", **settings))


def features(folder: Path, image: np.ndarray = WIDE, **settings: Any) -> np.ndarray:
    made = teacher(folder, **settings).feature_map(views(image), 0).features
    assert made is not None
    return made


def rewrite(path: Path, **changes: Any) -> None:
    stated = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in stated.items() if value is not None}))


def change_weights(folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    from safetensors.torch import load_file, save_file

    weights = change(load_file(folder / "model.safetensors"))
    made = {name: value.contiguous() for name, value in weights.items()}
    save_file(made, folder / "model.safetensors", {"format": "pt"})
