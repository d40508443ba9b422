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
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning, about, listed
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import (
    choose_tensors,
    digest_files,
    find_file,
    load_companion,
    load_pretrained,
    load_tokenizer,
    open_session,
    quiet_transformers,
    read_config,
    run_on_picture,
)
from gsencoder.core.process import Device
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.onnx import fit_to_patches, normalized
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, Views

MAX_CLASSES_BYTES = 1 << 22


def synonyms_of_classes(names: Sequence[str], nothing: Sequence[str]) -> list[list[str]]:
    """The synonyms of each class; none of a class that is no kind of thing.

    Args:
        names: of the classes.
        nothing: names of classes that are no kind of thing.

    Raises:
        InputError: a class has no name.

    Warns:
        SceneWarning: several classes have one name.
    """
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
    """The names in a .json list or object of numbers to names, or the lines of a text file.

    Raises:
        InputError: the file is none of these, or a name is empty.
    """
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


TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxSegmenterOptions:
    """How pictures are given to an ONNX file, and how its output is read."""

    input: str = field(default="", metadata={"help": "input tensor; empty = the model's first"})
    output: str = field(default="", metadata={"help": "output tensor; empty = the model's first"})
    activation: Literal["softmax", "none"] = field(
        default="softmax",
        metadata={"help": "softmax = the output is logits; none = it is probabilities already"},
    )
    size: int = field(
        default=512,
        metadata={
            "help": "longer side of the picture in pixels; a model of a fixed size has its own, and the picture "
            "is squeezed into it"
        },
    )
    multiple: int = field(default=32, metadata={"help": "sides of the picture are multiples of this"})
    scale: float = field(default=255.0, metadata={"help": "8-bit values are divided by this, then mean and std apply"})
    mean: tuple[float, ...] = field(default=(0.485, 0.456, 0.406), metadata={"help": "subtracted per channel"})
    std: tuple[float, ...] = field(default=(0.229, 0.224, 0.225), metadata={"help": "divided per channel"})
    threads: int = field(default=0, metadata={"help": "onnxruntime threads; 0 = its own choice"})

    def __post_init__(self) -> None:
        if self.activation not in ("softmax", "none"):
            raise InputError(f"activation: expected softmax or none, got {self.activation!r}")
        for name, least, most in (("size", 1, 8192), ("multiple", 1, 1024), ("threads", 0, 1024)):
            if not least <= getattr(self, name) <= most:
                raise InputError(f"{name}: expected a whole number from {least} to {most}, got {getattr(self, name)}")
        if not 1e-6 <= self.scale <= 1e6:
            raise InputError(f"scale: expected a number from 1e-6 to 1e6, got {self.scale}")
        for name, low in (("mean", -1e6), ("std", 1e-6)):
            values = getattr(self, name)
            if len(values) != 3 or not all(low <= value <= 1e6 for value in values):
                raise InputError(f"{name}: expected three numbers, one a channel, got {list(values)}")


class OnnxSegmenter:
    """See `gsencoder.teachers.segmenter.Segmenter`."""

    def __init__(self, path: Path, options: OnnxSegmenterOptions) -> None:
        """Reads the model's signature.

        Args:
            path: the .onnx file.
            options: settings.

        Raises:
            InputError: it cannot be read, or does not take one picture of three channels.
        """
        self._session = open_session(path, "teacher segmenter", threads=options.threads)
        self.name, self.options = path.stem, options
        self._input, self._output = choose_tensors(
            self._session,
            options.input,
            options.output,
            f"teacher segmenter: {path.name}",
            " (teacher.onnx.input, teacher.onnx.output)",
        )
        tensor = next(tensor for tensor in self._session.get_inputs() if tensor.name == self._input)
        shape = tensor.shape
        if len(shape) != 4 or tensor.type not in TYPES or 3 not in (shape[1], shape[3]):
            raise InputError(
                f"teacher segmenter: {path.name} takes {tensor.type}{shape}; expected one picture of float or uint8, "
                "[1, 3, H, W] or [1, H, W, 3]"
            )
        self._channels_first = shape[1] == 3
        self._type = TYPES[tensor.type]
        sides = shape[2:4] if self._channels_first else shape[1:3]
        self._fixed = (sides[0], sides[1]) if all(isinstance(side, int) and side > 0 for side in sides) else None
        beside = path.with_suffix(".json")
        self.classes: tuple[str, ...] = ()
        if beside.is_file():
            self.classes = read_classes(beside)
        size = f"{self._fixed[1]}×{self._fixed[0]} px" if self._fixed else f"{options.size} px"
        self.preprocessing = f"resized to {size}, output {self._output}, {options.activation}"
        if self._type != np.uint8:
            self.preprocessing += f", / {options.scale:g} − {list(options.mean)} / {list(options.std)}"
        self.digest = digest_files(path)

    def outputs(
        self, image: UInt8[np.ndarray, "H W 3"], num_classes: int
    ) -> tuple[Float32[np.ndarray, "h w C"], bool, Float64[np.ndarray, "2 3"]]:
        """Class scores of one picture.

        Args:
            image: any size.
            num_classes: tells the axis of the classes from those of the grid; where it does not, outputs are laid out
                as inputs are.

        Raises:
            InputError: the model does not run on it, or gives no grid of classes.
        """
        resized = self._fitted(image)
        feed = resized[None] if not self._channels_first else resized.transpose(2, 0, 1)[None]
        where = f"teacher segmenter: {self.name}"
        output = run_on_picture(self._session, (self._input, self._output), feed, where)
        if not isinstance(output, np.ndarray) or output.ndim != 4 or len(output) != 1 or output.dtype.kind != "f":
            raise InputError(
                f"{where} gave {self._output!r} of {getattr(output, 'dtype', '?')}{list(np.shape(output))}; expected "
                "scores [1, classes, rows, columns]; give teacher.onnx.output= of the logits"
            )
        scores = output[0].transpose(1, 2, 0) if self._classes_first(output.shape, num_classes) else output[0]
        rows, columns = scores.shape[:2]
        affine = np.array([[columns / image.shape[1], 0.0, 0.0], [0.0, rows / image.shape[0], 0.0]])
        return np.ascontiguousarray(scores, np.float32), self.options.activation == "none", affine

    def _classes_first(self, shape: tuple[int, ...], count: int) -> bool:
        first, last = shape[1] == count, shape[3] == count
        return first if first != last else self._channels_first

    def _fitted(self, image: UInt8[np.ndarray, "H W 3"]) -> Any:
        """The picture in the model's size and type."""
        options = self.options
        if self._fixed:
            resized = np.asarray(Image.fromarray(image).resize(self._fixed[::-1], Image.Resampling.BILINEAR))
        else:
            resized, _ = fit_to_patches(image, options.size, options.multiple)
        if self._type == np.uint8:
            return resized
        return normalized(resized, options.scale, options.mean, options.std).astype(self._type)


WHAT = "teacher segmenter"
MASK_HEADS = ("mask2former", "oneformer", "maskformer", "eomt", "eomt_dinov3")
"""Kinds of models that give a class and a mask for each of many queries."""


class TransformersSegmenter:
    """See `gsencoder.teachers.segmenter.Segmenter`."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere.

        Args:
            folder: of the model.
            device: where the model runs.

        Raises:
            InputError: transformers is missing, or the folder holds no segmenter with its preprocessing.
        """
        config = read_config(folder, WHAT)
        import transformers

        from gsencoder.core.device import choose_device

        self._kind = config.model_type
        universal = self._kind in MASK_HEADS
        loader = "AutoModelForUniversalSegmentation" if universal else "AutoModelForSemanticSegmentation"
        model = load_pretrained(getattr(transformers, loader), folder, WHAT)
        if self._kind == "oneformer":
            self._processor = _oneformer_processor(folder, config.task_seq_len)
        else:
            self._processor = load_companion(transformers.AutoImageProcessor, folder, WHAT, "preprocessing")
        self._device = choose_device(device)
        self._model = model.to(self._device)
        self.name = folder.resolve().name
        names = getattr(config, "id2label", None) or {}
        unnamed = all(str(name).startswith("LABEL_") for name in names.values())
        self.classes = () if unnamed else tuple(str(names[number]) for number in sorted(names))
        self.preprocessing = "the model's own"
        files = [*folder.glob("*.safetensors"), *folder.glob("*.json"), *folder.glob("*.txt")]
        self.digest = digest_files(*sorted(files))

    def outputs(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        num_classes: int,  # noqa: ARG002
    ) -> tuple[Float32[np.ndarray, "h w C"], bool, Float64[np.ndarray, "2 3"]]:
        """Class scores of one picture: logits of a semantic head, probabilities of a head of masks."""
        import torch

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
        rows, columns = (side * used / size for side, used, size in zip(values.shape, filled, input_size, strict=False))
        affine = np.array([[columns / image.shape[1], 0.0, 0.0], [0.0, rows / image.shape[0], 0.0]])
        return np.ascontiguousarray(values), are_probabilities, affine


def _oneformer_processor(folder: Path, task_tokens: int) -> Any:
    """OneFormer's preprocessing, which also tokenizes its task.

    Its files name a list of classes that lies in another repository and serves training alone; without this override
    transformers would fetch it.
    """
    from transformers import AutoImageProcessor, OneFormerProcessor

    images = load_companion(AutoImageProcessor, folder, WHAT, "preprocessing", class_info_file=None)
    return OneFormerProcessor(images, load_tokenizer(folder, WHAT), task_seq_length=task_tokens)


def _semantic_map(classes: Any, masks: Any) -> Any:
    """Σ over queries of the probability of a class, times that of the mask, [C, h, w]; cells that several queries claim
    are brought down to a sum of 1."""
    import torch

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
