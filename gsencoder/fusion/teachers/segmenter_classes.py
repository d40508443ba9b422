"""Names of the classes of a segmenter, from files."""

import json
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.files import read_foreign_text

MAX_CLASSES_BYTES = 1 << 22


def synonyms_of_classes(names: Sequence[str], nothing: Sequence[str]) -> list[list[str]]:
    """The synonyms of each class; none of a class that is no kind of thing.

    Args:
        names: of the classes.
        nothing: names of classes that are no kind of thing.

    Raises:
        InputError: a class has no name.

    Warns:
        SceneWarning: several classes have one name.
    """
    no_kind = {word.strip().casefold() for word in nothing}
    synonyms = [[] if name.strip().casefold() in no_kind else _synonyms(name) for name in names]
    for name, each in zip(names, synonyms, strict=True):
        if not each and name.strip().casefold() not in no_kind:
            raise InputError(f"teacher.classes: class {name!r} has no name; expected a word, or one of teacher.nothing")
    if len(set(names)) < len(names):
        doubled = sorted({name for name in names if list(names).count(name) > 1})
        warnings.warn(
            f"teacher.classes: {len(doubled)} names stand for several classes: {listed(doubled)}",
            SceneWarning,
            stacklevel=3,
        )
    return synonyms


def _synonyms(name: str) -> list[str]:
    """The parts of "window, windowpane" or "door;double door", with blanks for _ and -."""
    parts = [re.sub(r"[\s_\-]+", " ", part).strip() for part in re.split(r"[,;]", name)]
    return [part for part in parts if part]


def read_classes(path: Path) -> tuple[str, ...]:
    """The names in a .json list or object of numbers to names, or the lines of a text file.

    Raises:
        InputError: the file is none of these, or a name is empty.
    """
    try:
        text = read_foreign_text(path, MAX_CLASSES_BYTES)
        values = json.loads(text) if path.suffix.lower() == ".json" else text.splitlines()
    except InputError as error:
        raise InputError(f"teacher.classes: {error}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"teacher.classes: {path} cannot be read: {str(error)[:80]}") from error
    if isinstance(values, dict):
        numbers = [str(number) for number in range(len(values))]
        values = [values.get(number) for number in numbers]
    if path.suffix.lower() != ".json":
        values = [line for line in values if line.strip()]
    if not isinstance(values, list) or not all(isinstance(name, str) and name.strip() for name in values):
        raise InputError(f"teacher.classes: {path}: expected a list of names, in the order of the network's classes")
    return tuple(name.strip() for name in values)
