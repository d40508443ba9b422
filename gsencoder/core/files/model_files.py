"""Files of models and text tables: at a path, or by name in the folder of models; and their fingerprints."""

import hashlib
import os
from pathlib import Path

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files.foreign_file import open_foreign

MODELS_VARIABLE = "GSENCODER_MODELS"
BLOCK_BYTES = 1 << 24
POINTER = b"version https://git-lfs"
"""What files begin with that stand for large ones in a repository."""


def check_fetched(path: Path) -> None:
    """Checks that a file is not the pointer that git keeps in the place of a large one.

    Raises:
        InputError: it is, or cannot be read.
    """
    with readable(path), open_foreign(path) as stream:
        if stream.read(len(POINTER)) == POINTER:
            raise InputError(f"{path}: is a pointer of git-lfs and not the file itself; fetch it with git lfs pull")


def find_file(name: str, option: str, *, folder: bool = False) -> Path:
    """The file at `name`, else the file of that name in the folder GSENCODER_MODELS.

    Args:
        name: a path, or a bare file name.
        option: name of the option, for the error.
        folder: whether to look for a folder, for models of several files.

    Raises:
        InputError: neither exists.
    """
    models = os.environ.get(MODELS_VARIABLE, "")
    tried = [Path(name)]
    if models and not tried[0].is_absolute():
        tried.append(Path(models) / name)
    for path in tried if name else ():
        if path.is_dir() if folder else path.is_file():
            return path
    hint = "" if models else f", and {MODELS_VARIABLE} is not set (a folder to look for models in)"
    raise InputError(f"{option}: no {'folder' if folder else 'file'} at {' or '.join(map(str, tried))}{hint}")


def digest_files(*files: Path, settings: object = None) -> str:
    """A fingerprint of the contents of files, in this order, and of settings; 16 hexadecimal digits.

    Raises:
        InputError: one cannot be read.
    """
    digest = hashlib.sha256(b"" if settings is None else repr(settings).encode("utf-8", "backslashreplace"))
    for path in files:
        with readable(path), open_foreign(path) as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()[:16]
