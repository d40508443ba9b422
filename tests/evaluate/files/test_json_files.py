"""Files of recognized objects and of sentences' boxes: what is written is read back, and bad entries are named."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labeled_scans import group, write_scannet_labels

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import read_scanrefer, write_scanrefer
from gsencoder.evaluate.benchmarks import recognition, referring
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.recognition import read_recognition_labels, read_recognition_predictions
from gsencoder.evaluate.benchmarks.referring import (
    PredictedBoxes,
    read_referring_labels,
    read_referring_predictions,
    write_referring_predictions,
)

CORNERS = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (-1.0, 3.0)]
BOX = np.array([[0.0, 0, -1], [1, 2, 3]])
KEY = {"scene_id": "scene0011_00", "object_id": "3", "ann_id": "0"}
PREDICTED = KEY | {"bbox": CORNERS, "unique_multiple": 1, "others": 0}
TRUTH = PREDICTED | {"object_name": "office_chair", "description": "The chair.", "token": ["the", "chair", "."]}
INSTANCE = {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
NAMES = {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "bed"]}


def written(path: Path, rows: Any) -> Path:
    path.write_text(json.dumps(rows))
    return path


def test_boxes_are_read_back(tmp_path: Path) -> None:
    boxes = np.stack([BOX, BOX + 1, BOX / 3])
    predictions = [
        PredictedBoxes(scene="a", object_id=1, annotation="2", boxes=boxes, multiple=True, others=False),
        PredictedBoxes(scene="a", object_id=1, annotation="3", boxes=np.zeros((0, 2, 3))),
    ]
    write_referring_predictions(tmp_path / "p.json", predictions)
    for before, after in zip(predictions, read_referring_predictions(tmp_path / "p.json"), strict=True):
        assert before.key == after.key
        assert np.array_equal(before.boxes, after.boxes)
        assert (before.multiple, before.others) == (after.multiple, after.others)


def test_what_is_known_of_the_truth_is_read_back(tmp_path: Path) -> None:
    path = written(tmp_path / "t.json", [TRUTH, TRUTH | {"ann_id": "1", "others": None}])
    write_scanrefer(tmp_path / "again.json", read_scanrefer(path))
    for file in (path, tmp_path / "again.json"):
        first, second = read_referring_labels(file)
        assert first.key == ("scene0011_00", 3, "0")
        assert np.array_equal(np.array(first.aabb), BOX)
        assert (first.multiple, first.others, second.multiple, second.others) == (True, False, True, None)


def test_sentences_whose_object_has_no_box_are_counted_and_not_scored(tmp_path: Path) -> None:
    bare = TRUTH | {"object_id": "4", "bbox": None}
    truth = written(tmp_path / "t.json", [TRUTH, bare])
    results = referring.score(written(tmp_path / "p.json", [PREDICTED]), truth, ScoreOptions()).results
    assert (results["sentences"], results["not_scored"]) == (1, {"the object has no box in the truth": 1})
    with pytest.raises(InputError, match=r"t.json: no sentence has a box \(bbox\).*scans="):
        read_referring_labels(written(tmp_path / "t.json", [bare]))


@pytest.mark.parametrize(
    ("boxes", "count"),
    [
        ({"bbox": CORNERS}, 1),
        ({"bbox": BOX.tolist()}, 1),
        ({"bboxes": [CORNERS, BOX.tolist()]}, 2),
        ({"bbox": CORNERS, "bboxes": [BOX.tolist(), CORNERS]}, 2),
        ({"bbox": None}, 0),
    ],
)
def test_boxes_are_read_as_corners_or_as_two_of_them(tmp_path: Path, boxes: dict[str, Any], count: int) -> None:
    (prediction,) = read_referring_predictions(written(tmp_path / "p.json", [KEY | boxes]))
    assert len(prediction.boxes) == count
    assert all(np.array_equal(box, BOX) for box in prediction.boxes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bbox": CORNERS[:7]}, "entry 0: bbox must be a list of 8 corners .*a lower and an upper one, got a list"),
        ({"scene_id": 7}, "entry 0: the scene must be a text, got 7"),
        ({"object_id": "chair"}, "entry 0: object_id must be a whole number from 0, got 'chair'"),
        ({"others": 2}, "entry 0: others must be 0 or 1, got 2"),
    ],
)
def test_a_bad_entry_of_sentences_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    for read, row in ((read_referring_labels, TRUTH), (read_referring_predictions, PREDICTED)):
        path = written(tmp_path / "boxes.json", [row | changes])
        with pytest.raises(InputError, match=message) as error:
            read(path)
        assert str(path) in str(error.value)
        assert len(str(error.value)) < len(str(path)) + 250


def test_a_sentence_that_is_there_twice_or_has_no_box_is_named(tmp_path: Path) -> None:
    for read, row in ((read_referring_labels, TRUTH), (read_referring_predictions, PREDICTED)):
        path = written(tmp_path / "boxes.json", [row, row | {"ann_id": "1"}, row | {"ann_id": "00"}])
        with pytest.raises(InputError, match="entries 0 and 2 have one id: sentence 0 about object 3 of scene0011_00;"):
            read(path)
    with pytest.raises(InputError, match="entry 0: bbox is missing"):
        read_referring_predictions(written(tmp_path / "boxes.json", [KEY]))


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ({"bboxes": CORNERS}, r"bboxes\[0\] must be a list of 8 corners"),
        ({"bboxes": [None] * 10_001}, "bboxes must be a list of at most 10,000 boxes, got 10,001"),
        ({"bbox": (BOX + 1).tolist(), "bboxes": [CORNERS]}, "bbox is not the first of bboxes"),
    ],
)
def test_bad_lists_of_boxes_are_named(tmp_path: Path, boxes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"entry 0: {message}"):
        read_referring_predictions(written(tmp_path / "p.json", [KEY | boxes]))


def test_swapped_files_of_sentences_are_told(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [TRUTH])
    with pytest.raises(InputError, match="t.json: entry 0: unexpected key 'description'.*swapped"):
        read_referring_predictions(truth)
    for boxes, problem in (({"bboxes": []}, ", got bboxes: these are predictions"), ({"bbox": CORNERS}, "")):
        problem = f"p.json: entry 0: expected an expression with a description{problem}; predictions and truth"
        with pytest.raises(InputError, match=problem):
            read_referring_labels(written(tmp_path / "p.json", [KEY | boxes]))


def test_what_predictions_and_truth_do_not_share_is_told_with_the_file(tmp_path: Path) -> None:
    truth, other = written(tmp_path / "t.json", [TRUTH]), written(tmp_path / "p.json", [PREDICTED | {"ann_id": 4}])
    with pytest.raises(InputError, match="p.json: sentence 4 about object 3 of scene0011_00 is predicted, and not in"):
        referring.score(other, truth, ScoreOptions())
    with pytest.raises(InputError, match="p.json: sentence 0 about object 3 of scene0011_00 has no prediction"):
        referring.score(written(tmp_path / "p.json", []), truth, ScoreOptions())
    missing = referring.score(written(tmp_path / "p.json", []), truth, ScoreOptions(allow_missing=True))
    assert missing.results["without_box"] == 1


# ScanRefer's own files, which have neither boxes nor kinds


def scan_refer(folder: Path) -> tuple[Path, Path, Path]:
    """Sentences about a scan, its folder, and a label map: two chairs and a monitor, an object without vertices."""
    vertices = np.array([[0, 0, 0], [1, 2, 3], [5, 5, 5], [6, 6, 6], [9, 9, 9], [9, 9, 8]], np.float32)
    # A quarter turn about z: (x, y) becomes (-y, x).
    turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
    groups = [group(0, "office chair", [7]), group(1, "armchair", [8]), group(2, "monitor", [9]), group(3, "bed", [9])]
    name = "scene0011_00"
    write_scannet_labels(folder / "scans" / name, name, vertices, np.repeat([7, 8, 9], 2), groups, alignment=turn)
    names = ("office_chair", "armchair", "monitor", "bed")
    bare = {key: value for key, value in TRUTH.items() if key not in ("bbox", "unique_multiple", "others")}
    rows = [bare | {"object_id": str(number), "object_name": each} for number, each in enumerate(names)]
    lines = ["raw_category\tnyu40id", "office chair\t5", "armchair\t5", "monitor\t40", "bed\t4"]
    (folder / "map.tsv").write_text("\n".join(lines) + "\n")
    return written(folder / "ScanRefer_filtered_val.json", rows), folder / "scans", folder / "map.tsv"


def test_scanrefers_own_file_has_boxes_from_the_scans_and_kinds_from_the_label_map(tmp_path: Path) -> None:
    path, scans, label_map = scan_refer(tmp_path)
    with pytest.raises(InputError, match="no sentence has a box"):
        read_referring_labels(path, label_map=label_map)
    truth = read_referring_labels(path, label_map=label_map, scans=scans)
    # The first chair's vertices (0, 0, 0) and (1, 2, 3) are (0, 0, 0) and (-2, 1, 3) in the aligned frame.
    assert np.allclose(np.array(truth[0].aabb), [[-2, 0, 0], [0, 1, 3]])
    # Of the monitor all vertices belong to the bed, which was annotated later.
    assert [each.aabb is None for each in truth] == [False, False, True, False]
    assert [each.multiple for each in truth] == [True, True, False, False]
    assert [each.others for each in truth] == [False, False, True, False]
    # Without the map nothing says what the objects are.
    assert {(each.multiple, each.others) for each in read_referring_labels(path, scans=scans)} == {(None, None)}


# Recognition


def test_names_are_read_and_null_is_no_answer(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [INSTANCE])
    assert read_recognition_labels(truth) == {("scene0011_00", "3"): "chair"}
    predictions = written(tmp_path / "p.json", [NAMES, NAMES | {"object_id": 4, "labels": None}])
    names = {("scene0011_00", "3"): ("chair", "bed"), ("scene0011_00", "4"): ()}
    assert read_recognition_predictions(predictions) == names


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"labels": "chair"}, "labels must be a list of names, got 'chair'"),
        ({"labels": ["chair", 5]}, r"labels\[1\] must be a text of one line with 1 to 200 characters, got 5"),
        ({"label": "chair"}, "unexpected key 'label'; predictions and truth may be swapped"),
    ],
)
def test_a_bad_entry_of_names_is_named(tmp_path: Path, row: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"p.json: entry 0: {message}"):
        read_recognition_predictions(written(tmp_path / "p.json", [NAMES | row]))


def test_entries_that_are_there_twice_swapped_or_of_no_class_are_named(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [INSTANCE])
    with pytest.raises(InputError, match="p.json: entries 0 and 1 have one id: object 3 of scene0011_00"):
        read_recognition_predictions(written(tmp_path / "p.json", [NAMES, NAMES]))
    with pytest.raises(InputError, match="p.json: entry 0: unexpected key 'labels'; predictions and truth may be"):
        recognition.score(truth, written(tmp_path / "p.json", [NAMES]), ScoreOptions())
    with pytest.raises(InputError, match="p.json: object 3 of scene0011_00 is predicted as 'bed', which is no class"):
        recognition.score(tmp_path / "p.json", truth, ScoreOptions())
