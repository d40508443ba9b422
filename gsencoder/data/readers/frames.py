"""Frames of RGB-D sequences: matching of files, lost poses and warnings, which their readers share."""

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.image_file import picture_size
from gsencoder.data.readers.undistort import CameraModel, check_camera

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


def frame_key(stem: str) -> tuple[bool, int, str]:
    """Orders names of frames: numbers by value, then other names."""
    return (not stem.isdecimal(), int(stem) if stem.isdecimal() else 0, stem)


def files_by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder by their stems, in the order of `frame_key`; hidden files are left out.

    Raises:
        InputError: two files have one stem.
    """
    if not folder.is_dir():
        return {}
    files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    stems: dict[str, Path] = {}
    for path in sorted(files, key=lambda path: (frame_key(path.stem), path.name)):
        if path.stem in stems:
            raise InputError(f"{folder}: frame {path.stem} is there twice ({stems[path.stem].name}, {path.name})")
        stems[path.stem] = path
    return stems


def is_lost(pose: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether a pose says that tracking was lost there: sequences write -inf, inf or NaN."""
    return not np.isfinite(pose).all()


def pinhole_of(
    fx: float, fy: float, cx: float, cy: float, picture: Path, where: str, *, size: tuple[int, int] | None = None
) -> CameraModel:
    """A camera without distortion at the size of a picture, or at another that is given.

    Raises:
        InputError: numbers that are no camera's, or a principal point that lies outside the middle of the picture, as
            that of intrinsics for another size does.
    """
    width, height = size or picture_size(picture)
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(fx, fy, cx, cy))
    check_camera(camera, where)
    if not (0.25 * width < cx < 0.75 * width and 0.25 * height < cy < 0.75 * height):
        raise InputError(
            f"{where}: principal point {cx:g}, {cy:g} does not belong to pictures of {width}×{height} "
            f"({picture.name}); scale the intrinsics to the size of the pictures"
        )
    return camera


@dataclass(slots=True)
class SkippedFrames:
    """Frames that a reader left out, counted by reason, for one warning each."""

    source: str
    total: int
    reasons: dict[str, list[str]] = field(default_factory=dict)

    def add(self, reason: str, name: str) -> None:
        """Counts a frame."""
        self.reasons.setdefault(reason, []).append(name)

    def warn(self) -> None:
        """One warning for each reason, with the number of frames and the first one's name."""
        for reason, names in self.reasons.items():
            warnings.warn(
                f"{self.source}: {len(names)} of {self.total} frames {reason} and are left out (first: {names[0]!r})",
                SceneWarning,
                stacklevel=3,
            )

    def describe(self) -> str:
        """The counts, for an error."""
        return ", ".join(f"{len(names)} {reason}" for reason, names in self.reasons.items()) or "none has a picture"
