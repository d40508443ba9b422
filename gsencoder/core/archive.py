"""Archives: safetensors files with a JSON header and checksums, written atomically and validated when they are read.

Files are not trusted: an array of another size would otherwise be broadcast, or fail far from the cause. Each block of
each array has a CRC-32, and a SHA-256 covers the header and all of these, so that a reader that maps a file checks only
what it reads: a training step touches a small part of a scene. A CRC-32 detects every error of up to 32 neighboring
bits in a block, and misses one in 2³² of all others; it is no protection against deliberate changes.

A process that touches a page of a map beyond the end of its file is ended by the system (SIGBUS) without a word. Arrays
are therefore read without a map where they are read whole: a file that another program cuts off is then shorter than
expected, and an error names it.
"""

import hashlib
import json
import math
import mmap
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float32, Int, Int64, UInt8

from gsencoder.core.errors import InputError, error_prefix, readable
from gsencoder.core.files import atomic_file, check_foreign, open_foreign
from gsencoder.core.pretrained import check_fetched

BLOCK_BYTES = 1 << 18
"""Bytes of a block, which has one checksum; the last block of an array may be shorter."""
DIGITS = 8
"""Hexadecimal digits of one checksum."""


def bytes_of(array: np.ndarray) -> UInt8[np.ndarray, " bytes"]:
    """The bytes of an array in C order, without a copy if it is contiguous."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def block_count(size: int) -> int:
    return -(-size // BLOCK_BYTES)


def _checksum(data: UInt8[np.ndarray, " bytes"], block: int) -> str:
    return f"{zlib.crc32(data[block * BLOCK_BYTES : (block + 1) * BLOCK_BYTES].data):0{DIGITS}x}"


def damaged_blocks(
    data: UInt8[np.ndarray, " bytes"], checksums: str, blocks: Int64[np.ndarray, " n"] | None = None
) -> list[int]:
    """Numbers of the blocks of an array that do not match their checksums, of `blocks` or of all."""
    count = block_count(len(data))
    if len(checksums) != count * DIGITS:
        return list(range(max(count, 1)))
    numbers = range(count) if blocks is None else blocks.tolist()
    return [n for n in numbers if _checksum(data, n) != checksums[n * DIGITS : (n + 1) * DIGITS]]


def file_digest(header: Mapping[str, Any], entries: "Entries") -> str:
    """The SHA-256 over a header (the checksums of all blocks included) and over the types and shapes of the arrays."""
    arrays = {name: [dtype, list(shape)] for name, (dtype, shape) in entries.items()}
    return hashlib.sha256(json.dumps([header, arrays], sort_keys=True).encode()).hexdigest()


HEADER_LIMIT = 100_000_000
"""Bytes of the longest header that the library reads."""
DTYPES = {
    "F16": "float16",
    "F32": "float32",
    "F64": "float64",
    "I8": "int8",
    "I32": "int32",
    "I64": "int64",
    "U8": "uint8",
    "U16": "uint16",
}
"""The types of arrays that archives may hold, by their names in safetensors."""
NAMES_OF_DTYPES = {dtype: name for name, dtype in DTYPES.items()}
ORDER = ("I64", "F64", "F32", "I32", "F16", "U16", "I8", "U8")
"""The types in the order in which safetensors writes arrays: those first that are aligned to more bytes."""
Entries = Mapping[str, tuple[str, tuple[int, ...]]]
"""Type and shape of each array of a file."""


def array_offsets(stream: BinaryIO) -> dict[str, tuple[int, int]]:
    """The first byte of each array in a file whose header the library has accepted, and the byte after its last."""
    length = int.from_bytes(read_bytes(stream, 0, 8).tobytes(), "little")
    begin = 8 + length
    text = read_bytes(stream, 8, min(begin, HEADER_LIMIT)).tobytes()
    try:
        table = json.loads(text)
        spans = {name: entry["data_offsets"] for name, entry in table.items() if name != "__metadata__"}
        return {name: (begin + span[0], begin + span[1]) for name, span in spans.items()}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise InputError("was cut off or replaced while its header was read; give the command again") from error


def read_bytes(stream: BinaryIO, first: int, last: int) -> UInt8[np.ndarray, " bytes"]:
    """The bytes from `first` to before `last` of a file; fewer where the file ends before."""
    data = np.empty(max(last - first, 0), np.uint8)
    stream.seek(first)
    done = 0
    # The system reads 2 GiB at once at most.
    while done < len(data) and (count := stream.readinto(data[done:].data)):  # type: ignore[attr-defined]
        done += count
    return data[:done]


def write_safetensors(path: Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Writes the bytes of `safetensors.numpy.save`, without a second copy of the arrays in memory. The library's
    `save_file` writes a file of a random name first, which a kill leaves in the folder for good."""
    entries = entries_of(arrays)
    header = safetensors_header(entries, metadata)
    with atomic_file(path) as stream:
        stream.write(header)
        for name in _file_order(entries):
            stream.write(bytes_of(arrays[name]).data)


def entries_of(arrays: Mapping[str, np.ndarray]) -> Entries:
    """Type and shape of each array."""
    return {name: (array.dtype.name, array.shape) for name, array in arrays.items()}


def _file_order(entries: Entries) -> list[str]:
    return sorted(entries, key=lambda name: (ORDER.index(NAMES_OF_DTYPES[entries[name][0]]), name))


def safetensors_header(entries: Entries, metadata: Mapping[str, str]) -> bytes:
    """The bytes before the arrays: the length of the table of names, types, shapes and offsets, and the table."""
    table: dict[str, Any] = {"__metadata__": dict(metadata)}
    end = 0
    for name in _file_order(entries):
        dtype, shape = entries[name]
        begin, end = end, end + math.prod(shape) * np.dtype(dtype).itemsize
        table[name] = {"dtype": NAMES_OF_DTYPES[dtype], "shape": list(shape), "data_offsets": [begin, end]}
    text = json.dumps(table, separators=(",", ":"), ensure_ascii=False).encode("utf-8", "surrogatepass")
    # Arrays begin at a multiple of eight bytes.
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


VERSION = 2
RESERVED_KEYS = ("version", "checksums", "digest")
"""Keys of the header that callers may not use: the digest is of all others."""
LARGEST_NUMBER = 2.0**63
LONGEST_NUMBER = -2.2250738585072014e-308
"""JSON writes no number in more characters: it stands for numbers of a header that are not known yet."""
LONGEST_SHARE = abs(LONGEST_NUMBER)
"""The same for numbers that cannot be negative."""
DAMAGED = "the file is damaged"


class Archive:
    """An open archive; arrays and header values are validated as they are read.

    Attributes:
        sizes: values of the letters in shapes, as set by the arrays that were read so far.
    """

    def __init__(self, path: Path, file: Any, stream: BinaryIO, header: dict[str, Any]) -> None:
        """`file` is that of safetensors, for names, types and shapes; arrays are read from `stream`."""
        self.path, self.sizes, self._prefix = path, dict[str, int](), ""
        self._file, self._header, self._names = file, header, frozenset(file.keys())
        self._stream, self._offsets = stream, array_offsets(stream)
        version = header.get("version")
        if version != VERSION:
            raise InputError(f"{path}: expected version {VERSION} of the format, got {str(version)[:20]}")
        covered = {key: value for key, value in header.items() if key != "digest"}
        checksums = header.get("checksums")
        digest = file_digest(covered, {name: self._stored(name) for name in self._names})
        if not isinstance(checksums, dict) or checksums.keys() != self._names or header.get("digest") != digest:
            raise InputError(f"{path}: {DAMAGED}: its header does not have the checksum that was written with it")
        self.checksums: Mapping[str, str] = checksums

    def array(self, name: str, dtype: str, shape: tuple[int | str, ...]) -> np.ndarray:
        """Reads an array; a letter in its shape stands for the same size in all arrays of the file."""
        expected = tuple(self.sizes.get(side, side) if isinstance(side, str) else side for side in shape)
        got = self._checked_shape(name, dtype, expected)
        self.sizes |= {side: size for side, size in zip(expected, got, strict=True) if isinstance(side, str)}
        values = self._read(name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            bad = values.size - int(np.count_nonzero(np.isfinite(values)))
            raise InputError(f"{self.path}: {bad} of {values.size} values of {name} are not finite")
        return values

    def shape(self, name: str, dtype: str, axes: int) -> tuple[int, ...]:
        """The shape of an array, without reading it."""
        return self._checked_shape(name, dtype, ("?",) * axes)

    def _checked_shape(self, name: str, dtype: str, expected: tuple[int | str, ...]) -> tuple[int, ...]:
        """The shape of an array, whose sides are those expected; a letter stands for any size."""
        got_dtype, got = self._stored(name)
        same = len(got) == len(expected) and all(
            isinstance(wanted, str) or wanted == side for wanted, side in zip(expected, got, strict=True)
        )
        if got_dtype != dtype or not same:
            raise InputError(
                f"{self.path}: expected {name} {dtype}[{_listed(expected)}], got {got_dtype}[{_listed(got)}]; "
                "the file is damaged or from another program"
            )
        return got

    def _read(self, name: str) -> np.ndarray:
        # Not through the memory map of safetensors, which ends the process where the file is cut off meanwhile.
        dtype, shape = self._stored(name)
        name = self._prefix + name
        if dtype not in NAMES_OF_DTYPES:
            raise InputError(f"{self.path}: {name} has type {dtype}, expected one of {', '.join(NAMES_OF_DTYPES)}")
        data = read_bytes(self._stream, *self._offsets.get(name, (0, 0)))
        if len(data) != np.dtype(dtype).itemsize * math.prod(shape):
            raise InputError(f"{self.path}: was cut off or replaced while {name} was read; give the command again")
        if damaged_blocks(data, self.checksums[name]):
            raise InputError(f"{self.path}: {DAMAGED}: {name} does not have the checksum that was written with it")
        return data.view(dtype).reshape(shape)

    def _stored(self, name: str) -> tuple[str, tuple[int, ...]]:
        """Type and shape of an array according to the file."""
        name = self._prefix + name
        if name not in self._names:
            raise InputError(f"{self.path}: the array {name!r} is missing; the file is damaged or from another program")
        stored = self._file.get_slice(name)
        return DTYPES.get(stored.get_dtype(), stored.get_dtype()), tuple(stored.get_shape())

    def value(self, key: str, *kinds: type | None) -> Any:
        """Reads a value of the header, which must be of one of these types."""
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
        """Verifies the checksums of all arrays."""
        for name in sorted(self._names):
            self._read(name)

    def section(self, prefix: str, header: Mapping[str, Any]) -> "Archive":
        """A part of the archive: the arrays whose names begin with `prefix`, named without it, with a header and
        letters in shapes of its own."""
        part = copy(self)
        part.sizes, part._prefix, part._header = {}, prefix, dict(header)
        return part

    def __contains__(self, key: str) -> bool:
        return key in self._header or self._prefix + key in self._names


def _listed(shape: tuple[int | str, ...]) -> str:
    return ", ".join(map(str, shape))


def write_archive(path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Writes arrays of the types in `DTYPES` and a header of JSON values with their checksums; an existing file is
    replaced once the new one is complete."""
    # np.ascontiguousarray alone gives a scalar an axis.
    pieces = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
    assert not set(RESERVED_KEYS) & set(header)
    assert all(array.dtype.name in NAMES_OF_DTYPES for array in pieces.values()), "a type that cannot be read back"
    checksums = {}
    for name, array in pieces.items():
        data = bytes_of(array)
        checksums[name] = "".join(_checksum(data, block) for block in range(block_count(len(data))))
    write_safetensors(path, pieces, _metadata(entries_of(pieces), checksums, header))


def archive_bytes(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> int:
    """The size of the file that `write_archive` would write; values of arrays do not matter, so that arrays of
    `shape_only` will do."""
    entries = entries_of(arrays)
    sizes = {name: math.prod(shape) * np.dtype(dtype).itemsize for name, (dtype, shape) in entries.items()}
    checksums = {name: "0" * (DIGITS * block_count(size)) for name, size in sizes.items()}
    return len(safetensors_header(entries, _metadata(entries, checksums, header))) + sum(sizes.values())


def shape_only(dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of zeros that takes no memory."""
    return np.broadcast_to(np.zeros((), dtype), shape)


def _metadata(entries: Entries, checksums: Mapping[str, str], header: Mapping[str, Any]) -> dict[str, str]:
    # The digest is of what a reader will see: JSON turns tuples into lists and keys into text.
    covered = json.loads(json.dumps({**header, "version": VERSION, "checksums": checksums}))
    return {"gsencoder": json.dumps({**covered, "digest": file_digest(covered, entries)})}


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Opens a file for the block; an `InputError` in the block that does not name it is prefixed with its path."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path}: no such file; expected one that gsencoder wrote")
    try:
        with error_prefix(path), path.open("rb", buffering=0) as stream, safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("gsencoder", "{}"))
            yield Archive(path, file, stream, header if isinstance(header, dict) else {})
    except InputError:
        raise
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        check_fetched(path)
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged or no safetensors file: {message}") from error


def verify_archive(path: Path) -> None:
    """Reads an archive and verifies its checksums."""
    with open_archive(path) as file:
        file.verify()


class MappedArrays:
    """Read-only arrays of a file. A block is verified against its checksum when it is first used, and not again; values
    are not validated otherwise. The size of the file is compared whenever an array is asked for (SIGBUS, see above),
    which leaves the moment in which its values are used."""

    def __init__(self, path: Path, types: Mapping[str, tuple[str, int]], earlier: "MappedArrays | None" = None) -> None:
        """Maps arrays of these types and numbers of axes. Blocks that `earlier`, a closed map of them, verified are not
        verified again if the file has not been written since."""
        self.path = path
        with open_archive(path) as file:
            shapes = {name: file.shape(name, dtype, axes) for name, (dtype, axes) in types.items()}
            self._checksums = file.checksums
        with error_prefix(path), open_foreign(path) as stream:
            state, offsets = os.fstat(stream.fileno()), array_offsets(stream)
            self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._stamp = (state.st_ino, state.st_size, state.st_mtime_ns)
        self._check_size()
        raw = np.frombuffer(self._map, np.uint8)
        self._bytes: dict[str, UInt8[np.ndarray, " bytes"]] = {}
        self._arrays: dict[str, np.ndarray] = {}
        for name, (dtype, _) in types.items():
            first, last = offsets[name]
            self._bytes[name] = raw[first:last]
            self._arrays[name] = self._bytes[name].view(dtype).reshape(shapes[name])
        blocks = {name: block_count(len(data)) for name, data in self._bytes.items()}
        self._unchecked = {name: np.ones(count, bool) for name, count in blocks.items() if count}
        if earlier is not None and earlier._stamp == self._stamp:
            self._unchecked = earlier._unchecked

    def close(self) -> None:
        """Closes the file; only the record of verified blocks remains."""
        self._bytes.clear()
        self._arrays.clear()

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of an array."""
        return self._arrays[name].shape

    def array(self, name: str) -> np.ndarray:
        """A complete array, verified; a view of the map."""
        self._check_size()
        if name in self._unchecked:
            self._check(name, np.flatnonzero(self._unchecked[name]))
        return self._arrays[name]

    def rows(self, name: str, rows: Int[np.ndarray, " n"] | slice) -> np.ndarray:
        """Copies rows of an array; of a slice from one row to another it is a view of the map."""
        self._check_size()
        array = self._arrays[name]
        if name in self._unchecked:
            size = array.dtype.itemsize * int(np.prod(array.shape[1:]))
            numbers = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
            first = numbers.astype(np.int64) * size
            touched = np.zeros(len(self._unchecked[name]), bool)
            # A row may extend over several blocks.
            for offset in range(0, size + BLOCK_BYTES, BLOCK_BYTES):
                touched[(first + min(offset, max(size - 1, 0))) // BLOCK_BYTES] = True
            self._check(name, np.flatnonzero(touched & self._unchecked[name]))
        values: np.ndarray = array[rows]
        return values

    def _check_size(self) -> None:
        _, written, _ = self._stamp
        if (now := self._map.size()) < written:
            raise InputError(
                f"{self.path}: was cut off while it was in use: {now:,} of {written:,} bytes are left; write it again"
            )

    def _check(self, name: str, blocks: Int64[np.ndarray, " n"]) -> None:
        if damaged_blocks(self._bytes[name], self._checksums[name], blocks):
            raise InputError(f"{self.path}: {DAMAGED}: {name} does not have the checksum that was written with it")
        self._unchecked[name][blocks] = False
        if not self._unchecked[name].any():
            del self._unchecked[name]


LARGEST_ARRAY = 1 << 29
"""Largest size of an array, bytes: a thousand masks of half a million vertices."""
MAX_TEXT = 1 << 12
"""Largest number of characters of an entry of a text array; numpy stores all entries with the length of the longest."""
_KINDS = {"U": "text", "f": "floating point", "b": "bool", "i": "signed integers", "u": "unsigned integers"}
"""What messages call numpy's kinds of types."""


def read_npz(
    file: Path,
    required: Mapping[str, tuple[str, int]],
    optional: Mapping[str, tuple[str, int]] | None = None,
    *,
    max_text: int = MAX_TEXT,
) -> dict[str, np.ndarray]:
    """Reads arrays of an .npz by name.

    Args:
        required: kind of type (a key of `_KINDS`) and number of axes of each array.
        optional: the same for arrays that may be missing.
    """
    try:
        check_foreign(file)
        with zipfile.ZipFile(file) as archive:
            present = set(archive.namelist())
            missing = [name for name in required if f"{name}.npy" not in present]
            if missing:
                raise InputError(f"{file}: expected the arrays {' and '.join(required)}, {missing[0]} is missing")
            types = {**required, **{k: v for k, v in (optional or {}).items() if f"{k}.npy" in present}}
            return {name: _read_member(archive, name, *kind, file, max_text) for name, kind in types.items()}
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, MemoryError) as error:
        message = (" ".join(str(error).split()) or type(error).__name__)[:200]
        raise InputError(f"{file}: cannot be read as .npz: {message}") from error


def _read_member(archive: zipfile.ZipFile, name: str, kind: str, ndim: int, file: Path, max_text: int) -> np.ndarray:
    """Reads an array whose header matches its size in the archive; of another kind it is not read."""
    where, size = f"{file}: {name}", archive.getinfo(f"{name}.npy").file_size
    if size > LARGEST_ARRAY:
        raise InputError(f"{where} claims {size:,} bytes; at most {LARGEST_ARRAY:,} are read")
    with archive.open(f"{name}.npy") as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
        if dtype.kind != kind or len(shape) != ndim:
            got = "Python objects, which would run code" if dtype.hasobject else str(dtype)
            sides, axes = " × ".join(map(str, shape)) or "one", "1 axis" if ndim == 1 else f"{ndim} axes"
            raise InputError(f"{where}: expected {axes} of {_KINDS[kind]}, got {sides} of {got}")
        length = dtype.itemsize // np.dtype("U1").itemsize
        if kind == "U" and length > max_text:
            raise InputError(f"{where}: entries of {length:,} characters, expected at most {max_text:,}")
        expected = size - stream.tell()
        if int(np.prod(shape, dtype=object)) * dtype.itemsize != expected:
            raise InputError(f"{where}: its header claims other sizes than the {expected:,} bytes that the file holds")
        data = stream.read(expected)
    if len(data) != expected:
        raise InputError(f"{where}: truncated, {expected - len(data):,} of {expected:,} bytes are missing")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


class RowFile:
    """Rows that are appended part by part and then read as one array, whose pages the system loads and drops. The file
    is in the folder for temporary files (TMPDIR) and has no name, so that it goes with the process."""

    def __init__(self, channels: int) -> None:
        self._channels, self._count = channels, 0
        self._file = TemporaryFile()  # noqa: SIM115

    def append(self, rows: Float32[np.ndarray, "n D"]) -> None:
        try:
            self._file.write(np.ascontiguousarray(rows, np.float32).tobytes())
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"rows: {self._count + len(rows):,} rows of {self._channels} channels do not fit into the folder for "
                f"temporary files ({error.strerror or error}); set TMPDIR to a folder with more room"
            ) from error
        self._count += len(rows)

    def array(self) -> Float32[np.ndarray, "n D"]:
        """All rows, mapped from the file; they are valid until it is closed."""
        if not self._count:
            return np.zeros((0, self._channels), np.float32)
        return np.memmap(self._file, np.float32, "r", shape=(self._count, self._channels))

    def __enter__(self) -> "RowFile":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


def copy_checked(source: Path, target: Path, check: Callable[[Path], object]) -> None:
    """Copies a file and checks the copy, since the source may have been cut off while it was copied: `check` reads it
    and raises InputError where it is damaged. An earlier target is replaced then."""
    with atomic_file(target) as stream:
        with readable(source), open_foreign(source) as original:
            shutil.copyfileobj(original, stream)
        stream.flush()
        try:
            check(Path(stream.name))
        except InputError as error:
            raise InputError(str(error).replace(stream.name, str(source))) from error
