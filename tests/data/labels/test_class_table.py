"""The table of a benchmark's classes."""

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable

TABLE = ClassTable(names=("bed", "chair", "wall"), ids=(4, 5, 1), groups={"head": ("chair", "wall"), "tail": ("bed",)})


def test_ids_lead_to_rows_of_the_table_and_unknown_ones_to_none() -> None:
    rows = TABLE.rows(np.array([1, 5, 4, 0, 6, -1, 2]))
    assert rows.tolist() == [2, 1, 0, -1, -1, -1, -1]


def test_names_and_ids_lead_to_each_other() -> None:
    assert TABLE.id_of == {"bed": 4, "chair": 5, "wall": 1}
    assert {name: number for number, name in TABLE.name_of.items()} == TABLE.id_of
    assert len(TABLE) == 3


def test_no_ids_lead_to_no_rows() -> None:
    assert TABLE.rows(np.zeros(0, np.int64)).tolist() == []


def test_names_are_taken_out_of_their_groups_too() -> None:
    table = TABLE.without(("wall", "ceiling"))
    assert table.names == ("bed", "chair")
    assert table.ids == (4, 5)
    assert table.groups == {"head": ("chair",), "tail": ("bed",)}


@pytest.mark.parametrize(
    ("names", "ids", "groups", "message"),
    [
        ((), (), {}, "one or more names"),
        (("bed",), (1, 2), {}, "1 names and 2 ids"),
        (("bed", "bed"), (1, 2), {}, "'bed' is there twice"),
        (("bed", "chair"), (1, 1), {}, "the id 1 is there twice"),
        (("bed",), (-1,), {}, "0 or more"),
        (("bed",), (1,), {"head": ("sofa",)}, "'sofa' of the group 'head' is no class"),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(
    names: tuple[str, ...], ids: tuple[int, ...], groups: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        ClassTable(names=names, ids=ids, groups=groups)


def test_ids_in_any_order_lead_to_the_rows_of_their_names() -> None:
    table = ClassTable(names=("c", "a", "b"), ids=(30, 10, 20), groups={"g": ("b", "c")})
    assert table.rows(np.array([10, 20, 30, 0, 25, 99, -10])).tolist() == [1, 2, 0, -1, -1, -1, -1]
    assert table.without(("a", "x")).rows(np.array([10, 20, 30])).tolist() == [-1, 1, 0]
    assert (len(table), table.name_of, table.id_of["b"]) == (3, {30: "c", 10: "a", 20: "b"}, 20)


def test_0_is_a_class_only_where_it_does_not_stand_for_none() -> None:
    ClassTable(names=("a",), ids=(1,)).check_instance_ids()
    with pytest.raises(InputError, match="classes: 'b' has the id 0, which files of instances cannot hold"):
        ClassTable(names=("a", "b"), ids=(1, 0)).check_instance_ids()
