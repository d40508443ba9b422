"""The exception for wrong input, as opposed to a bug, and text that a terminal can show.

Every message is one line that says what was wrong, where, what was expected, and what to do. The command line prints it
and exits with code 2; any other exception is a bug and is shown with its traceback.
"""

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A file, option or array given by the user cannot be used; the message says why and what to do."""


class BusyError(InputError):
    """Another run is writing what this one was to write."""


class WriteError(InputError):
    """A file cannot be written: the disk is full, or the system refuses."""


class SceneWarning(UserWarning):
    """Something in the input was left out or estimated; the message counts it and says how."""


def listed(names: Sequence[str], limit: int = 8) -> str:
    """The first names of a list, for a message."""
    return ", ".join(names[:limit]) + (", …" if len(names) > limit else "")


def counted(number: int, noun: str, several: str = "") -> str:
    """A number with its noun, for a message: 1 scene, 1,200 scenes; `several` is the plural that does not end in s."""
    return f"{number:,} {noun if number == 1 else several or f'{noun}s'}"


@contextmanager
def error_prefix(subject: object) -> Iterator[None]:
    """Prefixes the message of an `InputError` that leaves the block with `subject`, unless it contains it already."""
    try:
        yield
    except InputError as error:
        raise error if str(subject) in str(error) else type(error)(f"{subject}: {error}") from error


@contextmanager
def error_hint(advice: str) -> Iterator[None]:
    """Appends advice to the message of an `InputError` that leaves the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}; {advice}") from error


@contextmanager
def renamed_options(section: str, typed: str, options: Iterable[str]) -> Iterator[None]:
    """Names `options` of a section in the message of an `InputError` that leaves the block by the keys that are typed
    for them: with section teacher and typed teachers.clip, teacher.model becomes teachers.clip.model. Other words that
    begin like the section, such as files, are left as they are."""
    try:
        yield
    except InputError as error:
        key = rf"(?<![\w./\\-]){re.escape(section)}\.(?=(?:{'|'.join(map(re.escape, options))})\b)"
        message = re.sub(key, lambda _: f"{typed}.", str(error))
        raise error if message == str(error) else type(error)(message) from error


@contextmanager
def readable(path: str | Path) -> Iterator[None]:
    """Turns an error of the system in the block into one that names the file: an error of reading does not."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


MAX_LINE, END_OF_LINE = 2000, 500
"""Largest number of characters of a message, and of its end, which says what to do; a longer one is cut in between."""


def printable(text: str) -> str:
    """Replaces control characters and overrides of the direction of writing, which change what a terminal displays, and
    escapes lone surrogates, which are bytes of file names that are not UTF-8."""
    direction_overrides = {*map(chr, range(0x202A, 0x202F)), *map(chr, range(0x2066, 0x206A))}
    return "".join(
        "\N{REPLACEMENT CHARACTER}"
        if letter in direction_overrides or (unicodedata.category(letter) == "Cc" and letter not in "\n\t")
        else letter
        for letter in text.replace("\r\n", "\n").encode(errors="backslashreplace").decode()
    )


def one_line(message: str) -> str:
    """A message as one sanitized line."""
    return printable(clipped(" ".join(message.split())))


def clipped(line: str) -> str:
    """A line of at most `MAX_LINE` characters."""
    if len(line) <= MAX_LINE:
        return line
    return f"{line[: MAX_LINE - END_OF_LINE - 3]} … {line[-END_OF_LINE:]}"
