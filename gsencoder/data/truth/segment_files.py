"""The two JSON files of an annotated scan, which ScanNet and ScanNet++ write alike.

One gives each vertex of the mesh the number of its segment (`segIndices`), the other lists objects as groups of
segments (`segGroups`: objectId, label, segments).
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.truth.checked_files import check_file
from gsencoder.data.truth.entries import entries_of, shown

MAX_BYTES = 512 << 20
"""Larger JSON files are refused before they are read: they would take tens of times as much memory."""
MAX_NAME = 1000
"""Largest number of characters of a name, as in a text table."""
MAX_ID = 2**31 - 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentGroup:
    """One object of an annotation.

    Attributes:
        id: its objectId, as the file gives it.
        label: its raw name, as the file gives it.
        segments: numbers of its segments, ascending and unique.
    """

    id: int
    label: str
    segments: Int64[np.ndarray, " S"]


def read_segments(path: Path) -> Int64[np.ndarray, " V"]:
    """The segment of each vertex.

    Raises:
        InputError: unreadable, too large, or not a list `segIndices` of whole numbers.
    """
    values = _read(path, "segIndices", "the segment of each vertex")
    numbers = _integers(values, f"{path}: segIndices")
    if not len(numbers):
        raise InputError(f"{path}: segIndices is empty; expected the segment of each vertex of the mesh")
    return numbers


def read_groups(path: Path, *, first_id: int) -> tuple[SegmentGroup, ...]:
    """The objects of an annotation, in the order of the file.

    Args:
        path: ID.aggregation.json of ScanNet, or segments_anno.json of ScanNet++.
        first_id: smallest objectId.

    Raises:
        InputError: unreadable, too large, not a list `segGroups`, a group without objectId, label or segments, or an
            objectId that is there twice; the group is named.
    """
    groups: list[SegmentGroup] = []
    rows = _read(path, "segGroups", "the objects")
    for row, where in entries_of(rows, path, "objectId, label and segments", key="segGroups"):
        number, label = row.get("objectId"), row.get("label")
        if isinstance(number, bool) or not isinstance(number, int) or not first_id <= number <= MAX_ID:
            raise InputError(f"{where}: objectId must be a whole number from {first_id}, got {shown(number)}")
        of_object = f"{where} (objectId {number})"
        if not isinstance(label, str):
            raise InputError(f"{of_object}: label must be a name, got {shown(label)}")
        if len(label) > MAX_NAME:
            raise InputError(f"{of_object}: label has {len(label):,} characters, expected at most {MAX_NAME:,}")
        segments = row.get("segments")
        if not isinstance(segments, list):
            raise InputError(f"{of_object}: segments must be a list of numbers of segments, got {shown(segments)}")
        if not segments:
            raise InputError(f"{of_object}: {label[:40]!r} has no segments; remove it, or get the annotation anew")
        groups.append(
            SegmentGroup(id=number, label=label, segments=np.unique(_integers(segments, f"{of_object}: segments")))
        )
    if repeated := first_repeated(group.id for group in groups):
        number, first, second = repeated
        raise InputError(f"{path}: segGroups[{second}]: objectId {number} is already that of segGroups[{first}]")
    return tuple(groups)


class SegmentVertices:
    """The vertices of each segment of a mesh."""

    def __init__(self, segments: Int64[np.ndarray, " V"], path: Path) -> None:
        """Sorts the vertices by segment.

        Args:
            segments: of each vertex.
            path: of their file, for messages.
        """
        self._order = np.argsort(segments, kind="stable")
        self._numbers, self._starts = np.unique(segments[self._order], return_index=True)
        self._ends = np.append(self._starts[1:], len(segments))
        self._path = path

    def of(self, group: SegmentGroup, path: Path) -> Int64[np.ndarray, " n"]:
        """The vertices of an object of the annotation at `path`.

        Raises:
            InputError: it names a segment that no vertex of the mesh belongs to.
        """
        rows = np.searchsorted(self._numbers, group.segments)
        unknown = self._numbers[np.minimum(rows, len(self._numbers) - 1)] != group.segments
        if unknown.any():
            raise InputError(
                f"{path}: objectId {group.id} ({group.label[:40]!r}) names segment {group.segments[unknown][0]}, which "
                f"no vertex has in {self._path}; expected both of one scan"
            )
        return np.concatenate(
            [self._order[start:end] for start, end in zip(self._starts[rows], self._ends[rows], strict=True)]
        )


def check_counts(segments: Int64[np.ndarray, " V"], vertices: np.ndarray, path: Path, mesh: Path) -> None:
    """Checks that a file of segments and a mesh have as many vertices.

    Raises:
        InputError: they have not.
    """
    if len(segments) != len(vertices):
        raise InputError(
            f"{path}: segIndices has {len(segments):,} entries, but {mesh} has {len(vertices):,} vertices; expected "
            "the files of one mesh"
        )


def _read(path: Path, key: str, subject: str) -> list[Any]:
    """The list at a key of the object that a JSON file holds."""
    check_file(path, max_bytes=MAX_BYTES)
    data = read_json(path)
    values = data.get(key) if isinstance(data, dict) else None
    if not isinstance(values, list):
        keys = f"an object with {', '.join(map(str, list(data)[:6]))[:80]}" if isinstance(data, dict) else "no object"
        raise InputError(f"{path}: expected an object with the list {key!r}, {subject}; got {keys}")
    return values


def _integers(values: list[Any], where: str) -> Int64[np.ndarray, " n"]:
    """A list of whole numbers as an array; the first entry that is none is named."""
    # JSON's true is not a number here, though Python and numpy would count it as 1.
    if set(map(type, values)) <= {int}:
        with suppress(OverflowError):
            return np.array(values, np.int64)
    for index, value in enumerate(values):
        if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
            raise InputError(f"{where}[{index}]: expected a whole number, got {shown(value)}")
    return np.array(values, np.int64)
