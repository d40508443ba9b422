"""Files of instances: ScanNet's submission format and truth, and .npz in place of the pickles that others use.

Truth is SCENE.txt with one number a line: class id · 1000 + number of the instance, and 0 for none. A prediction is
SCENE.txt with "mask file, class id, score" in each line, where the mask file lies below the same folder and has one
number a line, 0 outside of the mask; or SCENE.npz with pred_masks (bool, vertices × masks), pred_classes (integers) and
pred_scores (floating point), as OpenMask3D and Mask3D name them.
"""

import io
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError, about
from gsencoder.core.files import write_bytes
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.files import mask_bytes, read_checked_text, read_mask, read_whole_numbers
from gsencoder.evaluate.files.scan_truth import instances_of_scan
from gsencoder.evaluate.files.scene_folders import scene_files
from gsencoder.evaluate.scores.instance_masks import InstancePrediction, InstanceTruth, prediction_of_masks
from gsencoder.evaluate.scores.instance_matches import MIN_REGION, SceneMatches, match_instances

MASK_FOLDER = "predicted_masks"
MAX_LIST_BYTES = 64 << 20
MAX_PATH = 1000
"""Largest number of characters of the path of a mask."""
"""Largest size of the list of a scene's masks."""
MAX_ID = 2**31 - 1


def match_instance_files(
    predictions: Path,
    truth: Path,
    classes: ClassTable,
    *,
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    class_agnostic: bool = False,
    min_region: int = MIN_REGION,
) -> Iterator[SceneMatches]:
    """Matches the predictions of a folder with the truth of another, one scene in memory at a time.

    Args:
        predictions: folder of SCENE.txt or SCENE.npz.
        truth: folder of SCENE.txt, or of ScanNet's scans.
        classes: that are scored.
        scenes: to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
        class_agnostic: leave the classes out of account.
        min_region: smallest number of vertices that counts.

    Raises:
        InputError: files that cannot be used, or scenes that are in one folder only.
    """
    suffixes, scans = (".txt", ".npz"), raw_ids is not None
    for files in scene_files(predictions, truth, scenes=scenes, suffixes=suffixes, scans=scans):
        if raw_ids is None:
            instances = read_instance_truth(files.truth)
        else:
            instances = instances_of_scan(files.truth, raw_ids, classes)
        masks = read_instance_prediction(files.prediction, num_vertices=len(instances.ids))
        with about(files.prediction):
            matches = match_instances(instances, masks, classes, class_agnostic=class_agnostic, min_region=min_region)
        yield matches


def read_instance_truth(path: Path) -> InstanceTruth:
    """Reads the instance of each vertex; the scene is named as the file.

    Raises:
        InputError: unreadable, empty, or a line that is no whole number.
    """
    ids = read_whole_numbers(path, hint="; predictions and truth may be swapped")
    if not len(ids):
        raise InputError(f"{path}: no vertices; expected one whole number for each")
    return InstanceTruth(scene=path.stem, ids=ids)


def read_instance_prediction(path: Path, *, num_vertices: int) -> InstancePrediction:
    """Reads the masks of a scene, which is named as the file.

    Args:
        path: SCENE.txt or SCENE.npz.
        num_vertices: of the scene.

    Raises:
        InputError: unreadable; a mask that is missing, listed twice, outside of the folder or of another length; a
            class id that is no whole number; a score that is no finite number.
    """
    if path.suffix == ".npz":
        return _read_npz(path, num_vertices)
    lines = read_checked_text(path, max_bytes=MAX_LIST_BYTES).splitlines()
    first: dict[Path, int] = {}
    vertices, labels, scores = [], [], []
    for number, line in enumerate(lines, start=1):
        where, words = f"{path}: line {number}", line.split()
        if len(words) != 3:
            hint = "; predictions and truth may be swapped" if len(words) == 1 else ""
            raise InputError(f"{where}: expected a mask file, a class id and a score, got {line[:60]!r}{hint}")
        if len(words[0]) > MAX_PATH:
            raise InputError(f"{where}: expected a mask file, got a name of {len(words[0]):,} characters")
        file = PurePosixPath(words[0])
        try:
            mask_path = (path.parent / file).resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"{where}: the mask {words[0][:80]!r} cannot be read: {error}") from error
        if file.is_absolute() or not mask_path.is_relative_to(path.parent.resolve()):
            raise InputError(f"{where}: the mask {words[0][:80]!r} is not below {path.parent}")
        if mask_path in first:
            raise InputError(f"{where}: the mask {words[0][:80]!r} is that of line {first[mask_path]} already")
        first[mask_path] = number
        labels.append(_label(words[1], where))
        scores.append(_score(words[2], where))
        with about(where):
            mask = read_mask(mask_path)
        if len(mask) != num_vertices:
            raise InputError(
                f"{where}: the mask {words[0][:80]!r} has {len(mask):,} lines, and the scene {num_vertices:,} vertices"
            )
        vertices.append(np.flatnonzero(mask))
    return InstancePrediction(
        scene=path.stem,
        num_vertices=num_vertices,
        vertices=np.concatenate([np.zeros(0, np.int64), *vertices]),
        offsets=np.cumsum([0, *(len(part) for part in vertices)], dtype=np.int64),
        labels=np.array(labels, np.int64),
        scores=np.array(scores, np.float64),
    )


def write_instance_prediction(
    folder: Path, prediction: InstancePrediction, *, form: Literal["text", "npz"] = "text"
) -> Path:
    """Writes the masks of a scene as ScanNet's script takes them, or as one .npz, which is much smaller.

    Args:
        folder: an existing one, for all scenes.
        prediction: of one scene.
        form: "text" writes SCENE.txt and predicted_masks/SCENE_000.txt, …; "npz" writes SCENE.npz.

    Returns:
        The file SCENE.txt or SCENE.npz.
    """
    masks = np.zeros((len(prediction.labels), prediction.num_vertices), bool)
    for index, mask in enumerate(masks):
        mask[prediction.mask(index)] = True
    if form == "npz":
        data = io.BytesIO()
        np.savez_compressed(data, pred_masks=masks.T, pred_classes=prediction.labels, pred_scores=prediction.scores)
        write_bytes(folder / f"{prediction.scene}.npz", data.getvalue())
        return folder / f"{prediction.scene}.npz"
    (folder / MASK_FOLDER).mkdir(exist_ok=True)
    lines = []
    for index, mask in enumerate(masks):
        name = f"{MASK_FOLDER}/{prediction.scene}_{index:03d}.txt"
        (folder / name).write_bytes(mask_bytes(mask))
        lines.append(f"{name} {prediction.labels[index]} {float(prediction.scores[index])!r}\n")
    write_bytes(folder / f"{prediction.scene}.txt", "".join(lines).encode())
    return folder / f"{prediction.scene}.txt"


def _read_npz(path: Path, num_vertices: int) -> InstancePrediction:
    arrays = read_npz(path, {"pred_masks": ("b", 2), "pred_classes": ("i", 1), "pred_scores": ("f", 1)})
    masks, labels, scores = arrays["pred_masks"], arrays["pred_classes"], arrays["pred_scores"]
    if len(masks) != num_vertices:
        turned = "; transpose it" if masks.shape[1] == num_vertices else ""
        raise InputError(
            f"{path}: pred_masks is {masks.shape[0]:,} × {masks.shape[1]:,}, and the scene has {num_vertices:,} "
            f"vertices; expected vertices × masks{turned}"
        )
    if not len(labels) == len(scores) == masks.shape[1]:
        raise InputError(
            f"{path}: {masks.shape[1]} masks, {len(labels)} pred_classes and {len(scores)} pred_scores; expected as "
            "many of each"
        )
    with about(path):
        return prediction_of_masks(
            path.stem, np.ascontiguousarray(masks.T), labels.tolist(), scores.tolist(), num_vertices=num_vertices
        )


def _label(word: str, where: str) -> int:
    """A class id; ScanNet's script takes 5.0 for 5."""
    value = _number(word)
    if value is None or not abs(value) <= MAX_ID or value != int(value):
        raise InputError(f"{where}: expected a whole number as the class id, got {word[:40]!r}")
    return int(value)


def _score(word: str, where: str) -> float:
    value = _number(word)
    if value is None or not np.isfinite(value):
        raise InputError(f"{where}: expected a finite number as the score, got {word[:40]!r}")
    return value


def _number(word: str) -> float | None:
    try:
        # Python reads 1_000 as a number, and other tools do not.
        return None if "_" in word else float(word)
    except ValueError:
        return None
