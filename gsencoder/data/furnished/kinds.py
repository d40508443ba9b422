"""Kinds of things in rooms: their names, what else people call them, and where they stand."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Literal, cast, get_args

Place = Literal["wall", "free", "mounted", "ceiling", "surface", "floor", "opening"]
"""With its back to a wall, anywhere on the floor, on a wall, under the ceiling, on furniture, flat on the floor, or in
an opening of a wall."""
RoomType = Literal["bedroom", "living room", "kitchen", "bathroom", "office", "corridor", "storage room"]
ROOM_TYPES: tuple[RoomType, ...] = get_args(RoomType)
STRUCTURE = ("wall", "floor", "ceiling")
"""The kinds that enclose a room; all others are things."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of thing.

    Attributes:
        synonyms: other words for it; a scene's features are the mean over all of them.
        hypernyms: broader words, nearest first.
        rooms: how often rooms of each type have it; 1 = now and then, 3 = nearly always.
    """

    name: str
    synonyms: tuple[str, ...]
    hypernyms: tuple[str, ...]
    place: Place
    rooms: Mapping[RoomType, float]

    @property
    def words(self) -> tuple[str, ...]:
        return (self.name, *self.synonyms)


@cache
def kinds() -> Mapping[str, Kind]:
    """All kinds by name, in the order of their table."""
    return MappingProxyType({kind.name: kind for kind, _ in _table()})


@cache
def _table() -> tuple[tuple[Kind, tuple[str, ...]], ...]:
    return tuple(
        (
            Kind(
                name=row["kind"],
                synonyms=listed_cell(row["synonyms"]),
                hypernyms=listed_cell(row["hypernyms"]),
                place=cast(Place, row["place"]),
                rooms={
                    cast(RoomType, room): float(weight)
                    for room, weight in (each.split(":") for each in listed_cell(row["rooms"]))
                },
            ),
            listed_cell(row["names"]),
        )
        for row in table_rows("kinds.csv")
    )


def table_rows(name: str) -> list[dict[str, str]]:
    """The rows of a table of this folder."""
    return list(csv.DictReader(io.StringIO((files("gsencoder.data.furnished") / name).read_text("utf-8"))))


def listed_cell(cell: str) -> tuple[str, ...]:
    """The words of a cell, which | separates."""
    return tuple(each.strip() for each in cell.split("|") if each.strip())


@cache
def _kind_by_key() -> Mapping[str, Kind]:
    words = {word: kind for kind, _ in _table() for word in kind.words}
    return words | {name: kind for kind, names in _table() for name in names}


def kind_of(model_id: str, name: str, category: str) -> Kind | None:
    """The kind of a catalogue's model, by its id, its name in a category, its name, or a word for the kind; None if no
    kind has it."""
    known = _kind_by_key()
    for key in (f"#{model_id}", f"{name}@{category}", name, name.lower()):
        if key in known:
            return known[key]
    return None
