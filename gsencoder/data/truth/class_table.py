"""The classes of a benchmark: their names, their ids in files, and groups such as head, common and tail."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTable:
    """Classes that are scored. Whatever truth has beside them is ignored.

    Attributes:
        names: of the classes, each once.
        ids: of the classes in files, each once and 0 or more.
        groups: names of classes by the name of a group, such as ScanNet200's head, common and tail.
    """

    names: tuple[str, ...]
    ids: tuple[int, ...]
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.names or len(self.names) != len(self.ids):
            raise InputError(
                f"classes: expected one id for each of one or more names, got {len(self.names)} names and "
                f"{len(self.ids)} ids"
            )
        for kind, values in (("name", self.names), ("id", self.ids)):
            if repeated := first_repeated(values):
                raise InputError(f"classes: the {kind} {repeated[0]!r} is there twice")
        if min(self.ids) < 0:
            raise InputError(f"classes: expected ids of 0 or more, got {min(self.ids)}")
        for group, names in self.groups.items():
            unknown = [name for name in names if name not in self.names]
            if unknown:
                raise InputError(f"classes: {unknown[0]!r} of the group {group!r} is no class")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def name_of(self) -> dict[int, str]:
        """The name of each id."""
        return dict(zip(self.ids, self.names, strict=True))

    @property
    def id_of(self) -> dict[str, int]:
        """The id of each name."""
        return dict(zip(self.names, self.ids, strict=True))

    def check_instance_ids(self) -> None:
        """Checks that files of instances can hold all ids: class id · 1000 + number, below 1000 = no instance.

        Raises:
            InputError: a class has the id 0.
        """
        if 0 in self.ids:
            raise InputError(
                f"classes: {self.name_of[0]!r} has the id 0, which files of instances cannot hold: a vertex has "
                "class id · 1000 + number of the instance, and below 1000 it has none; give the class another id, here "
                "and in the files, or leave it out of classes="
            )

    def without(self, names: Collection[str]) -> "ClassTable":
        """The table without some names, of which those that it does not have are passed over."""
        rows = [row for row, name in enumerate(self.names) if name not in names]
        return ClassTable(
            names=tuple(self.names[row] for row in rows),
            ids=tuple(self.ids[row] for row in rows),
            groups={
                group: tuple(name for name in members if name not in names) for group, members in self.groups.items()
            },
        )

    def rows(self, ids: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """The row of each id in the table; -1 for ids that it does not have."""
        order = np.argsort(self.ids)
        ascending = np.array(self.ids, np.int64)[order]
        positions = np.minimum(np.searchsorted(ascending, ids), len(ascending) - 1)
        return np.where(ascending[positions] == ids, order[positions], -1)
