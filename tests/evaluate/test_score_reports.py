"""Reports of scored files, against figures worked out by hand: every column has the figure that its head says."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable, write_classes
from gsencoder.data.labels.files import write_integer_lines
from gsencoder.evaluate.benchmarks import answers, captions, recognition, referring, text_metrics
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.instances import prediction_of_masks, score_instances, write_instance_prediction
from gsencoder.evaluate.benchmarks.semantics import score_semantics
from gsencoder.evaluate.tables import spread

CLASSES = ClassTable(
    names=("bed", "chair", "wall"), ids=(4, 5, 1), groups={"head": ("bed",), "tail": ("chair", "wall")}
)
NOTHING = {"scenes": 0, "mean": math.nan, "std": math.nan}


def written(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def table(report: Any) -> dict[str, dict[str, float]]:
    """The measured figures of a report's table, percent."""
    return {row.method: dict(row.values) for row in report.table.rows if row.source == "measured"}


def test_the_spread_is_over_scenes_that_have_a_value() -> None:
    rows = [{"a": 1.0, "b": None}, {"a": 4.0, "b": math.nan}, {"a": math.nan}]
    deviation = spread(rows, ["a", "b"])
    # The deviation of a sample: sqrt(((1 - 2.5)² + (4 - 2.5)²) / 1).
    assert deviation["a"] == {"scenes": 2, "mean": 2.5, "std": pytest.approx(math.sqrt(4.5))}
    assert deviation["b"] == pytest.approx(NOTHING, nan_ok=True)
    assert spread(rows[:1], ["a"])["a"] == pytest.approx({"scenes": 1, "mean": 1, "std": math.nan}, nan_ok=True)


# Instances

SIZE = 1000
Mask = tuple[int, int, int, float]


def instance_folders(folder: Path, truths: dict[str, np.ndarray], masks: dict[str, list[Mask]]) -> tuple[Path, Path]:
    for name in ("predictions", "truth"):
        (folder / name).mkdir()
    rows = np.arange(SIZE)
    for scene, ids in truths.items():
        write_integer_lines(folder / "truth" / f"{scene}.txt", ids)
        made = prediction_of_masks(
            scene, [(rows >= first) & (rows < last) for first, last, _, _ in masks[scene]],
            [label for _, _, label, _ in masks[scene]], [score for _, _, _, score in masks[scene]],
            num_vertices=SIZE,
        )  # fmt: skip
        write_instance_prediction(folder / "predictions", made)
    return folder / "predictions", folder / "truth"


def test_average_precision_is_reported_by_threshold_class_group_and_scene(tmp_path: Path) -> None:
    truths = {"a": np.repeat([4001, 5001, 0], [400, 400, 200]), "b": np.repeat([4001, 0], [400, 600])}
    # The bed of a is found whole, that of b by 0.5 and a bit, and the chair by 0.3.
    masks: dict[str, list[Mask]] = {
        "a": [(0, 400, 4, 0.9), (400, 520, 5, 0.8), (600, 900, 7, 0.8)],
        "b": [(0, 201, 4, 0.7)],
    }
    report = score_instances(*instance_folders(tmp_path, truths, masks), CLASSES, method="mine")
    results = report.results
    # Of beds both are right at 0.25 and 0.5. At the other eight thresholds one is right and ranks first, one wrong:
    # precision 1/2, 1, 1, recall 1/2, 1/2, 0, steps 0, 1/4, 1/4: AP 1/2. The chair is right at 0.25 alone.
    assert results["ap_25"] == 1
    assert results["ap_50"] == pytest.approx(1 / 2)
    assert results["ap"] == pytest.approx(((1 + 8 / 2) / 9 + 0) / 2)
    assert (results["ap_head"], results["ap_tail"]) == (pytest.approx(5 / 9), 0)
    assert (results["truths"], results["predictions"], results["other_classes"]) == (3, 3, 1)
    assert (results["class_agnostic"], results["equal_scores"]) == (False, False)
    assert results["thresholds"] == [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.25]
    assert table(report) == {
        "mine": pytest.approx({"ap_25": 100, "ap_50": 50, "ap": 250 / 9, "ap_head": 500 / 9, "ap_tail": 0})
    }
    # By scene: bed and chair of a, the bed of b. Of b, 201 / 400 is above 0.5 alone.
    assert report.rows["scenes"] == [
        {"scene": "a", "ap_25": 1.0, "ap_50": 0.5, "ap": 0.5, "truths": 2},
        {"scene": "b", "ap_25": 1.0, "ap_50": 1.0, "ap": pytest.approx(1 / 9), "truths": 1},
    ]
    assert results["spread"]["ap_50"] == {"scenes": 2, "mean": 0.75, "std": pytest.approx(math.sqrt(0.125))}
    classes = {row["class"]: row for row in report.rows["classes"]}
    counts = {name: (row["truths"], row["predictions"]) for name, row in classes.items()}
    assert counts == {"bed": (2, 2), "chair": (1, 1), "wall": (0, 0)}
    assert (classes["bed"]["ap_50"], classes["chair"]["ap_50"], classes["chair"]["ap_25"]) == (1, 0, 1)
    assert math.isnan(classes["wall"]["ap"])
    assert report.table.notes == ("Not counted: 1 mask with a class id that is none of the 3 that are scored.",)
    assert report.line == "3 objects in 2 scenes: AP 0.278, AP50 0.500, AP25 1.000"


def test_equal_scores_masks_over_several_objects_and_smaller_regions_are_told(tmp_path: Path) -> None:
    truths = {"a": np.repeat([4001, 4002, 0], [100, 100, 800])}
    folders = instance_folders(tmp_path, truths, {"a": [(40, 160, 5, 1.0), (0, 100, 5, 1.0)]})
    report = score_instances(*folders, CLASSES, class_agnostic=True)
    assert [row.source for row in report.table.rows] == ["measured"]
    assert report.table.notes[0].startswith("All predictions have one score")
    assert report.table.notes[1].startswith("All masks are of one class")
    assert report.table.notes[2].startswith(
        "Of the masks 1 overlap several true objects by more than 0.25; AP at 0.25 depends"
    )
    assert report.line.endswith(" without classes")
    write_integer_lines(folders[1] / "a.txt", np.repeat([4001, 0], [99, 901]))
    with pytest.raises(InputError, match="no object of the 3 classes has 100 vertices or more in 1 scene"):
        score_instances(*folders, CLASSES)


# Labels


def label_folders(folder: Path, labels: dict[str, tuple[list[int], list[int]]]) -> tuple[Path, Path]:
    """By scene the true and the predicted ids."""
    for name, column in (("truth", 0), ("predictions", 1)):
        (folder / name).mkdir()
        for scene, pair in labels.items():
            write_integer_lines(folder / name / f"{scene}.txt", np.array(pair[column]))
    return folder / "predictions", folder / "truth"


def test_iou_and_accuracy_are_reported_over_all_classes_and_the_foreground(tmp_path: Path) -> None:
    labels = {"a": ([4, 4, 5, 1], [4, 1, 5, 1]), "b": ([4, 5, 0], [4, 9, 4])}
    report = score_semantics(*label_folders(tmp_path, labels), CLASSES, method="mine")
    # bed: 2 of 3, none wrong. chair: 1 of 2, one predicted as nothing. wall: 1 of 1, one wrong.
    results = report.results
    assert results["miou"] == pytest.approx((2 / 3 + 1 / 2 + 1 / 2) / 3)
    assert results["f_miou"] == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert results["macc"] == pytest.approx((2 / 3 + 1 / 2 + 1) / 3)
    assert results["f_accuracy"] == pytest.approx(3 / 5)
    assert (results["vertices"], results["ignored"], results["unlabeled"], results["excluded"]) == (6, 1, 1, ["wall"])
    first, second = report.rows["scenes"]
    assert (first["miou"], first["f_miou"]) == (pytest.approx((1 / 2 + 1 + 1 / 2) / 3), pytest.approx((1 / 2 + 1) / 2))
    assert (second["scene"], second["vertices"], second["miou"]) == ("b", 2, 1 / 2)
    assert results["spread"]["f_miou"]["mean"] == pytest.approx((3 / 4 + 1 / 2) / 2)
    assert report.rows["classes"][1] == {"class": "chair", "iou": 0.5, "accuracy": 0.5, "truths": 2, "predictions": 1}
    assert report.table.notes == (
        "Columns f_ leave out wall.",
        "1 of 6 vertices that count are predicted as none of the classes.",
    )
    assert table(report)["mine"]["f_miou"] == pytest.approx(100 * results["f_miou"])
    assert report.line == "6 labels in 2 scenes: mIoU 0.556, mAcc 0.722, f-mIoU 0.583; 1 without a prediction"
    furniture = CLASSES.without(("wall",))
    all_in = score_semantics(tmp_path / "predictions", tmp_path / "truth", furniture, scenes=["a"])
    assert all_in.results["f_miou"] == all_in.results["miou"]
    assert all_in.table.notes[0].startswith("1 of 3 vertices")


# Recognition


def classes_file(folder: Path, *names: str) -> str:
    write_classes(folder / "c.csv", ClassTable(names=names, ids=tuple(range(len(names)))))
    return str(folder / "c.csv")


def test_recognition_is_reported_for_each_k_by_class_and_scene(tmp_path: Path) -> None:
    names = [("s", 1, "bed"), ("s", 2, "bed"), ("t", 1, "bed"), ("t", 2, "chair"), ("t", 3, "lamp")]
    ranked = [["bed", "chair"], ["chair", "bed"], [], ["lamp", "bed", "chair"], ["lamp"]]
    truth = written(tmp_path / "truth.json", [{"scene_id": s, "object_id": o, "label": n} for s, o, n in names])
    rows = [{"scene_id": s, "object_id": o, "labels": r} for (s, o, _), r in zip(names, ranked, strict=True)]
    predictions = written(tmp_path / "predictions.json", rows)
    report = recognition.score(predictions, truth, ScoreOptions(method="mine"))
    results = report.results
    # Beds: places 1, 2, none. Chairs: place 3. Lamps: place 1.
    assert (results["mean_1"], results["overall_1"]) == (pytest.approx((1 / 3 + 0 + 1) / 3), pytest.approx(2 / 5))
    assert (results["mean_5"], results["overall_5"]) == (pytest.approx((2 / 3 + 1 + 1) / 3), pytest.approx(4 / 5))
    assert (results["objects"], results["unanswered"], results["other_classes"]) == (5, 1, 0)
    assert table(report)["mine"] == pytest.approx({"mean": 400 / 9, "bed": 100 / 3, "chair": 0, "lamp": 100})
    assert report.rows["scenes"][0] == {"scene": "s", "objects": 2, "top_1": 0.5, "top_5": 1.0}
    assert report.rows["classes"][0] == {"class": "bed", "objects": 3} | {
        f"top_{k}": pytest.approx(share) for k, share in ((1, 1 / 3), (5, 2 / 3))
    }
    assert results["spread"]["top_1"]["mean"] == pytest.approx((1 / 2 + 1 / 3) / 2)
    assert report.line.endswith("top-1 0.444 (0.400), top-5 0.889 (0.800)")
    # Classes that are given leave out the others, and keep those without objects.
    with pytest.raises(InputError, match="is predicted as 'lamp', which is no class"):
        recognition.score(predictions, truth, ScoreOptions(classes=classes_file(tmp_path, "bed", "chair")))
    others = ScoreOptions(classes=classes_file(tmp_path, "a", "b", "c"))
    with pytest.raises(InputError, match="nothing to score: it holds no object of the 3 classes"):
        recognition.score(written(tmp_path / "none.json", []), truth, others)
    first_file = written(tmp_path / "kept.json", rows[:1])
    options = ScoreOptions(classes=classes_file(tmp_path, "bed", "chair", "sofa"), allow_missing=True)
    some = recognition.score(first_file, truth, options)
    assert (some.results["objects"], some.results["unanswered"], some.results["other_classes"]) == (4, 3, 1)
    assert some.rows["classes"][2]["objects"] == 0
    assert math.isnan(some.rows["classes"][2]["top_1"])


# Boxes


def cube(low: float, side: float = 1.0) -> list[list[float]]:
    return [[low, 0.0, 0.0], [low + side, 1.0, 1.0]]


def test_boxes_of_sentences_are_reported_by_kind_threshold_and_number(tmp_path: Path) -> None:
    far = cube(50)
    # IoUs of the boxes, best first: 0.6; 0.3 and then 0.7; 0.1; none.
    boxes: dict[str, list[list[list[float]]]] = {
        "0": [cube(0, 0.6)], "1": [cube(10, 0.3), far, cube(10, 0.7)], "2": [cube(20, 0.1)], "3": [],
    }  # fmt: skip
    truth = [
        {"scene_id": "ab"[row // 3], "object_id": str(row), "object_name": "chair", "ann_id": "0", "token": []}
        | {"description": "x", "bbox": cube(10 * row)}
        | ({"unique_multiple": int(row > 0), "others": 0} if row < 3 else {})
        for row in range(4)
    ]
    keys = ("scene_id", "object_id", "ann_id")
    rows = [{key: each[key] for key in keys} | {"bboxes": boxes[each["object_id"]]} for each in truth]
    files = written(tmp_path / "predictions.json", rows), written(tmp_path / "truth.json", truth)
    report = referring.score(*files, ScoreOptions(method="mine"))
    results = report.results
    assert (results["acc_25"], results["acc_50"]) == (2 / 4, 1 / 4)
    assert (results["sentences"], results["without_box"], results["not_scored"]) == (4, 1, {})
    assert results["thresholds"] == [0.25, 0.5]
    assert results["best_of"] == {"5": {"acc_25": 2 / 4, "acc_50": 2 / 4}, "all": {"acc_25": 2 / 4, "acc_50": 2 / 4}}
    mine = {"acc_25": 50, "acc_50": 25, "unique_25": 100, "unique_50": 100, "multiple_25": 50, "multiple_50": 0}
    best = mine | {"acc_50": 50, "multiple_50": 50}
    names = ["mine", "mine, best of 5", "mine, best of all"]
    assert table(report) == dict(zip(names, map(pytest.approx, (mine, best, best)), strict=True))
    assert results["tables"]["top_1"]["multiple"]["overall"] == {"sentences": 2, "acc25": 0.5, "acc50": 0.0}
    assert results["tables"]["best"]["multiple"]["overall"]["acc50"] == 0.5
    assert report.rows["scenes"] == [
        {"scene": "a", "sentences": 3, "acc_25": pytest.approx(2 / 3), "acc_50": pytest.approx(1 / 3)},
        {"scene": "b", "sentences": 1, "acc_25": 0.0, "acc_50": 0.0},
    ]
    second, last = report.rows["sentences"][1], report.rows["sentences"][3]
    assert (second["iou"], second["best_iou"], second["multiple"]) == (pytest.approx(0.3), pytest.approx(0.7), True)
    assert (last["iou"], last["best_iou"], last["multiple"]) == (0.0, 0.0, None)
    assert report.table.notes[0].startswith("1 sentence in the overall columns alone")
    assert report.line == (
        "4 sentences: Acc@0.25 0.500, Acc@0.5 0.250; 1 without a box; of all boxes the best: 0.500, 0.500"
    )


# Texts


def test_answers_are_reported_by_kind_and_scene_with_what_is_absent(tmp_path: Path) -> None:
    questions = [
        {"scene_id": "s", "question_id": "q0", "question": "What color is it?", "answers": ["brown", "dark brown"]},
        {"scene_id": "s", "question_id": "q1", "question": "Where is it?", "answers": ["on the table"]},
        {"scene_id": "t", "question_id": "q2", "question": "How many lamps?", "answers": ["2"]},
        {"scene_id": "t", "question_id": "q3", "question": "Is it?", "answers": ["yes"]},
    ]
    # Right; right among ten, and refined; right when cleaned; blank.
    said = {"q0": ["brown"], "q1": ["table", "on the table"], "q2": ["two"], "q3": ["?"]}
    rows = [{"scene_id": "st"[int(key[1]) // 2], "question_id": key, "answer_top10": a} for key, a in said.items()]
    truth = written(tmp_path / "truth.json", questions)
    report = answers.score(written(tmp_path / "p.json", rows), truth, ScoreOptions(method="mine", java=False))
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
    single = answers.score(written(tmp_path / "p.json", [rows[0]]), truth, ScoreOptions(java=False, allow_missing=True))
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
    red, blue = ("a red chair near the door", cube(0, 0.3)), ("a blue chair by it", cube(10, 0.6))
    said = {"s": [red, blue], "t": [("a lamp", cube(30))]}
    boxes = {scene: [{"caption": text, "box": box} for text, box in each] for scene, each in said.items()}
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
    monkeypatch.setattr(text_metrics, "find_java_tools", lambda: "there is none")
    questions = [{"scene_id": "s", "question_id": "q", "question": "What is it?", "answers": ["a"]}]
    truth_file = written(tmp_path / "t.json", questions), [{"question_id": "q", "answer_top10": ["a"]}]
    described = [{"scene_id": "s", "object_id": 1, "object_name": "x", "ann_id": 0, "description": "a", "token": ["a"]}]
    captioned = written(tmp_path / "d.json", described), {"s|1": ["a"]}
    for benchmark, (truth, rows) in ((answers, truth_file), (captions, captioned)):
        predictions = written(tmp_path / "p.json", rows)
        assert benchmark.score(predictions, truth, ScoreOptions()).results["absent"]["METEOR"] == "there is none"
        refused = benchmark.score(predictions, truth, ScoreOptions(java=False)).results["absent"]["METEOR"]
        assert refused == "Java was not asked for (java=false)"
