"""Removal of the API key from everything that a server sends."""

import re
from functools import cache
from html.entities import html5

LEAST_KEY = 6
"""Shorter keys are placeholders, which servers at home are given; any text may hold their letters."""
LEAST_PART = 12
"""Shorter beginnings of a key are no secret, and mostly its maker's name."""
LONGEST_PART = 256
"""Longer keys, which are compiled for minutes, are recognized by their beginning; what follows is compared letter by
letter."""
REDACTED = "(key)"


class KeyFilter:
    """Removes a key from text, in every spelling that a server gives it when it repeats a request: as it is, quoted for
    a URL, escaped for HTML, JSON or Python, several of these at once, or cut off in its second half."""

    def __init__(self, key: str) -> None:
        self._pattern: re.Pattern[str] | None = None
        self._key, self._rest = key, key[LONGEST_PART:]
        if len(key) >= LEAST_KEY:
            spelt = [_spellings(letter) for letter in key[:LONGEST_PART]]
            least = max(LEAST_PART, (len(spelt) + 1) // 2)
            self._pattern = re.compile("".join(spelt[:least]) + "".join(f"{each}?" for each in spelt[least:]))

    def clean(self, text: str, longest: int | None = None) -> str:
        """Text without the key, and only then cut to `longest` characters."""
        parts, at = [], 0
        # Of a long key with letters that begin escapes, the letters are not always told apart.
        text = text.replace(self._key, REDACTED) if self._pattern else text
        while self._pattern and (match := self._pattern.search(text, at)):
            parts += [text[at : match.start()], REDACTED]
            at = match.end()
            for letter in self._rest:
                if not (match := _pattern_of(letter).match(text, at)):
                    break
                at = match.end()
        return "".join([*parts, text[at:]])[:longest]

    def is_in(self, text: str) -> bool:
        """Whether text holds the key."""
        return self._pattern is not None and self._pattern.search(text) is not None


@cache
def _pattern_of(letter: str) -> re.Pattern[str]:
    return re.compile(_spellings(letter))


@cache
def _spellings(letter: str) -> str:
    """A pattern of one character, escaped never, once, or several times; no part of it repeats without end, as time
    would grow with the square of the text."""
    code = ord(letter)
    names = sorted(name for name, value in html5.items() if value == letter and name.endswith(";"))
    entities = "|".join([f"#0{{0,6}}{code};", f"#[xX]0{{0,6}}(?i:{code:x});", *names])
    # The letter itself comes last, as it may begin its own escape.
    return (
        rf"(?:%(?:25){{0,4}}(?i:{code:02x})|&(?:amp;){{0,4}}(?:{entities})|\\{{1,8}}(?:u00|x)(?i:{code:02x})"
        rf"|\\{{0,8}}{re.escape(letter)}{'|[+]' if letter == ' ' else ''})"
    )
