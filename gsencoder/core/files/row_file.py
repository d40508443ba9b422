"""Rows of float32 in a temporary file: more of them than are held in memory."""

from tempfile import TemporaryFile
from types import TracebackType

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError


class RowFile:
    """Rows that are appended part by part and then read as one array, whose pages the system loads and drops.

    The file is in the folder for temporary files (TMPDIR) and has no name, so that it goes with the process.
    """

    def __init__(self, channels: int) -> None:
        """Args:
        channels: of a row.
        """
        self._channels, self._count = channels, 0
        self._file = TemporaryFile()  # noqa: SIM115

    def append(self, rows: Float32[np.ndarray, "n D"]) -> None:
        """Adds rows after those that are there.

        Raises:
            InputError: rows of another length, or the disk is full.
        """
        if rows.shape[1] != self._channels:
            raise InputError(f"rows: expected {self._channels} channels, got {rows.shape[1]}")
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
