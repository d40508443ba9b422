"""`gsencoder views`: what it writes, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from asked_rooms import ORIGIN
from command_runs import refusal
from PIL import Image

from gsencoder.app import main as cli
from gsencoder.core.archive import open_archive

pytestmark = pytest.mark.slow

QUICK = ("choose.candidates=8", "choose.count=4", "choose.width=120", "choose.height=90", "quiet=true")


def test_views_are_written_with_what_they_show_and_why(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "views"
    assert cli.main(["views", str(features), "query=cube", "grid=[3,4]", f"out={out}", *QUICK]) == 0
    rows = json.loads((out / "views.json").read_text())
    assert len(rows) == 4
    for row in rows:
        with Image.open(out / row["picture"]) as picture:
            assert picture.size == (row["width"], row["height"])
        (sight,) = row["sights"]
        assert sight["target"] == "cube"
        # The cube lies at (0.3, 0.2, 0.8) from the origin, before each camera.
        at = np.array(row["cam_from_world"]) @ np.append(ORIGIN + np.array([0.3, 0.2, 0.8]), 1)
        pixel = np.array(row["K"]) @ at[:3] / at[2]
        assert at[2] > 0
        assert 0 < pixel[0] < row["width"]
        assert 0 < pixel[1] < row["height"]
    assert sum(row["sights"][0]["visible"] > 0.9 for row in rows) >= 3
    assert (out / "sheet.png").is_file()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["results"]["judged"] <= 8
    assert [box["query"] for box in summary["results"]["boxes"]] == ["cube"]
    with open_archive(out / "tokens.safetensors") as file:
        tokens = file.array("tokens", "float32", ("V", 12, 16))
    assert len(tokens) == 4
    assert np.isfinite(tokens).all()


def test_a_word_that_is_absent_is_said_to_be(features, tmp_path, capsys):
    words = "query=cube,pen holder"
    loud = [word for word in QUICK if word != "quiet=true"]
    assert cli.main(["views", str(features), words, f"out={tmp_path / 'views'}", *loud]) == 0
    assert "pen holder: absent (probability 0.0" in capsys.readouterr().out
    assert cli.main(["localize", str(features), words, "pictures=0", f"out={tmp_path / 'boxes'}"]) == 0
    output = capsys.readouterr().out
    assert "pen holder: absent (probability 0.0" in output
    assert "probability 1.00" in output or "probability 0.9" in output
    listed = json.loads((tmp_path / "boxes" / "boxes.json").read_text())
    assert {box["query"] for box in listed} == {"cube"}
    assert all(0.9 < box["probability"] <= 1 for box in listed)
    for folder in ("views", "boxes"):
        results = json.loads((tmp_path / folder / "summary.json").read_text())["results"]
        assert [row["absent"] for row in results["words"]] == [False, True]
    assert json.loads((tmp_path / "boxes" / "words.json").read_text()) == results["words"]


def test_several_words_and_boxes_are_looked_at_together(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "views"
    assert cli.main(["views", str(features), "query=cube,crate", "boxes=2", f"out={out}", *QUICK]) == 0
    rows = json.loads((out / "views.json").read_text())
    assert [sight["target"] for sight in rows[0]["sights"]] == ["cube", "crate", "crate 2"]
    shown = np.array([[sight["share"] for sight in row["sights"]] for row in rows])
    assert (shown.max(axis=0) > 0.02).all()


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ((), "query= is missing"),
        (("query=cube", "boxes=0"), "boxes: expected 1 or more"),
        (("query=cube", "grid=[3]"), "grid: expected rows and columns"),
        (("query=zebra",), "not among the 4 words"),
        (("query=pen holder",), "'pen holder' is absent (probability"),
        (("query=cube", "choose.count=4097"), "count: expected 1 to 4,096, got 4097"),
        (("choose.method=uniform", "grid=[3,4]", "space=other"), "none of 'other'"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(features, tmp_path, capsys, words, problem):
    assert problem in refusal(capsys, "views", str(features), *words, f"out={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()
