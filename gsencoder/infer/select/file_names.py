"""Names of files from words that people typed."""

import unicodedata
from collections.abc import Sequence

LONGEST = 60
"""Bytes of a name, without its ending."""
RESERVED = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in "0123456789")}
)
"""Names that Windows keeps for devices."""


def file_stems(words: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """A name for each word that is safe on every file system, and differs from all others in any case of letters.

    Letters and digits of any script stay, each run of other characters becomes one underscore. Marks that change the
    direction of writing, slashes, quotes, and all that a shell or a browser takes for more than text are among these.

    Args:
        words: in order; the first of several that would have one name keeps it, others get a number.
        taken: names that are not given out.
    """
    used = {name.casefold() for name in taken} | RESERVED
    stems = []
    for word in words:
        plain = _plain(word)
        stem, number = plain, 1
        while stem.casefold() in used:
            number += 1
            stem = f"{plain}_{number}"
        used.add(stem.casefold())
        stems.append(stem)
    return stems


def _plain(word: str) -> str:
    letters = "".join(
        # Letters, their marks, and numbers.
        letter if unicodedata.category(letter)[0] in "LMN" else " "
        for letter in unicodedata.normalize("NFKC", word)
    )
    stem = "_".join(letters.split())
    while len(stem.encode("utf-8")) > LONGEST:
        stem = stem[:-1]
    return stem.rstrip("_") or "object"
