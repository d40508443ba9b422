"""Files: written atomically, read only if they are regular and of a limited size, and what JSON and CSV hold."""

import csv
import errno
import io
import json
import math
import os
import re
import secrets
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from hashlib import sha1, sha256
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning, WriteError, readable

try:
    import fcntl
except ImportError:  # Without it, runs do not see each other's locks.
    fcntl = None  # type: ignore[assignment]


def lock_folder(folder: str | Path, *, wait: bool = False) -> int | None:
    """Locks a folder and returns the open descriptor; the system releases the lock when it is closed or the process
    ends. None where folders cannot be locked (some network file systems).

    Raises:
        BlockingIOError: another run holds the lock, and `wait` is false.
    """
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BaseException as error:
        os.close(descriptor)
        if isinstance(error, OSError) and not isinstance(error, BlockingIOError):
            return None
        raise
    return descriptor


@contextmanager
def locked(folder: str | Path, *, wait: bool = False) -> Iterator[bool]:
    """Locks a folder for the block, as `lock_folder` does; gives whether it could be locked."""
    descriptor = lock_folder(folder, wait=wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            os.close(descriptor)


def is_full_disk(error: BaseException) -> bool:
    """Whether an error of the system or of a library means that the disk or the quota is full."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    # numpy reports "4096 requested and 100 written"; safetensors quotes the system's message in its error.
    short = isinstance(error, OSError) and re.search(r"\d+ requested and \d+ written", str(error))
    return bool(short) or os.strerror(errno.ENOSPC) in str(error)


@contextmanager
def temporary_file(target: Path) -> Iterator[Path]:
    """A file of a hidden name in the folder of `target`, to write and then to rename to it; it is removed at the end of
    the block if it is still there. The name is the same every time, so that the next run writes over what a killed one
    left. The file is locked; a second run that writes the same target meanwhile gets a name of its own."""
    path = target.parent / f".{short_name(target.name)}.tmp"
    descriptor = _locked_file(path)
    if descriptor is None:
        path = path.with_name(f".{short_name(target.name)}.{secrets.token_hex(6)}.tmp")
    try:
        yield path
    finally:
        with suppress(OSError):
            # Once this file is renamed, another run may have one of the name.
            if descriptor is None or _is_file_of(path, descriptor):
                path.unlink(missing_ok=True)
        if descriptor is not None:
            os.close(descriptor)


def _is_file_of(path: Path, descriptor: int) -> bool:
    """Whether a name is that of an open file, and not of another that has taken its place."""
    try:
        here = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    own = os.fstat(descriptor)
    return (here.st_dev, here.st_ino) == (own.st_dev, own.st_ino)


def short_name(name: str) -> str:
    """The name, or a part and a digest of it if the temporary name would be longer than file systems allow."""
    raw = os.fsencode(name)
    return name if len(raw) <= 200 else f"{name[:40]}.{sha1(raw).hexdigest()}"


def _locked_file(path: Path) -> int | None:
    """Makes and locks an empty file, or empties that of a killed run; None if it is locked, or files cannot be."""
    if fcntl is None:
        return None
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # The run that had it may have renamed it before it released the lock.
        if _is_file_of(path, descriptor):
            try:
                os.ftruncate(descriptor, 0)
            except OSError:
                path.unlink(missing_ok=True)
                raise
            return descriptor
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES, errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL):
            os.close(descriptor)
            raise
    os.close(descriptor)
    return None


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Opens a binary file that appears at `path` only if the block ends without an error: it is written under a
    temporary name in the same folder, synced to disk and renamed."""
    target = Path(path)
    with _named_errors(target):
        _check_folder(target)
        with temporary_file(target) as temporary:
            with open(temporary, "wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, target)


def check_writable(path: str | Path) -> None:
    """Checks that `atomic_file` could write a file, by opening its temporary file: before work that takes a while."""
    target = Path(path)
    with _named_errors(target):
        _check_folder(target)
        with suppress(FileNotFoundError):
            os.lstat(target)  # The temporary name is shorter where this one is too long.
        with temporary_file(target) as temporary, open(temporary, "wb"):
            pass


def _check_folder(target: Path) -> None:
    if target.is_dir():
        raise InputError(f"{target}: is a folder; give the name of a file to write")
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; make it first")


@contextmanager
def _named_errors(target: Path) -> Iterator[None]:
    """Turns an error of the system in the block into one that names the file."""
    try:
        yield
    except OSError as error:
        if is_full_disk(error):
            message = f"{target}: no space left on the device; make room and give the command again"
            raise WriteError(message) from error
        raise WriteError(f"{target}: cannot write: {error.strerror or error}") from error


def plain(value: Any, where: str = "", lost: list[str] | None = None) -> Any:
    """Converts numpy values, paths, sequences, mappings and dataclasses, however nested, to JSON types. Numbers that
    are not finite become null; `lost` collects their dotted names, which begin with `where`."""

    def inside(name: object, item: Any) -> Any:
        return plain(item, f"{where}.{name}" if where else str(name), lost)

    if value is None or isinstance(value, (bool, str, int)):
        return value
    if isinstance(value, (float, np.floating)):
        if math.isfinite(value):
            return float(value)
        if lost is not None:
            lost.append(where or "value")
        return None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist(), where, lost)
    if isinstance(value, Mapping):
        return {str(name): inside(name, item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [inside(index, item) for index, item in enumerate(value)]
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: inside(item.name, getattr(value, item.name)) for item in fields(value)}
    raise TypeError(f"{where or 'value'}: {type(value).__name__} cannot be written as JSON")


def json_bytes(value: Any) -> tuple[bytes, list[str]]:
    """`value` as JSON, and the dotted names of the numbers that were not finite."""
    lost: list[str] = []
    text = json.dumps(plain(value, "", lost), indent=2, ensure_ascii=False, allow_nan=False)
    # A lone surrogate stands for a byte of a file name that is not UTF-8; it is escaped.
    return text.encode("utf-8", "backslashreplace") + b"\n", lost


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file atomically; an existing one is replaced."""
    with atomic_file(path) as stream:
        stream.write(data)


def write_json(path: str | Path, value: Any) -> None:
    """Writes a JSON file atomically; values are converted as by `plain`, with one warning about lost numbers."""
    data, lost = json_bytes(value)
    if lost:
        warnings.warn(
            f"{path}: {len(lost)} numbers are not finite and were written as null: {', '.join(lost[:5])}",
            SceneWarning,
            stacklevel=2,
        )
    write_bytes(path, data)


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """CSV of rows with the same keys, after a header line. Floats have six digits; None and NaN are empty cells."""
    if not rows:
        return ""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
    return stream.getvalue()


def _cell(value: Any) -> Any:
    if value is None or value != value:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value


PNG_LEVEL = 3
"""Of compression: of photographs it takes 40 % of the time of Pillow's 6, and 4 % more bytes."""


def write_picture(path: Path, picture: Image.Image | np.ndarray, **options: Any) -> None:
    """Writes a picture, or uint8 [H, W, 3], uint8 [H, W] or uint16 [H, W], in the format of the file's suffix, with
    options of Pillow's encoder. It is encoded in memory: encoders of Pillow that write into a file themselves pass over
    what a disk that is nearly full did not take."""
    write_bytes(path, picture_bytes(picture, path.suffix, **options))


def picture_bytes(picture: Image.Image | np.ndarray, suffix: str, **options: Any) -> bytes:
    """What `write_picture` writes into a file of this suffix, such as ".png"."""
    held = io.BytesIO()
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    kind = Image.registered_extensions()[suffix.lower()]
    if kind == "PNG":
        options = {"compress_level": PNG_LEVEL, **options}
    image.save(held, kind, **options)
    return held.getvalue()


TEXT_BYTES = 256 << 20
"""Larger files are no JSON and no text of one scene: some 100 MB describe a hundred thousand photographs."""
MODEL_BYTES = 16 << 30
"""Larger files are no camera model: COLMAP's largest published ones have 2 GB."""


def open_foreign(path: str | Path, max_bytes: int | None = None) -> BinaryIO:
    """Opens a regular file, or a link to one, for reading; a pipe does not block and a device is not read."""
    # Opening a pipe waits for a writer, unless it is asked not to; what was opened is then looked at, not its name.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOCTTY", 0)
    descriptor = os.open(path, flags)
    try:
        _check(path, os.fstat(descriptor), max_bytes)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_foreign(path: str | Path, max_bytes: int | None = None) -> None:
    """The checks of `open_foreign`, of a file that a library opens by its name."""
    _check(path, os.stat(path), max_bytes)


def read_foreign(path: str | Path, max_bytes: int = TEXT_BYTES) -> bytes:
    with open_foreign(path, max_bytes) as stream:
        return stream.read()


def read_foreign_text(path: str | Path, max_bytes: int = TEXT_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark, any line ends as \\n."""
    return read_foreign(path, max_bytes).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def _check(path: str | Path, status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = "is a folder" if stat.S_ISDIR(status.st_mode) else "is not a regular file (a pipe or a device)"
        raise InputError(f"{path}: {what}; expected a file")
    if max_bytes is not None and status.st_size > max_bytes:
        raise InputError(f"{path}: {status.st_size:,} bytes; at most {max_bytes:,} are read")


SUMMARY_NAME = "summary.json"
LARGEST_HEADER = 1 << 24
LARGEST_SUMMARY = 1 << 26
LEVELS = 3
"""In how many folders above a file the summary is looked for: `OUT/SCENE/00001/views.json` is the deepest."""


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    digest = sha256()
    with open_foreign(path) as stream:
        while block := stream.read(1 << 22):
            digest.update(block)
    return digest.hexdigest()


def checksums_of(folder: Path) -> dict[str, str]:
    """The SHA-256 of each file below a folder that has no checksums of its own, by its path in the folder."""
    sums = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != SUMMARY_NAME:
            with readable(path):
                if not _is_archive(path):
                    sums[path.relative_to(folder).as_posix()] = sha256_of(path)
    return sums


def _is_archive(path: Path) -> bool:
    """Whether a file is an archive of this package, which has checksums."""
    if path.suffix != ".safetensors":
        return False
    with open_foreign(path) as stream:
        length = int.from_bytes(stream.read(8), "little")
        return length <= LARGEST_HEADER and b'"gsencoder"' in stream.read(length)


def warn_if_modified(path: str | Path) -> None:
    """Warns if a file differs from the checksum that the run which wrote it left in its summary, in the file's folder
    or above, or in FILE.summary.json; a file without one is not checked."""
    file = Path(path).absolute()
    summaries = [Path(f"{file}.{SUMMARY_NAME}"), *(folder / SUMMARY_NAME for folder in list(file.parents)[:LEVELS])]
    for summary in summaries:
        recorded = _recorded(summary, file)
        if recorded is None:
            continue
        try:
            same = sha256_of(file) == recorded
        except (OSError, InputError):
            return  # Whoever reads it says so.
        if not same:
            warnings.warn(
                f"{path}: is not as it was written: its checksum in {summary} is another; it was edited since, or is "
                "damaged",
                SceneWarning,
                stacklevel=3,
            )
        return


def _recorded(summary: Path, file: Path) -> str | None:
    try:
        files = json.loads(read_foreign(summary, LARGEST_SUMMARY))["files"]
        recorded = files.get(file.relative_to(summary.parent).as_posix())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return recorded if isinstance(recorded, str) else None


SUM = "sum"
"""The key of the checksum, which rows have for nothing else."""


def with_checksum(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with its checksum: the first 16 digits of the SHA-256 of its JSON with sorted keys."""
    return {**row, SUM: sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()[:16]}


def without_checksum(row: Any) -> dict[str, Any]:
    """A row without its checksum."""
    if not isinstance(row, dict):
        raise ValueError("the row is no object")
    plain = {name: value for name, value in row.items() if name != SUM}
    if row != with_checksum(plain):
        raise ValueError("the row is not as it was written")
    return plain


UNFINISHED_FILE = "unfinished.txt"
"""The file by which the state of an unfinished run is recognized."""


def file_of_scene(option: str, name: str | Path, folder: Path) -> Path:
    """The file that an option of several scenes names: in each scene's own folder, or else from here. `{scene}` in it
    stands for the name of the scene's folder, as in splats/{scene}/splat.ply."""
    name = str(name).replace("{scene}", folder.name)
    try:
        for path in (folder / name, Path(name)):
            if path.exists():
                return path
    except (OSError, ValueError) as error:
        raise InputError(f"{option}={str(name)[:200]}: is not a path ({type(error).__name__})") from error
    raise InputError(f"{option}={name}: no such file (looked in {folder} and from here)")
