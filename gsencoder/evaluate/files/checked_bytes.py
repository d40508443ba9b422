"""The bytes of files that others wrote: of a limited size, and never a pickle."""

from pathlib import Path

from gsencoder.core.errors import InputError

MAX_BYTES = 256 << 20
"""Size from which on a file is no prediction or truth of one scene."""
PICKLE_SUFFIXES = (".p", ".pkl", ".pickle", ".pt", ".pth")
"""Of files that execute code when they are read."""


def read_checked(path: Path, *, max_bytes: int = MAX_BYTES) -> bytes:
    """Reads a file.

    Raises:
        InputError: there is no such file, it cannot be read or is too large, or it is a pickle.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise InputError(f"{path}: {path.stat().st_size:,} bytes; at most {max_bytes:,} are read")
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    # Pickles of protocols 2 to 5 begin so; files of torch.save are archives of them.
    if path.suffix.lower() in PICKLE_SUFFIXES or (data[:1] == b"\x80" and data[1:2] in b"\x02\x03\x04\x05"):
        raise InputError(
            f"{path}: is a pickle, which is refused since reading it executes code; write text, JSON or .npz"
        )
    if data[:4] == b"PK\x03\x04":
        raise InputError(f"{path}: is an archive (of torch.save, perhaps), and no text; write text, JSON or .npz")
    return data
