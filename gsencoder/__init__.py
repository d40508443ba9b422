"""gsencoder: vision-language feature fields for 3D Gaussian Splatting scenes.

The public names below load on first use, so that a torch-free program which reads a splat file or asks a text
table never imports torch (PEP 562).
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Gaussians": "gsencoder.types",
    "Cameras": "gsencoder.types",
    "Scene": "gsencoder.types",
    "InputError": "gsencoder.core.errors",
    "load_splat": "gsencoder.data.splats.files",
    "save_splat": "gsencoder.data.splats.files",
    "load_scene": "gsencoder.data.scenes",
    "seed": "gsencoder.data.seeding.seed",
    "default_teacher": "gsencoder.teachers.build",
    "PaletteConfig": "gsencoder.teachers.labels",
    "PaletteTeacher": "gsencoder.teachers.labels",
    "text_table_of": "gsencoder.teachers.build",
    "load_text_table": "gsencoder.text.table",
    "fuse": "gsencoder.fusion.fuse",
    "load_features": "gsencoder.fusion.folder",
    "save_features": "gsencoder.fusion.folder",
    "Encoder": "gsencoder.infer.encode",
    "load_encoder": "gsencoder.infer.encode",
    "load_weights": "gsencoder.models.encoder",
    "localize": "gsencoder.infer.localize",
    "targets_of": "gsencoder.infer.views.targets",
    "choose_views": "gsencoder.infer.views.choose",
    "render_image": "gsencoder.render.images",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gsencoder' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
