"""The `segmenter` teacher: any dense classifier of pictures, whose classes are words in the space of a text encoder.

Each cell is a mixture of class names, Σ_c p_c · t_c with the posterior p of the network and the vector t_c of a class's
name. Fusing is linear, so posteriors are lifted, a share a class, and turned into vectors once at the end. A Gaussian
then answers any phrase whose vector is near to those of the classes that it shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsencoder.core.errors import InputError, about
from gsencoder.core.pretrained import find_file
from gsencoder.fusion.teachers import MissingInput
from gsencoder.fusion.teachers.segmenter_classes import read_classes, synonyms_of_classes
from gsencoder.fusion.teachers.segmenter_onnx import OnnxSegmenter, OnnxSegmenterOptions
from gsencoder.fusion.teachers.segmenter_transformers import TransformersSegmenter
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, Views

SUM_TOLERANCE = 1e-2
"""Largest difference from 1 of the sum of probabilities that a network gives; those of float16 and int8 are rounded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterConfig:
    """Which network, what its classes are called, and how pictures are given to it."""

    name: Literal["segmenter"] = "segmenter"
    model: str = field(
        default="",
        metadata={
            "help": "an .onnx file, or a folder of a model for transformers (SegFormer, Mask2Former, OneFormer, …); "
            "also looked for in GSENCODER_MODELS"
        },
    )
    classes: str = field(
        default="",
        metadata={
            "help": "names of its classes in their order: a .json list or a text file with one a line; empty = those "
            "of the model's folder, or the .json beside the .onnx file"
        },
    )
    nothing: tuple[str, ...] = field(
        default=("other", "others", "background", "unlabeled", "unlabelled", "unknown", "void", "nothing"),
        metadata={"help": "classes that are no kind of thing; they stand for the mean of the text side"},
    )
    temperature: float = field(default=1.0, metadata={"help": "softmax temperature of the posteriors"})
    words: str = field(default="", metadata={"help": "text table with the names of the classes, if no text= is given"})
    device: Literal["auto", "cpu", "cuda"] = field(default="auto", metadata={"help": "where a model of a folder runs"})
    onnx: OnnxSegmenterOptions = field(default_factory=OnnxSegmenterOptions)

    def __post_init__(self) -> None:
        if not 1e-3 <= self.temperature <= 1e3:
            raise InputError(f"temperature: expected a number from 0.001 to 1000, got {self.temperature}")


@runtime_checkable
class Segmenter(Protocol):
    """A network that gives posteriors of its classes on a grid of cells.

    Attributes:
        name: for people.
        digest: of its files.
        classes: names that its own files give, in order; empty where they give none.
        preprocessing: in words.
    """

    name: str
    digest: str
    classes: tuple[str, ...]
    preprocessing: str

    def outputs(
        self, image: UInt8[np.ndarray, "H W 3"], num_classes: int
    ) -> tuple[Float32[np.ndarray, "h w C"], bool, Float64[np.ndarray, "2 3"]]:
        """Class scores, whether they are probabilities (else logits), and the affine from image pixels to cells.

        Args:
            image: any size.
            num_classes: tells the axis of the classes from those of the grid.
        """
        ...


class SegmenterTeacher:
    """Posteriors of a dense classifier as shares of its class names.

    Attributes:
        names: of the classes, in the order of the network.
        kinds: the names that stand for kinds of things, synonyms one by one.
    """

    needs_images = True
    cheap = False

    def __init__(self, config: SegmenterConfig, words: Words) -> None:
        """Loads the network, and embeds the names of its classes.

        Args:
            config: settings.
            words: turns names into vectors.

        Raises:
            InputError: no such model, or names that are missing, of the wrong number, or unknown to `words`.
        """
        if not config.model:
            raise InputError("teacher.model= is missing: an .onnx file, or a folder for transformers")
        self.config = config
        self._network: Segmenter
        if Path(config.model).suffix.lower() == ".onnx":
            self._network = OnnxSegmenter(find_file(config.model, "teacher.model"), config.onnx)
        else:
            folder = find_file(config.model, "teacher.model", folder=True)
            self._network = TransformersSegmenter(folder, config.device)
        if config.classes:
            self.names = read_classes(find_file(config.classes, "teacher.classes"))
        else:
            self.names = self._network.classes
        if not self.names:
            raise InputError(
                f"teacher segmenter: {self._network.name}: no file says what its classes are called; give "
                "teacher.classes= (a .json list, or a text file with one name a line)"
            )
        self.mean = words.mean
        synonyms = synonyms_of_classes(self.names, config.nothing)
        self.kinds = tuple(dict.fromkeys(phrase for each in synonyms for phrase in each))
        self.table = _class_vectors(synonyms, words)
        self.space = FeatureSpace(
            name=f"{self._network.name}-words",
            channels=words.space.channels,
            teacher="segmenter",
            weights=self._network.digest,
            layer=f"posteriors of {len(self.names)} classes as words, temperature {config.temperature:g}",
            preprocessing=self._network.preprocessing,
            text_encoder=words.space.text_encoder,
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Shares of the classes in the cells of one picture.

        Raises:
            InputError: no pictures, or outputs that are not finite, or of another number of classes.
        """
        if views.images is None:
            raise MissingInput("teacher segmenter: the scene has no pictures")
        scores, are_probabilities, grid_from_image = self._network.outputs(views.images[view], len(self.names))
        where = f"teacher segmenter: {self._network.name}: view {views.names[view]!r}"
        if scores.shape[-1] != len(self.names):
            raise InputError(
                f"{where}: the network gives {scores.shape[-1]} classes, and there are {len(self.names)} names for "
                "them; check teacher.classes and teacher.onnx.output"
            )
        bad = int(np.count_nonzero(~np.isfinite(scores)))
        if bad:
            raise InputError(
                f"{where}: {bad} of {scores.size} outputs are not finite; check the model, and how pictures are given "
                "to it (teacher.onnx.scale, mean, std)"
            )
        shares = _checked_shares(scores, where) if are_probabilities else softmax(scores, self.config.temperature)
        return FeatureMap(shares=shares, table=self.table, grid_from_image=grid_from_image, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {
            "name": "segmenter",
            "model": self._network.digest,
            "preprocessing": self._network.preprocessing,
            "classes": list(self.names),
            "nothing": list(self.config.nothing),
            "temperature": self.config.temperature,
            "text_encoder": self.space.text_encoder,
        }


def softmax(logits: Float32[np.ndarray, "h w C"], temperature: float) -> Float32[np.ndarray, "h w C"]:
    """Posteriors of logits; the largest is subtracted first, so that nothing overflows."""
    scaled = (logits - logits.max(axis=-1, keepdims=True)) / np.float32(temperature)
    shares = np.exp(scaled)
    shares /= shares.sum(axis=-1, keepdims=True)
    return shares.astype(np.float32)


def _checked_shares(scores: Float32[np.ndarray, "h w C"], where: str) -> Float32[np.ndarray, "h w C"]:
    """Probabilities as they are; cells may sum to less than 1, where no class is meant.

    Raises:
        InputError: one is negative, or a cell sums to more than 1.
    """
    if scores.min() < 0 or scores.sum(axis=-1).max() > 1 + SUM_TOLERANCE:
        raise InputError(
            f"{where}: expected probabilities, from 0 and at most 1 in sum, got {float(scores.min()):.3g} to "
            f"{float(scores.sum(axis=-1).max()):.3g}; are these logits (teacher.onnx.activation=softmax)?"
        )
    return scores


def _class_vectors(synonyms: Sequence[Sequence[str]], words: Words) -> Float32[np.ndarray, "C D"]:
    """The vector of each class: the normalized mean over its synonyms; of a class without any the direction of the text
    side's mean, as the labels teacher has it for "other"."""
    phrases = list(dict.fromkeys(phrase for each in synonyms for phrase in each))
    if not phrases:
        raise InputError("teacher segmenter: none of its classes is a kind of thing; check teacher.nothing")
    with about("teacher segmenter: names of its classes"):
        vector_of = dict(zip(phrases, words.encode(phrases).astype(np.float64), strict=True))
    mean = words.mean.astype(np.float64)
    table = np.stack([np.mean([vector_of[phrase] for phrase in each], axis=0) if each else mean for each in synonyms])
    return (table / np.sqrt((table**2).sum(axis=1, keepdims=True) + 1e-24)).astype(np.float32)
