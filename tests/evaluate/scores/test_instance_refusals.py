"""Scenes and masks of instances that are refused."""

import numpy as np
import pytest
from instance_scenes import CLASSES, masks_of, truth_of

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.instances import (
    InstancePrediction,
    InstanceTruth,
    average_precision,
    instance_scores,
    match_instances,
    prediction_of_masks,
)


def test_precision_and_recall_of_no_predictions_are_0() -> None:
    assert average_precision(np.zeros(0), np.zeros(0, bool), 3) == (0, 0)


def test_scenes_and_sizes_that_differ_are_refused() -> None:
    with pytest.raises(InputError, match="of the scene 'b', and the truth of 'a'"):
        match_instances(truth_of(), masks_of(scene="b"), CLASSES)
    with pytest.raises(InputError, match="2,000 vertices, and the truth 3"):
        match_instances(InstanceTruth(scene="a", ids=np.zeros(3, np.int64)), masks_of(), CLASSES)


def test_a_scene_that_is_there_twice_is_refused() -> None:
    matches = match_instances(truth_of(), masks_of(), CLASSES)
    with pytest.raises(InputError, match="the scene a is there twice"):
        instance_scores([matches, matches], CLASSES)
    with pytest.raises(InputError, match="no scene"):
        instance_scores([], CLASSES)


def test_scenes_matched_with_and_without_classes_are_not_mixed() -> None:
    first = match_instances(truth_of(), masks_of(), CLASSES)
    second = match_instances(truth_of(scene="b"), masks_of(scene="b"), CLASSES, class_agnostic=True)
    with pytest.raises(InputError, match="different classes"):
        instance_scores([first, second], CLASSES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scores": np.array([np.nan])}, "prediction 0 has the score nan"),
        ({"scores": np.array([np.inf])}, "score inf"),
        ({"scores": np.zeros(2)}, "1 labels, 2 scores and 1 masks"),
        ({"offsets": np.array([0, 2])}, "do not divide their 3 vertices"),
        ({"vertices": np.array([1, 1, 2])}, "not ascending"),
        ({"vertices": np.array([1, 2, 9])}, "outside of the scene's 9"),
        ({"vertices": np.array([-1, 2, 3])}, "outside"),
    ],
)
def test_masks_that_contradict_themselves_are_refused(
    changes: dict[str, np.ndarray], message: str, no_jaxtyping: None
) -> None:
    good = {
        "vertices": np.array([1, 2, 3]),
        "offsets": np.array([0, 3]),
        "labels": np.array([4]),
        "scores": np.array([0.5]),
    }
    InstancePrediction(scene="a", num_vertices=9, **good)
    with pytest.raises(InputError, match=message):
        InstancePrediction(scene="a", num_vertices=9, **(good | changes))


def test_masks_of_several_and_of_no_vertices_are_taken() -> None:
    prediction = prediction_of_masks(
        "a", [np.zeros(3, bool), np.ones(3, bool), np.zeros(3, bool)], [4, 4, 4], [1.0, 2.0, 3.0], num_vertices=3
    )
    assert [prediction.mask(index).tolist() for index in range(3)] == [[], [0, 1, 2], []]
    with pytest.raises(InputError, match="mask 0 has 3 vertices, and the scene 4"):
        prediction_of_masks("a", [np.zeros(3, bool)], [4], [1.0], num_vertices=4)
