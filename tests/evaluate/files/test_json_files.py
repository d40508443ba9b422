"""Files of recognized objects and of sentences' boxes: what is written is read back, and bad entries are named."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.files.recognition import (
    read_recognition_predictions,
    read_recognition_truth,
    recognize_files,
    write_recognition_predictions,
    write_recognition_truth,
)
from gsencoder.evaluate.files.referring import (
    compare_box_files,
    read_referring_predictions,
    read_referring_truth,
    write_referring_predictions,
    write_referring_truth,
)
from gsencoder.evaluate.scores.recognition import NamedInstance, RankedNames
from gsencoder.evaluate.scores.referring import PredictedBoxes, ReferredObject, referring_scores

CORNERS = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (-1.0, 3.0)]
BOX = np.array([[0.0, 0, -1], [1, 2, 3]])
KEY = {"scene_id": "scene0011_00", "object_id": "3", "ann_id": "0"}
SENTENCE = KEY | {"bbox": CORNERS, "unique_multiple": 1, "others": 0}
INSTANCE = {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
NAMES = {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "bed"]}


def written(path: Path, rows: Any) -> Path:
    path.write_text(json.dumps(rows))
    return path


def test_boxes_are_read_back(tmp_path: Path) -> None:
    boxes = np.stack([BOX, BOX + 1, BOX / 3])
    predictions = [
        PredictedBoxes(scene="a", object="1", annotation="2", boxes=boxes, multiple=True, others=False),
        PredictedBoxes(scene="a", object="1", annotation="3", boxes=np.zeros((0, 2, 3))),
    ]
    write_referring_predictions(tmp_path / "p.json", predictions)
    for before, after in zip(predictions, read_referring_predictions(tmp_path / "p.json"), strict=True):
        assert before.key == after.key
        assert np.array_equal(before.boxes, after.boxes)
        assert (before.multiple, before.others) == (after.multiple, after.others)
    truth = [
        ReferredObject(scene="a", object="1", annotation="2", box=BOX / 3, multiple=True, others=False),
        ReferredObject(scene="a", object="1", annotation="3", box=None),
    ]
    write_referring_truth(tmp_path / "t.json", truth)
    again = read_referring_truth(tmp_path / "t.json")
    assert [item.key for item in again] == [item.key for item in truth]
    assert np.array_equal(again[0].box, BOX / 3)  # type: ignore[arg-type]
    assert again[1].box is again[1].multiple is None
    results, skipped = compare_box_files(tmp_path / "p.json", tmp_path / "t.json")
    assert (len(results), sum(skipped.values())) == (1, 1)


@pytest.mark.parametrize(
    ("boxes", "count"),
    [
        ({"bbox": CORNERS}, 1),
        ({"bbox": BOX.tolist()}, 1),
        ({"bboxes": [CORNERS, BOX.tolist()]}, 2),
        ({"bbox": CORNERS, "bboxes": [BOX.tolist(), CORNERS]}, 2),
        ({"bbox": None}, 0),
        ({"bboxes": []}, 0),
        ({"bbox": None, "bboxes": [CORNERS]}, 1),
        ({"bbox": CORNERS, "bboxes": None}, 1),
    ],
)
def test_boxes_are_read_as_corners_or_as_two_of_them(tmp_path: Path, boxes: dict[str, Any], count: int) -> None:
    (found,) = read_referring_predictions(written(tmp_path / "p.json", [KEY | boxes]))
    assert len(found.boxes) == count
    assert all(np.array_equal(box, BOX) for box in found.boxes)


def test_ids_are_the_same_as_numbers_and_as_text(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [SENTENCE])
    results, _ = compare_box_files(written(tmp_path / "p.json", [SENTENCE | {"object_id": 3, "ann_id": "00"}]), truth)
    assert referring_scores(results).top1["multiple"]["not_in_others"].acc50 == 1


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"a": 1}, "expected a list of entries, got an object"),
        ([3], "entry 0: expected an object, got 3"),
        ([SENTENCE, SENTENCE], "entry 1: sentence 0 about object 3 of scene0011_00 is there already"),
        ([KEY], "entry 0: bbox is missing"),
        ([SENTENCE | {"bbox": CORNERS[:7]}], "entry 0: bbox must be eight corners, or a lower and an upper one"),
        ([SENTENCE | {"bbox": [1, 2, 3, 4, 5, 6]}], "bbox must be eight corners"),
        ([SENTENCE | {"bbox": "box"}], "bbox must be eight corners"),
        ([SENTENCE | {"bbox": BOX[::-1].tolist()}], "entry 0: bbox: the lower corner .* is not below the upper"),
        ([SENTENCE | {"bbox": [[0, 0, float("nan")], [1, 1, 1]]}], "entry 0: bbox has nan where a finite number"),
        ([SENTENCE | {"bbox": [[0, 0, 0], [1, 1, float("inf")]]}], "bbox has inf where"),
        ([SENTENCE | {"bbox": [[0, 0, 0], [1, 1, 10**400]]}], "where a finite number is expected"),
        ([SENTENCE | {"bbox": [[0, 0, "0"], [1, 1, 1]]}], "bbox has '0' where"),
        ([SENTENCE | {"bbox": [[0, 0, True], [1, 1, 1]]}], "bbox has True where"),
        ([SENTENCE | {"scene_id": 7}], "entry 0: scene_id must be a word, got 7"),
        ([SENTENCE | {"scene_id": ""}], "scene_id must be printable text"),
        ([SENTENCE | {"scene_id": "x" * 10_000_000}], "scene_id must be printable text .* got 10,000,000 characters"),
        ([SENTENCE | {"object_id": "chair"}], "entry 0: object_id must be a whole number of 0 or more, got 'chair'"),
        ([SENTENCE | {"object_id": 1.0}], "object_id must be a whole number"),
        ([SENTENCE | {"object_id": -1}], "object_id must be a whole number"),
        ([SENTENCE | {"object_id": None}], "object_id must be a whole number of 0 or more, got nothing"),
        ([SENTENCE | {"ann_id": True}], "ann_id must be a whole number"),
        ([SENTENCE | {"others": 2}], "entry 0: others must be 0 or 1, got 2"),
        ([SENTENCE | {"unique_multiple": "unique"}], "unique_multiple must be 0 or 1, got 'unique'"),
    ],
)
def test_a_bad_entry_of_sentences_is_named(tmp_path: Path, rows: Any, message: str) -> None:
    path = written(tmp_path / "boxes.json", rows)
    for read in (read_referring_truth, read_referring_predictions):
        with pytest.raises(InputError, match=message) as error:
            read(path)
        assert str(path) in str(error.value)
        assert len(str(error.value)) < len(str(path)) + 250


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ({"bboxes": CORNERS}, r"bboxes\[0\] must be eight corners"),
        ({"bboxes": "all"}, "bboxes must be a list of at most 10,000 boxes, got 'all'"),
        ({"bboxes": [None] * 10_001}, "bboxes must be a list of at most 10,000 boxes, got 10,001"),
        ({"bbox": (BOX + 1).tolist(), "bboxes": [CORNERS]}, "bbox is not the first of bboxes"),
        ({"bbox": CORNERS, "bboxes": []}, "bbox is not the first of bboxes"),
    ],
)
def test_bad_lists_of_boxes_are_named(tmp_path: Path, boxes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"entry 0: {message}"):
        read_referring_predictions(written(tmp_path / "p.json", [KEY | boxes]))


def test_swapped_files_of_sentences_are_told(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [SENTENCE | {"description": "the chair"}])
    with pytest.raises(InputError, match="t.json: entry 0: unexpected key 'description'.*swapped"):
        read_referring_predictions(truth)
    with pytest.raises(
        InputError, match="p.json: entry 0: unexpected key 'bboxes'; predictions and truth may be swapped"
    ):
        compare_box_files(truth, written(tmp_path / "p.json", [KEY | {"bboxes": []}]))


def test_what_predictions_and_truth_do_not_share_is_told_with_the_file(tmp_path: Path) -> None:
    truth, other = written(tmp_path / "t.json", [SENTENCE]), written(tmp_path / "p.json", [SENTENCE | {"ann_id": 4}])
    with pytest.raises(InputError, match="p.json: sentence 4 about object 3 of scene0011_00 is predicted, and not in"):
        compare_box_files(other, truth)
    with pytest.raises(InputError, match="p.json: sentence 0 about object 3 of scene0011_00 has no prediction"):
        compare_box_files(written(tmp_path / "p.json", []), truth)
    assert len(compare_box_files(written(tmp_path / "p.json", []), truth, allow_missing=True)[0]) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable JSON file"),
        (b'[{"a": 1, "a": 2}]', "the key 'a' is twice in one entry"),
        (b"[" * 100_000, "not a readable JSON file"),
        (b'["\xff"]', "not a readable JSON file"),
        (pickle.dumps([SENTENCE]), "is a pickle, which is refused"),
    ],
)
def test_a_file_that_is_no_list_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    for read in (read_referring_truth, read_recognition_truth):
        with pytest.raises(InputError, match=f"a.json: {message}"):
            read(tmp_path / "a.json")


# Recognition


def test_names_are_read_back_and_scored(tmp_path: Path) -> None:
    truth = [NamedInstance(scene="a", object="1", name="chair"), NamedInstance(scene="a", object="2", name="dog")]
    answers = [RankedNames(scene="a", object="1", names=("bed", "chair")), RankedNames(scene="a", object="2", names=())]
    write_recognition_truth(tmp_path / "t.json", truth)
    write_recognition_predictions(tmp_path / "p.json", answers)
    assert read_recognition_truth(tmp_path / "t.json") == tuple(truth)
    assert read_recognition_predictions(tmp_path / "p.json") == tuple(answers)
    found, others = recognize_files(tmp_path / "p.json", tmp_path / "t.json", ("bed", "chair"))
    assert ([item.place for item in found], others) == ([2], 1)


def test_null_is_no_answer(tmp_path: Path) -> None:
    (found,) = read_recognition_predictions(written(tmp_path / "p.json", [NAMES | {"labels": None}]))
    assert found.names == ()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"labels": "chair"}, "labels must be a list of names, got 'chair'"),
        ({"labels": ["chair", 5]}, r"labels\[1\] must be a word, got 5"),
        ({"labels": ["chair\n"]}, r"labels\[0\] must be printable text"),
        ({"labels": ["x" * 10_000_000]}, r"labels\[0\] must be .* got 10,000,000 characters"),
        ({"object_id": 0.5}, "object_id must be a whole number"),
        ({"label": "chair"}, "unexpected key 'label'; predictions and truth may be swapped"),
    ],
)
def test_a_bad_entry_of_names_is_named(tmp_path: Path, row: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"p.json: entry 0: {message}"):
        read_recognition_predictions(written(tmp_path / "p.json", [NAMES | row]))


def test_a_prediction_without_names_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="entry 0: labels must be a list of names, got nothing"):
        read_recognition_predictions(written(tmp_path / "p.json", [{"scene_id": "a", "object_id": 1}]))


def test_entries_that_are_there_twice_swapped_or_of_no_class_are_named(tmp_path: Path) -> None:
    truth = written(tmp_path / "t.json", [INSTANCE])
    with pytest.raises(InputError, match="p.json: entry 1: object 3 of scene0011_00 is there already"):
        read_recognition_predictions(written(tmp_path / "p.json", [NAMES, NAMES]))
    with pytest.raises(
        InputError, match="p.json: entry 0: unexpected key 'labels'; predictions and truth may be swapped"
    ):
        recognize_files(truth, written(tmp_path / "p.json", [NAMES]), ("chair",))
    with pytest.raises(InputError, match="p.json: object 3 of scene0011_00 is predicted as 'bed', which is no class"):
        recognize_files(tmp_path / "p.json", truth, ("chair",))
