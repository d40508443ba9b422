"""The exported encoder under onnxruntime, without torch, and the metadata of its file, which any program can read.

The entry `gsencoder` is JSON: the format's version, the grid, the curves, the feature space (or the spaces of several
teachers, in whose columns the features are), and for each array its type and shape. `gsencoder.NAME` is the array NAME:
little-endian, deflated, in base64. `gsencoder.sum` is the sha256 of the whole file, with zeros in the sum's own place.
"""

import base64
import binascii
import hashlib
import io
import json
import math
import warnings
import zlib
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError, SceneWarning, error_prefix, readable
from gsencoder.core.files import MODEL_BYTES, read_foreign
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device, Precision, Stored
from gsencoder.models.grid import ALIGN, INVALID_CODE, Order, SceneCurves, check_extent
from gsencoder.models.output_space import OutputSpace, OutputSpaces, output_spaces_parts
from gsencoder.text.table import TextTable, tower_from_json, tower_to_json, trained_from_json, unrounded
from gsencoder.types import FeatureBasis, FeatureSpace, Gaussians

KEY = "gsencoder"
VERSION, VERSION_OF_SEVERAL = 2, 3
"""Of files of one output space, and of several; the first is read by earlier versions of gsencoder, too."""
SUM, NO_SUM = f"{KEY}.sum", "0" * 64
FIELDS = ("means", "quats", "scales", "opacities", "sh_dc")
"""Inputs of the graph that every cloud has."""
SETTINGS = ("voxel", "corner", "starts")
"""Inputs that have values of their own: the grid in metres, and those of a cloud that is no part of another."""
OUTPUT = "features"
ARRAYS = ("mean", "components", "words", "words_mean", "words_scale")
MAX_INFLATION = 20
"""Bytes that a character of text may stand for, where an array is large."""
WORD_STEPS = 63
"""Largest integer of a word's embedding in an int8 file: seven bits leave centered cosines of 0.9995 or more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EncoderHeader:
    """What a runtime must know of an encoder.

    Attributes:
        voxel: edge of the finest grid, metres.
        coarser: further grids, whose outputs are averaged with those on it, as multiples of the voxel.
        patch: most tokens in a patch.
        outputs: what the features mean; the graph has restored them already.
        tables: what turns words into their spaces, by teacher, where there are such tables.
        made_by: settings and results of training and export, as JSON values.
    """

    voxel: float
    coarser: tuple[float, ...] = ()
    levels: int
    orders: tuple[Order, ...]
    patch: int
    outputs: OutputSpaces
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    precision: Stored = "float32"
    made_by: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        possible_orders, highest = get_args(Order), ALIGN.bit_length()
        numbers = type(self.levels) is int and type(self.patch) is int
        if not 0 < self.voxel < math.inf or not numbers or not 1 <= self.levels <= highest or self.patch < 1:
            raise InputError(
                f"expected a positive voxel, 1 to {highest} levels and patches of 1 or more, got {self.voxel}, "
                f"{self.levels}, {self.patch}"
            )
        if self.precision not in get_args(Stored):
            raise InputError(
                f"expected a precision among {', '.join(get_args(Stored))}, got {str(self.precision)[:40]}"
            )
        if not self.orders or not set(self.orders) <= set(possible_orders):
            raise InputError(f"expected orders among {', '.join(possible_orders)}, got {str(self.orders)[:80]}")


def to_metadata(header: EncoderHeader) -> dict[str, str]:
    """The entries of text that hold a header."""
    arrays, values = output_spaces_parts(header.outputs)
    values |= {
        "version": VERSION if len(header.outputs) == 1 else VERSION_OF_SEVERAL,
        "voxel": header.voxel,
        "coarser": list(header.coarser),
        "levels": header.levels,
        "orders": list(header.orders),
        "patch": header.patch,
        "precision": header.precision,
        "made_by": dict(header.made_by),
    }
    for number, name in enumerate(header.outputs):
        if name not in header.tables:
            continue
        single = len(header.outputs) == 1
        entry, prefix = (values, "") if single else (values["outputs"][number], f"{number}.")
        words_arrays, entry["words"] = _words_parts(header.tables[name], in_int8=header.precision.startswith("int8"))
        arrays |= {prefix + key: value for key, value in words_arrays.items()}
    values["arrays"] = {name: {"dtype": value.dtype.name, "shape": value.shape} for name, value in arrays.items()}
    entries = {KEY: json.dumps(values, ensure_ascii=False)}
    for name, value in arrays.items():
        little = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        entries[f"{KEY}.{name}"] = base64.b64encode(zlib.compress(little.tobytes(), 9)).decode("ascii")
    return entries


def _words_parts(words: TextTable, *, in_int8: bool) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = {"words_mean": words.mean}
    if in_int8:
        arrays["words"], arrays["words_scale"] = round_columns(words.embeddings, WORD_STEPS)
    else:
        arrays["words"] = words.embeddings.astype(np.float16)
    values: dict[str, Any] = {"names": list(words.names), "space": asdict(words.space)}
    if words.tower is not None:
        values["tower"] = tower_to_json(words.tower)
    if words.trained is not None:
        values["trained"] = list(words.trained)
    return arrays, values


def from_metadata(entries: Mapping[str, str]) -> EncoderHeader:
    """The header that entries of text hold."""
    if KEY not in entries:
        raise InputError("is no encoder that `gsencoder export` wrote")
    try:
        values = json.loads(entries[KEY])
        version = values["version"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"the entry {KEY!r} is damaged ({type(error).__name__})") from error
    if values.get("kind") == "memory":
        raise InputError(
            "is the attention of a memory, which `gsencoder export memory=` wrote; expected an encoder, which "
            "`gsencoder export weights=` writes"
        )
    if version not in (VERSION, VERSION_OF_SEVERAL):
        raise InputError(
            f"is of format version {str(version)[:20]}, and this gsencoder reads {VERSION} and {VERSION_OF_SEVERAL}; "
            "export it again"
        )
    try:
        parts = [("", values)]
        if version == VERSION_OF_SEVERAL:
            parts = [(f"{number}.", part) for number, part in enumerate(values["outputs"])]
        by_teacher: dict[str, OutputSpace] = {}
        tables: dict[str, TextTable] = {}
        for prefix, part in parts:
            forms = {name: values["arrays"][prefix + name] for name in ARRAYS if prefix + name in values["arrays"]}
            arrays = {name: _array(entries, prefix + name, **form) for name, form in forms.items()}
            outputs = _output_space(part, arrays)
            teacher = str(part["teacher"])
            if teacher in by_teacher:
                raise InputError(f"expected output spaces of distinct teachers, got two of {teacher[:60]!r}")
            by_teacher[teacher] = outputs
            if "words" in part:
                tables[teacher] = _text_table(part["words"], arrays)
        return EncoderHeader(
            voxel=float(values["voxel"]),
            coarser=tuple(map(float, values.get("coarser", ()))),
            levels=values["levels"],
            orders=tuple(values["orders"]),
            patch=values["patch"],
            outputs=OutputSpaces(by_teacher=by_teacher),
            tables=tables,
            precision=values["precision"],
            made_by=values["made_by"],
        )
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, binascii.Error, zlib.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"its entries are damaged ({type(error).__name__}: {str(error)[:80]})") from error


def _output_space(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> OutputSpace:
    space, mean = FeatureSpace(**values["space"]), arrays["mean"]
    basis = None
    if "components" in arrays:
        components, energy_kept = arrays["components"], values["energy_kept"]
        basis = FeatureBasis(mean=mean, components=components, energy_kept=energy_kept, space=space)
    more = {name: values[name] for name in ("centered", "scaled")} | {"confidence": tuple(values.get("confidence", ()))}
    return OutputSpace(space=space, mean=mean, scale=float(values["scale"]), basis=basis, **more)


def _text_table(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TextTable:
    return TextTable(
        names=tuple(values["names"]),
        embeddings=unrounded(arrays["words"].astype(np.float32) * arrays.get("words_scale", np.float32(1))),
        space=FeatureSpace(**values["space"]),
        mean=arrays["words_mean"],
        tower=tower_from_json(values["tower"]) if "tower" in values else None,
        trained=trained_from_json(values["trained"]) if "trained" in values else None,
    )


def with_sum(model: bytes) -> bytes:
    """A serialized model whose entry `SUM` is filled in."""
    position = _sum_position(model)
    if position is None:
        raise ValueError(f"the model has no entry {SUM}")
    return model[:position] + _digest(model, position) + model[position + len(NO_SUM) :]


def check_sum(model: bytes) -> bool:
    """Whether a file has a sum."""
    position = _sum_position(model)
    if position is not None and model[position : position + len(NO_SUM)] != _digest(model, position):
        raise InputError(
            "its contents do not have the sum that was written with them: it is damaged, or was changed by a program "
            f"that left the entry {SUM} in it"
        )
    return position is not None


def _sum_position(model: bytes) -> int | None:
    """Where the digits of the sum begin: an entry is its key, then the mark of a second field and the length of it."""
    key = SUM.encode() + bytes((0x12, len(NO_SUM)))
    start = model.rfind(key)
    return start + len(key) if start >= 0 and start + len(key) + len(NO_SUM) <= len(model) else None


def _digest(model: bytes, position: int) -> bytes:
    digest = hashlib.sha256(model[:position])
    digest.update(NO_SUM.encode())
    digest.update(model[position + len(NO_SUM) :])
    return digest.hexdigest().encode()


def _array(entries: Mapping[str, str], name: str, *, dtype: str, shape: list[int]) -> np.ndarray:
    if dtype not in ("float32", "float16", "int8"):
        raise InputError(f"expected {name} of float32, float16 or int8, got {dtype[:20]!r}")
    text = entries[f"{KEY}.{name}"]
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if not 0 <= size <= max(1 << 24, MAX_INFLATION * len(text)):
        raise InputError(f"{name} claims {str(size)[:20]} bytes in {len(text)} of text")
    unpacking = zlib.decompressobj()
    raw = unpacking.decompress(base64.b64decode(text, validate=True), size + 1)
    if len(raw) != size or not unpacking.eof:
        raise InputError(f"expected {size} bytes of {name}, got {'more' if len(raw) > size else len(raw)}")
    values = np.frombuffer(raw, np.dtype(dtype).newbyteorder("<")).reshape(shape).astype(dtype)
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values


SUFFIX = ".onnx"
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


Run = Callable[[Gaussians, SceneCurves | None, int], Float32[np.ndarray, "n channels"]]
"""Restored outputs of the first n Gaussians of a part of a scene, given the part, the curves of the complete region
where that was cut, and n."""


@runtime_checkable
class Network(Protocol):
    """What `gsencoder.infer.encode.Encoder` runs: `OnnxNetwork`, or `gsencoder.infer.torch_network.TorchNetwork`."""

    header: EncoderHeader

    def precisions(self, device: Device, /) -> tuple[Precision, ...]:
        """The types that it computes in on a device, the most exact one first; others than that are cheaper."""

    def runner(self, precision: Precision, device: Device, voxel: float) -> Run:
        """Prepares to run on a splat in metres, whose finest grid has cells of `voxel`."""

    def lower(self, *, half: bool = False) -> Any:
        """The network as an ONNX graph; see `gsencoder.infer.onnx.export.lower`."""


class OnnxNetwork:
    """A file of `gsencoder export`, ready to run."""

    def __init__(self, file: str | Path | bytes, *, device: Device = "auto", threads: int = 0) -> None:
        """Reads and checks the file.

        Args:
            file: a path, a name in the folder GSENCODER_MODELS, or what the file holds.
            device: where it is to run; auto = a GPU where this onnxruntime has one.
            threads: of the CPU; 0 = onnxruntime's own choice.
        """
        self.name = "the model" if isinstance(file, bytes) else str(find_file(str(file), "weights"))
        with readable(self.name):
            model = file if isinstance(file, bytes) else read_foreign(self.name, MODEL_BYTES)
        with error_prefix(self.name):
            summed = check_sum(model)
        self.session = open_session(model, self.name, device, threads)
        with error_prefix(self.name):
            self.header: EncoderHeader = from_metadata(self.session.get_modelmeta().custom_metadata_map)
            types = {"voxel": "tensor(double)", "starts": "tensor(int64)"}
            expected = {f"{name}: {types.get(name, 'tensor(float)')}" for name in (*FIELDS, *SETTINGS)}
            taken = [*self.session.get_inputs(), *self.session.get_overridable_initializers()]
            inputs = {f"{each.name}: {each.type}" for each in taken}
            if inputs != expected or OUTPUT not in [each.name for each in self.session.get_outputs()]:
                raise InputError(f"expected inputs {', '.join(sorted(expected))}, got {', '.join(sorted(inputs))}")
        if not summed:
            warnings.warn(
                f"{self.name}: has no entry {SUM}: another program changed it, and damage would not be noticed",
                SceneWarning,
                stacklevel=2,
            )

    def precisions(self, _device: Device) -> tuple[Precision, ...]:
        """That of the file, which it was exported in."""
        return ("auto",)

    def lower(self, *, half: bool = False) -> Any:  # noqa: ARG002
        """Refuses: the encoder has been exported."""
        raise InputError(f"export: {self.name} is an ONNX file already; copy it")

    def runner(self, precision: Precision, _device: Device, voxel: float) -> Run:
        """Runs the session where it was opened, in the precision of the file."""
        if precision not in ("auto", self.header.precision):
            raise InputError(
                f"precision: {self.name} computes in {self.header.precision}, not {precision}; export another file for "
                "that"
            )

        def run(subset: Gaussians, curves: SceneCurves | None, count: int) -> Float32[np.ndarray, "n channels"]:
            feed = feed_of(subset, curves, voxel)
            try:
                (features,) = self.session.run([OUTPUT], feed)
            except Exception as error:  # onnxruntime raises its own classes, which share only this base
                raise InputError(f"{self.name}: onnxruntime could not run it: {_first_line(error)}") from error
            channels = self.header.outputs.channels
            if features.shape != (len(subset), channels):
                raise InputError(f"{self.name}: expected {channels} channels, got {features.shape}")
            return np.asarray(features[:count], np.float32)

        return run


def feed_of(subset: Gaussians, scene_curves: SceneCurves | None, voxel: float) -> dict[str, np.ndarray]:
    """What the graph takes of a part of a scene, in the grid of the whole; `scene_curves` is None where it is all of
    it."""
    scaled = np.floor(subset.means.astype(np.float64) / voxel)
    check_extent(float((scaled.max(axis=0) - scaled.min(axis=0)).max()) + 1, voxel)
    feed = inputs_of(subset) | {"voxel": np.array(voxel, np.float64)}
    if scene_curves is not None:
        feed |= {"corner": scene_curves.corner, "starts": starts_table(scene_curves)}
    return feed


def inputs_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """What the graph takes of a cloud."""
    values = (getattr(gaussians, name) for name in FIELDS[:-1])
    return dict(zip(FIELDS, (*values, np.ascontiguousarray(gaussians.sh[:, 0])), strict=True))


def starts_table(curves: SceneCurves) -> Int64[np.ndarray, "rows P"]:
    """The starts of all levels and orders in one array, as the graph takes them, filled up with `INVALID_CODE`."""
    rows = [row for starts in curves.starts for row in starts]
    table = np.full((len(rows), max(map(len, rows))), INVALID_CODE, np.int64)
    for target, row in zip(table, rows, strict=True):
        target[: len(row)] = row
    return table


def open_session(model: bytes, name: str, device: Device, threads: int = 0) -> Any:
    """onnxruntime with a graph."""
    import onnxruntime

    available = onnxruntime.get_available_providers()
    if device == "cuda" and CUDA not in available:
        raise InputError(f"device: this onnxruntime has no GPU ({', '.join(available)}); give device=cpu")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # Planning which tensor takes over whose buffer is quadratic in the graph, half of the time that a session takes to
    # open; without it buffers go back to the arena as soon as they can, which is a fifth less memory as well.
    options.enable_mem_reuse = False
    if threads:
        options.intra_op_num_threads = threads
    providers: list[Any] = [CPU]
    on_gpu = device != "cpu" and CUDA in available
    if on_gpu:
        # TensorFloat-32, onnxruntime's default, moves features by 2 % of the largest.
        providers.insert(0, (CUDA, {"use_tf32": "0"}))
        if hasattr(onnxruntime, "preload_dlls"):
            # CUDA and cuDNN of pip's packages, where the system has none. It prints what it does not load.
            with redirect_stdout(io.StringIO()):
                onnxruntime.preload_dlls()
    try:
        session = onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # as above
        raise InputError(f"{name}: is no model that onnxruntime reads, or damaged: {_first_line(error)}") from error
    if on_gpu and CUDA not in session.get_providers():
        # onnxruntime falls back to the CPU by itself.
        problem = "onnxruntime has a GPU provider, and could not load CUDA or cuDNN for it"
        if device == "cuda":
            raise InputError(f"device=cuda: {problem}; install the libraries that it needs, or give device=cpu")
        warnings.warn(f"device=auto: {problem}; computing on the CPU", SceneWarning, stacklevel=2)
    return session


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
