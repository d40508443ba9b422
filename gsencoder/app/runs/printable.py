"""Text from elsewhere, made fit for a terminal."""

import unicodedata

LONGEST_LINE, END_OF_LINE = 2000, 500
"""Characters of a message; of a longer one the beginning and the end are shown, where it says what to do."""


def printable(text: str) -> str:
    """Text without the characters by which a terminal could be told to do other things than to show it: controls,
    halves of characters, and what turns the direction of writing."""
    turning = {*map(chr, range(0x202A, 0x202F)), *map(chr, range(0x2066, 0x206A))}
    return "".join(
        "\N{REPLACEMENT CHARACTER}"
        if letter in turning or (unicodedata.category(letter) in ("Cc", "Cs") and letter not in "\n\t")
        else letter
        for letter in text.replace("\r\n", "\n")
    )


def one_line(message: str) -> str:
    """A message as one line of a terminal."""
    return printable(clipped(" ".join(message.split())))


def clipped(line: str) -> str:
    """A line of at most `LONGEST_LINE` characters."""
    if len(line) <= LONGEST_LINE:
        return line
    return f"{line[: LONGEST_LINE - END_OF_LINE - 3]} … {line[-END_OF_LINE:]}"
