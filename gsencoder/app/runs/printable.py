"""Sanitized text for terminals."""

import unicodedata

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
