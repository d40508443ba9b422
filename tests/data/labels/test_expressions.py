"""ScanRefer's JSON and Nr3D's CSV: what is read, and what is refused with one line that names the entry."""

import csv
import json
import pickle
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression, read_nr3d, read_scanrefer, write_scanrefer
from gsencoder.data.labels.files import MAX_TEXT, box_corners, corner_bounds

NR3D = {
    "assignmentid": "14",
    "stimulus_id": "scene0525_00-trash_can-3-8-10-14",
    "utterance": "The can, by the door.",
    "instance_type": "trash can",
    "scan_id": "scene0525_00",
    "target_id": "8",
    "tokens": "['the', 'can', 'by', \"o'clock\"]",
    "mentions_target_class": "True",
    "correct_guess": "FALSE",
}


def entry(**changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "scene0011_00",
        "object_id": "34",
        "object_name": "coffee_table",
        "ann_id": "1",
        "description": "A brown table. It is low.",
        "token": ["a", "brown", "table", ".", "it", "is", "low", "."],
    } | changes


def written(folder: Path, content: Any) -> Path:
    path = folder / "ScanRefer_filtered_val.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def nr3d(folder: Path, *rows: dict[str, str]) -> Path:
    path = folder / "nr3d.csv"
    with open(path, "w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path


def test_scanrefer_is_read_as_it_is_published(tmp_path: Path) -> None:
    corners = [[1, 0, 3], [1, -1, 3], [0, -1, 3], [0, 0, 3], [1, 0, 2], [1, -1, 2], [0, -1, 2], [0, 0, 2.5]]
    path = written(tmp_path, [entry(), entry(ann_id="2", object_id=7, bbox=corners)])
    first, second = read_scanrefer(path)
    assert first.key == ("scene0011_00", 34, "1")
    assert (first.object_name, first.text, first.tokens[1]) == ("coffee_table", "A brown table. It is low.", "brown")
    assert first.aabb is None
    assert second.aabb == ((0, -1, 2), (1, 0, 3))


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    expressions = (
        Expression(scene="s", object_id=0, object_name="x", annotation="0", text="é x", tokens=("é", "x"), aabb=None),
        Expression(
            scene="s",
            object_id=1,
            object_name="y",
            annotation="0",
            text="y",
            tokens=("y",),
            aabb=((0.25, -1.0, 2.0), (0.5, 1.0, 3.0)),
        ),
    )
    write_scanrefer(tmp_path / "a.json", expressions)
    assert read_scanrefer(tmp_path / "a.json") == expressions
    with pytest.raises(InputError, match="entries 0 and 2 have one id: sentence 0 about object 0 of s;"):
        write_scanrefer(tmp_path / "a.json", [*expressions, expressions[0]])


def test_corners_and_bounds_are_inverse() -> None:
    lower, upper = (0.0, 1.0, 2.0), (3.0, 4.0, 5.0)
    corners = box_corners(lower, upper)
    assert corner_bounds(corners, "here", "bbox") == (lower, upper)
    assert len({tuple(corner) for corner in corners}) == 8
    # utils/box_util.py begins at the upper corner and has the four of the top first.
    assert corners[0] == list(upper)
    assert [corner[2] for corner in corners] == [5.0] * 4 + [2.0] * 4


def test_nr3d_is_read_as_it_is_published(tmp_path: Path) -> None:
    (row,) = read_nr3d(nr3d(tmp_path, NR3D))
    assert row.key == ("scene0525_00", 8, "14")
    assert row.tokens == ("the", "can", "by", "o'clock")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"questions": []}, "expected a list of expressions.*swapped"),
        ([3], "entry 0: expected an object with scene_id.*got 3"),
        ([entry(), {"scene_id": "s", "aabb": []}], "entry 1: expected an expression.*got aabb: these are predictions"),
        ([entry(scene_id=3)], "entry 0: the scene must be a text, got 3"),
        ([entry(scene_id="../x")], "entry 0: the scene must be a name"),
        ([entry(scene_id="a\nb")], "entry 0: the scene must be a name"),
        ([entry(object_id="x")], "entry 0: object_id must be a whole number from 0, got 'x'"),
        ([entry(object_id=-1)], "entry 0: object_id must be a whole number"),
        ([entry(object_id=True)], "entry 0: object_id must be a whole number"),
        ([entry(ann_id=None)], "entry 0: ann_id must be a whole number or a text"),
        ([entry(description="")], "entry 0: description is empty"),
        ([entry(description="x" * (MAX_TEXT + 1))], "entry 0: description has 20,001 characters"),
        ([entry(token="a b")], "entry 0: token must be a list of texts, got 'a b'"),
        ([entry(token=["a", 3])], r"entry 0: token\[1\] must be a text, got 3"),
        ([entry(bbox=[[0, 0, 0]])], "entry 0: bbox must be a list of 8 corners"),
        ([entry(bbox=[[0, 0, 0]] * 7 + [[0, "1", 0]])], r"entry 0: bbox\[7\] must be a number, got '1'"),
        ([entry(bbox=[[0, 0, 0]] * 7 + [[0, float("nan"), 0]])], r"bbox\[7\] must be a finite number"),
        ([entry(), entry()], "entries 0 and 1 have one id: sentence 1 about object 34 of scene0011_00"),
        ([entry(), entry(ann_id="2", object_name="lamp")], "give object 34 of scene0011_00 different names"),
    ],
)
def test_a_wrong_entry_of_scanrefer_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_scanrefer(written(tmp_path, content))
    assert "\n" not in str(caught.value)
    assert "ScanRefer_filtered_val.json" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tokens": "__import__('os').getcwd()"}, "line 2: tokens must be a list of words"),
        ({"tokens": "[" * 9999}, "line 2: tokens must be a list of words"),
        ({"tokens": "[1]"}, r"line 2: tokens\[0\] must be a text"),
        ({"target_id": "8.5"}, "line 2: target_id must be a whole number"),
        ({"utterance": "x" * (MAX_TEXT + 1)}, "line 2: utterance has 20,001 characters"),
        ({"utterance": "x" * 200_000}, "not a readable CSV file"),
    ],
)
def test_a_wrong_row_of_nr3d_is_named(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_nr3d(nr3d(tmp_path, NR3D | changes))


def test_a_table_with_other_columns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its first line lacks tokens"):
        read_nr3d(nr3d(tmp_path, {name: value for name, value in NR3D.items() if name != "tokens"}))
    with pytest.raises(InputError, match="entries 0 and 1 have one id: sentence 14 about object 8 of scene0525_00"):
        read_nr3d(nr3d(tmp_path, NR3D, NR3D))
    (tmp_path / "nr3d.csv").write_text("a,b\n1\n")
    with pytest.raises(InputError, match="lacks assignmentid"):
        read_nr3d(tmp_path / "nr3d.csv")
    (tmp_path / "nr3d.csv").write_text("")
    with pytest.raises(InputError, match="lacks assignmentid"):
        read_nr3d(tmp_path / "nr3d.csv")
    path = nr3d(tmp_path, NR3D)
    path.write_text(path.read_text() + "1,2\n")
    with pytest.raises(InputError, match="line 3 has 2 cells"):
        read_nr3d(path)


class Harmful:
    """A pickle of it makes a file when it is loaded."""

    def __reduce__(self) -> tuple[Any, tuple[str, str]]:
        return (open, (self.path, "w"))

    def __init__(self, path: Path) -> None:
        self.path = str(path)


@pytest.mark.parametrize("name", ["truth.json", "truth.pkl", "truth.p"])
def test_pickles_are_refused_and_not_loaded(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(pickle.dumps(Harmful(tmp_path / "harm")))
    for read in (read_scanrefer, read_nr3d):
        with pytest.raises(InputError, match="is a pickle"):
            read(tmp_path / name)
    assert not (tmp_path / "harm").exists()


def test_files_that_are_none_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_scanrefer(tmp_path / "none.json")
    with pytest.raises(InputError, match="is a folder"):
        read_scanrefer(tmp_path)
    (tmp_path / "a.json").write_text('[{"scene_id": "a", "scene_id": "b"}]')
    with pytest.raises(InputError, match="'scene_id' is there twice"):
        read_scanrefer(tmp_path / "a.json")
    (tmp_path / "a.json").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not a readable JSON file"):
        read_scanrefer(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="not a readable JSON file"):
        read_scanrefer(tmp_path / "a.json")


def test_no_expressions_are_read_as_none(tmp_path: Path) -> None:
    assert read_scanrefer(written(tmp_path, [])) == ()
