"""Photographs from videos: which frames to take, how to decode them, and where they are stored."""

import json
import shutil
import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt8

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.files import check_foreign, read_foreign_text, write_json, write_picture
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import CheckedConfig, option

SIZE = 640  # Longer side in pixels of the pictures whose sharpness is measured; motion is measured at half of it
BLOCK = 64  # Side in pixels of the blocks whose motion is measured
CONTRAST = 3.0
"""Blocks whose gray levels, of 255, have a smaller standard deviation show nothing that could be seen moving."""
CLEAR = 0.1  # Height of the peak of a phase correlation, of 1, from which on it is no noise
MOVED = 8.0  # Motion in pixels after which a picture is compared with a newer one
EDGE = 0.5  # What the sharpness of a frame counts midway between two positions, where that of a frame at one counts 1


class Course(NamedTuple):
    """What happens in a video."""

    # How far the picture has moved since the first frame, in widths of the picture; never falls.
    positions: Float[np.ndarray, " F"]
    # Variance of the Laplacian of each frame, comparable between frames that show the same.
    sharpness: Float[np.ndarray, " F"]


def follow(pictures: Iterable[UInt8[np.ndarray, "H W"]]) -> Course:
    """Motion and sharpness of all frames, of whose pictures the longer side has about `SIZE` pixels.

    Each frame is compared with the newest one from which the picture had moved by some pixels, so that slow motion
    counts in full, and trembling about one place does not.
    """
    positions: list[float] = []
    sharpness: list[float] = []
    reference: Float[np.ndarray, "h w"] | None = None
    base = 0.0
    for picture in pictures:
        full = picture.astype(np.float32)
        sharpness.append(laplacian_variance(full))
        height, width = (side // 2 for side in full.shape)
        half = full[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean(axis=(1, 3))
        # A picture of another size cannot be compared; few videos change theirs.
        if reference is None or reference.shape != half.shape:
            reference = half
            positions.append(positions[-1] if positions else 0.0)
            base = positions[-1]
            continue
        motion = median_motion(reference, half)
        positions.append(max(positions[-1], base + motion / half.shape[1]))
        if motion >= MOVED:
            reference, base = half, positions[-1]
    return Course(np.array(positions, np.float64), np.array(sharpness, np.float64))


def laplacian_variance(picture: Float[np.ndarray, "H W"]) -> float:
    """The usual measure of sharpness: variance of the sum of second differences."""
    middle = picture[1:-1, 1:-1]
    return float((picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:] - 4 * middle).var())


def median_motion(before: Float[np.ndarray, "H W"], after: Float[np.ndarray, "H W"]) -> float:
    """Median length in pixels of the motion of blocks, by phase correlation.

    Blocks without contrast count nowhere; where a picture has no others it stands still. A block with contrast whose
    motion is not clear has moved too far, or became blurred: it counts as half a block, the most that can be measured.
    """
    pairs = np.stack((_blocks(before), _blocks(after)))
    textured = pairs.std(axis=(2, 3)).min(axis=0) >= CONTRAST
    if not textured.any():
        return 0.0
    window = np.hanning(pairs.shape[2])[:, None] * np.hanning(pairs.shape[3])
    pairs = pairs[:, textured]
    spectra = np.fft.rfft2((pairs - pairs.mean(axis=(2, 3), keepdims=True)) * window)
    cross = spectra[1] * spectra[0].conj()
    surface = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-6), s=pairs.shape[2:])
    flat = surface.reshape(len(surface), -1)
    peaks = flat.argmax(axis=1)
    shifts = np.stack(np.unravel_index(peaks, surface.shape[1:]), axis=1).astype(np.float64)
    sides = np.array(surface.shape[1:])
    shifts -= sides * (shifts > sides / 2)
    lengths = np.linalg.norm(shifts, axis=1)
    lengths[flat[np.arange(len(flat)), peaks] < CLEAR] = BLOCK / 2
    return float(np.median(lengths))


def choose_frames(course: Course, *, motion: float, most: int, least: int) -> Int64[np.ndarray, " n"]:
    """Indices of the frames to take, rising: of those nearest to each of evenly spaced positions a sharp one.

    Positions are `motion` widths of the picture apart, or as far as `most` and `least` frames ask.
    """
    total = float(course.positions[-1])
    if total < motion:
        raise InputError(
            f"the picture moves by {total:.0%} of its width in {len(course.positions)} frames; a reconstruction needs "
            "a camera that moves through the scene"
        )
    count = min(max(round(total / motion) + 1, least), most, len(course.positions))
    # Nearest positions of all frames; those of one are a slice, because positions never fall.
    step = total / max(1, count - 1)
    nearest = np.floor(course.positions / step + 0.5).astype(np.int64).clip(0, count - 1)
    away = np.abs(course.positions / step - nearest)
    worth = course.sharpness * (1 - (1 - EDGE) * (2 * away) ** 2)
    bounds = np.searchsorted(nearest, np.arange(count + 1))
    slices = [(first, end) for first, end in pairwise(bounds) if first < end]
    return np.array([first + worth[first:end].argmax() for first, end in slices], np.int64)


def _blocks(picture: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "B h w"]:
    """Blocks side by side over the whole picture; a picture that is smaller than a block is one."""
    height, width = (min(BLOCK, side) for side in picture.shape)
    rows, columns = (side // block for side, block in zip(picture.shape, (height, width), strict=True))
    cut = picture[: rows * height, : columns * width].reshape(rows, height, columns, width)
    return cut.swapaxes(1, 2).reshape(-1, height, width)


TIME_BASE = 1_000_000  # Parts of a second in which files state how long they are
SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def refuse_video(path: Path) -> None:
    """Checks that a path where a scene or a splat is expected is no video."""
    if is_video(path):
        raise InputError(f"{path}: is a video; gsencoder reconstruct makes a scene of it")


class Video:
    """A video file that can be decoded from its beginning several times.

    Attributes:
        pixel_aspect: width of a stored pixel by its height; 1 where the file states none.
        seconds: duration that the file states; 0 = it states none.
        decoded: seconds of the video that the last pass decoded.
        failure: why the last pass ended before the end of the file; None = the decoder says that it did not.
    """

    def __init__(self, path: Path) -> None:
        try:
            import av
        except ImportError:
            raise InputError(
                "video files are decoded by PyAV, which is missing: pip install 'gsencoder[video]'"
            ) from None
        av.logging.set_level(av.logging.PANIC)
        self.path, self._av = path, av
        self.decoded = 0.0
        self.failure: str | None = None
        with self._open() as container:
            stream = container.streams.video[0]
            duration = stream.duration * stream.time_base if stream.duration else (container.duration or 0) / TIME_BASE
            self.pixel_aspect, self.seconds = float(stream.sample_aspect_ratio or 1), float(duration)

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
        """All frames, as PyAV's VideoFrame, in the order of display. Where decoding fails they end, and
        `failure` says why."""
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


def color_picture(frame: Any, size: int, pixel_aspect: float = 1.0) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of a frame as it is meant to be seen: rotated as the file states, with square pixels.

    Args:
        size: its longer side becomes at most this many pixels.
        pixel_aspect: width of a stored pixel by its height.
    """
    color = _reformatted(frame, round(frame.width * pixel_aspect), frame.height, size, "rgb24")
    return np.ascontiguousarray(np.rot90(color, round(frame.rotation / 90)))


def _reformatted(frame: Any, width: int, height: int, size: int, form: str) -> np.ndarray:
    """The pixels of a frame at width × height, reduced to a longer side of `size`."""
    scale = min(1.0, size / max(width, height))
    width, height = (max(1, round(side * scale)) for side in (width, height))
    return np.asarray(frame.reformat(width=width, height=height, format=form).to_ndarray())


def _reason(error: BaseException) -> str:
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:120]


RECORD_FILE = "frames.json"
FEWEST = 16  # Frames that are taken of a video in which the picture moves little
THIN = 0.35  # Frames that are farther apart, in widths of the picture, overlap too little to be registered surely
ENOUGH = 0.98  # A video of which a smaller share can be decoded, less a second for its last frames, is not whole
PIXELS = 1600  # Longer side of the frames, at most
QUALITY = 95  # Of the JPEG files


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoConfig(CheckedConfig):
    """Which frames of a video become photographs."""

    frames: int = option(100, "most frames that are taken of a video", ge=3)
    motion: float = option(
        0.08, "by what share of its width the picture moves from one frame to the next", ge=0.001, le=1
    )


def take_frames(
    path: Path, folder: Path, config: VideoConfig = VideoConfig(), *, track: Track = untracked
) -> tuple[str, ...]:
    """Writes the frames of a video that show most: sharp ones, evenly spaced by how far the picture moves.

    The video is decoded twice: small, to measure motion and sharpness of all frames, and large, for the frames that are
    taken. A folder that an earlier call completed for the same file and settings is used again; any other is replaced.

    Returns:
        Names of the files in the order of the video, such as frame_000007.jpg for its frame 7.
    """
    state = path.stat()
    inputs = {"video": [path.name, state.st_size, state.st_mtime_ns], "settings": asdict(config)}
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        record = json.loads(read_foreign_text(folder / RECORD_FILE))
        if record["asked"] == inputs and all((folder / name).is_file() for name in record["files"]):
            return tuple(record["files"])
    video = Video(path)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    small = track(video.frames(), "looking through the video")
    course = follow(_reformatted(frame, frame.width, frame.height, SIZE, "gray") for frame in small)
    if video.failure is not None or video.decoded < ENOUGH * video.seconds - 1:
        reason = f" ({video.failure})" if video.failure else ""
        warnings.warn(
            f"{path}: is damaged or cut off: {video.decoded:.1f} s of {video.seconds:.1f} s can be decoded{reason}; "
            "the rest is not used",
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
            picture = color_picture(frame, PIXELS, video.pixel_aspect)
            write_picture(folder / names[-1], picture, quality=QUALITY, subsampling=0)
        if index == numbers[-1]:
            break
    # Written last: with it the folder is whole.
    write_json(folder / RECORD_FILE, {"asked": inputs, "files": names})
    return tuple(names)
