"""How arrays travel to the page: a header of JSON, and the arrays behind it in one piece.

    8 bytes     GSVIEW01
    4 bytes     length of the header, little-endian; the header ends at a multiple of 8 bytes
    header      {"meta": {…}, "arrays": {name: {"type": "uint8", "shape": […], "offset": bytes behind the header}}}
    arrays      little-endian, row-major, each from a multiple of 8 bytes on

`viewer/src/container.ts` reads it.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.files import plain

MAGIC = b"GSVIEW01"
TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Container:
    """Values and arrays for the page.

    Attributes:
        meta: JSON values; numbers that are not finite become null.
        arrays: by name, of the types in `TYPES`.
    """

    meta: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def to_bytes(self) -> bytes:
        """The container in the form that the module describes.

        Raises:
            InputError: an array of another type.
        """
        listed: dict[str, Any] = {}
        parts: list[bytes] = []
        offset = 0
        for name, array in self.arrays.items():
            if array.dtype.name not in TYPES:
                raise InputError(f"Container: array {name!r} is {array.dtype.name}, expected one of {', '.join(TYPES)}")
            data = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
            listed[name] = {"type": array.dtype.name, "shape": list(array.shape), "offset": offset}
            padding = -len(data) % 8
            parts += [data, b"\0" * padding]
            offset += len(data) + padding
        header = json.dumps({"meta": plain(self.meta), "arrays": listed}).encode("ascii")
        header += b" " * (-(len(MAGIC) + 4 + len(header)) % 8)
        return b"".join([MAGIC, struct.pack("<I", len(header)), header, *parts])
