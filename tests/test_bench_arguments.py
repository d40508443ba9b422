"""Bench scripts refuse wrong arguments in one line, before they write anything."""

import json
import runpy
import sys
from importlib.machinery import PathFinder
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

BENCH = Path(__file__).parents[1] / "bench"


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A folder of two rooms with a mug (1) and a plate (2), as far as scripts look for rooms."""
    for number in range(2):
        room = tmp_path / "house" / f"train_00{number}"
        room.mkdir(parents=True)
        Image.fromarray(np.repeat(np.array([[0, 1, 2]], np.uint8), 8, axis=1)).save(room / "instance.png")
        objects = [{"id": 1, "name": "mug"}, {"id": 2, "name": "plate"}, {"id": 3, "name": None}]
        (room / "objects.json").write_text(json.dumps(objects))
        (room / "transforms.json").write_text(json.dumps({"frames": [{"instance_file_path": "instance.png"}]}))
    return tmp_path / "house"


def run(monkeypatch: pytest.MonkeyPatch, script: str, *words: object) -> None:
    """Runs a script of bench in this process."""
    monkeypatch.syspath_prepend(str(BENCH))
    monkeypatch.setattr(sys, "argv", [script, *map(str, words)])
    runpy.run_path(str(BENCH / script), run_name="__main__")


def refusal(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], script: str, *words: object) -> str:
    """The line with which a script refuses arguments."""
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, script, *words)
    assert stop.value.code == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if "error: " in line]
    assert len(lines) == 1
    return lines[0]


def test_no_script_of_bench_hides_a_module_of_python_or_of_a_package() -> None:
    """Python looks for imports beside the script first."""
    names = {path.stem for path in BENCH.glob("*.py")}
    assert not names & set(sys.stdlib_module_names)
    path = [folder for folder in sys.path if folder != str(BENCH)]
    specs = {name: PathFinder.find_spec(name, path) for name in names}
    assert [name for name, spec in specs.items() if spec is not None and spec.origin is not None] == []


@pytest.mark.parametrize(
    ("script", "words", "expected"),
    [
        ("presence_evidence.py", ["GONE", "OUT", "--words", "names"], "no such file or folder"),
        ("presence_evidence.py", ["HOUSE", "OUT", "--words", "names", "--every", "0"], "a whole number from 1"),
        ("presence.py", ["HOUSE", "--known", "fused"], "the groups of HOUSE are: train_000, train_001"),
        ("presence.py", ["HOUSE", "--known", "fused:abc"], "argument --known: 'fused:abc'"),
        ("mix.py", ["HOUSE", "OUT", "--names", "zzz"], "train_000, train_001"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(house, tmp_path, monkeypatch, capfd, script, words, expected):
    paths = {"HOUSE": house, "OUT": tmp_path / "out", "GONE": tmp_path / "gone"}
    message = refusal(monkeypatch, capfd, script, *(paths.get(word, word) for word in words))
    assert expected.replace("HOUSE", str(house)) in message
    assert not (tmp_path / "out").exists()
