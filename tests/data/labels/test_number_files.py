"""Files of numbers, and files of others, at their limits: the last that is read, and the first that is refused."""

from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels import files as number_files
from gsencoder.data.labels.files import (
    LIST_BYTES,
    SCENE_BYTES,
    check_file,
    read_checked_text,
    read_integer_lines,
    read_mask,
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
