"""Dense classifiers as ONNX files: any layout, fixed or free input sizes, float or 8-bit input."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import choose_tensors, digest_files, open_session, run_on_picture
from gsencoder.fusion.teachers.resize import fit_to_patches, normalized
from gsencoder.fusion.teachers.segmenter_classes import read_classes

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
    """See `gsencoder.fusion.teachers.segmenter.Segmenter`."""

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
