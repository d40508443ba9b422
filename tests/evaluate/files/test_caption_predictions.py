"""Predicted captions in Scan2Cap's files, and every way in which they can be wrong."""

import json
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.files import box_corners
from gsencoder.evaluate.benchmarks.captions import CaptionedObject, read_caption_predictions

OBJECTS = tuple(
    CaptionedObject(scene=scene, object_id=number, object_name="office_chair", captions=("sos a chair eos",))
    for scene, number in (("s0", 3), ("s0", 4), ("s1", 3))
)
CORNERS = box_corners((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))


def written(folder: Path, content: Any) -> Path:
    path = folder / "pred.json"
    path.write_text(json.dumps(content))
    return path


def row(**changes: Any) -> dict[str, Any]:
    return {"caption": "sos a chair eos", "box": CORNERS, "sem_prob": [0.5, 0.5], "obj_prob": [0.25, 0.75]} | changes


def test_captions_of_boxes_are_read_as_the_benchmark_takes_them(tmp_path: Path) -> None:
    content = {"s0": [row(), {"caption": "", "box": CORNERS[::-1]}], "s1": []}
    aabb = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    expected = {"s0": [("sos a chair eos", aabb), ("", aabb)]}
    assert read_caption_predictions(written(tmp_path, content), OBJECTS) == (expected, {})


def test_captions_of_given_objects_are_read_as_scan2cap_writes_them(tmp_path: Path) -> None:
    path = written(tmp_path, {"s0|3|office_chair": ["sos a chair eos"], "s1|3": ["b"]})
    assert read_caption_predictions(path, OBJECTS) == ({}, {("s0", 3): "sos a chair eos", ("s1", 3): "b"})
    assert read_caption_predictions(written(tmp_path, {}), OBJECTS) == ({}, {})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"s9": [row()]}, "'s9': is no scene of the truth"),
        ({"s0": row()}, "pred.json: s0 must be a list of objects with caption and box, got an object"),
        ({"s0": [row(), row(box=None)]}, r"s0\[1\]: box must be a list of 8 corners"),
        ({"s0": [row(caption=3)]}, r"s0\[0\]: caption must be a text, got 3"),
        ({"s9|3": ["a"]}, r"'s9\|3': is no object of the truth"),
        ({"s0|3|lamp": ["a"]}, "the truth calls this object 'office_chair'"),
        ({"s0|3": ["a"], "s0|3|office_chair": ["b"]}, r"is the same object as 's0\|3'"),
        ({"s0|3": []}, "has 0 captions, expected one"),
        ([{"ann_id": "1"}], "this is truth: were predictions and truth swapped"),
        ([], "expected an object from scenes"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_caption_predictions(written(tmp_path, content), OBJECTS)
    assert "pred.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scene_that_is_there_twice_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "pred.json").write_text('{"s0": [], "s0": []}')
    with pytest.raises(InputError, match="'s0' is there twice"):
        read_caption_predictions(tmp_path / "pred.json", OBJECTS)
