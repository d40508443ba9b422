"""The `onnx` teacher: any dense ONNX backbone under onnxruntime, its outputs as they are or as word mixtures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import choose_tensors, digest_files, find_file, open_session, run_on_picture
from gsencoder.teachers.base import MissingInput
from gsencoder.types import FeatureMap, FeatureSpace, Views


def patches_of(height: int, width: int, size: int, patch: int) -> tuple[int, int]:
    """Rows and columns of patches of a picture whose longer side becomes about `size` pixels."""
    ratio = size / max(height, width)
    return max(1, round(height * ratio / patch)), max(1, round(width * ratio / patch))


def fit_to_patches(
    image: UInt8[np.ndarray, "H W 3"],
    size: int,
    patch: int,
    resample: Image.Resampling = Image.Resampling.BICUBIC,
) -> tuple[UInt8[np.ndarray, "h w 3"], Float64[np.ndarray, "2 3"]]:
    """A picture with sides of whole patches, and the affine from its own pixels to the grid of patches.

    Args:
        image: any size.
        size: about what the longer side becomes, pixels.
        patch: pixels along a patch.
        resample: the filter.
    """
    height, width = image.shape[:2]
    rows, columns = patches_of(height, width, size, patch)
    resized = Image.fromarray(image).resize((columns * patch, rows * patch), resample)
    return np.asarray(resized), np.array([[columns / width, 0, 0], [0, rows / height, 0]])


def normalized(
    image: UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"],
    scale: float,
    mean: Sequence[float],
    std: Sequence[float],
) -> Float32[np.ndarray, "H W 3"]:
    """(image / scale − mean) / std, channel by channel."""
    return (image.astype(np.float32) / np.float32(scale) - np.array(mean, np.float32)) / np.array(std, np.float32)


LARGEST_SIDE = 8192
"""Pixels along a resized picture: beyond this the backbone's own maps no longer fit into memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxConfig:
    """How to feed a dense ONNX backbone and read its output."""

    name: Literal["onnx"] = "onnx"
    model: str = field(default="", metadata={"help": "the .onnx file; also looked for in GSENCODER_MODELS"})
    space: str = field(default="", metadata={"help": "short name of its feature space; empty = the file's name"})
    input: str = field(default="", metadata={"help": "input tensor [B,3,H,W]; empty = the model's first"})
    output: str = field(default="", metadata={"help": "output tensor; empty = the model's first"})
    layout: Literal["tokens", "grid"] = field(
        default="tokens", metadata={"help": "output as [B, T, D] tokens or as [B, D, h, w] grid"}
    )
    skip_tokens: int = field(default=0, metadata={"help": "leading tokens that are no patches (CLS, registers)"})
    patch: int = field(default=14, metadata={"help": "pixels of the resized picture in a cell"})
    size: int = field(default=448, metadata={"help": "longer side of the resized picture in pixels"})
    scale: float = field(default=255.0, metadata={"help": "8-bit values are divided by this, then mean and std apply"})
    mean: tuple[float, ...] = field(default=(0.485, 0.456, 0.406), metadata={"help": "subtracted per channel"})
    std: tuple[float, ...] = field(default=(0.229, 0.224, 0.225), metadata={"help": "divided per channel"})
    classes: str = field(default="", metadata={"help": ".npz of class vectors: logits become mixtures of them"})
    top_k: int = field(default=5, metadata={"help": "classes in a mixture"})
    temperature: float = field(default=1.0, metadata={"help": "softmax temperature of the posteriors"})
    words: str = field(default="", metadata={"help": "text table that leads into the space; empty if none"})
    joint: bool = field(
        default=False,
        metadata={"help": "the model is the image side of the joint model that text= is the text side of"},
    )
    threads: int = field(default=0, metadata={"help": "onnxruntime threads; 0 = its own choice"})

    def __post_init__(self) -> None:
        for name, low, high in (
            ("patch", 1, LARGEST_SIDE),
            ("size", 1, LARGEST_SIDE),
            ("skip_tokens", 0, 1_000_000),
            ("top_k", 1, 1_000_000),
            ("threads", 0, 1024),
        ):
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}: expected a whole number from {low} to {high}, got {getattr(self, name)}")
        for name in ("scale", "temperature"):
            if not 1e-6 <= getattr(self, name) <= 1e6:
                raise InputError(f"{name}: expected a number from 1e-6 to 1e6, got {getattr(self, name)}")
        if len(self.mean) != 3 or not all(abs(value) <= 1e6 for value in self.mean):
            raise InputError(f"mean: expected three numbers, one a channel, got {list(self.mean)}")
        if len(self.std) != 3 or not all(1e-6 <= value <= 1e6 for value in self.std):
            raise InputError(f"std: expected three numbers from 1e-6 to 1e6, one a channel, got {list(self.std)}")


class OnnxTeacher:
    """A dense backbone behind onnxruntime. The whole picture is resized to multiples of the patch, without a crop."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, config: OnnxConfig, *, text_encoder: str = "") -> None:
        """Reads the model's signature and, for a classifier, the class vectors.

        Args:
            config: what to run and how.
            text_encoder: what turns words into this space; empty if nothing does.

        Raises:
            InputError: a missing or unreadable model, or names that it does not have.
        """
        self.config = config
        if not config.model:
            raise InputError("teacher.model= is missing: the .onnx file of the backbone")
        path = find_file(config.model, "teacher.model")
        self._session = open_session(path, "teacher onnx", threads=config.threads)
        self._path = path
        self._input, self._output = choose_tensors(
            self._session, config.input, config.output, f"teacher onnx: {path.name}"
        )
        self._digest = digest_files(path)
        self._classes = _load_classes(find_file(config.classes, "teacher.classes")) if config.classes else None
        shape = next(tensor.shape for tensor in self._session.get_outputs() if tensor.name == self._output)
        stated = shape[-1 if config.layout == "tokens" else 1] if len(shape) == self._axes else None
        if self._classes is not None:
            stated = self._classes.shape[1]
        # What a model states of its output may be a name, or nothing at all; then it is run to see.
        channels = stated if isinstance(stated, int) and stated > 0 else self._probe()
        self.space = FeatureSpace(
            name=config.space or path.stem,
            channels=channels,
            teacher="onnx",
            weights=self._digest,
            layer=self._output + (f", top {config.top_k} classes as words" if config.classes else ""),
            preprocessing=f"resized to {config.size} px in multiples of {config.patch}",
            text_encoder=text_encoder,
        )

    @property
    def _axes(self) -> int:
        return 3 if self.config.layout == "tokens" else 4

    def _probe(self) -> int:
        side = self.config.patch * 2
        return int(self._run(np.zeros((side, side, 3), np.uint8)).shape[-1])

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The backbone's cells for one picture.

        Raises:
            MissingInput: no pictures.
            InputError: an output whose grid does not fit the input.
        """
        if views.images is None:
            raise MissingInput("teacher onnx: the scene has no pictures")
        patch = self.config.patch
        resized, grid_from_image = fit_to_patches(views.images[view], self.config.size, patch)
        rows, columns = resized.shape[0] // patch, resized.shape[1] // patch
        features = self._run(resized)
        if features.shape[:2] != (rows, columns):
            raise InputError(
                f"teacher onnx: expected {rows}×{columns} cells of {patch} pixels, the model gave "
                f"{features.shape[0]}×{features.shape[1]}; check teacher.patch and teacher.skip_tokens"
            )
        bad = int(np.count_nonzero(~np.isfinite(features)))
        if bad:
            raise InputError(
                f"teacher onnx: {bad} of {features.size} values of {self._path.name} for view {views.names[view]!r} "
                "are not finite; check teacher.scale, teacher.mean and teacher.std, or the model"
            )
        return FeatureMap(features=features, grid_from_image=grid_from_image, space=self.space)

    def _run(self, image: np.ndarray) -> Float32[np.ndarray, "h w D"]:
        config = self.config
        result = self._output_of(normalized(image, config.scale, config.mean, config.std).transpose(2, 0, 1)[None])
        if config.layout == "grid":
            result = result.transpose(1, 2, 0)
        else:
            result = result[config.skip_tokens :]
            rows, columns = image.shape[0] // config.patch, image.shape[1] // config.patch
            if len(result) != rows * columns:
                raise InputError(
                    f"teacher onnx: expected {rows * columns} patch tokens, the model gave {len(result)}; "
                    f"check teacher.patch and teacher.skip_tokens"
                )
            result = result.reshape(rows, columns, -1)
        if self._classes is not None:
            result = self._mix(result.reshape(-1, result.shape[-1])).reshape(*result.shape[:2], -1)
        return np.ascontiguousarray(result, np.float32)

    def _output_of(self, tensor: Float32[np.ndarray, "1 3 H W"]) -> np.ndarray:
        """The model's output for one picture, without the batch axis."""
        where = f"teacher onnx: {self._path.name}"
        output = run_on_picture(self._session, (self._input, self._output), tensor, where)
        if not isinstance(output, np.ndarray) or output.ndim != self._axes or len(output) != 1:
            expected = "[1, tokens, channels]" if self.config.layout == "tokens" else "[1, channels, rows, columns]"
            raise InputError(
                f"{where} gave {self._output!r} of shape {list(np.shape(output))}, expected {expected}; "
                "check teacher.layout and teacher.output"
            )
        return output[0]

    def _mix(self, logits: Float32[np.ndarray, "n classes"]) -> Float32[np.ndarray, "n D"]:
        """Unit-norm mixture of the word vectors of the most probable classes, weighted by their probabilities."""
        assert self._classes is not None
        if logits.shape[1] != len(self._classes):
            raise InputError(f"teacher onnx: {logits.shape[1]} classes but {len(self._classes)} class vectors")
        has_vector = np.isfinite(self._classes[:, 0])
        logits = np.where(has_vector, logits / self.config.temperature, -np.inf)
        k = min(self.config.top_k, int(has_vector.sum()))
        best = np.argpartition(-logits, k - 1, axis=1)[:, :k]
        top = np.take_along_axis(logits, best, axis=1)
        share = np.exp(top - top.max(axis=1, keepdims=True))
        mixed = np.einsum("nk,nkd->nd", share / share.sum(axis=1, keepdims=True), self._classes[best])
        return (mixed / np.sqrt((mixed * mixed).sum(axis=1, keepdims=True) + 1e-12)).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        values = {name: getattr(self.config, name) for name in self.config.__dataclass_fields__}
        del values["threads"], values["words"], values["joint"]
        values["model"] = self._digest
        values["classes"] = Path(self.config.classes).name
        return {**{k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}}


def _load_classes(path: Path) -> Float32[np.ndarray, "classes D"]:
    """Word vectors of a classifier's classes; NaN rows for those without one.

    Raises:
        InputError: no such file, or one without `embeddings` and `known`.
    """
    arrays = read_npz(path, {"embeddings": ("f", 2), "known": ("b", 1)})
    vectors, known = arrays["embeddings"].astype(np.float32), arrays["known"]
    if known.shape != (len(vectors),) or not known.any() or not np.isfinite(vectors[known]).all():
        raise InputError(f"teacher.classes: {path}: expected embeddings [C, D] and known [C], finite where known")
    return np.where(known[:, None], vectors, np.nan).astype(np.float32)
