"""Summaries are JSON whatever the results hold, and say what a run did."""

import json
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from gsencoder.app.options import SharedScenesConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import SceneWarning
from gsencoder.core.files import SUMMARY_NAME, write_json
from gsencoder.core.process import peak_memory_mb


@dataclass(frozen=True)
class Thing:
    path: Path
    size: np.float32


def test_numpy_values_paths_and_dataclasses_are_written_as_json(tmp_path: Path) -> None:
    value = {
        "array": np.arange(6, dtype=np.float32).reshape(2, 3), "int": np.int64(3), "bool": np.bool_(True),
        "half": np.float16(0.5), "thing": Thing(path=Path("a/b"), size=np.float32(0.5)),
        "tuple": (1, None, os.fsdecode(b"a\xff")), 3: [],
    }  # fmt: skip
    write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "array": [[0, 1, 2], [3, 4, 5]], "int": 3, "bool": True, "half": 0.5,
        "thing": {"path": "a/b", "size": 0.5}, "tuple": [1, None, "a\udcff"], "3": [],
    }  # fmt: skip


def test_numbers_that_are_not_finite_become_null_and_are_named(tmp_path: Path) -> None:
    value = {"a": math.nan, "b": [1.0, np.float32("inf")], "c": np.array([[0.0, -np.inf]])}
    with pytest.warns(SceneWarning, match="3 numbers are not finite and were written as null: a, b.1, c.0.1"):
        write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": None, "b": [1.0, None], "c": [[0.0, None]]}


def test_a_summary_records_what_the_run_did(tmp_path: Path) -> None:
    summary = Run("fuse", SharedScenesConfig(out=Path("x"), worker=2))
    for _ in range(2):
        with summary.step("fuse"):
            time.sleep(0.01)
    with pytest.raises(ValueError), summary.step("fail"):
        raise ValueError
    summary.add_seconds({"fuse": 0.5, "seeds": 1.0})
    summary.results["miou"] = math.nan
    summary.warnings.append("3 images were left out")
    with summary.folder(tmp_path / "out"):
        pass
    record = json.loads((tmp_path / "out" / SUMMARY_NAME).read_text())
    assert (record["command"], record["settings"]["out"], record["settings"]["worker"]) == ("fuse", "x", 2)
    assert 0.52 <= record["timings"]["fuse"] < 5
    assert list(record["timings"]) == ["fuse", "fail", "seeds", "total"]
    assert record["results"] == {"miou": None}
    assert record["non_finite"] == ["results.miou"]
    assert record["warnings"] == ["3 images were left out"]
    assert record["versions"]["numpy"] == np.__version__
    assert set(record) >= {"version", "peak_memory_mb", "platform"}


def test_a_summary_names_neither_the_machine_nor_the_user(tmp_path: Path) -> None:
    text = json.dumps(Run("fuse", SharedScenesConfig()).to_dict())
    assert os.uname().nodename not in text
    assert str(Path.home()) + os.sep not in text


@pytest.mark.alone
def test_peak_memory_counts_a_large_array() -> None:
    before = peak_memory_mb()
    assert 10 < before < 100_000
    block = np.ones(int(before + 64) << 17)
    assert peak_memory_mb() >= before + 32
    del block
