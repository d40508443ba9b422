"""`gsencoder score answers` and `captions`: official files in, a table beside the papers' rows out."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from command_runs import refusal, results_of

from gsencoder.app import main as cli

QUESTIONS = [
    {"scene_id": "s0", "question_id": "q0", "question": "What color is the chair?", "answers": ["red", "dark red"]},
    {"scene_id": "s0", "question_id": "q1", "question": "Where is the cup?", "answers": ["on the table"]},
    {"scene_id": "s1", "question_id": "q2", "question": "How many lamps are there?", "answers": ["2"]},
]
ANSWERS = {"q0": ["red"], "q1": ["the table"], "q2": ["3"]}


def test_columns_of_other_tokens_do_not_stand_under_those_of_papers(tmp_path: Path) -> None:
    scenes = {each["question_id"]: each["scene_id"] for each in QUESTIONS}
    rows = [{"scene_id": scenes[name], "question_id": name, "answer_top10": texts} for name, texts in ANSWERS.items()]
    (tmp_path / "truth.json").write_text(json.dumps(QUESTIONS))
    (tmp_path / "predictions.json").write_text(json.dumps(rows))
    files = [f"{name}={tmp_path / name}.json" for name in ("predictions", "truth")]
    assert cli.main(["score", "answers", *files, "java=false", f"out={tmp_path / 'out'}", "quiet=true"]) == 0
    results = results_of(tmp_path / "out")
    assert "EM@10" in results["absent"]
    assert results["em_10"] is None
    with (tmp_path / "out" / "questions.csv").open(newline="") as stream:
        assert [row["question_id"] for row in csv.DictReader(stream)] == ["q0", "q1", "q2"]
    with (tmp_path / "out" / "table.csv").open(newline="") as stream:
        measured, *published = csv.DictReader(stream)
    tokens = results_of(tmp_path / "out")["tokens"]
    assert measured["em_1"]
    assert not measured["cider"]
    assert measured[f"cider ({tokens})"]
    assert any(row["cider"] for row in published)
    assert not any(row[f"cider ({tokens})"] for row in published)


@pytest.mark.parametrize("protocol", ["recognition", "referring", "answers", "captions"])
def test_lists_without_an_entry_are_refused(protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("truth", "predictions"):
        (tmp_path / f"{name}.json").write_text("[]")
    message = refusal(
        capsys, "score", protocol, f"predictions={tmp_path / 'predictions.json'}", f"truth={tmp_path / 'truth.json'}"
    )
    assert "truth.json" in message


def test_scenes_without_captions_are_refused_or_count_as_empty(tmp_path, capsys):
    corners = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    entry: dict[str, Any] = {"object_id": "0", "object_name": "mug", "ann_id": "0", "bbox": corners}
    words = {"description": "a red mug", "token": ["a", "red", "mug"]}
    truth = [{"scene_id": scene, **entry, **words} for scene in ("a", "b")]
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    boxes = [{"caption": "a red mug", "box": corners, "sem_prob": [1.0], "obj_prob": [0.0, 1.0]}]
    (tmp_path / "predictions.json").write_text(json.dumps({"a": boxes}))
    files = [f"{name}={tmp_path / name}.json" for name in ("predictions", "truth")]
    arguments = ["score", "captions", *files, "java=false", f"out={tmp_path / 'out'}"]
    assert "1 scene without a prediction, first b" in refusal(capsys, *arguments)
    assert cli.main([*arguments, "allow_missing=true", "quiet=true"]) == 0
    assert results_of(tmp_path / "out")["missing"] == 1
