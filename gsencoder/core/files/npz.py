"""A reader of untrusted .npz files: no pickle, and no more memory than the size of the file justifies."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.files.foreign_file import check_foreign

LARGEST_ARRAY = 1 << 29
"""Largest size of an array, bytes: a thousand masks of half a million vertices."""
MAX_TEXT = 1 << 12
"""Largest number of characters of an entry of a text array; numpy stores all entries with the length of the longest."""


_KINDS = {"U": "text", "f": "floating point", "b": "bool", "i": "signed integers", "u": "unsigned integers"}
"""What messages call numpy's kinds of types."""


def read_npz(
    file: Path,
    required: Mapping[str, tuple[str, int]],
    optional: Mapping[str, tuple[str, int]] | None = None,
    *,
    max_text: int = MAX_TEXT,
) -> dict[str, np.ndarray]:
    """Reads arrays of an .npz by name.

    Args:
        file: the archive.
        required: kind of type ("U" text, "f" floating point, "b" bool, "i" and "u" integers) and number of axes of each
            array.
        optional: the same for arrays that may be missing.
        max_text: largest number of characters of an entry of text.

    Raises:
        InputError: damaged or hostile, or an array is missing or of another kind.
    """
    try:
        check_foreign(file)
        with zipfile.ZipFile(file) as archive:
            present = set(archive.namelist())
            missing = [name for name in required if f"{name}.npy" not in present]
            if missing:
                raise InputError(f"{file}: expected the arrays {' and '.join(required)}, {missing[0]} is missing")
            types = {**required, **{k: v for k, v in (optional or {}).items() if f"{k}.npy" in present}}
            return {name: _read_member(archive, name, *kind, file, max_text) for name, kind in types.items()}
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, MemoryError) as error:
        message = (" ".join(str(error).split()) or type(error).__name__)[:200]
        raise InputError(f"{file}: cannot be read as .npz: {message}") from error


def _described(dtype: np.dtype, shape: tuple[int, ...]) -> str:
    name = "Python objects, which would run code" if dtype.hasobject else f"{dtype}"
    return f"{' × '.join(f'{each:,}' for each in shape) or 'one'} of {name}"


def _read_member(archive: zipfile.ZipFile, name: str, kind: str, ndim: int, file: Path, max_text: int) -> np.ndarray:
    """Reads an array; its header must match the size in the archive, which is checked before memory is allocated."""
    where, size = f"{file}: {name}", archive.getinfo(f"{name}.npy").file_size
    if size > LARGEST_ARRAY:
        raise InputError(f"{where} claims {size:,} bytes; at most {LARGEST_ARRAY:,} are read")
    with archive.open(f"{name}.npy") as stream:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
        if read is None:
            raise InputError(f"{where}: unknown .npy version {version}")
        shape, fortran, dtype = read(stream)
        count = int(np.prod(shape, dtype=object))
        if dtype.kind != kind or len(shape) != ndim:
            raise InputError(
                f"{where}: expected {ndim} {'axis' if ndim == 1 else 'axes'} of {_KINDS[kind]}, got "
                f"{_described(dtype, shape)}"
            )
        length = dtype.itemsize // np.dtype("U1").itemsize
        if kind == "U" and length > max_text:
            raise InputError(f"{where}: entries of {length:,} characters, expected at most {max_text:,}")
        expected = size - stream.tell()
        if count * dtype.itemsize != expected:
            raise InputError(f"{where}: header claims {count * dtype.itemsize:,} bytes, the file holds {expected:,}")
        data = stream.read(expected)
    if len(data) != expected:
        raise InputError(f"{where}: truncated, {expected - len(data):,} of {expected:,} bytes are missing")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
