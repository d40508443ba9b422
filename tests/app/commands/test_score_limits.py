"""`gsencoder score` on files with nothing to score, ids of no class, and files that are not what they seem."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal, results_of

from gsencoder.app import main as cli

CLASSES = "id,name\n1,mug\n2,box\n"


def instance_files(
    folder: Path, truth: np.ndarray, masks: list[tuple[np.ndarray, int, float]], classes: str = CLASSES
) -> list[str]:
    """Files of one scene: ids of truth, and masks with a class and a score."""
    for name in ("truth", "predictions", "predictions/masks"):
        (folder / name).mkdir()
    (folder / "truth/s.txt").write_text("".join(f"{value}\n" for value in truth))
    lines = []
    for number, (mask, label, score) in enumerate(masks):
        (folder / f"predictions/masks/{number}.txt").write_text("".join(f"{int(value)}\n" for value in mask))
        lines.append(f"masks/{number}.txt {label} {score}\n")
    (folder / "predictions/s.txt").write_text("".join(lines))
    (folder / "classes.csv").write_text(classes)
    files = [f"{name}={folder / name}" for name in ("predictions", "truth")]
    return ["score", "instances", *files, f"out={folder / 'out'}"]


def blocks(*ids: int) -> np.ndarray:
    """A hundred vertices of each id."""
    return np.repeat(np.array(ids), 100)


def test_a_wall_that_nobody_predicts_costs_nothing(tmp_path: Path) -> None:
    truth = blocks(1001, 2001, 3001)
    words = instance_files(tmp_path, truth, [(truth == 3001, 3, 0.9)])
    assert cli.main([*words, "classes=scannet20", "quiet=true"]) == 0
    results = results_of(tmp_path / "out")
    assert (results["truths"], results["ap"]) == (1, 1.0)


def test_masks_of_classes_that_are_not_scored_are_counted(tmp_path: Path) -> None:
    truth = blocks(1001, 2001)
    words = instance_files(tmp_path, truth, [(truth == 1001, 1, 0.9), (truth == 2001, 7, 0.9)])
    assert cli.main([*words, f"classes={tmp_path / 'classes.csv'}", "quiet=true"]) == 0
    results = results_of(tmp_path / "out")
    assert (results["other_classes"], results["predictions"], results["ap"]) == (1, 1, 0.5)
    assert "Not counted: 1 mask with a class id that is none of the 2" in (tmp_path / "out/table.md").read_text()


def test_labels_of_no_class_are_refused_in_truth_and_counted_in_predictions(tmp_path, capsys):
    for name in ("truth", "predictions"):
        (tmp_path / name).mkdir()
    (tmp_path / "classes.csv").write_text(CLASSES)
    files = [f"{name}={tmp_path / name}" for name in ("predictions", "truth")]
    words = ["score", "semantics", *files, f"classes={tmp_path / 'classes.csv'}", f"out={tmp_path / 'out'}"]
    (tmp_path / "predictions/s.txt").write_text("1\n9\n2\n")
    (tmp_path / "truth/s.txt").write_text("9\n9\n0\n")
    assert "nothing to score: no vertex" in refusal(capsys, *words)
    (tmp_path / "truth/s.txt").write_text("1\n2\n2\n")
    assert cli.main([*words, "quiet=true"]) == 0
    assert results_of(tmp_path / "out")["unlabeled"] == 1
    assert "1 of 3 vertices that count are predicted as none" in (tmp_path / "out/table.md").read_text()


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
