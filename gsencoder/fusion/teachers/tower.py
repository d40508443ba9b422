"""The `transformers` teacher: dense features of vision towers (CLIP, SigLIP, DINO, SAM, those of VLMs)."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import find_file
from gsencoder.fusion.teachers import MissingInput
from gsencoder.fusion.teachers.tower_kinds import WHAT, tower_in
from gsencoder.fusion.teachers.tower_preprocessing import read_preprocessing
from gsencoder.types import FeatureMap, FeatureSpace, Views

LARGEST_SIDE = 8192
"""Pixels along a resized picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformersConfig:
    """Which vision tower, which of its vectors, and how pictures are given to it."""

    name: Literal["transformers"] = "transformers"
    model: str = field(
        default="",
        metadata={
            "help": "folder of a model for transformers (CLIP, SigLIP, SigLIP2, DINOv2, DINOv3, SAM, LLaVA, PaliGemma, "
            "SmolVLM, …); also looked for in GSENCODER_MODELS"
        },
    )
    dense: Literal["auto", "tokens", "values", "summary"] = field(
        default="auto",
        metadata={
            "help": "vectors of patches: tokens = hidden states; in the space of the text tower: values = of the last "
            "attention (MaskCLIP), summary = the summary head on each patch; auto = values of CLIP, summary of SigLIP, "
            "else tokens"
        },
    )
    layer: int | None = field(
        default=None,
        metadata={
            "help": "hidden states of this layer: -2 = before the last layer, -1 = after it, 1 = after the first; "
            "null = after the final norm"
        },
    )
    size: int = field(
        default=0, metadata={"help": "longer side of the resized picture in pixels; 0 = as the model was trained"}
    )
    large: Literal["interpolate", "windows"] = field(
        default="interpolate",
        metadata={
            "help": "pictures of another size than the model's: its position embeddings are interpolated, or windows "
            "of its size are averaged"
        },
    )
    overlap: float = field(
        default=0.5, metadata={"help": "smallest share of a window that the next one covers again, with large=windows"}
    )
    words: str = field(default="", metadata={"help": "text table that leads into the space; empty if none"})
    device: Literal["auto", "cpu", "cuda"] = field(default="auto", metadata={"help": "where the tower runs"})

    def __post_init__(self) -> None:
        if not 0 <= self.size <= LARGEST_SIDE:
            raise InputError(f"size: expected 1 to {LARGEST_SIDE} pixels, or 0, got {self.size}")
        if not 0 <= self.overlap <= 0.9:
            raise InputError(f"overlap: expected a share from 0 to 0.9, got {self.overlap}")
        if self.layer is not None and self.dense in ("values", "summary"):
            raise InputError(f"layer: hidden states of a layer are dense=tokens, got dense={self.dense}")


class TransformersTeacher:
    """A vision tower on whole pictures, which are resized to multiples of the patch, without a crop."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, config: TransformersConfig, *, text_encoder: str = "") -> None:
        """Loads tower and preprocessing; nothing is fetched from anywhere.

        Args:
            config: which, and how.
            text_encoder: what turns words into this space; empty if nothing does.

        Raises:
            InputError: transformers is missing, or the folder holds no tower of a kind that is known, with its
                preprocessing.
        """
        if not config.model:
            raise InputError("teacher.model= is missing: the folder of a vision model")
        folder = find_file(config.model, "teacher.model", folder=True)
        tower = tower_in(folder)
        self._preprocessing = read_preprocessing(folder, WHAT, floats=tower.kind.resizes_floats)
        from gsencoder.core.device import choose_device
        from gsencoder.fusion.teachers.tower_network import VisionTower

        self._device = choose_device(config.device).type
        network = VisionTower(folder, tower, config.dense, config.layer).to(self._device)
        self._network, self.config = network, config
        self.joint = network.joint
        self._size = config.size or network.native
        if tower.kind.native_only and config.large == "interpolate" and self._size > network.native:
            raise InputError(
                f"{WHAT}: size: {tower.kind.name} takes pictures of up to {network.native} pixels, got {self._size}; "
                "give large=windows for larger ones"
            )
        how = f"{self._preprocessing.describe()}, resized to {self._size} px in multiples of {network.patch}"
        if config.large == "windows":
            how += f", windows of {network.native} px with an overlap of {config.overlap:g}"
        layer = "after the final norm" if config.layer is None else f"of layer {config.layer}"
        name = folder.resolve().name
        self.space = FeatureSpace(
            name=name,
            channels=network.channels,
            teacher="transformers",
            weights=network.digest,
            layer=f"tokens {layer}" if network.dense == "tokens" else network.dense,
            preprocessing=how,
            text_encoder=text_encoder,
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The tower's vectors of the patches of one picture.

        Raises:
            MissingInput: no pictures.
            InputError: features that are not finite.
        """
        import torch

        from gsencoder.core.device import enough_memory, teacher_autocast
        from gsencoder.fusion.teachers.windows import map_in_windows

        if views.images is None:
            raise MissingInput(f"{WHAT}: the scene has no pictures")
        network = self._network
        fitted, grid_from_image = self._preprocessing.fit(views.images[view], self._size, network.patch)
        pixels = torch.from_numpy(np.ascontiguousarray(fitted)).to(self._device)
        with torch.inference_mode(), teacher_autocast(self._device), enough_memory(WHAT, "teacher.size="):
            if self.config.large == "windows":
                cells = map_in_windows(network, pixels, network.patch, network.native, self.config.overlap)
            else:
                cells = network(pixels)
        features = np.ascontiguousarray(cells.cpu().numpy())
        if not np.isfinite(features).all():
            raise InputError(f"{WHAT}: features of view {views.names[view]!r} are not finite; check the weights")
        return FeatureMap(features=features, grid_from_image=grid_from_image, space=self.space)

    def settings(self) -> dict[str, Any]:
        values: dict[str, Any] = {
            "name": "transformers",
            "model": self._network.digest,
            "dense": self._network.dense,
            "layer": self.config.layer,
            "size": self._size,
            "preprocessing": self._preprocessing.describe(),
            "large": self.config.large,
        }
        return {**values, "overlap": self.config.overlap} if self.config.large == "windows" else values
