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
ANSWERS = {"q0": ["red"], "q1": ["the table", "on the table"], "q2": ["3"]}
SQUARE = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
OBJECTS = [
    {
        "scene_id": "s0",
        "object_id": str(number),
        "object_name": "chair",
        "ann_id": "0",
        "description": text,
        "token": text.split(),
        "bbox": [[x + 3 * number, y, z] for x, y, z in SQUARE],
    }
    for number, text in enumerate(["a red chair near the door", "a blue chair under the window"])
]


def write(path: Path, value: Any) -> Path:
    path.write_text(json.dumps(value))
    return path


def answer_files(folder: Path, answers: dict[str, list[str]]) -> list[str]:
    scenes = {each["question_id"]: each["scene_id"] for each in QUESTIONS}
    rows = [
        {"scene_id": scenes.get(name, "s0"), "question_id": name, "answer_top10": texts}
        for name, texts in answers.items()
    ]
    truth, predictions = write(folder / "truth.json", QUESTIONS), write(folder / "predictions.json", rows)
    return ["score", "answers", f"predictions={predictions}", f"truth={truth}", "java=false"]


def test_columns_of_other_tokens_do_not_stand_under_those_of_papers(tmp_path: Path) -> None:
    first = {name: texts[:1] for name, texts in ANSWERS.items()}
    assert cli.main([*answer_files(tmp_path, first), f"out={tmp_path / 'out'}", "quiet=true"]) == 0
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


def caption_files(folder: Path, predictions: Any) -> list[str]:
    files = write(folder / "captions.json", predictions), write(folder / "expressions.json", OBJECTS)
    return ["score", "captions", f"predictions={files[0]}", f"truth={files[1]}", "java=false"]


def test_captions_of_given_objects_need_no_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    captions = {f"s0|{number}|chair": [f"sos {each['description']} eos"] for number, each in enumerate(OBJECTS)}
    assert cli.main([*caption_files(tmp_path, captions), f"out={tmp_path / 'out'}", "quiet=true"]) == 0
    results = results_of(tmp_path / "out")
    assert (results["missing"], results["min_iou"]) == (0, None)
    assert results["rouge_l"] == pytest.approx(1.0)
    del captions["s0|1|chair"]
    message = refusal(capsys, *caption_files(tmp_path, captions), f"out={tmp_path / 'other'}")
    assert "1 object without a prediction, first 1 of s0" in message
