"""Reads what the page of `view` gets, as its script does."""

import json
import struct

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.infer.page.page import MAGIC, Container


def read_container(data: bytes) -> Container:
    """Reads what `Container.to_bytes` wrote.

    Raises:
        InputError: something else, or cut off.
    """
    begin = len(MAGIC) + 4
    if data[: len(MAGIC)] != MAGIC or len(data) < begin:
        raise InputError(f"expected {len(data)} bytes that begin with {MAGIC!r}, got {data[:8]!r}")
    (length,) = struct.unpack_from("<I", data, len(MAGIC))
    header = json.loads(data[begin : begin + length])
    arrays = {}
    for name, entry in header["arrays"].items():
        count = int(np.prod(entry["shape"], dtype=np.int64))
        kind = np.dtype(entry["type"]).newbyteorder("<")
        at = begin + length + entry["offset"]
        if at + count * kind.itemsize > len(data):
            raise InputError(f"array {name!r} ends behind the {len(data):,} bytes there are")
        arrays[name] = np.frombuffer(data, kind, count, at).reshape(entry["shape"]).astype(entry["type"])
    return Container(meta=header["meta"], arrays=arrays)
