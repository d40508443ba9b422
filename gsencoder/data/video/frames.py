"""Frames of a video as photographs in a folder."""

import json
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import atomic_file, read_foreign_text, sha256_of
from gsencoder.core.process import Track, untracked
from gsencoder.data.video.choose import SIZE, choose_frames, follow
from gsencoder.data.video.decode import Video, color_picture, grey_picture

RECORD_FILE = "frames.json"
FEWEST = 16
"""So many frames are taken of a video in which the picture moves little."""
THIN = 0.35
"""Frames that are farther apart, in widths of the picture, overlap too little to be registered surely."""
ENOUGH = 0.98
"""A video of which a smaller share can be decoded, less a second for its last frames, is not whole."""
QUALITY = 95
"""Of the JPEG files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoConfig:
    """Which frames of a video become photographs."""

    frames: int = field(default=100, metadata={"help": "most frames that are taken of a video"})
    motion: float = field(
        default=0.08, metadata={"help": "by what share of its width the picture moves from one frame to the next"}
    )
    pixels: int = field(default=1600, metadata={"help": "longer side of the frames in pixels, at most"})

    def __post_init__(self) -> None:
        if self.frames < 3:
            raise InputError(f"frames: expected at least 3, got {self.frames}")
        if not 0.001 <= self.motion <= 1:
            raise InputError(f"motion: expected a share of the width from 0.001 to 1, got {self.motion}")
        if not 64 <= self.pixels <= 16384:
            raise InputError(f"pixels: expected 64 to 16384, got {self.pixels}")


def take_frames(
    path: Path, folder: Path, config: VideoConfig = VideoConfig(), *, track: Track = untracked
) -> tuple[str, ...]:
    """Writes the frames of a video that show most: sharp ones, evenly spaced by how far the picture moves.

    The video is decoded twice: small, to measure motion and sharpness of all frames, and large, for those that are
    taken. A folder that an earlier call completed for the same file and settings is used again.

    Args:
        path: of the video.
        folder: is replaced; it receives `frame_000000.jpg` and so on, the number being that of the frame in the video,
            and a record of what they were made from.
        config: settings.
        track: progress of decoding.

    Returns:
        Names of the files, in the order of the video.

    Raises:
        InputError: PyAV is missing, no video, or a camera that hardly moves.

    Warns:
        SceneWarning: the video ends early because it is damaged, or the frames are far apart.
    """
    inputs = _inputs(path, config)
    earlier = _taken(folder, inputs)
    if earlier is not None:
        return earlier
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    video = Video(path)
    course = follow(_small_pictures(video, track))
    if video.failure is not None or video.decoded < ENOUGH * video.seconds - 1:
        reason = f" ({video.failure})" if video.failure else ""
        warnings.warn(
            f"{path}: is damaged or cut off: {video.decoded:.1f} s of {video.seconds:.1f} s can be decoded{reason}; "
            "the "
            "rest is not used",
            SceneWarning,
            stacklevel=2,
        )
    try:
        numbers = choose_frames(course, motion=config.motion, most=config.frames, least=min(FEWEST, config.frames))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    apart = float(course.positions[-1]) / max(1, len(numbers) - 1)
    if apart > THIN:
        warnings.warn(
            f"{path}: {len(numbers)} frames are {apart:.0%} of the picture's width apart, and overlap little; "
            f"video.frames={int(course.positions[-1] / config.motion)} takes them closer together",
            SceneWarning,
            stacklevel=2,
        )
    names: list[str] = []
    selected = set(numbers.tolist())
    for index, frame in track(enumerate(video.frames()), f"taking {len(numbers)} frames"):
        if index in selected:
            names.append(f"frame_{index:06d}.jpg")
            _write(folder / names[-1], color_picture(frame, config.pixels, video.pixel_aspect))
        if index == numbers[-1]:
            break
    digests = {name: sha256_of(folder / name) for name in names}
    with atomic_file(folder / RECORD_FILE) as stream:
        stream.write(json.dumps({"asked": inputs, "files": digests}).encode())
    return tuple(names)


def _small_pictures(video: Video, track: Track) -> Iterator[UInt8[np.ndarray, "H W"]]:
    for frame in track(video.frames(), "looking through the video"):
        yield grey_picture(frame, SIZE)


def _taken(folder: Path, inputs: dict[str, Any]) -> tuple[str, ...] | None:
    """Names of the frames that an earlier call has written, if they are whole and were asked for as now."""
    try:
        record = json.loads(read_foreign_text(folder / RECORD_FILE))
        files = record["files"]
        if record["asked"] != inputs or any(sha256_of(folder / name) != digest for name, digest in files.items()):
            return None
        return tuple(files)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _inputs(path: Path, config: VideoConfig) -> dict[str, Any]:
    state = path.stat()
    return {"video": [path.name, state.st_size, state.st_mtime_ns], "settings": asdict(config)}


def _write(path: Path, picture: UInt8[np.ndarray, "H W 3"]) -> None:
    from gsencoder.core.files import write_picture

    write_picture(path, picture, quality=QUALITY, subsampling=0)
