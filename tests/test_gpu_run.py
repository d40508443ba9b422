"""The run on a GPU (`make gpu`), smaller and on a CPU: every part works, and a failure of one hides no other."""

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

BENCH = Path(__file__).parents[1] / "bench"
LEFT_OUT = ("processes", "onnx")
"""Parts that take long here, and whose work tests of training and of exports do."""


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What bench/gpu.py defines."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    return runpy.run_path(str(BENCH / "gpu.py"))


def run(script: dict[str, Any], monkeypatch: pytest.MonkeyPatch, out: Path, *words: str) -> tuple[int, list[Any]]:
    """The exit code and the parts of the report."""
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--small", "--device", "cpu", "--out", str(out), *words])
    code = script["main"]()
    return code, json.loads(out.with_suffix(".json").read_text())


@pytest.mark.slow
def test_every_part_is_well_on_a_cpu_or_says_why_it_is_skipped(script, tmp_path, monkeypatch):
    names = [name for name in script["PARTS"] if name not in LEFT_OUT]
    code, parts = run(script, monkeypatch, tmp_path / "gpu.md", "--parts", ",".join(names))
    states = {each["part"]: each["state"] for each in parts}
    assert list(states) == names
    allowed = re.compile(r"ok|skipped: (no CUDA device|package missing: .+)")
    assert [f"{name}: {state}" for name, state in states.items() if not allowed.fullmatch(state)] == []
    assert states["blend"] == states["losses"] == "ok"
    assert code == 0
    report = (tmp_path / "gpu.md").read_text()
    assert all(f"| {name} |" in report for name in states)


def test_a_part_that_raises_is_reported_and_hides_no_other(script, tmp_path, monkeypatch):
    def broken(setting: Any) -> list[Any]:
        raise ValueError("a kernel | was lost\nin two lines")

    chosen = {"environment": script["environment"], "broken": broken, "products": script["PARTS"]["products"]}
    script["PARTS"].clear()
    script["PARTS"].update(chosen)
    code, parts = run(script, monkeypatch, tmp_path / "gpu.md", "--parts", "environment,broken,products")
    assert code == 1
    assert [each["state"].split(" (")[0] for each in parts] == ["ok", "failed: ValueError: a kernel | was lost", "ok"]
    assert "| broken | failed: ValueError: a kernel \\| was lost" in (tmp_path / "gpu.md").read_text()
