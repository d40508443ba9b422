"""Label images in a .zip, read on access without unpacking it, as ScanNet's SCAN_2d-instance-filt.zip has them."""

import io
import zipfile
import zlib
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign
from gsencoder.data.readers.image_file import open_picture, read_integers
from gsencoder.data.readers.label_images import LabelFiles

MAX_MEMBER_BYTES = 64 << 20
"""Larger files in an archive are no label images."""


class ArchivedLabels(LabelFiles):
    """Label images of views in one archive, as int32 [H, W]; paths are those of members below that of the archive."""

    @property
    def archive(self) -> Path:
        """The .zip."""
        path = self._paths[0]
        assert path is not None
        return archive_of(path)

    def _read(self, path: Path) -> Int32[np.ndarray, "H W"]:
        return read_integers(path, "a label image", wide=False, data=member_bytes(path))


def members_by_stem(archive: Path) -> dict[str, Path]:
    """The .png files of an archive by their stems, as paths below that of the archive.

    Raises:
        InputError: it cannot be read as .zip, or two files have one stem.
    """
    try:
        check_foreign(archive)
        with zipfile.ZipFile(archive) as file:
            names = [name for name in file.namelist() if name.lower().endswith(".png")]
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise InputError(f"{archive}: cannot be read as .zip: {' '.join(str(error).split())[:120]}") from error
    members: dict[str, Path] = {}
    for name in names:
        stem = PurePosixPath(name).stem
        if stem in members:
            raise InputError(f"{archive}: has several files called {stem}.png, such as {name}; expected one a frame")
        members[stem] = archive / name
    return members


def archived_size(path: Path) -> tuple[int, int]:
    """(width, height) of a member, from its header.

    Raises:
        InputError: damaged or no picture.
    """
    with open_picture(path, member_bytes(path)) as picture:
        return picture.size


def archive_of(path: Path) -> Path:
    """The archive that a member's path is below."""
    return next(each for each in path.parents if each.suffix.lower() == ".zip" and each.is_file())


def member_bytes(path: Path) -> io.BytesIO:
    """The content of a member.

    Raises:
        InputError: the archive or the member is damaged, encrypted or too large.
    """
    archive = archive_of(path)
    name = path.relative_to(archive).as_posix()
    try:
        check_foreign(archive)
        with zipfile.ZipFile(archive) as file:
            size = file.getinfo(name).file_size
            if size > MAX_MEMBER_BYTES:
                raise InputError(f"{path}: {size:,} bytes; a label image has at most {MAX_MEMBER_BYTES:,}")
            return io.BytesIO(file.read(name))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, KeyError, RuntimeError, NotImplementedError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())[:120]}") from error
