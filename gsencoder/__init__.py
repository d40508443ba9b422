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
    "load_splat": "gsencoder.data.splats",
    "save_splat": "gsencoder.data.splats",
    "load_scene": "gsencoder.data.scenes",
    "fuse": "gsencoder.fusion.fuse",
    "encode": "gsencoder.infer.encode.encode",
    "load_weights": "gsencoder.models.weights",
    "localize": "gsencoder.infer.localize.localize",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gsencoder' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
