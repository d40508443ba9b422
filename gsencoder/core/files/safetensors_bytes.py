"""The bytes of safetensors files: arrays read without a memory map, and files written without a second copy of them.

A process that touches a page of a map beyond the end of its file is ended by the system (SIGBUS) without a word. Read
as here, a file that is cut off by another program is shorter than expected, and an error names it.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files.atomic import atomic_file
from gsencoder.core.files.checksums import bytes_of

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
    """The first byte of each array in the file, and the byte after its last.

    Args:
        stream: of the file, whose header the library has accepted.

    Raises:
        InputError: the header is cut off, or is no longer what the library read.
    """
    length = int.from_bytes(read_bytes(stream, (0, 8)).tobytes(), "little")
    text = read_bytes(stream, (8, 8 + min(length, HEADER_LIMIT))).tobytes()
    try:
        table = json.loads(text)
        begin = 8 + length
        return {
            name: (begin + entry["data_offsets"][0], begin + entry["data_offsets"][1])
            for name, entry in table.items()
            if name != "__metadata__"
        }
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise InputError("was cut off or replaced while its header was read; give the command again") from error


def read_bytes(stream: BinaryIO, span: tuple[int, int]) -> UInt8[np.ndarray, " bytes"]:
    """The bytes of a part of a file; fewer where the file ends before.

    Args:
        stream: of the file.
        span: its first byte, and the byte after its last.
    """
    first, last = span
    data = np.empty(max(last - first, 0), np.uint8)
    stream.seek(first)
    done = 0
    # The system reads 2 GiB at once at most.
    while done < len(data) and (count := stream.readinto(data[done:].data)):  # type: ignore[attr-defined]
        done += count
    return data[:done]


def write_safetensors(path: Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Writes the bytes that `safetensors.numpy.save` gives, without a second copy of the arrays in memory.

    The library's `save_file` writes a file of a random name first, which a kill leaves in the folder for good.
    """
    entries = entries_of(arrays)
    with atomic_file(path) as stream:
        stream.write(safetensors_header(entries, metadata))
        for name in _file_order(entries):
            stream.write(bytes_of(arrays[name]).data)


def entries_of(arrays: Mapping[str, np.ndarray]) -> Entries:
    """Type and shape of each array."""
    return {name: (array.dtype.name, array.shape) for name, array in arrays.items()}


def _file_order(entries: Entries) -> list[str]:
    """The names of arrays in the order in which they stand in the file."""
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
