"""Which vision towers of transformers the `transformers` teacher runs, and which of them a folder holds."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import read_config

WHAT = "teacher transformers"


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerKind:
    """How the vision towers of one kind are loaded and run.

    Attributes:
        name: for people.
        loader: class of transformers.
        weight: name, within the tower, of the weight of its patch embedding.
        joint: what leads from tokens into the space of a text tower: the visual projection, the attention pooling head,
            or nothing.
        interpolates: whether the library interpolates its position embeddings only where it is asked to.
        native_only: whether it takes pictures of its native size alone; smaller ones are padded.
        resizes_floats: whether its preprocessing resizes values in [0, 1] instead of 8-bit ones.
    """

    name: str
    loader: str
    weight: str = "embeddings.patch_embedding.weight"
    joint: Literal["", "projection", "head"] = ""
    interpolates: bool = False
    native_only: bool = False
    resizes_floats: bool = False


KINDS: Mapping[str, TowerKind] = {
    "clip_vision_model": TowerKind(name="CLIP", loader="CLIPVisionModel", joint="projection", interpolates=True),
    "siglip_vision_model": TowerKind(name="SigLIP", loader="SiglipVisionModel", joint="head", interpolates=True),
    "siglip2_vision_model": TowerKind(name="SigLIP2", loader="Siglip2VisionModel", joint="head"),
    "dinov2": TowerKind(name="DINOv2", loader="Dinov2Model", weight="embeddings.patch_embeddings.projection.weight"),
    "dinov2_with_registers": TowerKind(
        name="DINOv2 with registers",
        loader="Dinov2WithRegistersModel",
        weight="embeddings.patch_embeddings.projection.weight",
    ),
    "dinov3_vit": TowerKind(
        name="DINOv3", loader="DINOv3ViTModel", weight="embeddings.patch_embeddings.weight", resizes_floats=True
    ),
    "sam_vision_model": TowerKind(
        name="SAM", loader="SamVisionModel", weight="vision_encoder.patch_embed.projection.weight", native_only=True
    ),
    "idefics3_vision": TowerKind(name="Idefics3", loader="Idefics3VisionTransformer"),
    "smolvlm_vision": TowerKind(name="SmolVLM", loader="SmolVLMVisionTransformer"),
}
"""By the `model_type` of the tower's configuration."""

WITH_OTHER_PARTS = ("clip", "siglip", "siglip2", "sam")
"""Models from whose folders the class of their vision tower loads by itself; of others the tower is cut out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerInFolder:
    """What the configuration of a folder says about its vision tower.

    Attributes:
        kind: of the tower.
        config: of the tower, as transformers reads it.
        alone: whether the folder holds the tower alone.
        cut_out: whether it is a part of a larger model, such as a vision-language model, of which nothing else is read.
    """

    kind: TowerKind
    config: Any
    alone: bool
    cut_out: bool


def tower_in(folder: Path) -> TowerInFolder:
    """The vision tower of a folder, by its config.json.

    Raises:
        InputError: transformers does not know the model without code of its own, or it has no tower of these kinds.
    """
    stated = read_config(folder, WHAT)
    config: Any = stated if stated.model_type in KINDS else getattr(stated, "vision_config", None)
    kind = KINDS.get(getattr(config, "model_type", ""))
    if kind is None:
        inner = f" with a {config.model_type} tower" if config is not None else ""
        hint = "give teacher=radio for it" if stated.model_type == "radio" else f"expected one of {supported()}"
        raise InputError(f"{WHAT}: {folder} holds a {stated.model_type} model{inner}; {hint}")
    if stated.model_type == "clip":
        # The width of the joint space stands in both configurations, and in old files only in this one.
        config.projection_dim = stated.projection_dim
    alone = config is stated
    cut_out = not alone and stated.model_type not in WITH_OTHER_PARTS
    return TowerInFolder(kind=kind, config=config, alone=alone, cut_out=cut_out)


def supported() -> str:
    """The kinds, for messages."""
    return (
        ", ".join(kind.name for kind in KINDS.values())
        + ", or a vision-language model with such a tower (LLaVA, PaliGemma, Gemma 3, …)"
    )
