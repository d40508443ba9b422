"""Bytes of the arrays of a safetensors file, read without a memory map.

A process that touches a page of a map beyond the end of its file is ended by the system (SIGBUS) without a word. Read
as here, a file that is cut off by another program is shorter than expected, and an error names it.
"""

import json
from typing import BinaryIO

import numpy as np
from jaxtyping import UInt8

from gsencoder.core.errors import InputError

HEADER_LIMIT = 100_000_000
"""Bytes of the longest header that the library reads."""


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
