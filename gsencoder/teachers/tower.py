"""The `transformers` teacher: dense features of vision towers (CLIP, SigLIP, DINO, SAM, those of VLMs)."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from PIL import Image
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import digest_files, find_file, load_part, load_pretrained, read_config, weight_files
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.onnx import fit_to_patches, normalized, patches_of
from gsencoder.types import FeatureMap, FeatureSpace, Views

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


FILES = ("processor_config.json", "preprocessor_config.json")
"""Where it is stated: in the section `image_processor` of a processor's file, which transformers prefers, or alone."""
FLOAT_FILTERS = {Image.Resampling.BILINEAR: "bilinear", Image.Resampling.BICUBIC: "bicubic"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Preprocessing:
    """Resize with a filter, times a factor, minus a mean, divided by a standard deviation.

    Attributes:
        resample: filter of the resize.
        factor: 8-bit values are multiplied by this.
        mean: subtracted, one a channel.
        std: divided by, one a channel.
        floats: whether values are resized after they were multiplied, and not rounded to 8 bits.
    """

    resample: Image.Resampling
    factor: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    floats: bool = False

    def fit(
        self, image: UInt8[np.ndarray, "H W 3"], size: int, patch: int
    ) -> tuple[Float32[np.ndarray, "1 3 h w"], Float64[np.ndarray, "2 3"]]:
        """What the network takes, with sides of whole patches, and the affine from pixels of the picture to patches.

        Args:
            image: any size.
            size: about what the longer side becomes, pixels.
            patch: pixels along a patch.
        """
        if self.floats:
            return self._fit_floats(image, size, patch)
        resized, affine = fit_to_patches(image, size, patch, self.resample)
        return normalized(resized, 1 / self.factor, self.mean, self.std).transpose(2, 0, 1)[None], affine

    def _fit_floats(
        self, image: UInt8[np.ndarray, "H W 3"], size: int, patch: int
    ) -> tuple[Float32[np.ndarray, "1 3 h w"], Float64[np.ndarray, "2 3"]]:
        import torch

        height, width = image.shape[:2]
        rows, columns = patches_of(height, width, size, patch)
        values = torch.from_numpy(image.astype(np.float32).transpose(2, 0, 1)[None] * np.float32(self.factor))
        resized = torch.nn.functional.interpolate(
            values, (rows * patch, columns * patch), mode=FLOAT_FILTERS[self.resample], antialias=True
        )
        pixels = normalized(resized[0].permute(1, 2, 0).numpy(), 1.0, self.mean, self.std)
        return pixels.transpose(2, 0, 1)[None], np.array([[columns / width, 0, 0], [0, rows / height, 0]])

    def describe(self) -> str:
        """For the feature space."""
        numbers = (f"{name} {[round(value, 6) for value in getattr(self, name)]}" for name in ("mean", "std"))
        return f"{self.resample.name.lower()}, × {self.factor:.6g}, {', '.join(numbers)}"


def read_preprocessing(folder: Path, subject: str, *, floats: bool = False) -> Preprocessing:
    """The preprocessing that a folder states.

    Its sizes and crops are not used: a map is of the whole picture. Mean, standard deviation and filter must be stated,
    since features of pictures that were normalized otherwise look plausible, and are wrong.

    Args:
        folder: of the model.
        subject: who reads it, for messages.
        floats: see `Preprocessing`.

    Raises:
        InputError: no file, or one that does not state it.
    """
    path, stated = _stated(folder, subject)
    where = f"{subject}: {path}"
    missing = [name for name in ("resample", "image_mean", "image_std") if name not in stated]
    if missing:
        raise InputError(f"{where} does not state {', '.join(missing)}; take the file that belongs to the model")
    if type(stated["resample"]) is not int or not 0 <= stated["resample"] <= 5:
        raise InputError(f"{where}: resample: expected a number from 0 to 5, got {stated['resample']!r}")
    resample = Image.Resampling(stated["resample"])
    if floats and resample not in FLOAT_FILTERS:
        raise InputError(f"{where}: resample: expected 2 (bilinear) or 3 (bicubic), got {int(resample)}")
    normalizes = stated.get("do_normalize", True)
    factor = stated.get("rescale_factor", 1 / 255) if stated.get("do_rescale", True) else 1.0
    if not _is_number(factor) or factor <= 0:
        raise InputError(f"{where}: rescale_factor: expected a number above 0, got {factor!r}")
    return Preprocessing(
        resample=resample,
        factor=float(factor),
        mean=_three(stated["image_mean"], f"{where}: image_mean") if normalizes else (0.0, 0.0, 0.0),
        std=_three(stated["image_std"], f"{where}: image_std", positive=True) if normalizes else (1.0, 1.0, 1.0),
        floats=floats,
    )


def _stated(folder: Path, subject: str) -> tuple[Path, dict[str, Any]]:
    for path in (folder / name for name in FILES):
        try:
            stated = json.loads(read_foreign_text(path))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise InputError(f"{subject}: {path}: cannot be read: {error}") from error
        section = stated.get("image_processor") if isinstance(stated, dict) and path.name == FILES[0] else stated
        if isinstance(section, dict):
            return path, section
    raise InputError(
        f"{subject}: {folder} has no preprocessor_config.json, which says how its pictures are resized and normalized; "
        "take the file that belongs to the model"
    )


def _three(value: Any, where: str, *, positive: bool = False) -> tuple[float, ...]:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(_is_number(number) and (number > 0 or not positive) for number in numbers):
        expected = "three numbers above 0" if positive else "three numbers"
        raise InputError(f"{where}: expected {expected}, one a channel, got {str(value)[:60]}")
    return tuple(float(number) for number in numbers)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


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
        patch: pixels along a patch.
        native: pixels along the pictures that the model was trained on.
        channels: of its vectors.
        digest: of configuration and weights.
        dense: what the vectors are; "auto" is decided.
        joint: whether they lie in the space of a text tower.
    """

    def __init__(self, folder: Path, tower: TowerInFolder, dense: Dense | Literal["auto"], layer: int | None) -> None:
        """Loads the tower in float32; nothing is fetched from anywhere.

        Args:
            folder: of the model.
            tower: what its configuration says.
            dense: what the vectors are; auto = in the joint space if there is one: values of CLIP, summary of SigLIP.
            layer: tokens are hidden states of a layer, as transformers counts them: 0 = what goes into the first layer,
                −1 = what comes from the last one, without the final norm. None = after the final norm.

        Raises:
            InputError: weights that cannot be read or do not fit, or vectors or a layer that the model does not have.
        """
        super().__init__()
        self._kind, config = tower.kind, tower.config
        files = weight_files(folder, WHAT)
        self._head = self._joint_head(folder, tower)
        self.dense = self._decide(dense, layer)
        self._layer = layer
        layers = int(config.num_hidden_layers)
        if layer is not None and not -layers - 1 <= layer <= layers:
            raise InputError(
                f"{WHAT}: layer: expected {-layers - 1} to {layers}, as this {self._kind.name} tower has {layers} "
                f"layers, got {layer}"
            )
        import transformers

        if tower.cut_out:
            loader = getattr(transformers, self._kind.loader)
            self._model, files = load_part(loader, config, folder, self._kind.weight, WHAT)
        else:
            projects = "WithProjection" if self._head == "projection" else ""
            loader = getattr(transformers, self._kind.loader + projects)
            others = "warn" if tower.alone else "ignore"
            self._model = load_pretrained(loader, folder, WHAT, other_parts=others, config=config)
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
            has = not tower.alone or "visual_projection.weight" in _names_of_weights(folder)
            return "projection" if has else ""
        return ""

    def _decide(self, dense: str, layer: int | None) -> Dense:
        if dense == "tokens" or layer is not None or (dense == "auto" and not self._head):
            return "tokens"
        if not self._head:
            raise InputError(
                f"{WHAT}: dense={dense} needs a head that leads into the space of a text tower, and this "
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
        """One vector a patch, float32.

        Args:
            pixels: a normalized picture with sides of whole patches.
        """
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


def _names_of_weights(folder: Path) -> set[str]:
    from safetensors import SafetensorError, safe_open

    names: set[str] = set()
    for path in weight_files(folder, WHAT):
        try:
            with safe_open(path, framework="pt") as opened:
                names |= set(opened.keys())
        except SafetensorError:
            continue  # Loading it says what is wrong with it.
    return names


def window_starts(count: int, window: int, overlap: float) -> list[int]:
    """Where windows begin along a side, in patches: evenly apart, the first at 0 and the last one at the end.

    Args:
        count: patches along the side.
        window: patches along a window; one window is enough where it is not less than `count`.
        overlap: smallest share of a window that the next one covers again, in [0, 1).
    """
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
        patch: pixels along a patch.
        window: pixels along a window, in whole patches; a side of the picture that is shorter is one window.
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
