"""The `segmenter` teacher: any dense classifier of pictures, whose classes are words in the space of a text encoder.

Each cell is a mixture of class names, Σ_c p_c · t_c with the posterior p of the network and the vector t_c of a class's
name. Fusing is linear, so posteriors are lifted, a share a class, and turned into vectors once at the end. A Gaussian
then answers any phrase whose vector is near to those of the classes that it shows.
"""

import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, SceneWarning, error_prefix, listed
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import (
    digest_files,
    find_file,
    load_companion,
    load_pretrained,
    load_tokenizer,
    quiet_transformers,
    read_config,
)
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.teachers.base import Teacher, TeacherSettings
from gsencoder.teachers.pictures import (
    LARGEST_SIDE,
    OnnxNetwork,
    OnnxOptions,
    check_finite,
    fit_to_patches,
    photograph,
    resize_affine,
)
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

LABEL = "teacher segmenter"
MULTIPLE = 32
"""Sides of pictures are multiples of this, where a model does not have a size of its own."""
MAX_CLASSES_BYTES = 1 << 22


def synonyms_of_classes(names: Sequence[str], nothing: Sequence[str]) -> list[list[str]]:
    """The synonyms of each class; none of a class whose name is in `nothing`, as it is no kind of thing."""
    no_kind = {word.strip().casefold() for word in nothing}
    synonyms = [[] if name.strip().casefold() in no_kind else _synonyms(name) for name in names]
    for name, each in zip(names, synonyms, strict=True):
        if not each and name.strip().casefold() not in no_kind:
            raise InputError(f"teacher.classes: class {name!r} has no name; expected a word, or one of teacher.nothing")
    if len(set(names)) < len(names):
        doubled = sorted({name for name in names if list(names).count(name) > 1})
        warnings.warn(
            f"teacher.classes: {len(doubled)} names stand for several classes: {listed(doubled)}",
            SceneWarning,
            stacklevel=3,
        )
    return synonyms


def _synonyms(name: str) -> list[str]:
    """The parts of "window, windowpane" or "door;double door", with blanks for _ and -."""
    parts = [re.sub(r"[\s_\-]+", " ", part).strip() for part in re.split(r"[,;]", name)]
    return [part for part in parts if part]


def read_classes(path: Path) -> tuple[str, ...]:
    """The names in a .json list or object of numbers to names, or the lines of a text file."""
    try:
        text = read_foreign_text(path, MAX_CLASSES_BYTES)
        values = json.loads(text) if path.suffix.lower() == ".json" else text.splitlines()
    except InputError as error:
        raise InputError(f"teacher.classes: {error}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"teacher.classes: {path} cannot be read: {str(error)[:80]}") from error
    if isinstance(values, dict):
        numbers = [str(number) for number in range(len(values))]
        values = [values.get(number) for number in numbers]
    if path.suffix.lower() != ".json":
        values = [line for line in values if line.strip()]
    if not isinstance(values, list) or not all(isinstance(name, str) and name.strip() for name in values):
        raise InputError(f"teacher.classes: {path}: expected a list of names, in the order of the network's classes")
    return tuple(name.strip() for name in values)


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxSegmenterOptions(OnnxOptions):
    """How pictures are given to an ONNX file, and which output has the scores."""

    size: int = option(
        512,
        "longer side of the picture in pixels; a model of a fixed size has its own, and the picture "
        "is squeezed into it",
        ge=1,
        le=LARGEST_SIDE,
    )


Scores = tuple[Float32[np.ndarray, "h w C"], bool, Float64[np.ndarray, "2 3"]]
"""Class scores of a picture, whether they are probabilities (else logits), and the affine from its pixels to cells."""


class OnnxSegmenter:
    """An .onnx file that gives scores of classes on a grid; `classes` are the names in the .json of the same name."""

    def __init__(self, path: Path, options: OnnxSegmenterOptions) -> None:
        self._network = network = OnnxNetwork(path, options, LABEL)
        self.name, self.digest, self._size = network.name, network.digest, options.size
        names = path.with_suffix(".json")
        self.classes = read_classes(names) if names.is_file() else ()
        size = f"{network.fixed[1]}×{network.fixed[0]} px" if network.fixed else f"{options.size} px"
        self.preprocessing = f"resized to {size}, output {network.output}, softmax"
        if not network.takes_bytes:
            self.preprocessing += f", / {options.scale:g} − {list(options.mean)} / {list(options.std)}"

    def scores(self, image: UInt8[np.ndarray, "H W 3"], num_classes: int) -> Scores:
        """Class scores; `num_classes` tells the axis of the classes from those of the grid.

        Outputs that are probabilities already (from 0, a sum of 1 in each cell) are recognized: no logits are.
        """
        network = self._network
        if network.fixed:
            picture = np.asarray(Image.fromarray(image).resize(network.fixed[::-1], Image.Resampling.BILINEAR))
        else:
            picture, _ = fit_to_patches(image, self._size, MULTIPLE)
        output = network.run(picture)
        if not isinstance(output, np.ndarray) or output.ndim != 4 or len(output) != 1 or output.dtype.kind != "f":
            raise InputError(
                f"{network.subject} gave {network.output!r} of {getattr(output, 'dtype', '?')}"
                f"{list(np.shape(output))}; expected scores [1, classes, rows, columns]; give teacher.onnx.output="
            )
        first, last = output.shape[1] == num_classes, output.shape[3] == num_classes
        classes_first = first if first != last else network.channels_first
        scores = np.ascontiguousarray(output[0].transpose(1, 2, 0) if classes_first else output[0], np.float32)
        are_probabilities = bool(scores.min() >= 0 and np.abs(scores.sum(axis=-1) - 1).max() <= SUM_TOLERANCE)
        return scores, are_probabilities, resize_affine(scores.shape[:2], image.shape[:2])


MASK_HEADS = ("mask2former", "oneformer", "maskformer", "eomt", "eomt_dinov3")
"""Kinds of models that give a class and a mask for each of many queries."""


class TransformersSegmenter:
    """A segmenter of transformers with its preprocessing; attributes are those of `OnnxSegmenter`."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere."""
        config = read_config(folder, LABEL)
        import transformers

        self._kind = config.model_type
        universal = self._kind in MASK_HEADS
        loader = "AutoModelForUniversalSegmentation" if universal else "AutoModelForSemanticSegmentation"
        model = load_pretrained(getattr(transformers, loader), folder, LABEL)
        if self._kind == "oneformer":
            self._processor = _oneformer_processor(folder, config.task_seq_len)
        else:
            self._processor = load_companion(transformers.AutoImageProcessor, folder, LABEL, "preprocessing")
        self._device = choose_device(device)
        self._model = model.to(self._device)
        self.name = folder.resolve().name
        names = getattr(config, "id2label", None) or {}
        unnamed = all(str(name).startswith("LABEL_") for name in names.values())
        self.classes = () if unnamed else tuple(str(names[number]) for number in sorted(names))
        self.preprocessing = "the model's own"
        files = [*folder.glob("*.safetensors"), *folder.glob("*.json"), *folder.glob("*.txt")]
        self.digest = digest_files(*sorted(files))

    def scores(self, image: UInt8[np.ndarray, "H W 3"], num_classes: int) -> Scores:  # noqa: ARG002
        """Class scores: logits of a semantic head, probabilities of a head of masks."""
        task = {"task_inputs": ["semantic"]} if self._kind == "oneformer" else {}
        with quiet_transformers():
            inputs = self._processor(images=image, return_tensors="pt", **task)
        input_size = inputs["pixel_values"].shape[-2:]
        filled = _filled(inputs.get("pixel_mask"), input_size)
        with torch.inference_mode():
            outputs = self._model(**{name: value.to(self._device) for name, value in inputs.items()})
            are_probabilities = self._kind in MASK_HEADS
            if are_probabilities:
                scores = _semantic_map(outputs.class_queries_logits[0], outputs.masks_queries_logits[0])
            else:
                scores = outputs.logits[0]
        values = scores.permute(1, 2, 0).float().cpu().numpy()
        # Padding at the right and below is part of the grid, and no part of the picture.
        sides = [side * used / size for side, used, size in zip(values.shape, filled, input_size, strict=False)]
        return np.ascontiguousarray(values), are_probabilities, resize_affine(sides, image.shape[:2])


def _oneformer_processor(folder: Path, task_tokens: int) -> Any:
    """OneFormer's preprocessing, which also tokenizes its task.

    Its files name a list of classes that lies in another repository and serves training alone; without this override
    transformers would fetch it.
    """
    from transformers import AutoImageProcessor, OneFormerProcessor

    images = load_companion(AutoImageProcessor, folder, LABEL, "preprocessing", class_info_file=None)
    return OneFormerProcessor(images, load_tokenizer(folder, LABEL), task_seq_length=task_tokens)


def _semantic_map(classes: Any, masks: Any) -> Any:
    """Σ over queries of the probability of a class, times that of the mask, [C, h, w]; cells that several queries claim
    are brought down to a sum of 1."""
    probabilities = classes.float().softmax(dim=-1)[..., :-1]
    scores = torch.einsum("qc,qhw->chw", probabilities, masks.float().sigmoid())
    return scores / scores.sum(dim=0, keepdim=True).clamp(min=1)


def _filled(pixel_mask: Any, input_size: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns that the picture fills."""
    if pixel_mask is None:
        return input_size[0], input_size[1]
    mask = pixel_mask[0].bool()
    return int(mask.any(dim=1).sum()), int(mask.any(dim=0).sum())


SUM_TOLERANCE = 1e-2
"""Largest difference from 1 of the sum of probabilities that a network gives; those of float16 and int8 are rounded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterConfig(TeacherSettings):
    """Which network, what its classes are called, and how pictures are given to it."""

    name: Literal["segmenter"] = "segmenter"
    model: str = option(
        "",
        "an .onnx file, or a folder of a model for transformers (SegFormer, Mask2Former, OneFormer, …); "
        "also looked for in GSENCODER_MODELS",
    )
    classes: str = option(
        "",
        "names of its classes in their order: a .json list or a text file with one a line; empty = those "
        "of the model's folder, or the .json of the same name as the .onnx file",
    )
    nothing: tuple[str, ...] = option(
        ("other", "others", "background", "unlabeled", "unlabelled", "unknown", "void", "nothing"),
        "classes that are no kind of thing; they stand for the mean of the text side",
    )
    temperature: float = option(1.0, "softmax temperature of the posteriors", ge=1e-3, le=1e3)
    words: str = option("", "text table with the names of the classes, if no text= is given")
    device: Device = option("auto", "where a model of a folder runs")
    onnx: OnnxSegmenterOptions = field(default_factory=OnnxSegmenterOptions)

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        if words is None:
            raise InputError(
                f"{LABEL}: its classes need words: give a text tower (text=onnx text.model=FOLDER), or a text table "
                "that has their names (teacher.words=)"
            )
        return SegmenterTeacher(self, words)


class SegmenterTeacher:
    """Posteriors of a dense classifier as shares of its class names.

    Attributes:
        names: of the classes, in the order of the network.
        kinds: the names that stand for kinds of things, synonyms one by one.
    """

    needs_images = True
    cheap = False

    def __init__(self, config: SegmenterConfig, words: Words) -> None:
        """Loads the network, and embeds the names of its classes with `words`."""
        if not config.model:
            raise InputError("teacher.model= is missing: an .onnx file, or a folder for transformers")
        self.config = config
        self._network: OnnxSegmenter | TransformersSegmenter
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
                f"{LABEL}: {self._network.name}: no file says what its classes are called; give "
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
        """Shares of the classes in the cells of one picture."""
        image = photograph(views, view, LABEL)
        scores, are_probabilities, grid_from_image = self._network.scores(image, len(self.names))
        where = f"{LABEL}: {self._network.name}: view {views.names[view]!r}"
        if scores.shape[-1] != len(self.names):
            raise InputError(
                f"{where}: the network gives {scores.shape[-1]} classes, and there are {len(self.names)} names for "
                "them; check teacher.classes and teacher.onnx.output"
            )
        check_finite(scores, where, "the model, and how pictures are given to it (teacher.onnx.scale, mean, std)")
        shares = scores if are_probabilities else softmax(scores, self.config.temperature)
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


def _class_vectors(synonyms: Sequence[Sequence[str]], words: Words) -> Float32[np.ndarray, "C D"]:
    """The vector of each class: the normalized mean over its synonyms; of a class without any the direction of the text
    side's mean, as the labels teacher has it for "other"."""
    phrases = list(dict.fromkeys(phrase for each in synonyms for phrase in each))
    if not phrases:
        raise InputError(f"{LABEL}: none of its classes is a kind of thing; check teacher.nothing")
    with error_prefix(f"{LABEL}: names of its classes"):
        vector_of = dict(zip(phrases, words.encode(phrases).astype(np.float64), strict=True))
    mean = words.mean.astype(np.float64)
    table = np.stack([np.mean([vector_of[phrase] for phrase in each], axis=0) if each else mean for each in synonyms])
    return (table / np.sqrt((table**2).sum(axis=1, keepdims=True) + 1e-24)).astype(np.float32)
