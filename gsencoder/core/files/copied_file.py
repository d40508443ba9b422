"""Copies of files, checked after they were copied."""

from collections.abc import Callable, Iterator
from pathlib import Path

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files.atomic import atomic_file
from gsencoder.core.files.checksums import BLOCK_BYTES
from gsencoder.core.files.foreign_file import open_foreign


def copy_checked(source: Path, target: Path, check: Callable[[Path], object]) -> None:
    """Copies a file and checks the copy, since the source may have been cut off while it was copied. An earlier target
    is replaced once the copy is complete and checked.

    Args:
        source: the file.
        target: its copy.
        check: reads the copy; raises InputError where it is damaged.

    Raises:
        InputError: the source cannot be read, the copy cannot be written, or is damaged; then the source is named.
    """
    with atomic_file(target) as stream:
        for block in _blocks(source):
            stream.write(block)
        stream.flush()
        try:
            check(Path(stream.name))
        except InputError as error:
            raise InputError(str(error).replace(stream.name, str(source))) from error


def _blocks(path: Path) -> Iterator[bytes]:
    with readable(path), open_foreign(path) as stream:
        while block := stream.read(BLOCK_BYTES):
            yield block
