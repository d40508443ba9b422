"""Sizes that no memory holds, and links to themselves, end in one line; other errors remain bugs."""

from pathlib import Path

import numpy as np
import pytest
import torch

from gsencoder.app.main import _impossible_sizes, main
from gsencoder.core.errors import InputError

SETTINGS = {"seed": 0, "model": {"projector": 10**15}, "sizes": [2, 10**11]}


@pytest.mark.parametrize(
    "make",
    [
        lambda: np.zeros(10**14),
        lambda: np.zeros((10**12, 10**12)),
        lambda: torch.zeros(10**14),
        lambda: torch.zeros(10**12, 10**12),
        lambda: np.zeros(10**20),
        lambda: bytearray(10**20),
        lambda: [0] * 10**18,
    ],
)
def test_sizes_that_cannot_be_allocated_name_the_large_settings(make: object) -> None:
    with (
        pytest.raises(
            InputError, match=r"^model.projector=1000000000000000, sizes=\[2, 100000000000\]: the machine has"
        ),
        _impossible_sizes(SETTINGS),
    ):
        make()  # type: ignore[operator]


def test_other_errors_stay_as_they_are() -> None:
    for error in (RuntimeError("shape"), ValueError("shape"), OverflowError("math range error"), InputError("its own")):
        with pytest.raises(type(error), match=str(error)), _impossible_sizes(SETTINGS):
            raise error


@pytest.mark.parametrize(
    "words",
    [
        ["view", "LOOP"],
        ["inspect", "LOOP"],
        ["localize", "LOOP", "query=mug"],
        ["export", "sizes=[99999999999]", "out=LOOP.onnx"],
        ["train", "LOOP", "model.projector=1000000000"],
    ],
)
def test_commands_end_in_one_line(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert main([word.replace("LOOP", str(loop)) for word in words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
