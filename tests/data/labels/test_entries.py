"""Checked values of benchmark files at their limits: the last that is taken, and the first that is not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.files import (
    annotation_id,
    box_corners,
    brief,
    corner_bounds,
    entries_of,
    id_value,
    name_value,
    number,
    object_id,
    refuse_repeated,
)

HERE = "f.json: entry 3"


def refused(call: Any, *arguments: Any, **named: Any) -> str:
    with pytest.raises(InputError) as error:
        call(*arguments, **named)
    return str(error.value)


def test_an_object_id_is_a_number_or_a_text_from_0() -> None:
    assert [object_id(each, HERE) for each in ("08", "999999999", 0, 2**31 - 1)] == [8, 999999999, 0, 2**31 - 1]
    for wrong in ("1234567890", "-1", "1.0", "٣", "", True, -1, 2**31, 1.0, None, [1]):
        assert refused(object_id, wrong, HERE).startswith(f"{HERE}: object_id must be a whole number from 0, got ")


def test_a_number_is_finite_and_at_most_so_large() -> None:
    assert (number(3, HERE, "x"), number(-1e15, HERE, "x"), number(5, HERE, "x", largest=5.0)) == (3.0, -1e15, 5.0)
    assert isinstance(number(3, HERE, "x"), float)
    for value in (float("nan"), float("inf"), 1.1e15, -1.1e15, 10**400):
        assert "x must be a finite number of at most 1e+15" in refused(number, value, HERE, "x")
    for value in (True, "3", None):
        assert f"x must be a number, got {brief(value)}" in refused(number, value, HERE, "x")


def test_the_eight_corners_go_around_the_top_and_then_around_the_bottom() -> None:
    # utils/box_util.py's get_3d_box: l, w, h at x, y, z with signs (+ + + +, - - - -) of the last axis.
    corners = box_corners((0.0, 10.0, 20.0), (1.0, 11.0, 21.0))
    assert np.array_equal(corners[:4], [[1, 11, 21], [1, 10, 21], [0, 10, 21], [0, 11, 21]])
    assert np.array_equal(corners[4:], [[1, 11, 20], [1, 10, 20], [0, 10, 20], [0, 11, 20]])


def test_bounds_are_those_of_all_corners_in_any_order_or_of_a_lower_and_an_upper_one() -> None:
    lower, upper = (0.0, -2.0, 5.0), (1.0, 3.0, 5.0)
    corners = box_corners(lower, upper)
    for bounds in (corners, corners[::-1], corners[3:] + corners[:3], [list(lower), list(upper)]):
        assert corner_bounds(bounds, HERE, "bbox") == (lower, upper)
    problem = refused(corner_bounds, [[0, 0, 1], [1, 1, 0]], HERE, "bbox")
    assert problem == f"{HERE}: bbox: the lower corner [0.0, 0.0, 1.0] is not below the upper [1.0, 1.0, 0.0]"
    for wrong in ([], corners[:7], [*corners, corners[0]], "box", None, 8):
        assert "bbox must be a list of 8 corners [x, y, z]" in refused(corner_bounds, wrong, HERE, "bbox")
    assert "bbox[1] must be a corner" in refused(corner_bounds, [[0, 0, 0], [1, 1]], HERE, "bbox")
    assert corner_bounds([[0, 0, 0], [1e9, 1, 1]], HERE, "bbox")[1][0] == 1e9
    assert "bbox[1] must be a finite number of at most 1e+09" in refused(
        corner_bounds, [[0, 0, 0], [1.1e9, 1, 1]], HERE, "bbox"
    )


def test_names_and_ids_are_texts_of_one_line_and_ids_are_numbers_as_well() -> None:
    assert name_value("a" * 200, HERE, "label") == "a" * 200
    assert (id_value(7, HERE, "id"), id_value("a b", HERE, "id"), id_value(-3, HERE, "id")) == ("7", "a b", "-3")
    assert (annotation_id("007", HERE), annotation_id(7, HERE), annotation_id("x7", HERE)) == ("7", "7", "x7")
    assert annotation_id("٣", HERE) == "٣"
    for wrong in ("a\nb", " ", "", 3, None):
        assert "label must be a text of one line with 1 to 200" in refused(name_value, wrong, HERE, "label")
    for wrong in ("a\nb", True, None, 1.5):
        assert "id must be a whole number or a text of one line" in refused(id_value, wrong, HERE, "id")
    for read in (name_value, id_value):
        assert "must be a" in refused(read, "a" * 201, HERE, "label")


def test_entries_have_their_number_and_their_key_in_messages() -> None:
    rows = [{"a": 1}, {"b": 2}]
    path = Path("f.json")
    assert [where for _, where in entries_of(rows, path, "a")] == ["f.json: entry 0", "f.json: entry 1"]
    assert entries_of(rows[:1], path, "a", key="rows") == (({"a": 1}, "f.json: rows[0]"),)
    assert "f.json: rows must be a list of objects with a, got an object" in refused(
        entries_of, {}, path, "a", key="rows"
    )
    assert "f.json: expected a list of objects with a, got 3" in refused(entries_of, 3, path, "a")
    assert "f.json: entry 1: expected an object with a, got 3" in refused(entries_of, [{}, 3], path, "a")


def test_two_entries_of_one_key_are_named_with_their_numbers(tmp_path: Any) -> None:
    path = tmp_path / "f.json"
    refuse_repeated(path, ["a", "b", "c"], str)
    problem = refused(refuse_repeated, path, ["a", "b", "c", "b"], lambda key: f"<{key}>", what="question_id")
    assert problem == f"{path}: entries 1 and 3 have one question_id: <b>; expected each once"
