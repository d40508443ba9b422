"""JSON files that are lists of entries, one for each object, sentence or question."""

import json
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.evaluate.files.checked_bytes import read_checked

MAX_JSON_BYTES = 1 << 30
"""Largest size of a list."""
MAX_WORD = 200
"""Largest number of characters of a name or an id."""


class Entry:
    """One entry, with its place for messages."""

    def __init__(self, values: dict[str, Any], where: str) -> None:
        self.values, self.where = values, where

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, message: str) -> InputError:
        return InputError(f"{self.where}: {message}")

    def word(self, key: str) -> str:
        """A name: text that is not empty, of one line and of at most 200 characters."""
        return self._word(self.values.get(key), key)

    def words(self, key: str) -> tuple[str, ...]:
        """A list of names; none for null."""
        values = self.values.get(key)
        if values is None and key in self.values:
            return ()
        if not isinstance(values, list):
            raise self.error(f"{key} must be a list of names, got {shown(values)}")
        return tuple(self._word(value, f"{key}[{index}]") for index, value in enumerate(values))

    def number_word(self, key: str) -> str:
        """An id: a whole number, as such or as text, without regard to zeros before it; 7 and "7" are the same."""
        value = self.values.get(key)
        good = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31
        if not good and isinstance(value, str) and value.isascii() and value.isdigit() and len(value) <= 10:
            value, good = int(value), True
        if not good:
            raise self.error(f"{key} must be a whole number of 0 or more, got {shown(value)}")
        return str(value)

    def flag(self, key: str) -> bool | None:
        """0 or 1, or false or true; None if there is none."""
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, int) or value not in (0, 1):
            raise self.error(f"{key} must be 0 or 1, got {shown(value)}")
        return bool(value)

    def _word(self, value: Any, key: str) -> str:
        if not isinstance(value, str):
            raise self.error(f"{key} must be a word, got {shown(value)}")
        if not value.strip() or not value.isprintable() or len(value) > MAX_WORD:
            size = f"{len(value):,} characters" if len(value) > MAX_WORD else shown(value)
            raise self.error(f"{key} must be printable text of 1 to {MAX_WORD} characters, got {size}")
        return value


def read_entries(path: Path) -> tuple[Entry, ...]:
    """Reads a list of objects.

    Raises:
        InputError: unreadable, not JSON, not such a list, an object with a key twice, or a pickle.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        values = dict(pairs)
        if len(values) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise InputError(f"{path}: the key {twice[:40]!r} is twice in one entry; expected each once")
        return values

    data = read_checked(path, max_bytes=MAX_JSON_BYTES)
    try:
        rows = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a readable JSON file ({' '.join(str(error).split())[:160]})") from error
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list of entries, got {shown(rows)}")
    entries = []
    for index, row in enumerate(rows):
        if not isinstance(row, dict):
            raise InputError(f"{path}: entry {index}: expected an object, got {shown(row)}")
        entries.append(Entry(row, f"{path}: entry {index}"))
    return tuple(entries)


def shown(value: Any) -> str:
    """A value for a message, cut off; the type alone of what may be large."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    return "nothing" if value is None else repr(value if not isinstance(value, str) else value[:40])[:60]
