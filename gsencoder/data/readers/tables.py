"""Text files of numbers, such as trajectories: blanks or tabs between, comments after #, any line ends."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign_text


def table_lines(path: Path) -> list[list[str]]:
    """The words of each line that is neither empty nor a comment; a byte order mark is skipped.

    Raises:
        InputError: unreadable, too large, or not text.
    """
    try:
        text = read_foreign_text(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable text file ({' '.join(str(error).split())[:120]})") from error
    lines = (line.split("#", 1)[0].split() for line in text.splitlines())
    return [words for words in lines if words]


def read_numbers(path: Path, *shapes: tuple[int | None, int]) -> Float64[np.ndarray, "rows columns"]:
    """A table of numbers of one of the shapes; None = any number of rows, at least one. NaN and infinity are numbers.

    Raises:
        InputError: unreadable, words that are no numbers, lines of different lengths, another shape.
    """
    lines = table_lines(path)
    expected = " or ".join(f"{'n' if rows is None else rows}×{columns}" for rows, columns in shapes)
    lengths = {len(words) for words in lines}
    if len(lengths) > 1:
        odd = next(number for number, words in enumerate(lines) if len(words) != len(lines[0]))
        raise InputError(
            f"{path}: row {odd + 1} has {len(lines[odd])} values and the first {len(lines[0])}; expected {expected}"
        )
    try:
        values = np.array(lines, np.float64).reshape(len(lines), len(lines[0]) if lines else 0)
    except ValueError as error:
        raise InputError(f"{path}: not a table of numbers ({' '.join(str(error).split())[:120]})") from error
    if not len(lines) or not any(
        values.shape[1] == columns and rows in (None, values.shape[0]) for rows, columns in shapes
    ):
        raise InputError(f"{path}: expected {expected} numbers, got {list(values.shape)}")
    return values
