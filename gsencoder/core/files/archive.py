"""Archives: safetensors files with a JSON header and checksums, written atomically and validated when they are read.

Files are not trusted: an array of another size would otherwise be broadcast, or fail far from the cause. Against
damage, files of version 2 carry checksums (`checksums.py`) of the header and the arrays, and each array is verified
when it is read. Files of version 1 have none, and are read with a warning. `safetensors_bytes.py` has the bytes.
"""

import hashlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning, about
from gsencoder.core.files.checksums import (
    BLOCK_BYTES,
    DIGITS,
    block_checksums,
    bytes_of,
    damaged_blocks,
    file_digest,
)
from gsencoder.core.files.model_files import check_fetched
from gsencoder.core.files.safetensors_bytes import (
    DTYPES,
    Entries,
    array_offsets,
    entries_of,
    read_bytes,
    safetensors_header,
    write_safetensors,
)

VERSION = 2
WITHOUT_CHECKSUMS = 1
"""The version without checksums, except for packages, which had one over the file."""
RESERVED_KEYS = ("version", "checksums", "digest")
"""Keys of the header that callers may not use: version, checksums of the blocks by array, and the digest of the rest.
"""
LARGEST_NUMBER = 2.0**63
LONGEST_NUMBER = -2.2250738585072014e-308
"""JSON writes no number in more characters: it stands for numbers of a header that are not known yet."""
LONGEST_SHARE = abs(LONGEST_NUMBER)
"""The same for numbers that cannot be negative."""
DAMAGED = "the file is damaged"


class Archive:
    """An open archive; arrays and header values are validated as they are read.

    Attributes:
        path: of the file, for messages.
        sizes: values of the letters in shapes, as set by the arrays that were read so far.
    """

    def __init__(self, path: Path, file: Any, stream: BinaryIO, header: dict[str, Any]) -> None:
        """Args:
        path: of the file.
        file: the file, opened by safetensors, for names, types and shapes.
        stream: the file, from which arrays are read.
        header: its JSON header.

        Raises:
            InputError: another version, or a header that does not match its digest.
        """
        self.path, self.sizes = path, dict[str, int]()
        self._file, self._header, self._names = file, header, frozenset(file.keys())
        self._stream, self._offsets = stream, array_offsets(stream)
        version = header.get("version")
        self.checksums: Mapping[str, str] | None = None
        if type(version) is int and version == WITHOUT_CHECKSUMS and not {"checksums", "digest"} & set(header):
            if "sum" not in header:
                warn_without_checksums(path)
            return
        if version != VERSION:
            raise InputError(f"{path}: expected version {VERSION} of the format, got {str(version)[:20]}")
        covered = {key: value for key, value in header.items() if key != "digest"}
        checksums = header.get("checksums")
        good = isinstance(checksums, dict) and checksums.keys() == self._names
        if not good or header.get("digest") != file_digest(covered, {name: self._stored(name) for name in self._names}):
            raise InputError(f"{path}: {DAMAGED}: its header does not have the checksum that was written with it")
        self.checksums = checksums

    def array(self, name: str, dtype: str, shape: tuple[int | str, ...]) -> np.ndarray:
        """Reads an array; a letter in its shape stands for the same size in all arrays of the file.

        Raises:
            InputError: missing, of another type or size, or not finite.
        """
        got_dtype, got = self._stored(name)
        expected = tuple(self.sizes.get(side, side) if isinstance(side, str) else side for side in shape)
        same = len(got) == len(expected) and all(
            isinstance(e, str) or e == g for e, g in zip(expected, got, strict=True)
        )
        if got_dtype != dtype or not same:
            raise InputError(
                f"{self.path}: expected {name} {dtype}[{_listed(expected)}], got {got_dtype}[{_listed(got)}]; "
                "the file is damaged or from another program"
            )
        self.sizes |= {side: size for side, size in zip(expected, got, strict=True) if isinstance(side, str)}
        values = self._read(name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            bad = values.size - int(np.count_nonzero(np.isfinite(values)))
            raise InputError(f"{self.path}: {bad} of {values.size} values of {name} are not finite")
        return values

    def shape(self, name: str, dtype: str, axes: int) -> tuple[int, ...]:
        """The shape of an array, without reading it.

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

    def _read(self, name: str) -> np.ndarray:
        values = self._values(name)
        if self.checksums is not None and damaged_blocks(bytes_of(values), self.checksums[name]):
            raise InputError(f"{self.path}: {DAMAGED}: {name} does not have the checksum that was written with it")
        return values

    def _values(self, name: str) -> np.ndarray:
        # Not through the memory map of safetensors, which ends the process where the file is cut off meanwhile.
        dtype, shape = self._stored(name)
        if dtype not in DTYPES.values():
            raise InputError(
                f"{self.path}: {name} is of the type {dtype}, expected one of {', '.join(DTYPES.values())}"
            )
        data = read_bytes(self._stream, self._offsets.get(name, (0, 0)))
        if len(data) != np.dtype(dtype).itemsize * math.prod(shape):
            raise InputError(f"{self.path}: was cut off or replaced while {name} was read; give the command again")
        return data.view(dtype).reshape(shape)

    def _stored(self, name: str) -> tuple[str, tuple[int, ...]]:
        """Type and shape of an array according to the file."""
        if name not in self._names:
            raise InputError(f"{self.path}: the array {name!r} is missing; the file is damaged or from another program")
        stored = self._file.get_slice(name)
        return DTYPES.get(stored.get_dtype(), stored.get_dtype()), tuple(stored.get_shape())

    def value(self, key: str, *kinds: type | None) -> Any:
        """Reads a value of the header, which must be of one of these types.

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
        """Verifies the checksums of all arrays, or of the file where its version is 1.

        Raises:
            InputError: the file is damaged, or has no checksums.
        """
        if self.checksums is not None:
            for name in sorted(self._names):
                self._read(name)
            return
        arrays = {name: self._values(name) for name in self._names}
        header = {key: value for key, value in self._header.items() if key not in ("version", "sum")}
        if self.value("sum", str) != _sum_of_version_1(arrays, header):
            raise InputError(f"{self.path}: {DAMAGED}: it does not have the checksum that was written with it")

    def section(self, prefix: str, header: Mapping[str, Any]) -> "ArchiveSection":
        """A part of the archive: the arrays whose names begin with `prefix`, with a header of its own."""
        return ArchiveSection(self, prefix, header)

    def __contains__(self, key: str) -> bool:
        return key in self._header or key in self._names


class ArchiveSection(Archive):
    """A part of an archive, in which arrays are named without their prefix, and letters in shapes are its own."""

    def __init__(self, archive: Archive, prefix: str, header: Mapping[str, Any]) -> None:
        self.path, self.sizes = archive.path, dict[str, int]()
        self._archive, self._prefix, self._header = archive, prefix, dict(header)
        self._names = frozenset(name.removeprefix(prefix) for name in archive._names if name.startswith(prefix))

    def _read(self, name: str) -> np.ndarray:
        return self._archive._read(self._prefix + name)

    def _stored(self, name: str) -> tuple[str, tuple[int, ...]]:
        return self._archive._stored(self._prefix + name)


def _listed(shape: tuple[int | str, ...]) -> str:
    return ", ".join(map(str, shape))


def warn_without_checksums(path: Path) -> None:
    """Warns once for each folder, since a run may read hundreds of such files from it."""
    if path.parent not in _WARNED:
        _WARNED.add(path.parent)
        warnings.warn(
            f"{path}: was written by an earlier version, without checksums, so damage to it or to files beside it "
            "would not be noticed; write it again to add them",
            SceneWarning,
            stacklevel=5,
        )


_WARNED: set[Path] = set()


def _sum_of_version_1(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> str:
    """sha256 over the header and over names, types, shapes and bytes of all arrays."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = _contiguous(arrays[name])
        digest.update(f"{name} {array.dtype.name}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def write_archive(path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Writes arrays and header with their checksums; an existing file is replaced once the new one is complete.

    Args:
        path: the file.
        arrays: by name, of the types in `DTYPES`.
        header: JSON values, under other keys than `RESERVED_KEYS`.

    Raises:
        InputError: the disk is full, or the system refuses.
    """
    pieces = {name: _contiguous(array) for name, array in arrays.items()}
    assert not set(RESERVED_KEYS) & set(header)
    assert all(array.dtype.name in DTYPES.values() for array in pieces.values()), "a type that cannot be read back"
    checksums = {name: block_checksums(array) for name, array in pieces.items()}
    write_safetensors(path, pieces, _metadata(entries_of(pieces), checksums, header))


def archive_bytes(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> int:
    """The size of the file that `write_archive` would write.

    Args:
        arrays: by name; values do not matter, so that arrays of `shape_only` will do.
        header: as it would be written; numbers of other lengths change the size by as many bytes.
    """
    entries = entries_of(arrays)
    sizes = {name: math.prod(shape) * np.dtype(dtype).itemsize for name, (dtype, shape) in entries.items()}
    checksums = {name: "0" * (DIGITS * -(-size // BLOCK_BYTES)) for name, size in sizes.items()}
    return len(safetensors_header(entries, _metadata(entries, checksums, header))) + sum(sizes.values())


def shape_only(dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of zeros that takes no memory: it stands for one of its type and shape in `archive_bytes`."""
    return np.broadcast_to(np.zeros((), dtype), shape)


def _metadata(entries: Entries, checksums: Mapping[str, str], header: Mapping[str, Any]) -> dict[str, str]:
    # The digest is of what a reader will see: JSON turns tuples into lists and keys into text.
    covered = json.loads(json.dumps({**header, "version": VERSION, "checksums": checksums}))
    return {"gsencoder": json.dumps({**covered, "digest": file_digest(covered, entries)})}


def _contiguous(array: np.ndarray) -> np.ndarray:
    """A contiguous copy of the same shape; np.ascontiguousarray alone gives a scalar an axis."""
    return np.ascontiguousarray(array).reshape(array.shape)


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Opens the file at `path` for the block. An `InputError` in the block that does not name the file is prefixed with
    its path, so that errors of validation say which file they are about.

    Raises:
        InputError: missing, damaged, or of another version.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path}: no such file; expected one that gsencoder wrote")
    try:
        with about(path), path.open("rb", buffering=0) as stream, safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("gsencoder", "{}"))
            if not isinstance(header, dict):
                raise InputError(f"{path}: expected version {VERSION} of the format, got none")
            yield Archive(path, file, stream, header)
    except InputError:
        raise
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        check_fetched(path)
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged or no safetensors file: {message}") from error


def verify_archive(path: Path) -> None:
    """Reads an archive and verifies its checksums.

    Raises:
        InputError: missing, damaged, of another version, or without checksums.
    """
    with open_archive(path) as file:
        file.verify()
