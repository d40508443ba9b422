"""The log of a training: a CSV that a resumed run continues, and TensorBoard events."""

import csv
import io
import os
import socket
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import atomic_file, read_foreign_text, write_picture


class EventFile:
    """A file of scalars and pictures by step for TensorBoard. Every event is on the disk when it has been added."""

    def __init__(self, folder: Path, purge_step: int) -> None:
        """Begins a new file in the folder of all runs; events of earlier files from `purge_step` on, which a killed
        run left, are hidden."""
        try:
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        except ImportError as error:
            raise InputError(
                "tensorboard=true needs the package tensorboard (pip install tensorboard), or tensorboard=false"
            ) from error
        # TensorBoard reads files in the order of their names.
        name = f"events.out.tfevents.{time.time():020.6f}.{socket.gethostname()}.{os.getpid()}.0"
        self._event, self.path = Event, folder / name
        self._write(0, file_version="brain.Event:2")
        self._write(purge_step, session_log=SessionLog(status=SessionLog.START))

    def add(self, step: int, values: dict[str, float]) -> None:
        """Adds scalars."""
        from torch.utils.tensorboard import summary

        for name, value in values.items():
            self._write(step, summary=summary.scalar(name, value))

    def picture(self, step: int, name: str, pixels: np.ndarray) -> None:
        """Adds a picture, uint8 [H, W, 3]."""
        from torch.utils.tensorboard import summary

        self._write(step, summary=summary.image(name, pixels, dataformats="HWC"))

    def _write(self, step: int, **content: Any) -> None:
        from tensorboard.summary.writer.record_writer import RecordWriter

        held = io.BytesIO()
        RecordWriter(held).write(self._event(wall_time=time.time(), step=step, **content).SerializeToString())
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as stream:
                stream.write(held.getvalue())
        except OSError as error:
            raise InputError(f"{self.path}: cannot write: {error.strerror or error}") from error


LOG_FILE, EVENTS_FOLDER = "log.csv", "tensorboard"


class Log:
    """Writes a row of numbers for each step. The file is closed after every row, so that a kill loses none.

    Attributes:
        before: the rows of earlier runs that it goes on from, as text.
    """

    def __init__(self, folder: Path, *, done: int, events: bool, begun: bool = False) -> None:
        """Removes the rows of steps after `done`, which will be repeated; a row holds the number of steps that were
        completed when it was written.

        Args:
            events: whether to write TensorBoard events too.
            begun: whether an earlier run wrote rows: a missing file is warned of.
        """
        self.path = folder / LOG_FILE
        self._columns: list[str] = []
        # Hides events of later steps, which a killed run left.
        self._events = EventFile(folder / EVENTS_FOLDER, purge_step=done + 1) if events else None
        try:
            if begun and not self.path.is_file():
                warnings.warn(f"{self.path}: is missing; the log starts at step {done}", SceneWarning, stacklevel=2)
            rows = read_log(self.path) if self.path.is_file() else []
            self.before = [row for row in rows if int(row["step"]) <= done]
            self._columns = list(dict.fromkeys(name for row in self.before for name in row))
            self._rewrite(self.before)
        except InputError:
            raise
        except (OSError, ValueError, KeyError, csv.Error) as error:
            raise InputError(f"{self.path}: cannot be continued: {error}") from error

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Appends a row; every number is also a TensorBoard scalar."""
        self._append({"step": step, **values})
        if self._events is not None:
            self._events.add(step, dict(values))

    def picture(self, step: int, name: str, pixels: np.ndarray) -> None:
        """Writes a picture, uint8 [H, W, 3]: a file `NAME_STEP.png` next to the log, and for TensorBoard."""
        path = self.path.parent / f"{name}_{step:06d}.png"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path}: cannot write: {error.strerror or error}") from error
        write_picture(path, pixels)
        if self._events is not None:
            self._events.picture(step, name, pixels)

    def _append(self, row: Mapping[str, Any]) -> None:
        new = [name for name in row if name not in self._columns]
        try:
            if new and self._columns:
                # Validation adds columns: the file is rewritten once, with empty cells in earlier rows.
                self._columns += new
                self._rewrite([*read_log(self.path), row])
                return
            self._columns += new
            with self.path.open("a", encoding="utf-8", newline="") as stream:
                stream.write(_text(self._columns, [row], header=bool(new)))
        except OSError as error:
            raise InputError(f"{self.path}: cannot write: {error.strerror or error}") from error

    def _rewrite(self, rows: Sequence[Mapping[str, Any]]) -> None:
        with atomic_file(self.path) as stream:
            stream.write((_text(self._columns, rows, header=True) if rows else "").encode())


def read_log(path: Path) -> list[dict[str, str]]:
    """The rows of a log, as text, without empty cells and without an incomplete last line that a kill left."""
    lines = read_foreign_text(path).rpartition("\n")[0]
    return [{name: cell for name, cell in row.items() if name and cell} for row in csv.DictReader(lines.splitlines())]


def _text(columns: Sequence[str], rows: Sequence[Mapping[str, Any]], *, header: bool) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()
