"""Metadata of an exported encoder: entries of text beside the graph, which any program can read.

`gsencoder` is JSON: the format's version, the grid, the curves, the feature space (or the spaces of several teachers,
in whose columns the features are), and for each array its type and shape. `gsencoder.NAME` is the array NAME:
little-endian, deflated, in base64. `gsencoder.sum` is the sha256 of the whole file, with zeros in the sum's own place.
"""

import base64
import binascii
import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError
from gsencoder.core.process import Stored
from gsencoder.models.grid import ALIGN, Order
from gsencoder.models.output_space import OutputSpace, OutputSpaces, output_spaces_parts
from gsencoder.text.table import TextTable, tower_from_json, tower_to_json, trained_from_json, unrounded
from gsencoder.types import FeatureBasis, FeatureSpace

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
class OnnxHeader:
    """What a runtime must know of an exported encoder.

    Attributes:
        voxel: edge of the finest grid, metres.
        levels: of the network.
        orders: the curves that attention follows.
        patch: most tokens in a patch.
        outputs: what the features mean; the graph has restored them already.
        tables: what turns words into their spaces, by teacher, where there are such tables.
        precision: what the graph computes in; files of earlier versions may say "int8_static".
        made_by: settings and results of training and export, as JSON values.
    """

    voxel: float
    levels: int
    orders: tuple[Order, ...]
    patch: int
    outputs: OutputSpaces
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    precision: Stored | Literal["int8_static"] = "float32"
    made_by: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        possible_orders = set(get_args(Order))
        numbers = type(self.levels) is int and type(self.patch) is int
        if not 0 < self.voxel < math.inf or not numbers or not 1 <= self.levels <= ALIGN.bit_length() or self.patch < 1:
            raise InputError(
                f"expected a positive voxel, 1 to {ALIGN.bit_length()} levels and patches of 1 or more, got "
                f"{self.voxel}, {self.levels}, {self.patch}"
            )
        readable = (*get_args(Stored), "int8_static")
        if self.precision not in readable:
            raise InputError(f"expected a precision among {', '.join(readable)}, got {str(self.precision)[:40]}")
        if not self.orders or not set(self.orders) <= possible_orders:
            raise InputError(f"expected orders among {', '.join(sorted(possible_orders))}, got {str(self.orders)[:80]}")


def to_metadata(header: OnnxHeader) -> dict[str, str]:
    """The entries of text that hold a header."""
    arrays, values = output_spaces_parts(header.outputs)
    values |= {
        "version": VERSION if len(header.outputs) == 1 else VERSION_OF_SEVERAL,
        "voxel": header.voxel,
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
    """The arrays and the JSON values that hold a text table."""
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


def from_metadata(entries: Mapping[str, str]) -> OnnxHeader:
    """The header that entries of text hold.

    Raises:
        InputError: there is none, it is of another version, or damaged.
    """
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
            # Files of earlier versions do not name their teacher otherwise.
            teacher = str(part.get("teacher") or outputs.space.teacher or outputs.space.name)
            if teacher in by_teacher:
                raise InputError(f"expected output spaces of distinct teachers, got two of {teacher[:60]!r}")
            by_teacher[teacher] = outputs
            if "words" in part:
                tables[teacher] = _text_table(part["words"], arrays)
        return OnnxHeader(
            voxel=float(values["voxel"]),
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
    """The output space that JSON values and arrays hold."""
    space, mean = FeatureSpace(**values["space"]), arrays["mean"]
    basis = None
    if "components" in arrays:
        components, energy_kept = arrays["components"], values["energy_kept"]
        basis = FeatureBasis(mean=mean, components=components, energy_kept=energy_kept, space=space)
    switches = {name: values[name] for name in ("centered", "scaled") if name in values}
    return OutputSpace(space=space, mean=mean, scale=float(values["scale"]), basis=basis, **switches)


def _text_table(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TextTable:
    """The text table that JSON values and arrays hold."""
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
    """Whether a file has a sum.

    Raises:
        InputError: it has another than its contents.
    """
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
