"""One safetensors file with a JSON header: written whole or not at all, and on load checked against what it must hold.

A file comes from anywhere: an array of another size would otherwise be broadcast, or end the run far from its cause.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.data.atomic import is_full_disk
from gsencoder.errors import InputError, about

VERSION = 1
LARGEST_NUMBER = 2.0**63
DTYPES = {"F16": "float16", "F32": "float32", "F64": "float64", "I32": "int32", "I64": "int64", "U8": "uint8"}
"""safetensors' names of the number types that are written here."""


def first_difference(found: Mapping[str, Any], wanted: Mapping[str, Any], prefix: str = "") -> str:
    """The first setting in which two runs differ, in words."""
    for key in sorted({*found, *wanted}):
        old, new = found.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict) and old != new:
            return first_difference(old, new, f"{prefix}{key}.")
        if old != new:
            return f"{prefix}{key}={old}, and this run asks {prefix}{key}={new}"
    return "other settings"


class Archive:
    """An open file; arrays and header values are checked as they are taken out.

    Attributes:
        path: of the file, for messages.
        sizes: what the letters of shapes stand for, as the arrays taken so far have fixed it.
    """

    def __init__(self, path: Path, file: Any, header: dict[str, Any]) -> None:
        self.path, self.sizes = path, dict[str, int]()
        self._file, self._header, self._names = file, header, frozenset(file.keys())

    def array(self, name: str, dtype: str, shape: tuple[int | str, ...]) -> np.ndarray:
        """An array; a letter in its shape means the same size in all arrays of the file.

        Raises:
            InputError: missing, of another type or size, or not finite.
        """
        got_dtype, got = self._stored(name)
        wanted = tuple(self.sizes.get(side, side) if isinstance(side, str) else side for side in shape)
        same = len(got) == len(wanted) and all(isinstance(w, str) or w == g for w, g in zip(wanted, got, strict=True))
        if got_dtype != dtype or not same:
            raise InputError(
                f"{self.path}: expected {name} {dtype}[{_listed(wanted)}], got {got_dtype}[{_listed(got)}]; "
                "the file is damaged or from another program"
            )
        self.sizes |= {side: size for side, size in zip(wanted, got, strict=True) if isinstance(side, str)}
        values: np.ndarray = self._file.get_tensor(name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            bad = values.size - int(np.count_nonzero(np.isfinite(values)))
            raise InputError(f"{self.path}: {bad} of {values.size} values of {name} are not finite")
        return values

    def shape(self, name: str, dtype: str, axes: int) -> tuple[int, ...]:
        """The size of an array, without reading it.

        Raises:
            InputError: missing, of another type, or with another number of axes.
        """
        got_dtype, shape = self._stored(name)
        if got_dtype != dtype or len(shape) != axes:
            raise InputError(
                f"{self.path}: expected {name} {dtype} with {axes} axes, got {got_dtype}[{_listed(shape)}]; "
                "the file is damaged or from another program"
            )
        return shape

    def _stored(self, name: str) -> tuple[str, tuple[int, ...]]:
        """Type and size of an array as the file states them."""
        if name not in self._names:
            raise InputError(f"{self.path}: the array {name!r} is missing; the file is damaged or from another program")
        stored = self._file.get_slice(name)
        return DTYPES.get(stored.get_dtype(), stored.get_dtype()), tuple(stored.get_shape())

    def value(self, key: str, *kinds: type | None) -> Any:
        """A value of the header, of one of these types.

        Raises:
            InputError: missing or of another type.
        """
        value = self._header.get(key)
        # JSON's true is a Python int, and no number here is meant to be one.
        good = (value is None and None in kinds) or isinstance(value, tuple(kind for kind in kinds if kind is not None))
        if key not in self._header or not good or (isinstance(value, bool) and bool not in kinds):
            names = " or ".join("null" if kind is None else kind.__name__ for kind in kinds)
            got = f"{str(value)[:60]!r}" if key in self._header else "nothing"
            raise InputError(f"{self.path}: expected {key} ({names}) in the header, got {got}")
        if isinstance(value, (int, float)) and not abs(value) < LARGEST_NUMBER:
            raise InputError(f"{self.path}: expected a finite {key} in the header, got {str(value)[:20]}")
        return value

    def verify(self) -> None:
        """Checks the sum that `write_archive` wrote with the contents, which reads all of them.

        Raises:
            InputError: there is none, or the file is damaged.
        """
        arrays = {name: self._file.get_tensor(name) for name in self._names}
        header = {key: value for key, value in self._header.items() if key not in ("version", "sum")}
        if self.value("sum", str) != _sum(arrays, header):
            raise InputError(f"{self.path}: its contents do not have the sum that was written with them; it is damaged")

    def __contains__(self, key: str) -> bool:
        return key in self._header or key in self._names


def _listed(shape: tuple[int | str, ...]) -> str:
    return ", ".join(map(str, shape))


def _sum(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> str:
    """sha256 over the header and over names, types, shapes and bytes of all arrays."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = _contiguous(arrays[name])
        digest.update(f"{name} {array.dtype.name}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def write_archive(
    path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any], *, summed: bool = False
) -> None:
    """Writes arrays and header; what had the name stays until the new file is whole.

    Args:
        path: the file.
        arrays: by name.
        header: values that JSON has.
        summed: with a sum for `Archive.verify`.

    Raises:
        InputError: the disk is full, or the system refuses.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    told = {**header, "sum": _sum(arrays, header)} if summed else header
    metadata = {"gsencoder": json.dumps({"version": VERSION, **told})}
    try:
        save_file({name: _contiguous(array) for name, array in arrays.items()}, temporary, metadata)
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        # safetensors writes files that nobody else may read.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except (OSError, SafetensorError) as error:
        if is_full_disk(error):
            raise InputError(f"{path}: no space left on the device; make room and give the command again") from error
        raise InputError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _contiguous(array: np.ndarray) -> np.ndarray:
    """The array in one piece, of the same shape; numpy's own function makes a number a list of one."""
    return np.ascontiguousarray(array).reshape(array.shape)


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """The file at `path`, open for the block. An `InputError` in the block that does not name the file is given its
    name, so that what the types refuse is told with its place.

    Raises:
        InputError: missing, damaged, or of another version.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path}: no such file; expected one that gsencoder wrote")
    try:
        with about(path), safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("gsencoder", "{}"))
            if not isinstance(header, dict) or header.get("version") != VERSION:
                found = header.get("version") if isinstance(header, dict) else None
                raise InputError(f"{path}: expected version {VERSION} of the format, got {found}")
            yield Archive(path, file, header)
    except InputError:
        raise
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged or no safetensors file: {message}") from error


def map_arrays(path: Path, wanted: Mapping[str, tuple[str, int]]) -> dict[str, np.ndarray]:
    """Arrays of a file as read-only memory maps: only what is looked at is read, and processes share it.

    Values are not looked at, so the file must be one that this program wrote whole.

    Args:
        path: the file.
        wanted: dtype and number of axes of each array.

    Raises:
        InputError: missing, damaged, or without these arrays.
    """
    with open_archive(path) as file:
        sizes = {name: file.shape(name, dtype, axes) for name, (dtype, axes) in wanted.items()}
    raw = np.memmap(path, dtype=np.uint8, mode="r")
    begin = 8 + int.from_bytes(raw[:8].tobytes(), "little")
    entries = json.loads(raw[8:begin].tobytes())
    mapped = {}
    for name, (dtype, _) in wanted.items():
        first, last = entries[name]["data_offsets"]
        mapped[name] = raw[begin + first : begin + last].view(dtype).reshape(sizes[name])
    return mapped
