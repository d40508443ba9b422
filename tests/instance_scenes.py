"""Truths and masks of instances by runs of vertices, and their scores."""

from pathlib import Path

import numpy as np

from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.instances import (
    InstancePrediction,
    InstanceScores,
    instance_scores,
    match_instances,
    prediction_of_masks,
)

CLASSES = ClassTable(
    names=("bed", "chair", "sofa"), ids=(4, 5, 6), groups={"head": ("bed",), "common": ("chair", "sofa"), "tail": ()}
)
BED, CHAIR, SOFA = 4, 5, 6
VERTICES = 2000
Mask = tuple[int, int, int, float]
"""First vertex, one past the last, class id, score."""


def truth_of(*parts: tuple[int, int, int]) -> np.ndarray:
    """A scene of 2,000 vertices with runs of vertices (first, one past the last, id); the others have the id 0."""
    ids = np.zeros(VERTICES, np.int64)
    for first, last, number in parts:
        ids[first:last] = number
    return ids


def masks_of(*masks: Mask, scene: str = "a") -> InstancePrediction:
    vertices = np.arange(VERTICES)
    return prediction_of_masks(
        scene, [(vertices >= first) & (vertices < last) for first, last, _, _ in masks],
        [label for _, _, label, _ in masks], [score for _, _, _, score in masks], num_vertices=VERTICES,
    )  # fmt: skip


def scored(truth: np.ndarray, *masks: Mask, class_agnostic: bool = False) -> InstanceScores:
    matches = match_instances(truth, masks_of(*masks), CLASSES, class_agnostic=class_agnostic)
    return instance_scores([matches], CLASSES)


def aps(scores: InstanceScores) -> tuple[float, float, float]:
    return scores.overall["ap"], scores.overall["ap_50"], scores.overall["ap_25"]


def write_text_prediction(folder: Path, prediction: InstancePrediction) -> Path:
    """Writes the masks of a scene as ScanNet's script takes them."""
    (folder / "predicted_masks").mkdir(exist_ok=True)
    lines = []
    for index, rows in enumerate(prediction.masks):
        name = f"predicted_masks/{prediction.scene}_{index:03d}.txt"
        mask = np.isin(np.arange(prediction.num_vertices), rows)
        (folder / name).write_text("".join(f"{int(inside)}\n" for inside in mask))
        lines.append(f"{name} {prediction.labels[index]} {float(prediction.scores[index])!r}\n")
    (folder / f"{prediction.scene}.txt").write_text("".join(lines))
    return folder / f"{prediction.scene}.txt"
