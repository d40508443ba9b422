"""Archives: what a file says is believed only where it agrees with what was asked for."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from gsencoder.data.archive import open_archive, write_archive
from gsencoder.errors import InputError

ARRAYS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.arange(3, dtype=np.float32)}


def taken(path: Path) -> tuple[np.ndarray, np.ndarray, Any]:
    with open_archive(path) as file:
        return file.array("a", "float32", ("N", "D")), file.array("b", "float32", ("D",)), file.value("name", str)


def test_arrays_and_header_come_back(tmp_path: Path) -> None:
    write_archive(tmp_path / "x", ARRAYS, {"name": "é"})
    a, b, name = taken(tmp_path / "x")
    assert (a == ARRAYS["a"]).all()
    assert (b == ARRAYS["b"]).all()
    assert name == "é"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"a": ARRAYS["a"]}, "the array 'b' is missing"),
        ({**ARRAYS, "b": ARRAYS["b"][:2]}, r"expected b float32\[3\], got float32\[2\]"),
        ({**ARRAYS, "b": ARRAYS["b"].astype(np.float64)}, r"expected b float32\[3\], got float64\[3\]"),
        ({**ARRAYS, "a": ARRAYS["a"][None]}, r"expected a float32\[N, D\], got float32\[1, 2, 3\]"),
        ({**ARRAYS, "b": np.array([0, np.nan, np.inf], np.float32)}, "2 of 3 values of b are not finite"),
    ],
)
def test_an_array_that_is_not_as_asked_is_named_with_its_file(
    tmp_path: Path, arrays: dict[str, np.ndarray], said: str
) -> None:
    write_archive(tmp_path / "x", arrays, {"name": "n"})
    with pytest.raises(InputError, match=f"{tmp_path / 'x'}: .*{said}"):
        taken(tmp_path / "x")


@pytest.mark.parametrize("header", [{}, {"name": None}, {"name": 5}, {"name": True}])
def test_a_header_value_that_is_not_as_asked_is_named(tmp_path: Path, header: dict[str, Any]) -> None:
    write_archive(tmp_path / "x", ARRAYS, header)
    with pytest.raises(InputError, match=r"expected name \(str\) in the header, got"):
        taken(tmp_path / "x")


@pytest.mark.parametrize("header", ["", "{", "[]", "null", "5", "[" * 50_000, json.dumps({"version": 2})])
def test_a_header_of_another_kind_or_version_is_an_error(tmp_path: Path, header: str) -> None:
    save_file(ARRAYS, tmp_path / "x", {"gsencoder": header})
    with pytest.raises(InputError, match="damaged or no safetensors file|expected version 1"):
        taken(tmp_path / "x")


def test_what_the_types_refuse_is_told_with_the_file(tmp_path: Path) -> None:
    write_archive(tmp_path / "x", ARRAYS, {})
    with pytest.raises(InputError, match=rf"^{tmp_path / 'x'}: scales > 0$"), open_archive(tmp_path / "x"):
        raise InputError("scales > 0")
