"""A command without a purpose, for tests of the command line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from splats import gaussians_at

from gsencoder.app.options import CommonConfig
from gsencoder.app.output import output_folder
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyConfig(CommonConfig):
    paths: tuple[str, ...] = field(default=(), metadata={"help": "scenes", "metavar": "SCENE"})
    size: int = field(default=1, metadata={"help": "how large"})
    word: str = field(default="", metadata={"help": "what to say"})


def write_toy(config: Any, summary: Any) -> None:
    summary.results["size"] = config.size
    if config.size < 0:
        raise InputError("size: expected a positive number")
    if config.out is not None:
        with output_folder(config.out, overwrite=config.overwrite, record=summary.to_dict) as folder:
            (folder / "word").write_text(config.word)


def splat(path: Path, count: int = 20) -> Path:
    save_splat(path, gaussians_at(np.random.default_rng(0).normal(size=(count, 3)), 0.1, 0.5))
    return path
