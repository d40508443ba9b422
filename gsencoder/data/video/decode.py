"""Decoding of video files by PyAV, upright and with square pixels."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from gsencoder.core.errors import InputError, listed
from gsencoder.core.files import check_foreign

TIME_BASE = 1_000_000
"""Parts of a second in which files state how long they are."""
SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def refuse_video(path: Path) -> None:
    """Checks that a path where a scene or a splat is expected is no video.

    Raises:
        InputError: it is one.
    """
    if is_video(path):
        raise InputError(f"{path}: is a video; gsencoder reconstruct makes a scene of it")


def load_av() -> Any:
    """The module av.

    Raises:
        InputError: it is not installed.
    """
    try:
        import av
    except ImportError:
        raise InputError("video files are decoded by PyAV, which is missing: pip install 'gsencoder[video]'") from None
    av.logging.set_level(av.logging.PANIC)
    return av


class Video:
    """A video file that can be decoded from its beginning several times.

    Attributes:
        path: of the file.
        pixel_aspect: width of a stored pixel by its height; 1 where the file states none.
        seconds: duration that the file states; 0 = it states none.
        decoded: seconds of the video that the last pass decoded.
        failure: why decoding ended before the end of the file, from the last pass; None = it did not, so far as the
            decoder says.
    """

    def __init__(self, path: Path) -> None:
        """Args:
        path: of the file.

        Raises:
            InputError: PyAV is missing, the file is no video, or it has no picture.
        """
        self.path = path
        self._av = load_av()
        with self._open() as container:
            stream = container.streams.video[0]
            duration = stream.duration * stream.time_base if stream.duration else (container.duration or 0) / TIME_BASE
            self.pixel_aspect = float(stream.sample_aspect_ratio or 1)
        self.seconds, self.decoded = float(duration), 0.0
        self.failure: str | None = None

    def _open(self) -> Any:
        try:
            check_foreign(self.path)
            container = self._av.open(str(self.path), metadata_errors="replace")
        except (self._av.FFmpegError, OSError, ValueError) as error:
            raise InputError(f"{self.path}: not a video that can be decoded ({_reason(error)})") from error
        if not container.streams.video:
            kinds = listed(sorted({stream.type for stream in container.streams})) or "nothing"
            container.close()
            raise InputError(f"{self.path}: holds no pictures, only {kinds}")
        return container

    def frames(self) -> Iterator[Any]:
        """All frames, as PyAV's VideoFrame, in the order in which they are shown. Where decoding fails they end, and
        `failure` says why.

        Raises:
            InputError: the file cannot be opened any more, or its first frame cannot be decoded.
        """
        self.failure, self.decoded, empty = None, 0.0, True
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            base = float(stream.time_base or 0)
            try:
                for frame in container.decode(stream):
                    empty = False
                    self.decoded = max(self.decoded, float(frame.time or 0) - float(stream.start_time or 0) * base)
                    yield frame
            except (self._av.FFmpegError, OSError, ValueError) as error:
                self.failure = _reason(error)
        if empty:
            raise InputError(f"{self.path}: no frame can be decoded ({self.failure or 'the video is empty'})")


def grey_picture(frame: Any, size: int) -> UInt8[np.ndarray, "H W"]:
    """Brightness of a frame as stored, not rotated.

    Args:
        frame: of `Video.frames`.
        size: its longer side becomes so many pixels at most.
    """
    width, height = _fitted(frame.width, frame.height, size)
    grey: np.ndarray = frame.reformat(width=width, height=height, format="gray").to_ndarray()
    return grey


def color_picture(frame: Any, size: int, pixel_aspect: float = 1.0) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of a frame as it is meant to be seen: rotated as the file states, with square pixels.

    Args:
        frame: of `Video.frames`.
        size: its longer side becomes so many pixels at most.
        pixel_aspect: width of a stored pixel by its height.
    """
    width, height = _fitted(round(frame.width * pixel_aspect), frame.height, size)
    color: np.ndarray = frame.reformat(width=width, height=height, format="rgb24").to_ndarray()
    return np.ascontiguousarray(np.rot90(color, round(frame.rotation / 90)))


def _fitted(width: int, height: int, size: int) -> tuple[int, int]:
    scale = min(1.0, size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _reason(error: BaseException) -> str:
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:120]
