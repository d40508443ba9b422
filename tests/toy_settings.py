"""Settings of a command without a purpose."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from gsencoder.app.compose import compose
from gsencoder.app.options import CommonConfig
from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsConfig:
    name: Literal["labels"] = "labels"
    table: Path | None = field(default=None, metadata={"help": "names and embeddings"})


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxConfig:
    name: Literal["onnx"] = "onnx"
    weights: str = field(default="", metadata={"help": "an ONNX file"})
    top_k: int = field(default=5, metadata={"help": "posteriors kept"})


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    voxel: float = field(default=0.02, metadata={"help": "grid in metres"})
    lift: Literal["center", "blend"] = field(default="blend", metadata={"help": "which lift"})
    tau: float | None = field(default=None, metadata={"help": "occlusion tolerance"})
    window: tuple[float, float] = field(default=(0.0, 1.0), metadata={"help": "depth range"})
    ranks: tuple[int, ...] = field(default=(8, 16), metadata={"help": "ranks"})
    against: tuple[Literal["depth", "render"], ...] = field(default=("depth",), metadata={"help": "tests"})

    def __post_init__(self) -> None:
        if self.voxel <= 0:
            raise InputError(f"voxel: expected a positive size, got {self.voxel}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyConfig(CommonConfig):
    paths: tuple[str, ...] = field(default=(), metadata={"help": "scenes", "metavar": "SCENE", "required": True})
    query: tuple[str, ...] = field(default=(), metadata={"help": "words"})
    question: str = field(default="", metadata={"help": "a question"})
    device: str | None = field(default=None, metadata={"help": "where to run"})
    seed: int = field(default=0, metadata={"help": "seed"})
    fusion: FusionConfig = field(default_factory=FusionConfig)
    teacher: LabelsConfig | OnnxConfig = field(default_factory=LabelsConfig)


def toy(conf: Path, *words: str) -> ToyConfig:
    return compose("toy", ToyConfig, words, conf)
