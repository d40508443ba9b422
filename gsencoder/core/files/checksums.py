"""Checksums of array files: a CRC-32 for each block of each array, and one SHA-256 over the header and all of these.

Blocks let a reader that maps a file check only what it reads: a training step touches a small part of a scene. A CRC-32
detects every error of up to 32 neighboring bits in a block, and misses one in 2³² of all others; it is no protection
against deliberate changes.
"""

import hashlib
import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

BLOCK_BYTES = 1 << 18
"""Bytes of a block, which has one checksum; the last block of an array may be shorter."""
DIGITS = 8
"""Hexadecimal digits of one checksum."""


def bytes_of(array: np.ndarray) -> UInt8[np.ndarray, " bytes"]:
    """The bytes of an array in C order, without a copy if it is contiguous."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def block_checksums(array: np.ndarray) -> str:
    """The CRC-32 of each block of an array, as one string of hexadecimal digits."""
    data = bytes_of(array)
    return "".join(_checksum(data, block) for block in range(-(-len(data) // BLOCK_BYTES)))


def _checksum(data: UInt8[np.ndarray, " bytes"], block: int) -> str:
    return f"{zlib.crc32(data[block * BLOCK_BYTES : (block + 1) * BLOCK_BYTES].data):0{DIGITS}x}"


def damaged_blocks(
    data: UInt8[np.ndarray, " bytes"], checksums: str, blocks: Int64[np.ndarray, " n"] | None = None
) -> list[int]:
    """Numbers of the blocks of an array that do not match their checksums.

    Args:
        data: the bytes of the array.
        checksums: of `block_checksums`.
        blocks: numbers of the blocks to verify; None = all.
    """
    count = -(-len(data) // BLOCK_BYTES)
    if len(checksums) != count * DIGITS:
        return list(range(max(count, 1)))
    numbers = range(count) if blocks is None else blocks.tolist()
    return [n for n in numbers if _checksum(data, n) != checksums[n * DIGITS : (n + 1) * DIGITS]]


def file_digest(header: Mapping[str, Any], entries: Mapping[str, tuple[str, tuple[int, ...]]]) -> str:
    """The SHA-256 over a header (the checksums of all blocks included) and over the types and shapes of the arrays.

    Args:
        header: JSON values.
        entries: type and shape of each array.
    """
    arrays = {name: [dtype, list(shape)] for name, (dtype, shape) in entries.items()}
    return hashlib.sha256(json.dumps([header, arrays], sort_keys=True).encode()).hexdigest()
