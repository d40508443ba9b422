"""The `transformers` teacher: dense features of vision towers (CLIP, SigLIP, DINO, SAM, those of VLMs)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import (
    ANY,
    digest_files,
    find_file,
    load_component,
    load_pretrained,
    read_config,
    weight_names,
)
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.teachers.base import Teacher, TeacherSettings, check_channels, text_encoder_of
from gsencoder.teachers.pictures import LARGEST_SIDE, TorchTeacher, read_preprocessing
from gsencoder.text.vocabulary import OpenVocabulary, Words
from gsencoder.types import FeatureSpace, Scene

LABEL = "teacher transformers"


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerKind:
    """How the vision towers of one kind are loaded and run.

    Attributes:
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
        alone: whether the folder holds the tower alone.
        cut_out: whether it is a part of a larger model, such as a vision-language model, of which nothing else is read.
    """

    kind: TowerKind
    config: Any
    alone: bool
    cut_out: bool


def tower_in(folder: Path) -> TowerInFolder:
    """The vision tower of a folder, by its config.json."""
    loaded = read_config(folder, LABEL)
    config: Any = loaded if loaded.model_type in KINDS else getattr(loaded, "vision_config", None)
    kind = KINDS.get(getattr(config, "model_type", ""))
    if kind is None:
        inner = f" with a {config.model_type} tower" if config is not None else ""
        hint = f"expected one of {', '.join(kind.name for kind in KINDS.values())}, or a vision-language model with one"
        hint = "give teacher=radio for it" if loaded.model_type == "radio" else hint
        raise InputError(f"{LABEL}: {folder} holds a {loaded.model_type} model{inner}; {hint}")
    if loaded.model_type == "clip":
        # The width of the joint space stands in both configurations, and in old files only in this one.
        config.projection_dim = loaded.projection_dim
    alone = config is loaded
    cut_out = not alone and loaded.model_type not in WITH_OTHER_PARTS
    return TowerInFolder(kind=kind, config=config, alone=alone, cut_out=cut_out)


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformersConfig(TeacherSettings):
    """Which vision tower, which of its vectors, and how pictures are given to it."""

    name: Literal["transformers"] = "transformers"
    model: str = option(
        "",
        "folder of a model for transformers (CLIP, SigLIP, SigLIP2, DINOv2, DINOv3, SAM, LLaVA, PaliGemma, "
        "SmolVLM, …); also looked for in GSENCODER_MODELS",
    )
    dense: Literal["auto", "tokens", "values", "summary"] = option(
        "auto",
        "vectors of patches: tokens = hidden states; in the space of the text tower: values = of the last "
        "attention (MaskCLIP), summary = the summary head on each patch; auto = values of CLIP, summary of SigLIP, "
        "else tokens",
    )
    layer: int | None = option(
        None,
        "hidden states of this layer: -2 = before the last layer, -1 = after it, 1 = after the first; "
        "null = after the final norm",
    )
    size: int = option(
        0, "longer side of the resized picture in pixels; 0 = as the model was trained", ge=0, le=LARGEST_SIDE
    )
    large: Literal["interpolate", "windows"] = option(
        "interpolate",
        "pictures of another size than the model's: its position embeddings are interpolated, or windows "
        "of its size are averaged",
    )
    overlap: float = option(
        0.5, "smallest share of a window that the next one covers again, with large=windows", ge=0, le=0.9
    )
    words: str = option("", "text table of the teacher's space; empty if none")
    device: Device = option("auto", "where the tower runs")

    def __post_init__(self) -> None:
        TeacherSettings.__post_init__(self)
        if self.layer is not None and self.dense in ("values", "summary"):
            raise InputError(f"layer: hidden states of a layer are dense=tokens, got dense={self.dense}")

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        tower = TransformersTeacher(self, text_encoder=text_encoder_of(words))
        if isinstance(words, OpenVocabulary) and not tower.network.joint:
            raise InputError(
                f"text=: no text tower shares the space of {tower.space.layer} of {tower.space.name}; leave out text=, "
                "or give a text-aligned model (CLIP, SigLIP, SigLIP2) with its head"
            )
        check_channels(tower.space, words)
        return tower

    def refuse_text(self) -> str:
        if self.dense == "tokens" or self.layer is not None:
            return (
                "text=: no text tower shares the space of hidden states (teacher.dense=tokens, teacher.layer=); give "
                "teacher.dense=values or summary with a text-aligned model, or leave out text="
            )
        return TeacherSettings.refuse_text(self)

    def takes_text(self) -> bool:
        # With dense=auto the folder decides, which is read when the teacher is built.
        return self.dense in ("values", "summary")


class TransformersTeacher(TorchTeacher):
    """A vision tower on whole pictures, which are resized to multiples of the patch, without a crop."""

    subject = LABEL

    def __init__(self, config: TransformersConfig, *, text_encoder: str = "") -> None:
        """Loads tower and preprocessing; nothing is fetched from anywhere."""
        if not config.model:
            raise InputError("teacher.model= is missing: the folder of a vision model")
        folder = find_file(config.model, "teacher.model", folder=True)
        tower = tower_in(folder)
        self.preprocessing = read_preprocessing(folder, LABEL, floats=tower.kind.resizes_floats)
        self.device, self.config = choose_device(config.device).type, config
        self.network: VisionTower = VisionTower(folder, tower, config.dense, config.layer).to(self.device)
        network = self.network
        self.size = config.size or network.native
        if tower.kind.native_only and config.large == "interpolate" and self.size > network.native:
            raise InputError(
                f"{LABEL}: size: {tower.kind.name} takes pictures of up to {network.native} pixels, got {self.size}; "
                "give large=windows for larger ones"
            )
        how = f"{self.preprocessing.describe()}, resized to {self.size} px in multiples of {network.patch}"
        if config.large == "windows":
            how += f", windows of {network.native} px with an overlap of {config.overlap:g}"
        layer = "after the final norm" if config.layer is None else f"of layer {config.layer}"
        self.space = FeatureSpace(
            name=folder.resolve().name,
            channels=network.channels,
            teacher="transformers",
            weights=network.digest,
            layer=f"tokens {layer}" if network.dense == "tokens" else network.dense,
            preprocessing=how,
            text_encoder=text_encoder,
        )

    def map_of(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        network = self.network
        if self.config.large == "windows":
            return map_in_windows(network, pixels, network.patch, network.native, self.config.overlap)
        out: Tensor = network(pixels)
        return out


Dense = Literal["tokens", "values", "summary"]
"""What the vectors of patches are; see `VisionTower`."""


class VisionTower(nn.Module):
    """The patches of a picture as vectors.

    With `dense="tokens"` they are hidden states: after the final norm, or of a layer (`layer`). With the others they
    lie in the joint space of pictures and text, into which a head leads that was trained on one summary of a picture.
    It is given each patch alone. Of CLIP it is the visual projection, after the final norm; of SigLIP the attention
    pooling, after the final norm, whose attention over one token is its value and output projection.

    - `dense="summary"`: the head on the tokens.
    - `dense="values"`: the head on W_o W_v LN(x), where x goes into the last layer: its attention is replaced by its
      value and output projections, so that each patch speaks for itself (MaskCLIP, Zhou et al. 2022). The residual
      connection and the MLP of that layer are left out, as in F3RM (Shen et al. 2023).

    Attributes:
        native: pixels along the pictures that the model was trained on.
        dense: what the vectors are; "auto" is decided.
        joint: whether they lie in the space of a text tower.
    """

    def __init__(self, folder: Path, tower: TowerInFolder, dense: Dense | Literal["auto"], layer: int | None) -> None:
        """Loads the tower in float32; nothing is fetched from anywhere.

        Args:
            folder, tower: of the model, and what its configuration says of the tower.
            dense: what the vectors are; auto = in the joint space if there is one: values of CLIP, summary of SigLIP.
            layer: tokens are hidden states of a layer, as transformers counts them: 0 = what goes into the first layer,
                −1 = what comes from the last one, without the final norm. None = after the final norm.
        """
        super().__init__()
        self._kind, config = tower.kind, tower.config
        self._head = self._joint_head(folder, tower)
        self.dense = self._decide(dense, layer)
        self._layer = layer
        layers = int(config.num_hidden_layers)
        if layer is not None and not -layers - 1 <= layer <= layers:
            raise InputError(
                f"{LABEL}: layer: expected {-layers - 1} to {layers}, as this {self._kind.name} tower has {layers} "
                f"layers, got {layer}"
            )
        import transformers  # Slow, and not needed by other teachers.

        if tower.cut_out:
            loader = getattr(transformers, self._kind.loader)
            self._model, files = load_component(loader, config, folder, self._kind.weight, LABEL)
        else:
            projects = "WithProjection" if self._head == "projection" else ""
            loader = getattr(transformers, self._kind.loader + projects)
            ignored = () if tower.alone else ANY
            self._model = load_pretrained(loader, folder, LABEL, ignored=ignored, config=config)
            files = sorted(folder.glob("*.safetensors"))
        self.digest = digest_files(folder / "config.json", *files)
        self.patch = _side(config.patch_size)
        # SigLIP2 with pictures of any shape states a number of patches instead.
        patches = getattr(config, "num_patches", None)
        self.native = _side(config.image_size) if patches is None else self.patch * round(patches**0.5)
        self.channels = self._count_channels(config)

    @property
    def joint(self) -> bool:
        return self.dense != "tokens"

    def _joint_head(self, folder: Path, tower: TowerInFolder) -> str:
        """The kind's head if this folder has it: towers that are published alone may be without."""
        if tower.cut_out:
            return ""
        if self._kind.joint == "head":
            return "head" if tower.config.vision_use_head else ""
        if self._kind.joint == "projection":
            has = not tower.alone or "visual_projection.weight" in weight_names(folder, LABEL)
            return "projection" if has else ""
        return ""

    def _decide(self, dense: str, layer: int | None) -> Dense:
        if dense == "tokens" or layer is not None or (dense == "auto" and not self._head):
            return "tokens"
        if not self._head:
            raise InputError(
                f"{LABEL}: dense={dense} needs a head that maps to the space of a text tower, and this "
                f"{self._kind.name} tower has none; give dense=tokens"
            )
        if dense == "auto":
            return "values" if self._head == "projection" else "summary"
        return "values" if dense == "values" else "summary"

    def _count_channels(self, config: Any) -> int:
        if self.joint and self._head == "projection":
            return int(config.projection_dim)
        if self._kind.name == "SAM" and self._layer is None:
            return int(config.output_channels)
        return int(config.hidden_size)

    def forward(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """One vector a patch, float32, of a normalized picture with sides of whole patches."""
        rows, columns = pixels.shape[2] // self.patch, pixels.shape[3] // self.patch
        if self._kind.name == "SAM":
            return self._grid_of_sam(pixels)[:rows, :columns].float()
        return self._tokens(pixels)[-rows * columns :].reshape(rows, columns, -1).float()

    def _tokens(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "n D"]:
        """Vectors of all tokens; patches are the last ones."""
        several = self._layer is not None or self.dense == "values"
        outputs = self._model(**self._inputs(pixels), output_hidden_states=several)
        if self._layer is not None:
            return outputs.hidden_states[self._layer][0]
        tower = getattr(self._model, "vision_model", self._model)
        if self.dense == "values":
            last = tower.encoder.layers[-1]
            values = last.self_attn.v_proj(last.layer_norm1(outputs.hidden_states[-2][0]))
            tokens = tower.post_layernorm(last.self_attn.out_proj(values))
        else:
            tokens = outputs.last_hidden_state[0]
            if self._kind.name == "CLIP":
                # transformers applies CLIP's final norm to the class token alone.
                tokens = tower.post_layernorm(tokens)
        if not self.joint:
            return tokens
        return self._model.visual_projection(tokens) if self._head == "projection" else tower.head(tokens[:, None])

    def _inputs(self, pixels: Float[Tensor, "1 3 H W"]) -> dict[str, Any]:
        if self._kind.name != "SigLIP2":
            return {"pixel_values": pixels, **({"interpolate_pos_encoding": True} if self._kind.interpolates else {})}
        patch = self.patch
        rows, columns = pixels.shape[2] // patch, pixels.shape[3] // patch
        cut = pixels[0].reshape(3, rows, patch, columns, patch).permute(1, 3, 2, 4, 0)
        return {
            "pixel_values": cut.reshape(1, rows * columns, -1),
            "pixel_attention_mask": torch.ones(1, rows * columns, dtype=torch.int32, device=pixels.device),
            "spatial_shapes": torch.tensor([[rows, columns]], device=pixels.device),
        }

    def _grid_of_sam(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """Of a picture that is padded with zeros to SAM's square, as its preprocessing does."""
        empty = (0, self.native - pixels.shape[3], 0, self.native - pixels.shape[2])
        outputs = self._model(nn.functional.pad(pixels, empty), output_hidden_states=self._layer is not None)
        if self._layer is not None:
            return outputs.hidden_states[self._layer][0]
        return outputs.last_hidden_state[0].permute(1, 2, 0)


def _side(value: Any) -> int:
    """A side of a square that a configuration states as one number or as two."""
    return int(value if isinstance(value, int) else value[0])


def window_starts(count: int, window: int, overlap: float) -> list[int]:
    """Where windows of `window` patches begin along a side of `count`: evenly apart, the first at 0 and the last one at
    the end; each covers again at least the share `overlap` of the one before."""
    if window >= count:
        return [0]
    step = max(1, int(window * (1 - overlap)))
    steps = -(-(count - window) // step)
    return [round(number * (count - window) / steps) for number in range(steps + 1)]


def map_in_windows(
    network: Callable[[Float[Tensor, "1 3 H W"]], Float[Tensor, "h w D"]],
    pixels: Float[Tensor, "1 3 H W"],
    patch: int,
    window: int,
    overlap: float,
) -> Float[Tensor, "h w D"]:
    """The mean, cell by cell, of the maps of all windows that hold the cell.

    Args:
        network: gives a window's map, one cell a patch.
        pixels: a picture with sides of whole patches.
        patch, window: pixels along each; a side of the picture that is shorter than a window is one.
        overlap: smallest share of a window that the next one covers again, in [0, 1).
    """
    rows, columns = pixels.shape[2] // patch, pixels.shape[3] // patch
    side = max(1, window // patch)
    height, width = min(side, rows), min(side, columns)
    sums, counts = torch.zeros(0), pixels.new_zeros(rows, columns, 1)
    for top in window_starts(rows, height, overlap):
        for left in window_starts(columns, width, overlap):
            inside = (slice(top, top + height), slice(left, left + width))
            cut = pixels[:, :, top * patch : (top + height) * patch, left * patch : (left + width) * patch]
            cells = network(cut)
            if not len(sums):
                sums = cells.new_zeros(rows, columns, cells.shape[-1])
            sums[inside] += cells
            counts[inside] += 1
    return sums / counts
