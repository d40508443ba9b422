"""The `radio` teacher: RADIO's backbone features through transformers, which SplatDistill distils (sec. 3.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, find_file, load_pretrained, read_config
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.teachers.adapter_heads import ADAPTERS, WHAT, Head, read_radio_heads
from gsencoder.teachers.base import Teacher, TeacherSettings, check_channels, text_encoder_of
from gsencoder.teachers.pictures import Preprocessing, TorchTeacher
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureSpace, Scene

PICKLED = (".tar", ".pth", ".pt", ".bin", ".ckpt")
"""Endings of files that are opened by unpickling them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioConfig(TeacherSettings):
    """Which RADIO, and how pictures are given to it."""

    has_heads = True

    name: Literal["radio"] = "radio"
    model: str = option("", "folder of a RADIO model for transformers; also looked for in GSENCODER_MODELS")
    size: int = option(768, "longer side of the resized picture in pixels", ge=1, le=2048)
    words: str = option("", "text table that leads into the space; empty if none")
    heads: tuple[str, ...] = option(
        (),
        "adapter heads that are stored with the features, such as siglip or sam: NAME.summary, "
        "NAME.features, or NAME for the one that is meant most often",
        names=True,
    )
    device: Device = option("auto", "where the backbone runs")

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        teacher = RadioTeacher(self, text_encoder=text_encoder_of(words))
        check_channels(teacher.space, words)
        return teacher

    @property
    def stored_heads(self) -> tuple[str, ...]:
        return self.heads

    def read_heads(self, names: Sequence[str]) -> list[Head]:
        folder = radio_folder(self)
        return read_radio_heads(folder, names, check_radio(folder))

    def refuse_text(self) -> str:
        return (
            "text=: no text tower speaks for the features of RADIO's backbone; leave out text= here, and give it "
            "where an adapter head is asked: localize head=siglip text=…"
        )


class RadioNetwork(nn.Module):
    """The patch features of RADIO's backbone."""

    def __init__(self, folder: Path) -> None:
        from transformers import AutoModel

        super().__init__()
        self._model = load_pretrained(AutoModel, folder, WHAT, ignored=(ADAPTERS,))
        self.patch, self.channels = int(self._model.config.patch_size), int(self._model.config.hidden_size)

    def forward(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """One vector a patch, float32, of a picture in [0, 1]."""
        rows, columns = pixels.shape[2] // self.patch, pixels.shape[3] // self.patch
        features: Tensor = self._model(pixel_values=pixels).features[0]
        return features.float().reshape(rows, columns, -1)


class RadioTeacher(TorchTeacher):
    """The backbone's patch features as they are: adapter heads lead from them into other spaces."""

    subject = WHAT
    preprocessing = Preprocessing()

    def __init__(self, config: RadioConfig, *, text_encoder: str = "") -> None:
        """Loads the model from its folder; nothing is fetched from anywhere."""
        folder = radio_folder(config)
        check_radio(folder)
        self.device, self.size, self.config = choose_device(config.device).type, config.size, config
        self.network = network = RadioNetwork(folder).to(self.device)
        self._digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("config.json")]))
        self.space = FeatureSpace(
            name=f"radio-{folder.resolve().name}",
            channels=network.channels,
            teacher="radio",
            weights=self._digest,
            layer="features",
            preprocessing=f"resized to {config.size} px in multiples of {network.patch}",
            text_encoder=text_encoder,
        )

    def settings(self) -> dict[str, Any]:
        return {"name": "radio", "model": self._digest, "size": self.config.size}


def radio_folder(config: RadioConfig) -> Path:
    """The folder of a RADIO model; InputError where none is named, or a file is."""
    if not config.model:
        raise InputError("teacher.model= is missing: the folder of a RADIO model")
    if config.model.lower().endswith(PICKLED) or Path(config.model).is_file():
        raise InputError(
            f"{WHAT}: teacher.model={config.model} is a file, and files of pickles, such as .pth.tar, are never "
            "opened; give the folder of the Hugging Face release, with config.json and safetensors"
        )
    return find_file(config.model, "teacher.model", folder=True)


def check_radio(folder: Path) -> int:
    """Checks that a folder states that it holds a RADIO model; returns the channels of its backbone."""
    stated = read_config(folder, WHAT)
    if stated.model_type != "radio":
        raise InputError(f"{WHAT}: {folder} holds a {stated.model_type} model, expected radio")
    return int(stated.hidden_size)
