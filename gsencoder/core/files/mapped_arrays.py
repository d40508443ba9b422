"""Memory-mapped arrays of an archive: only the blocks that are used are read, and processes share them."""

import mmap
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int64, UInt8

from gsencoder.core.errors import InputError, about
from gsencoder.core.files.archive import DAMAGED, open_archive
from gsencoder.core.files.checksums import BLOCK_BYTES, damaged_blocks
from gsencoder.core.files.foreign_file import open_foreign
from gsencoder.core.files.safetensors_bytes import array_offsets


class MappedArrays:
    """Read-only arrays of a file. A block is verified against its checksum when it is first used, and not again; values
    are not validated otherwise. Files of version 1 have no checksums, and are read as they are.

    The system ends a process that reads a page of the map beyond the end of the file (SIGBUS). So the size of the file
    is compared whenever an array is asked for, which leaves the moment in which its values are used.
    """

    def __init__(self, path: Path, types: Mapping[str, tuple[str, int]], earlier: "MappedArrays | None" = None) -> None:
        """Maps the file.

        Args:
            path: of the file.
            types: dtype and number of axes of each array.
            earlier: a closed map of these arrays; blocks that it verified are not verified again if the file has not
                been written since.

        Raises:
            InputError: missing, damaged, or without these arrays.
        """
        self.path = path
        with open_archive(path) as file:
            shapes = {name: file.shape(name, dtype, axes) for name, (dtype, axes) in types.items()}
            self._checksums = file.checksums
        with about(path), open_foreign(path) as stream:
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
        self._unchecked: dict[str, np.ndarray] = {}
        if self._checksums is not None:
            blocks = {name: -(-len(data) // BLOCK_BYTES) for name, data in self._bytes.items()}
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
        """A complete array, verified; a view of the map.

        Raises:
            InputError: the file is damaged, or was cut off.
        """
        self._check_size()
        if name in self._unchecked:
            self._check(name, np.flatnonzero(self._unchecked[name]))
        return self._arrays[name]

    def rows(self, name: str, rows: Int[np.ndarray, " n"]) -> np.ndarray:
        """Copies rows of an array.

        Args:
            name: of the array.
            rows: indices.

        Raises:
            InputError: these rows are damaged, or the file was cut off.
        """
        self._check_size()
        array = self._arrays[name]
        if name in self._unchecked and len(rows):
            size = array.dtype.itemsize * int(np.prod(array.shape[1:]))
            first = rows.astype(np.int64) * size
            touched = np.zeros(len(self._unchecked[name]), bool)
            # A row may extend over several blocks.
            for offset in range(0, size + BLOCK_BYTES, BLOCK_BYTES):
                touched[(first + min(offset, max(size - 1, 0))) // BLOCK_BYTES] = True
            self._check(name, np.flatnonzero(touched & self._unchecked[name]))
        values: np.ndarray = array[rows]
        return values

    def row_range(self, name: str, first: int, last: int) -> np.ndarray:
        """Rows `first` to `last`, exclusive, of an array; a view of the map.

        Raises:
            InputError: these rows are damaged, or the file was cut off.
        """
        self._check_size()
        array = self._arrays[name]
        if name in self._unchecked and last > first:
            size = array.dtype.itemsize * int(np.prod(array.shape[1:]))
            blocks = np.arange(first * size // BLOCK_BYTES, -(-last * size // BLOCK_BYTES))
            self._check(name, blocks[self._unchecked[name][blocks]])
        return array[first:last]

    def _check_size(self) -> None:
        _, written, _ = self._stamp
        if (now := self._map.size()) < written:
            raise InputError(
                f"{self.path}: was cut off while it was in use: {now:,} of {written:,} bytes are left; write it again"
            )

    def _check(self, name: str, blocks: Int64[np.ndarray, " n"]) -> None:
        assert self._checksums is not None
        if damaged_blocks(self._bytes[name], self._checksums[name], blocks):
            raise InputError(f"{self.path}: {DAMAGED}: {name} does not have the checksum that was written with it")
        self._unchecked[name][blocks] = False
        if not self._unchecked[name].any():
            del self._unchecked[name]
