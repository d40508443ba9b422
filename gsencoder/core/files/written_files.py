"""Checksums of the files of a run that have none of their own: JSON, tables, pictures and splats in the forms of other
programs. The summary of a run lists them, and who reads such a file back is told if it has changed since."""

import hashlib
import json
import warnings
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning, readable
from gsencoder.core.files.foreign_file import open_foreign, read_foreign

SUMMARY_NAME = "summary.json"
BLOCK_BYTES = 1 << 22
LARGEST_HEADER = 1 << 24
LARGEST_SUMMARY = 1 << 26
LEVELS = 3
"""In how many folders above a file the summary is looked for: `OUT/SCENE/00001/views.json` is the deepest."""


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with open_foreign(path) as stream:
        while block := stream.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def checksums_of(folder: Path) -> dict[str, str]:
    """The SHA-256 of each file below a folder that has no checksums of its own, by its path in the folder.

    Raises:
        InputError: a file cannot be read.
    """
    sums = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != SUMMARY_NAME:
            with readable(path):
                if not _is_archive(path):
                    sums[path.relative_to(folder).as_posix()] = sha256_of(path)
    return sums


def _is_archive(path: Path) -> bool:
    """Whether a file is an archive of this package (`core.files.archive`), which has checksums."""
    if path.suffix != ".safetensors":
        return False
    with open_foreign(path) as stream:
        length = int.from_bytes(stream.read(8), "little")
        return length <= LARGEST_HEADER and b'"gsencoder"' in stream.read(length)


def check_written(path: str | Path) -> None:
    """Compares a file with the checksum that the run which wrote it left in its summary, in the file's folder or above,
    or as FILE.summary.json beside it. A file without one is not checked.

    Warns:
        SceneWarning: the file is not as it was written.
    """
    file = Path(path).absolute()
    summaries = [Path(f"{file}.{SUMMARY_NAME}"), *(folder / SUMMARY_NAME for folder in list(file.parents)[:LEVELS])]
    for summary in summaries:
        stated = _stated(summary, file)
        if stated is None:
            continue
        try:
            same = sha256_of(file) == stated
        except (OSError, InputError):
            # Whoever reads it says so.
            return
        if not same:
            warnings.warn(
                f"{path}: is not as it was written: its checksum in {summary} is another; it was edited since, or is "
                "damaged",
                SceneWarning,
                stacklevel=3,
            )
        return


def _stated(summary: Path, file: Path) -> str | None:
    try:
        files = json.loads(read_foreign(summary, LARGEST_SUMMARY))["files"]
        stated = files.get(file.relative_to(summary.parent).as_posix())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return stated if isinstance(stated, str) else None
