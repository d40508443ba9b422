"""The `radio` teacher: RADIO's backbone features through transformers, which SplatDistill distils (sec. 3.2)."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, find_file, load_pretrained, read_config
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.onnx import fit_to_patches
from gsencoder.types import FeatureMap, FeatureSpace, Views

WHAT = "teacher radio"
ADAPTERS = "radio_model.adaptors."
"""What the keys of adapter heads begin with in the files of weights; `gsencoder.fusion.adapter_heads` reads them."""
PICKLED = (".tar", ".pth", ".pt", ".bin", ".ckpt")
"""What names of files end with that are opened by unpickling them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioConfig:
    """Which RADIO, and how pictures are given to it."""

    name: Literal["radio"] = "radio"
    model: str = field(
        default="", metadata={"help": "folder of a RADIO model for transformers; also looked for in GSENCODER_MODELS"}
    )
    size: int = field(default=768, metadata={"help": "longer side of the resized picture in pixels"})
    words: str = field(default="", metadata={"help": "text table that leads into the space; empty if none"})
    heads: tuple[str, ...] = field(
        default=(),
        metadata={
            "names": True,
            "help": "adapter heads that are stored with the features, such as siglip or sam: NAME.summary, "
            "NAME.features, or NAME for the one that is meant most often",
        },
    )
    device: Literal["auto", "cpu", "cuda"] = field(default="auto", metadata={"help": "where the backbone runs"})

    def __post_init__(self) -> None:
        if not 1 <= self.size <= 2048:
            raise InputError(f"size: expected 1 to 2048 pixels, got {self.size}")


class RadioTeacher:
    """The backbone's patch features as they are: adapter heads lead from them into other spaces."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, config: RadioConfig, *, text_encoder: str = "") -> None:
        """Loads the model from its folder; nothing is fetched from anywhere.

        Args:
            config: which, and how.
            text_encoder: what turns words into this space; empty if nothing does.

        Raises:
            InputError: transformers is missing, or the folder holds no RADIO.
        """
        folder = radio_folder(config)
        check_radio(folder)
        from transformers import AutoModel

        from gsencoder.core.device import choose_device

        model = load_pretrained(AutoModel, folder, WHAT, known_parts=(ADAPTERS,))
        device = choose_device(config.device).type
        self._model, self._device, self.config = model.to(device), device, config
        self._digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("config.json")]))
        self.space = FeatureSpace(
            name=f"radio-{folder.resolve().name}",
            channels=model.config.hidden_size,
            teacher="radio",
            weights=self._digest,
            layer="features",
            preprocessing=f"resized to {config.size} px in multiples of {model.config.patch_size}",
            text_encoder=text_encoder,
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The backbone's patch features of one picture.

        Raises:
            MissingInput: no pictures.
            InputError: features that are not finite.
        """
        import torch

        from gsencoder.core.device import enough_memory, teacher_autocast

        if views.images is None:
            raise MissingInput("teacher radio: the scene has no pictures")
        patch = self._model.config.patch_size
        resized, grid_from_image = fit_to_patches(views.images[view], self.config.size, patch)
        pixels = torch.from_numpy(resized.astype(np.float32) / 255).permute(2, 0, 1)[None].to(self._device)
        with torch.inference_mode(), teacher_autocast(self._device), enough_memory(WHAT, "teacher.size="):
            features = self._model(pixel_values=pixels).features[0].float().cpu().numpy()
        if not np.isfinite(features).all():
            raise InputError(f"teacher radio: features of view {views.names[view]!r} are not finite; check the weights")
        grid = features.reshape(resized.shape[0] // patch, resized.shape[1] // patch, -1)
        return FeatureMap(features=np.ascontiguousarray(grid), grid_from_image=grid_from_image, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {"name": "radio", "model": self._digest, "size": self.config.size}


def radio_folder(config: RadioConfig) -> Path:
    """The folder of a RADIO model.

    Raises:
        InputError: none is named or there, or a file is.
    """
    if not config.model:
        raise InputError("teacher.model= is missing: the folder of a RADIO model")
    if config.model.lower().endswith(PICKLED) or Path(config.model).is_file():
        raise InputError(
            f"{WHAT}: teacher.model={config.model} is a file, and files of pickles, such as .pth.tar, are never "
            "opened; give the folder of the Hugging Face release, with config.json and safetensors"
        )
    return find_file(config.model, "teacher.model", folder=True)


def check_radio(folder: Path) -> int:
    """Checks that a folder states that it holds a RADIO model; returns the channels of its backbone.

    Raises:
        InputError: it does not, or transformers cannot read its configuration.
    """
    stated = read_config(folder, WHAT)
    if stated.model_type != "radio":
        raise InputError(f"{WHAT}: {folder} holds a {stated.model_type} model, expected radio")
    return int(stated.hidden_size)
