"""Values and files of numbers at their limits: the last that is read, and the first that is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels import files as number_files
from gsencoder.data.labels.files import (
    LIST_BYTES,
    SCENE_BYTES,
    annotation_id,
    box_corners,
    brief,
    check_file,
    corner_bounds,
    entries_of,
    id_value,
    name_value,
    number,
    object_id,
    read_checked_text,
    read_integer_lines,
    read_mask,
    refuse_repeated,
    write_integer_lines,
)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("number", [2**31 - 1, -(2**31 - 1)])
def test_numbers_are_those_of_31_bits(tmp_path: Path, number: int) -> None:
    assert read_integer_lines(written(tmp_path / "n.txt", f"1\n{number}\n".encode())).tolist() == [1, number]
    beyond = number + (1 if number > 0 else -1)
    with pytest.raises(InputError, match=f"line 2: expected one whole number, got '{beyond}'; swapped"):
        read_integer_lines(written(tmp_path / "n.txt", f"1\n{beyond}\n".encode()), hint="; swapped")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"0\n1\n2\n9\n", [0, 1, 1, 1]),
        (b"0\r\n1\r\n", [0, 1]),
        (b"10\n0\n00\n", [1, 0, 0]),
        (b" 1 \n\t0\n-3", [1, 0, 1]),
        (b"\xef\xbb\xbf1\n0\n", [1, 0]),
        (b"1", [1]),
        (b"", []),
    ],
)
def test_what_is_not_0_is_in_a_mask(tmp_path: Path, content: bytes, expected: list[int]) -> None:
    assert read_mask(written(tmp_path / "m.txt", content)).tolist() == [bool(each) for each in expected]


@pytest.mark.parametrize(
    "content", [b"1\n:\n", b"1\n/\n", b"1\n\n", b"\n1\n", b"1\n1 0\n", b"1\n+\n", b"1\n-\n", b"1\n--1\n", b"1\n- 1\n"]
)
def test_other_lines_are_named_in_masks_and_in_numbers(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path / "m.txt", content)
    for read in (read_mask, read_integer_lines):
        with pytest.raises(InputError, match=r"m\.txt: line [12]: expected one whole number"):
            read(path)


def test_masks_and_numbers_of_several_chunks_are_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(number_files, "CHUNK", 3)
    for count in (0, 1, 3, 4, 7):
        values = np.arange(count) - 2
        write_integer_lines(tmp_path / "n.txt", values)
        assert read_integer_lines(tmp_path / "n.txt").tolist() == values.tolist()
        lines = "".join(f"{int(value > 0)}\n" for value in values).encode()
        assert read_mask(written(tmp_path / "m.txt", lines)).tolist() == (values > 0).tolist()


def sparse(path: Path, size: int) -> Path:
    with path.open("wb") as stream:
        stream.truncate(size)
    return path


@pytest.mark.parametrize("limit", [SCENE_BYTES, LIST_BYTES])
def test_files_are_read_up_to_their_largest_size(tmp_path: Path, limit: int) -> None:
    assert (SCENE_BYTES, LIST_BYTES) == (268_435_456, 1_073_741_824)
    check_file(sparse(tmp_path / "a.txt", limit), max_bytes=limit)
    with pytest.raises(InputError, match=rf"a\.txt: {limit + 1:,} bytes; at most {limit:,} are read"):
        check_file(sparse(tmp_path / "a.txt", limit + 1), max_bytes=limit)


def test_files_that_run_code_are_refused_by_name_or_by_their_first_byte(tmp_path: Path) -> None:
    for name in ("a.p", "a.pkl", "a.PICKLE", "a.pt", "a.pth"):
        with pytest.raises(InputError, match="is a pickle, which is refused since reading it can run code"):
            check_file(written(tmp_path / name, b"1\n"))
    with pytest.raises(InputError, match="is a pickle"):
        check_file(written(tmp_path / "a.txt", b"\x80\x04"))
    with pytest.raises(InputError, match="is an archive"):
        check_file(written(tmp_path / "a.txt", b"PK\x03\x04"))
    check_file(written(tmp_path / "a.txt", b"PK\x03"))
    check_file(written(tmp_path / "b.txt", b"1\x80"))


def test_text_may_begin_with_a_byte_order_mark_and_what_is_none_is_named_by_its_byte(tmp_path: Path) -> None:
    assert read_checked_text(written(tmp_path / "a.txt", b"\xef\xbb\xbfx\xc3\xa9")) == "xé"
    with pytest.raises(InputError, match=r"not a text file \(.* at byte 2\)"):
        read_checked_text(written(tmp_path / "a.txt", b"ab\xff"))


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
    problem = refused(corner_bounds, [[0, 0, 0], [1.1e9, 1, 1]], HERE, "bbox")
    assert "bbox[1] must be a finite number of at most 1e+09" in problem


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
    problem = refused(entries_of, {}, path, "a", key="rows")
    assert "f.json: rows must be a list of objects with a, got an object" in problem
    assert "f.json: expected a list of objects with a, got 3" in refused(entries_of, 3, path, "a")
    assert "f.json: entry 1: expected an object with a, got 3" in refused(entries_of, [{}, 3], path, "a")


def test_two_entries_of_one_key_are_named_with_their_numbers(tmp_path: Any) -> None:
    path = tmp_path / "f.json"
    refuse_repeated(path, ["a", "b", "c"], str)
    problem = refused(refuse_repeated, path, ["a", "b", "c", "b"], lambda key: f"<{key}>", what="question_id")
    assert problem == f"{path}: entries 1 and 3 have one question_id: <b>; expected each once"
