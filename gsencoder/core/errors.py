"""The one exception that means "the input is wrong", as opposed to "the program is wrong".

Every message is one line that says what was wrong, where, what was expected, and what to do. The command line
prints it and leaves with exit code 2; anything else that escapes is a defect of ours and keeps its traceback.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class InputError(ValueError):
    """A file, option or array given by the user cannot be used; the message says why and what to do."""


class SceneWarning(UserWarning):
    """Something in the input was left out or estimated; the message counts it and says how."""


def listed(names: Sequence[str], most: int = 8) -> str:
    """The first of many names, for a message."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


@contextmanager
def about(what: object) -> Iterator[None]:
    """An `InputError` in the block says which of many things it is about, unless it does so already."""
    try:
        yield
    except InputError as error:
        raise error if str(what) in str(error) else type(error)(f"{what}: {error}") from error


@contextmanager
def advised(advice: str) -> Iterator[None]:
    """An `InputError` in the block also says what to do about it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}; {advice}") from error
