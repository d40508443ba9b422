"""Classes of points: on Gaussians those of their features, on vertices a vote of the nearest ones."""

from dataclasses import replace

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.semantics import class_ids, predict_semantics
from gsencoder.evaluate.sources import LabeledPoints, labeled_points
from gsencoder.text.table import make_text_table
from gsencoder.types import GaussianFeatures, Gaussians, MeshLabels, Scene

CLASSES = ClassTable(names=("bed", "chair"), ids=(4, 5))
WORDS = make_text_table(list(CLASSES.names), np.eye(2, dtype=np.float32), "words")
BED, CHAIR, UNSEEN = 0, 1, 2


def line_of(kinds: list[int]) -> tuple[Gaussians, GaussianFeatures]:
    """Gaussians at x = 0, 1, 2, …, which are beds, chairs, or were never seen."""
    means = np.zeros((len(kinds), 3), np.float32)
    means[:, 0] = np.arange(len(kinds))
    vectors = np.array([[1, 0], [0, 1], [0, 0]], np.float32)
    features = GaussianFeatures(
        features=vectors[kinds], weights=(np.array(kinds) != UNSEEN).astype(np.float32),
        mean=np.full(2, 0.5, np.float32), space=WORDS.space,
    )  # fmt: skip
    return replace(random_gaussians(len(kinds)), means=means), features


def points_at(positions: list[float] | None, count: int) -> LabeledPoints:
    objects, rows = np.zeros(count, np.int32), np.arange(count)
    places = None if positions is None else np.array([[x, 0, 0] for x in positions], np.float64)
    return LabeledPoints(scene="s", objects=objects, names={}, gaussians=rows, positions=places)


def classes_at(positions: list[float] | None, kinds: list[int], voters: int) -> list[int]:
    gaussians, features = line_of(kinds)
    points = points_at(positions, len(kinds) if positions is None else len(positions))
    return predict_semantics(points, gaussians, features, CLASSES, WORDS, voters).tolist()


def test_a_vertex_has_the_class_of_most_of_the_nearest_gaussians() -> None:
    kinds = [BED, CHAIR, CHAIR, BED, BED]
    # The nearest one of 0.1 is a bed; of the nearest three two are chairs, and of all five three are beds.
    assert [classes_at([0.1], kinds, voters) for voters in (1, 3, 5, 25)] == [[4], [5], [4], [4]]


def test_gaussians_that_were_not_seen_do_not_vote_and_no_distance_is_too_large() -> None:
    # Without the two that were not seen, the nearest one of 0.1 is the chair at 2, and so are two of the nearest three.
    kinds = [UNSEEN, UNSEEN, CHAIR, CHAIR, BED, BED]
    assert [classes_at([0.1, 1e6], kinds, voters) for voters in (1, 3)] == [[5, 4], [5, 4]]
    assert classes_at([0.1], [UNSEEN, UNSEEN], 25) == [0]


def test_gaussians_that_are_the_points_have_their_own_class_however_many_vote() -> None:
    kinds = [BED, CHAIR, UNSEEN, CHAIR, BED]
    assert classes_at(None, kinds, 1) == classes_at(None, kinds, 25) == [4, 5, 0, 5, 4]


def test_vertices_lie_in_the_frame_of_the_gaussians_and_take_masks_from_the_nearest_one_that_is_near() -> None:
    gaussians, _ = line_of([BED, CHAIR])
    origin = np.array([10.0, 0, 0])
    mesh = MeshLabels(
        vertices=np.array([[10.05, 0, 0], [11, 0.09, 0], [11.5, 0, 0]], np.float32),
        instances=np.array([1, 2, 0], np.int32),
        objects=((1, "bed"), (2, "lamp")),
    )
    points = labeled_points(Scene(name="s", gaussians=gaussians, origin=origin), mesh)
    assert points.gaussians.tolist() == [0, 1, -1]
    assert points.positions == pytest.approx(mesh.vertices - origin)
    assert class_ids(points, CLASSES).tolist() == [4, 0, 0]


def test_a_class_may_have_the_id_0_among_labels_and_not_among_instances() -> None:
    classes = ClassTable(names=("bed", "chair"), ids=(0, 5))
    gaussians, features = line_of([BED, UNSEEN])
    points = points_at(None, 2)
    # Points of no class then have ScanNet++'s ignore label.
    assert predict_semantics(points, gaussians, features, classes, WORDS).tolist() == [0, -100]
    assert -100 in class_ids(points, classes).tolist()
