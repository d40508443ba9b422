"""Bench scripts refuse wrong arguments in one line, before they write anything."""

import json
import runpy
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

BENCH = Path(__file__).parents[1] / "bench"


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A folder of two rooms with a mug (1) and a plate (2), as far as `unseen_kinds.py without` reads them."""
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


def test_rooms_are_copied_without_a_kind_and_never_over_others(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    run(monkeypatch, "unseen_kinds.py", "without", house, out, "--kinds", "mug")
    assert "2 objects left out of 2 rooms" in capfd.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["train_000", "train_001"]
    objects = json.loads((out / "train_001" / "objects.json").read_text())
    assert [each["name"] for each in objects] == ["plate", None]
    frame = json.loads((out / "train_001" / "transforms.json").read_text())["frames"][0]
    mask = np.asarray(Image.open(out / "train_001" / frame["mask_path"]))
    assert (mask[0, 8:16] == 0).all()
    assert (mask[0, 20:] == 255).all()
    message = refusal(monkeypatch, capfd, "unseen_kinds.py", "without", house, out, "--kinds", "mug")
    assert "out/train_000" in message
    assert "exists already" in message


def test_an_interrupted_copy_leaves_no_room(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Image, "fromarray", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(monkeypatch, "unseen_kinds.py", "without", house, tmp_path / "out", "--kinds", "mug")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_kind_that_no_room_has_is_refused_before_anything_is_copied(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    message = refusal(monkeypatch, capfd, "unseen_kinds.py", "without", house, out, "--kinds", "mug,unicorn")
    assert "--kinds unicorn: " in message
    assert "mug, plate" in message
    assert not out.exists()


@pytest.mark.parametrize(
    ("script", "words", "expected"),
    [
        ("unseen_kinds.py", ["without", "HOUSE", "--kinds", "mug"], "needs OUT"),
        ("unseen_kinds.py", ["without", "GONE", "OUT", "--kinds", "mug"], "no such folder"),
        ("unseen_kinds.py", ["score", "HOUSE", "--kinds", ""], "argument --kinds"),
        ("unseen_kinds.py", ["score", "HOUSE", "--kinds", "mug", "--rooms", "zzz*"], "train_000, train_001"),
        ("presence_evidence.py", ["GONE", "OUT", "--words", "names"], "no such file or folder"),
        ("presence_evidence.py", ["HOUSE", "OUT", "--words", "names", "--every", "0"], "a whole number from 1"),
        ("presence_evidence.py", ["HOUSE", "OUT", "--words", "names", "--rooms", "zzz*"], "train_000, train_001"),
        ("presence.py", ["GONE"], "no such folder"),
        ("presence.py", ["HOUSE", "--known", "fused"], "the groups of HOUSE are: train_000, train_001"),
        ("presence.py", ["HOUSE", "--known", "train_000"], "no room matches"),
        ("presence.py", ["HOUSE", "--known", "fused:abc"], "argument --known: 'fused:abc'"),
        ("presence.py", ["HOUSE", "--known", "fused:0"], "a number above 0"),
        ("mix.py", ["GONE", "OUT"], "no such folder"),
        ("mix.py", ["HOUSE", "OUT", "--names", "zzz"], "train_000, train_001"),
        ("mix.py", ["HOUSE", "OUT", "--names", ""], "not a pattern"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(
    house: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    script: str,
    words: list[str],
    expected: str,
) -> None:
    paths = {"HOUSE": house, "OUT": tmp_path / "out", "GONE": tmp_path / "gone"}
    message = refusal(monkeypatch, capfd, script, *(paths.get(word, word) for word in words))
    assert expected.replace("HOUSE", str(house)) in message
    assert not (tmp_path / "out").exists()
