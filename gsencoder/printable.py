"""Text from elsewhere, made fit for a terminal."""

import unicodedata


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
