"""Which names of a table the text of a question holds."""

import re
import unicodedata
from dataclasses import dataclass

from gsencoder.text.table import TextTable

PRONOUNS = frozenset({"i", "you", "we", "they", "he", "she", "one", "someone", "anyone"})
"""A name right after one of these is a verb, as in "do you watch"."""
AUXILIARIES = frozenset({"can"})
"""Such a name right before a pronoun is a verb, as in "can you"."""
COLORS = frozenset({"orange", "peach", "plum", "lime", "olive", "rose", "lavender", "chocolate"})
"""Such a name right before another name is its color, as in "the orange chair"."""


@dataclass(frozen=True, slots=True)
class _Token:
    """A word, and whether nothing but a blank or a hyphen stands between it and the one before."""

    text: str
    start: int
    end: int
    joined: bool


def words_in(text: str, table: TextTable) -> tuple[str, ...]:
    """The names of a table that a text holds, in its order; of names within names the longest.

    Words of one name stand together: "table, lamp" holds no table lamp. A name may be in its singular or plural.
    """
    text = unicodedata.normalize("NFKC", text)
    tokens = _tokens(text)
    longest = max((len(name.split()) + name.count("-") for name in table.names), default=0)
    matches: list[tuple[int, int, str]] = []
    start = 0
    while start < len(tokens):
        row, length = _longest_name(text, tokens, start, longest, table)
        if row is not None and not (length == 1 and _is_verb(tokens, start)):
            matches.append((start, start + length, table.names[row]))
        start += length
    begins = {begin for begin, _, _ in matches}
    # A color belongs to the name after it.
    names = [name for _, end, name in matches if not (name.lower() in COLORS and end in begins and tokens[end].joined)]
    return tuple(dict.fromkeys(names))


def _longest_name(
    text: str, tokens: list[_Token], start: int, longest: int, table: TextTable
) -> tuple[int | None, int]:
    """The row of the longest name that begins at a token, and of how many tokens it is; None and 1 where none does."""
    count = 1
    while count < longest and start + count < len(tokens) and tokens[start + count].joined:
        count += 1
    for length in range(count, 0, -1):
        span = tokens[start : start + length]
        for name in (text[span[0].start : span[-1].end], " ".join(token.text for token in span)):
            row = table.find(name)
            if row is not None:
                return row, length
    return None, 1


def _is_verb(tokens: list[_Token], position: int) -> bool:
    before = tokens[position - 1].text.lower() if position and tokens[position].joined else ""
    after = tokens[position + 1].text.lower() if position + 1 < len(tokens) and tokens[position + 1].joined else ""
    return before in PRONOUNS or (tokens[position].text.lower() in AUXILIARIES and after in PRONOUNS)


def _tokens(text: str) -> list[_Token]:
    """Words of letters, marks and digits, without the ending of a genitive."""
    wordly = "".join("w" if unicodedata.category(letter)[0] in "LMN" else letter for letter in text)
    tokens: list[_Token] = []
    last = 0
    for match in re.finditer(r"w+(?:['’]w+)*", wordly):
        word = re.sub(r"['’]s?$", "", text[match.start() : match.end()], flags=re.IGNORECASE)
        between = text[last : match.start()]
        joined = bool(tokens) and (between.isspace() or between in ("-", "\N{HYPHEN}"))
        tokens.append(_Token(word, match.start(), match.start() + len(word), joined))
        last = match.end()
    return tokens
