"""The `onnx` teacher: any dense ONNX backbone under onnxruntime, its outputs as they are or as word mixtures."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import find_file
from gsencoder.core.settings import option
from gsencoder.teachers.base import Teacher, TeacherSettings, check_channels, text_encoder_of
from gsencoder.teachers.pictures import LARGEST_SIDE, OnnxNetwork, OnnxOptions, PictureTeacher, fit_to_patches
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureSpace, Scene

TOP_CLASSES = 5
"""The most probable classes of a cell whose words are mixed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseOnnxOptions(OnnxOptions):
    """How an .onnx file of an image tower is run, and how its dense output is read."""

    layout: Literal["tokens", "grid"] = option("tokens", "dense output as [B, T, D] tokens or as [B, D, h, w] grid")
    skip_tokens: int = option(0, "leading tokens that are no patches (CLS, registers)", ge=0, le=1_000_000)
    patch: int = option(14, "pixels of the resized picture in a cell", ge=1, le=LARGEST_SIDE)


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxConfig(TeacherSettings, DenseOnnxOptions):
    """How to feed a dense ONNX backbone and read its output."""

    name: Literal["onnx"] = "onnx"
    model: str = option("", "the .onnx file; also looked for in GSENCODER_MODELS")
    space: str = option("", "short name of its feature space; empty = the file's name")
    classes: str = option("", "word vectors of a classifier's classes (.npz); features become their mixtures")
    temperature: float = option(1.0, "softmax temperature of the posteriors", ge=1e-6, le=1e6)
    words: str = option("", "text table of the teacher's space; empty if none")
    joint: bool = option(False, "the model is the image side of the joint model that text= is the text side of")

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        teacher = OnnxTeacher(self, text_encoder=text_encoder_of(words))
        check_channels(teacher.space, words)
        return teacher

    def refuse_text(self) -> str:
        if self.classes:
            return "text=: the classes of teacher.classes= have vectors of their own; leave out one of the two"
        if not self.joint:
            return (
                "text=: the features of teacher=onnx are taken for those of the text tower if teacher.joint=true says "
                "that both belong to one joint model, such as CLIP; other backbones have no words"
            )
        return TeacherSettings.refuse_text(self)


class OnnxTeacher(PictureTeacher):
    """A dense backbone behind onnxruntime. The whole picture is resized to multiples of the patch, without a crop."""

    subject = "teacher onnx"
    advice = "teacher.scale, teacher.mean and teacher.std, or the model"

    def __init__(self, config: OnnxConfig, *, text_encoder: str = "") -> None:
        """Reads the model's signature and, for a classifier, the class vectors."""
        self.config = config
        if not config.model:
            raise InputError("teacher.model= is missing: the .onnx file of the backbone")
        self._network = OnnxNetwork(find_file(config.model, "teacher.model"), config, self.subject)
        self.subject = self._network.subject
        self._classes = _load_classes(find_file(config.classes, "teacher.classes")) if config.classes else None
        shape = self._network.output_shape
        channels = shape[-1 if config.layout == "tokens" else 1] if len(shape) == self._axes else None
        if self._classes is not None:
            channels = self._classes.shape[1]
        if not isinstance(channels, int) or channels < 1:
            # What a model says of its output may be a name, or nothing at all; then it is run to see.
            channels = self._run(np.zeros((2 * config.patch, 2 * config.patch, 3), np.uint8)).shape[-1]
        self.space = FeatureSpace(
            name=config.space or self._network.name,
            channels=int(channels),
            teacher="onnx",
            weights=self._network.digest,
            layer=self._network.output + (f", top {TOP_CLASSES} classes as words" if config.classes else ""),
            preprocessing=f"resized to {config.size} px in multiples of {config.patch}",
            text_encoder=text_encoder,
        )

    @property
    def _axes(self) -> int:
        return 3 if self.config.layout == "tokens" else 4

    def cells(
        self, image: UInt8[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "h w D"], Float64[np.ndarray, "2 3"]]:
        """The backbone's cells of one picture; InputError for an output whose grid does not fit the input."""
        patch = self.config.patch
        resized, grid_from_image = fit_to_patches(image, self.config.size, patch)
        rows, columns = resized.shape[0] // patch, resized.shape[1] // patch
        features = self._run(resized)
        if features.shape[:2] != (rows, columns):
            raise InputError(
                f"teacher onnx: expected {rows}×{columns} cells of {patch} pixels, the model gave "
                f"{features.shape[0]}×{features.shape[1]}; check teacher.patch"
            )
        return features, grid_from_image

    def _run(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "h w D"]:
        config, network = self.config, self._network
        output = network.run(image)
        if not isinstance(output, np.ndarray) or output.ndim != self._axes or len(output) != 1:
            expected = "[1, tokens, channels]" if config.layout == "tokens" else "[1, channels, rows, columns]"
            raise InputError(
                f"{network.subject} gave {network.output!r} of shape {list(np.shape(output))}, expected {expected}; "
                "check teacher.layout and teacher.output"
            )
        result = output[0]
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

    def _mix(self, logits: Float32[np.ndarray, "n classes"]) -> Float32[np.ndarray, "n D"]:
        """Unit-norm mixture of the word vectors of the most probable classes, weighted by their probabilities."""
        assert self._classes is not None
        if logits.shape[1] != len(self._classes):
            raise InputError(f"teacher onnx: {logits.shape[1]} classes but {len(self._classes)} class vectors")
        has_vector = np.isfinite(self._classes[:, 0])
        logits = np.where(has_vector, logits / self.config.temperature, -np.inf)
        k = min(TOP_CLASSES, int(has_vector.sum()))
        best = np.argpartition(-logits, k - 1, axis=1)[:, :k]
        top = np.take_along_axis(logits, best, axis=1)
        share = np.exp(top - top.max(axis=1, keepdims=True))
        mixed = np.einsum("nk,nkd->nd", share / share.sum(axis=1, keepdims=True), self._classes[best])
        return (mixed / np.sqrt((mixed * mixed).sum(axis=1, keepdims=True) + 1e-12)).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        values = {name: value for name, value in asdict(self.config).items() if name not in ("words", "joint")}
        values |= {"mean": list(self.config.mean), "std": list(self.config.std)}
        return {**values, "model": self._network.digest, "classes": Path(self.config.classes).name}


def _load_classes(path: Path) -> Float32[np.ndarray, "classes D"]:
    """Word vectors of a classifier's classes; NaN rows for those without one."""
    arrays = read_npz(path, {"embeddings": ("f", 2), "known": ("b", 1)})
    vectors, known = arrays["embeddings"].astype(np.float32), arrays["known"]
    if known.shape != (len(vectors),) or not known.any() or not np.isfinite(vectors[known]).all():
        raise InputError(f"teacher.classes: {path}: expected embeddings [C, D] and known [C], finite where known")
    return np.where(known[:, None], vectors, np.nan).astype(np.float32)
