"""Archives, whose words are believed only where they agree with what was asked for; rows in a file; indices."""

import errno
import json
import os
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from archives import flip_bit, header_of, rewrite
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import save_file

from gsencoder.core.archive import (
    BLOCK_BYTES,
    MappedArrays,
    RowFile,
    archive_bytes,
    open_archive,
    shape_only,
    write_archive,
)
from gsencoder.core.arrays import even_indices, first_repeated, is_strictly_increasing
from gsencoder.core.errors import InputError

ARRAYS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.arange(3, dtype=np.float32)}
NAMED = {"name": "n"}


def taken(path: Path) -> tuple[np.ndarray, np.ndarray, Any]:
    with open_archive(path) as file:
        return file.array("a", "float32", ("N", "D")), file.array("b", "float32", ("D",)), file.value("name", str)


def test_arrays_and_header_come_back(tmp_path: Path) -> None:
    # JSON makes lists of tuples and text of keys, and the digest is of that.
    header = {"name": "\ud800é\u2028", "k": {"b": (1, -0.0, 1e300), 10: "y"}}
    for name in ("x", "y"):
        write_archive(tmp_path / name, ARRAYS, header)
    a, b, name = taken(tmp_path / "x")
    assert (a == ARRAYS["a"]).all()
    assert (b == ARRAYS["b"]).all()
    assert name == header["name"]
    assert (tmp_path / "x").read_bytes() == (tmp_path / "y").read_bytes()
    rewrite(tmp_path / "x")
    assert header_of(tmp_path / "x") == json.loads(json.dumps(header))


@pytest.mark.parametrize(
    ("arrays", "header", "problem"),
    [
        ({"a": ARRAYS["a"]}, NAMED, "the array 'b' is missing"),
        ({**ARRAYS, "b": ARRAYS["b"][:2]}, NAMED, r"expected b float32\[3\], got float32\[2\]"),
        ({**ARRAYS, "a": ARRAYS["a"][None]}, NAMED, r"expected a float32\[N, D\], got float32\[1, 2, 3\]"),
        ({**ARRAYS, "b": np.array([0, np.nan, np.inf], np.float32)}, NAMED, "2 of 3 values of b are not finite"),
        (ARRAYS, {}, r"expected name \(str\) in the header, got"),
        (ARRAYS, {"name": True}, r"expected name \(str\) in the header, got"),
    ],
)
def test_what_is_not_as_asked_is_named_with_its_file(tmp_path, arrays, header, problem):
    write_archive(tmp_path / "x", arrays, header)
    with pytest.raises(InputError, match=f"{tmp_path / 'x'}: .*{problem}"):
        taken(tmp_path / "x")


@pytest.mark.parametrize("header", ["{", "[]", "[" * 50_000, json.dumps({"version": 3})])
def test_a_header_of_another_kind_or_version_is_an_error(tmp_path: Path, header: str) -> None:
    save_file(ARRAYS, tmp_path / "x", {"gsencoder": header})
    with pytest.raises(InputError, match="damaged or no safetensors file|expected version 2"):
        taken(tmp_path / "x")


def test_a_file_whose_checksums_are_gone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_archive(path, ARRAYS, {"name": "n"})
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["gsencoder"])
    for missing in ("checksums", "digest"):
        save_file(ARRAYS, path, {"gsencoder": json.dumps({k: v for k, v in header.items() if k != missing})})
        with pytest.raises(InputError, match="its header does not have the checksum"):
            taken(path)
    # Nor does another version help.
    save_file(ARRAYS, path, {"gsencoder": json.dumps({**header, "version": 1})})
    with pytest.raises(InputError, match="expected version 2 of the format, got 1"):
        taken(path)


ROW = BLOCK_BYTES // 4
"""Four float32 rows of this many columns reach over four blocks."""
SIZES = {
    "long": np.arange(BLOCK_BYTES // 4 * 3 + 17, dtype=np.float32),
    "wide": np.arange(4 * ROW, dtype=np.float32).reshape(4, ROW),
    "odd": np.arange(30_000 * 7, dtype=np.float16).reshape(-1, 7),
    "empty": np.zeros((0, 5), np.float32),
    "hollow": np.zeros((3, 0), np.float32),
    "number": np.array(3.0),
}


@pytest.fixture
def mapped(tmp_path: Path) -> Path:
    write_archive(tmp_path / "m", SIZES, {})
    return tmp_path / "m"


def open_mapped(path: Path) -> MappedArrays:
    return MappedArrays(path, {name: (array.dtype.name, array.ndim) for name, array in SIZES.items()})


def test_mapped_arrays_are_what_was_written(mapped: Path, rng: np.random.Generator) -> None:
    arrays = open_mapped(mapped)
    for name, array in SIZES.items():
        assert arrays.shape(name) == array.shape
        if array.ndim:
            rows = rng.integers(0, max(len(array), 1), 50 if len(array) else 0)
            np.testing.assert_array_equal(arrays.rows(name, rows), array[rows])
            half = slice(1, max(len(array) // 2, 1))
            np.testing.assert_array_equal(arrays.rows(name, half), array[half])
        np.testing.assert_array_equal(arrays.array(name), array)


@pytest.mark.parametrize("name", ["long", "wide", "odd"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9999])
def test_a_flip_is_seen_by_whoever_reads_its_block_and_by_nobody_else(mapped: Path, name: str, share: float) -> None:
    array = SIZES[name]
    byte = int(share * array.nbytes)
    data = mapped.read_bytes()
    begin = 8 + int.from_bytes(data[:8], "little")
    flip_bit(mapped, 8 * (begin + json.loads(data[8:begin])[name]["data_offsets"][0] + byte))
    size = array.nbytes // len(array)
    blocks = [range(at // BLOCK_BYTES, (at + size - 1) // BLOCK_BYTES + 1) for at in range(0, array.nbytes, size)]
    touching = [row for row, touched in enumerate(blocks) if byte // BLOCK_BYTES in touched]
    for row in {0, len(array) - 1, touching[0], touching[-1], max(touching[0] - 1, 0), touching[len(touching) // 2]}:
        for rows in (np.array([row]), slice(row, row + 1)):
            arrays = open_mapped(mapped)
            read = partial(arrays.rows, name, rows)
            if row in touching:
                with pytest.raises(InputError, match=f"m: the file is damaged: {name} does not have the checksum"):
                    read()
                # It is refused again, and not only the first time.
                with pytest.raises(InputError):
                    read()
            else:
                np.testing.assert_array_equal(read()[0], array[row])
    with pytest.raises(InputError):
        open_mapped(mapped).array(name)


def test_what_was_checked_is_remembered_until_the_file_is_written_again(mapped, monkeypatch):
    import gsencoder.core.archive as checksums

    looked_at: list[int] = []
    plain = checksums._checksum
    wanted = {name: (array.dtype.name, array.ndim) for name, array in SIZES.items()}
    arrays = open_mapped(mapped)
    arrays.rows("wide", np.array([0, 3]))
    arrays.close()
    monkeypatch.setattr(checksums, "_checksum", lambda data, block: looked_at.append(block) or plain(data, block))
    again = MappedArrays(mapped, wanted, arrays)
    np.testing.assert_array_equal(again.array("wide"), SIZES["wide"])
    assert looked_at == [1, 2]
    again.close()
    looked_at.clear()
    os.utime(mapped, ns=(1, 1))
    MappedArrays(mapped, wanted, again).array("wide")
    assert looked_at == [0, 1, 2, 3]


def test_a_pointer_of_git_lfs_is_named_as_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(InputError, match="x: is a pointer of git-lfs and not the file itself"):
        taken(tmp_path / "x")


def test_the_size_of_a_file_is_known_before_it_is_written(tmp_path: Path) -> None:
    header = {"name": "räum", "error": 0.25, "views": ["a", "b"]}
    write_archive(tmp_path / "a", SIZES, header)
    shapes = {name: shape_only(array.dtype.name, array.shape) for name, array in SIZES.items()}
    assert archive_bytes(shapes, header) == archive_bytes(SIZES, header) == (tmp_path / "a").stat().st_size


@given(st.integers(1, 5000), st.integers(1, 6000))
def test_places_are_distinct_ascending_and_as_many_as_wanted_or_as_there_are(available: int, wanted: int) -> None:
    places = even_indices(available, wanted)
    assert len(places) == min(available, wanted)
    assert places[0] == 0
    assert (np.diff(places) > 0).all()
    if wanted > 1:
        assert places[-1] == available - 1


def test_the_value_and_both_places_are_given() -> None:
    assert first_repeated(["a", "b", "c", "b", "a"]) == ("b", 1, 3)
    assert first_repeated([]) is first_repeated(["a"]) is None
    assert first_repeated(iter([None, 0, None])) == (None, 0, 2)


@pytest.mark.parametrize(
    ("rows", "count", "expected"),
    [
        ([], 0, True),
        ([0], 1, True),
        ([0, 3, 9], 10, True),
        ([0, 3, 10], 10, False),
        ([-1, 3], 10, False),
        ([3, 3], 10, False),
        ([4, 3, 9], 10, False),
        # Their differences leave the range of the type, and look positive.
        ([0, 2**31 - 1, -(2**31), 9], 10, False),
    ],
)
def test_rows_rise_strictly_from_0_to_less_than_their_count(rows: list[int], count: int, expected: bool) -> None:
    assert is_strictly_increasing(np.array(rows, np.int32), count) is expected


@pytest.mark.parametrize("sizes", [[], [0, 5, 0, 1, 7]])
def test_rows_come_back_in_order_however_they_were_divided(sizes: list[int]) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(size, 4)).astype(np.float32) for size in sizes]
    with RowFile(4) as file:
        for part in parts:
            file.append(part)
        np.testing.assert_array_equal(file.array(), np.concatenate([np.zeros((0, 4), np.float32), *parts]))


def test_a_full_disk_is_named_with_the_folder_that_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(**{"write.side_effect": OSError(errno.ENOSPC, "No space left on device")})
    monkeypatch.setattr("gsencoder.core.archive.TemporaryFile", lambda: full)
    with RowFile(4) as file, pytest.raises(InputError, match="2 rows of 4 channels do not fit .*; set TMPDIR"):
        file.append(np.zeros((2, 4), np.float32))
