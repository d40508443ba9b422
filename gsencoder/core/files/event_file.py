"""Events that TensorBoard shows, written by the caller and not by a thread of TensorBoard's own, whose errors nobody
would handle."""

import os
import re
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError

_NAME = re.compile(r"events[.]out[.]tfevents[.](\d+)[.].*")


class EventFile:
    """A file of scalars and pictures by step. Every event is on the disk when it has been added."""

    def __init__(self, folder: Path, purge_step: int) -> None:
        """Begins a new file.

        Args:
            folder: of the files of all runs; created if it does not exist.
            purge_step: events of earlier files from this step on, which a killed run left, are hidden.

        Raises:
            InputError: TensorBoard is not installed, the disk is full, or the system refuses.
        """
        try:
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog
            from torch.utils.tensorboard import summary
        except ImportError as error:
            raise InputError(
                "tensorboard=true needs the package tensorboard (pip install tensorboard), or tensorboard=false"
            ) from error
        self._event, self._summary = Event, summary
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # TensorBoard reads files in the order of these numbers, and a clock may have been set back.
            earlier = [int(match[1]) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))]
            number = max([int(time.time()), *(each + 1 for each in earlier)])
            self.path = folder / f"events.out.tfevents.{number:010d}.{socket.gethostname()}.{os.getpid()}.0"
        except OSError as error:
            raise InputError(f"{folder}: cannot write: {error.strerror or error}") from error
        self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))
        start = SessionLog(status=SessionLog.START)
        self._write(Event(wall_time=time.time(), step=purge_step, session_log=start))

    def add(self, step: int, values: dict[str, float]) -> None:
        """Adds scalars.

        Raises:
            InputError: the disk is full, or the system refuses.
        """
        for name, value in values.items():
            self._write(self._event(wall_time=time.time(), step=step, summary=self._summary.scalar(name, value)))

    def picture(self, step: int, name: str, pixels: np.ndarray) -> None:
        """Adds a picture, uint8 [H, W, 3].

        Raises:
            InputError: the disk is full, or the system refuses.
        """
        summary = self._summary.image(name, pixels, dataformats="HWC")
        self._write(self._event(wall_time=time.time(), step=step, summary=summary))

    def _write(self, event: Any) -> None:
        import io

        from tensorboard.summary.writer.record_writer import RecordWriter

        held = io.BytesIO()
        RecordWriter(held).write(event.SerializeToString())
        try:
            with self.path.open("ab") as stream:
                stream.write(held.getvalue())
        except OSError as error:
            raise InputError(f"{self.path}: cannot write: {error.strerror or error}") from error
