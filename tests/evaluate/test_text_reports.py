"""Reports of scored answers and captions, against figures worked out by hand."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.evaluate.benchmarks import answers as answers_of_questions
from gsencoder.evaluate.benchmarks import captions
from gsencoder.evaluate.benchmarks import text_metrics as sentences
from gsencoder.evaluate.benchmarks.files import ScoreOptions


def written(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def cube(low: float, side: float = 1.0) -> list[list[float]]:
    return [[low, 0.0, 0.0], [low + side, 1.0, 1.0]]


def test_answers_are_reported_by_kind_and_scene_with_what_is_absent(tmp_path: Path) -> None:
    questions = [
        {"scene_id": "s", "question_id": "q0", "question": "What color is it?", "answers": ["brown", "dark brown"]},
        {"scene_id": "s", "question_id": "q1", "question": "Where is it?", "answers": ["on the table"]},
        {"scene_id": "t", "question_id": "q2", "question": "How many lamps?", "answers": ["2"]},
        {"scene_id": "t", "question_id": "q3", "question": "Is it?", "answers": ["yes"]},
    ]
    # Right; right among ten, and refined; right when cleaned; blank.
    answers = {"q0": ["brown"], "q1": ["table", "on the table"], "q2": ["two"], "q3": ["?"]}
    rows = [{"scene_id": "st"[int(key[1]) // 2], "question_id": key, "answer_top10": a} for key, a in answers.items()]
    truth = written(tmp_path / "truth.json", questions)
    report = answers_of_questions.score(
        written(tmp_path / "p.json", rows), truth, ScoreOptions(method="mine", java=False)
    )
    results = report.results
    figures = {name: results[name] for name in ("em_1", "em_10", "em_cleaned", "em_refined")}
    assert figures == {"em_1": 1 / 4, "em_10": 2 / 4, "em_cleaned": 2 / 4, "em_refined": 1.0}
    assert (results["questions"], results["missing"], results["tokens"]) == (4, 0, "Python tokens")
    assert results["kinds"]["Place"] == pytest.approx(
        {"kind": "Place", "questions": 1, "em_1": 0, "em_10": 1, "em_cleaned": 0, "em_refined": 1}
        | {"f_value": results["kinds"]["Place"]["f_value"]},
        nan_ok=True,
    )
    assert [row["questions"] for row in report.rows["scenes"]] == [2, 2]
    assert [row["em_cleaned"] for row in report.rows["scenes"]] == [1 / 2, 1 / 2]
    assert results["spread"]["em_10"] == {"scenes": 2, "mean": 0.5, "std": pytest.approx(math.sqrt(0.5))}
    assert math.isnan(results["meteor (Python tokens)"])
    assert "METEOR is absent: Java was not asked for (java=false)." in report.table.notes
    assert "1 answer without a word once cleaned: right in the refined match." in report.table.notes
    assert len(report.rows["questions"]) == 4
    single = answers_of_questions.score(
        written(tmp_path / "p.json", [rows[0]]), truth, ScoreOptions(java=False, allow_missing=True)
    )
    assert math.isnan(single.results["em_10"])
    assert (single.results["missing"], single.results["em_1"]) == (3, 1 / 4)
    assert single.line.startswith("4 questions, 3 without an answer: EM@1 0.250, refined 0.250, CIDEr ")


@pytest.mark.parametrize(("min_iou", "ending", "published"), [(0.5, "_50", True), (0.25, "_25", False)])
def test_captions_are_reported_with_their_k(tmp_path: Path, min_iou: float, ending: str, published: bool) -> None:
    texts = {"a red chair near the door": ("s", 0), "a blue chair under the window": ("s", 1), "a lamp": ("t", 0)}
    truth = [
        {"scene_id": scene, "object_id": number, "object_name": "x", "ann_id": 0, "description": text}
        | {"token": text.split(), "bbox": cube(10 * number)}
        for text, (scene, number) in texts.items()
    ]
    # IoUs of 0.3 and 0.6; the lamp has a caption of another box.
    boxes = {
        "s": [
            {"caption": "a red chair near the door", "box": cube(0, 0.3)},
            {"caption": "a blue chair by it", "box": cube(10, 0.6)},
        ],
        "t": [{"caption": "a lamp", "box": cube(30)}],
    }
    files = written(tmp_path / "p.json", boxes), written(tmp_path / "t.json", truth)
    report = captions.score(*files, ScoreOptions(min_iou=min_iou, java=False))
    results, (first, second, third) = report.results, report.rows["objects"]
    assert (results["objects"], results["predictions"], results["min_iou"]) == (3, 3, min_iou)
    assert results["missing"] == (2 if min_iou == 0.5 else 1)
    assert [row["iou"] for row in (first, second, third)] == pytest.approx([0.3, 0.6, 0.0])
    assert [(row["scene"], row["object"]) for row in (first, second, third)] == [("s", 0), ("s", 1), ("t", 0)]
    # A whole caption has scores of 1, and those of "sos eos" share no 4-gram.
    assert first["bleu_4"] == pytest.approx(float(min_iou == 0.25), abs=1e-3)
    assert first["rouge_l"] == pytest.approx(1.0) if min_iou == 0.25 else first["rouge_l"] < 0.6
    # "sos a blue chair by it eos" and "sos a blue chair under the window eos": 5 of 7 and of 8 words in common.
    assert second["rouge_l"] == pytest.approx(2.44 * (5 / 7) * (5 / 8) / (5 / 8 + 1.44 * 5 / 7))
    assert results[f"rouge_l{ending}"] == pytest.approx(np.mean([row["rouge_l"] for row in report.rows["objects"]]))
    assert results[f"cider{ending}"] == pytest.approx(np.mean([row["cider"] for row in report.rows["objects"]]))
    # BLEU is of the corpus.
    assert results[f"bleu_4{ending}"] != pytest.approx(np.mean([row["bleu_4"] for row in report.rows["objects"]]))
    assert report.rows["scenes"][0] == {"scene": "s", "objects": 2} | {
        name: pytest.approx((first[name] + second[name]) / 2) for name in ("cider", "rouge_l", "bleu_4")
    }
    assert report.table.title == f"Captions at an IoU of {min_iou}"
    assert any(row.source == "published" for row in report.table.rows) is published
    # A k of one half is what is taken where none is given.
    assert (captions.score(*files, ScoreOptions(java=False)).results["missing"] == results["missing"]) is published


def test_java_is_looked_for_unless_it_is_not_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sentences, "find_java_tools", lambda: "there is none")
    questions = [{"scene_id": "s", "question_id": "q", "question": "What is it?", "answers": ["a"]}]
    truth_file = written(tmp_path / "t.json", questions), [{"question_id": "q", "answer_top10": ["a"]}]
    described = [{"scene_id": "s", "object_id": 1, "object_name": "x", "ann_id": 0, "description": "a", "token": ["a"]}]
    captioned = written(tmp_path / "d.json", described), {"s|1": ["a"]}
    for benchmark, (truth, rows) in ((answers_of_questions, truth_file), (captions, captioned)):
        predictions = written(tmp_path / "p.json", rows)
        assert benchmark.score(predictions, truth, ScoreOptions()).results["absent"]["METEOR"] == "there is none"
        refused = benchmark.score(predictions, truth, ScoreOptions(java=False)).results["absent"]["METEOR"]
        assert refused == "Java was not asked for (java=false)"
