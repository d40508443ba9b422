"""Split files of benchmarks: one name of a scene a line, such as scannetv2_val.txt."""

from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.data.truth.checked_files import read_checked_text

MAX_BYTES = 16 << 20


def read_split(path: Path) -> tuple[str, ...]:
    """The names of the scenes of a split, in the order of the file; blank lines are left out.

    Raises:
        InputError: unreadable, too large, empty, a line that is no name of a folder, or a name that is there twice.
    """
    lines = read_checked_text(path, max_bytes=MAX_BYTES).splitlines()
    first: dict[str, int] = {}
    for number, line in enumerate(lines, start=1):
        name = line.strip()
        if not name:
            continue
        if name in (".", "..") or any(each in name for each in "/\\\0") or len(name) > 255 or len(name.split()) > 1:
            raise InputError(f"{path}: line {number}: expected the name of a scene, got {name[:60]!r}")
        if name in first:
            raise InputError(f"{path}: line {number}: {name!r} is already on line {first[name]}")
        first[name] = number
    if not first:
        raise InputError(f"{path}: lists no scene; expected one name a line")
    return tuple(first)
