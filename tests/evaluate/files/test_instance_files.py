"""Files of instances and labels in ScanNet's formats: what is written is read back, and bad files are named."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from instance_scenes import write_text_prediction

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.files import write_integer_lines
from gsencoder.evaluate.benchmarks.files import scene_files
from gsencoder.evaluate.benchmarks.instances import (
    InstancePrediction,
    match_instance_files,
    prediction_of_masks,
    read_instance_prediction,
    write_instance_prediction,
)
from gsencoder.evaluate.benchmarks.semantics import count_label_files

CLASSES = ClassTable(names=("bed", "chair"), ids=(4, 5))
IDS = np.repeat([4001, 5001, 0], [150, 120, 30])
SIZE = len(IDS)


def prediction(scene: str = "scene0011_00") -> InstancePrediction:
    return prediction_of_masks(scene, [IDS == 4001, IDS == 5001], [4, 5], [0.1, 1 / 3], num_vertices=SIZE)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Predictions and truth of one scene, on which the predictions are perfect."""
    predictions, truth = tmp_path / "predictions", tmp_path / "truth"
    for folder in (predictions, truth):
        folder.mkdir()
    write_text_prediction(predictions, prediction())
    write_integer_lines(truth / "scene0011_00.txt", IDS)
    return predictions, truth


@pytest.mark.parametrize("form", ["text", "npz"])
def test_what_is_written_is_read_back(tmp_path: Path, form: str) -> None:
    write = write_text_prediction if form == "text" else write_instance_prediction
    write(tmp_path, prediction())
    path = next(tmp_path.glob("scene*"))
    again = read_instance_prediction(path, num_vertices=SIZE)
    assert again.scene == "scene0011_00"
    for name in ("labels", "scores"):
        assert np.array_equal(getattr(again, name), getattr(prediction(), name))
    assert all(map(np.array_equal, again.masks, prediction().masks))


def test_files_of_other_tools_are_read(folders: tuple[Path, Path]) -> None:
    # ScanNet's script writes its results beside predictions. Class ids may be written as 4.0; masks with any number,
    # with CRLF, and without an end of the last line.
    (folders[0] / "semantic_instance_evaluation.txt").write_text("class,class id,ap\n")
    (folders[0] / "masks").mkdir()
    (folders[0] / "masks" / "m.txt").write_bytes(b"\r\n".join(b"17" if own else b"0" for own in IDS == 4001))
    (folders[0] / "scene0011_00.txt").write_bytes(b"./masks/m.txt 4.0 1e-1\r\n")
    assert [files.scene for files in scene_files(*folders)] == ["scene0011_00"]
    prediction = read_instance_prediction(folders[0] / "scene0011_00.txt", num_vertices=SIZE)
    assert np.array_equal(prediction.masks[0], np.flatnonzero(IDS == 4001))
    assert (prediction.labels[0], prediction.scores[0]) == (4, 0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("4001\n5001\n", "line 1: expected a mask file, .* got '4001'; predictions and truth may be"),
        ("predicted_masks/scene0011_00_000.txt bed 1\n", "line 1: expected a whole number as the class id, got 'bed'"),
        ("predicted_masks/scene0011_00_000.txt 4 nan\n", "line 1: expected a finite number as the score, got 'nan'"),
        ("/etc/passwd 4 1\n", "line 1: the mask '/etc/passwd' is not below"),
        ("../truth/scene0011_00.txt 4 1\n", "is not below"),
        ("predicted_masks/other.txt 4 1\n", "other.txt: no such file"),
        (
            "predicted_masks/scene0011_00_000.txt 4 1\npredicted_masks/../predicted_masks/scene0011_00_000.txt 5 1\n",
            "line 2: the mask .* is that of line 1 already",
        ),
    ],
)
def test_a_bad_line_of_a_prediction_is_named(folders: tuple[Path, Path], text: str, message: str) -> None:
    path = folders[0] / "scene0011_00.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        list(match_instance_files(*folders, CLASSES))
    assert "scene0011_00.txt" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"0\n1\n", "line 1: the mask 'predicted_masks/scene0011_00_000.txt' has 2 lines, and the scene 300 vertices"),
        (b"0\nx\n", "line 2: expected one whole number, got 'x'"),
        (pickle.dumps(np.zeros(3)), "is a pickle, which is refused"),
    ],
)
def test_a_bad_mask_is_named(folders: tuple[Path, Path], content: bytes, message: str) -> None:
    (folders[0] / "predicted_masks" / "scene0011_00_000.txt").write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        list(match_instance_files(*folders, CLASSES))
    assert "scene0011_00_000.txt" in str(error.value)


def save_npz(path: Path, **changes: object) -> Path:
    arrays = {"pred_masks": np.ones((SIZE, 2), bool), "pred_classes": np.array([4, 5]), "pred_scores": np.ones(2)}
    np.savez(path, **(arrays | changes))  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pred_masks": np.ones((2, SIZE), bool)}, "pred_masks is 2 × 300, and the scene has 300 vertices.*transpose"),
        ({"pred_masks": np.ones((5, 2), bool)}, "pred_masks is 5 × 2, and the scene has 300 vertices; expected"),
        ({"pred_classes": np.array([4])}, "2 masks, 1 pred_classes and 2 pred_scores"),
        ({"pred_scores": np.array([1, np.nan])}, "prediction 1 has the score nan"),
        ({"pred_scores": np.array(["a", "b"])}, "pred_scores: expected 1 axis of floating point, got 2 of <U1"),
    ],
)
def test_a_bad_npz_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = save_npz(tmp_path / "a.npz", **changes)
    with pytest.raises(InputError, match=message) as error:
        read_instance_prediction(path, num_vertices=SIZE)
    assert str(path) in str(error.value)


# Folders


def test_scenes_of_one_folder_only_are_refused(folders: tuple[Path, Path]) -> None:
    write_text_prediction(folders[0], prediction("scene0022_00"))
    with pytest.raises(InputError, match="scene0022_00.txt: there is no truth of this scene"):
        scene_files(*folders)
    (folders[0] / "scene0022_00.txt").rename(folders[1] / "scene0022_00.txt")
    with pytest.raises(InputError, match="no prediction of 1 scene: scene0022_00"):
        scene_files(*folders)
    assert [files.scene for files in scene_files(*folders, scenes=["scene0011_00"])] == ["scene0011_00"]
    with pytest.raises(InputError, match="no truth of 1 scene to score: scene0033_00"):
        scene_files(*folders, scenes=["scene0011_00", "scene0033_00"])


def test_two_predictions_of_a_scene_are_refused(folders: tuple[Path, Path]) -> None:
    write_instance_prediction(folders[0], prediction())
    with pytest.raises(InputError, match="the scene scene0011_00 has both scene0011_00.npz and scene0011_00.txt"):
        list(match_instance_files(*folders, CLASSES))


def test_folders_without_files_of_scenes_are_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    with pytest.raises(InputError, match="empty: expected a folder"):
        scene_files(empty, folders[1])
    empty.mkdir()
    with pytest.raises(InputError, match="no predictions; expected SCENE.txt"):
        scene_files(empty, folders[1])
    with pytest.raises(InputError, match="no truth"):
        scene_files(folders[0], empty)
    with pytest.raises(InputError, match="same folder"):
        scene_files(folders[0], tmp_path / "truth" / ".." / "predictions")
    (empty / "scene0011_00.pth").write_bytes(b"\x80\x02.")
    with pytest.raises(InputError, match="pickles are refused"):
        scene_files(empty, folders[1])


# Semantic labels


@pytest.fixture
def label_folders(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("predictions", "truth"):
        (tmp_path / name).mkdir()
        write_integer_lines(tmp_path / name / "scene0011_00.txt", np.array([4, 4, 5, 0]))
    return tmp_path / "predictions", tmp_path / "truth"


@pytest.mark.parametrize(
    ("side", "text", "message"),
    [
        (0, "4\n4\n5\n", "the prediction has 3 labels, and the truth 4"),
        (0, "4\nbed\n5\n0\n", "line 2: expected one whole number, got 'bed'"),
        (1, "4001\n4002\n5001\n0\n", "ids such as 5001 are those of instances"),
        (1, "", "no vertices"),
    ],
)
def test_bad_labels_are_named(label_folders: tuple[Path, Path], side: int, text: str, message: str) -> None:
    path = label_folders[side] / "scene0011_00.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        list(count_label_files(*label_folders, CLASSES))
    assert str(path) in str(error.value)
