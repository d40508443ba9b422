"""A command without a purpose, for tests of the command line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.app.options import CommonConfig
from gsencoder.app.output import output_folder
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat
from gsencoder.types import Gaussians


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
        with output_folder(config.out, overwrite=config.overwrite, summary=summary) as folder:
            (folder / "word").write_text(config.word)


def splat(path: Path, count: int = 20) -> Path:
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.1, np.float32),
        opacities=np.full(count, 0.5, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )
    save_splat(path, gaussians)
    return path
