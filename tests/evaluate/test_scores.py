"""Scores of boxes and fields against cases whose answer is known."""

import time

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.files import csv_text
from gsencoder.core.process import memory_growth
from gsencoder.evaluate.benchmarks.localization import (
    Hit,
    aabb_iou,
    queryable_objects,
    score_boxes,
    scores,
    scores_by_name,
)
from gsencoder.fusion.basis import field_error
from gsencoder.types import Box, FeatureBasis, FeatureSpace, GaussianFeatures, Localization, Scene, SceneObject

SPACE = FeatureSpace(name="s", channels=4)
ONES = np.ones(3)


def box(query: str, rank: int, low: float, high: float) -> Box:
    return Box(
        query=query, rank=rank, score=1.0 - 0.1 * rank, probability=1.0, aabb_min=ONES * low,
        aabb_max=ONES * high, obb_center=ONES * (low + high) / 2, obb_rotation=np.eye(3),
        obb_size=ONES * (high - low), rows=np.arange(1),
    )  # fmt: skip


def thing(number: int, name: str | None, low: float, high: float, **facts: int | bool) -> SceneObject:
    return SceneObject(id=number, name=name, aabb_min=ONES * low, aabb_max=ONES * high, **facts)  # type: ignore[arg-type]


def field(features: np.ndarray, weights: np.ndarray, basis: FeatureBasis | None = None) -> GaussianFeatures:
    return GaussianFeatures(
        features=features.astype(np.float32), weights=weights.astype(np.float32),
        mean=np.array([1.0, 0, 0, 0], np.float32), space=SPACE, basis=basis,
    )  # fmt: skip


def test_iou_of_boxes_that_touch_overlap_and_coincide() -> None:
    zero, one = np.zeros(3), np.ones(3)
    assert aabb_iou(zero, one, zero, one) == 1
    assert aabb_iou(zero, one, one, 2 * one) == 0
    assert aabb_iou(zero, one, one / 2, 3 * one / 2) == pytest.approx(0.125 / 1.875)
    assert aabb_iou(zero, zero, zero, zero) == 0


def test_only_small_named_objects_that_were_seen_are_asked_for() -> None:
    seen = {"views": 9, "max_pixels": 900}
    objects = [
        thing(1, "mug", 0, 1, placed=True, **seen),
        thing(2, "table", 0, 1, placed=False, **seen),
        thing(3, None, 0, 1, placed=True, **seen),
        thing(4, "fork", 0, 1, placed=True, views=4, max_pixels=900),
        thing(5, "pen", 0, 1, placed=True, views=9, max_pixels=59),
    ]
    assert [one.id for one in queryable_objects(objects)] == [1]
    assert [one.id for one in queryable_objects(objects, min_views=4, min_pixels=59)] == [1, 4, 5]


def test_the_first_box_counts_and_any_object_of_its_name_may_be_the_one_found() -> None:
    cups = (thing(1, "cup", 0, 1), thing(2, "cup", 5, 6))
    # Out of order: ranks decide.
    boxes, one = (box("cup", 1, 0, 1), box("cup", 0, 5, 6.5)), np.ones(1, np.float32)
    localization = Localization(queries=("cup",), relevancy=one[None], thresholds=one, probabilities=one, boxes=boxes)
    hits = score_boxes(Scene(name="a", objects=cups), localization, cups)
    assert [hit.iou for hit in hits] == pytest.approx([1 / 1.5**3] * 2)
    assert [hit.oracle_iou for hit in hits] == [1, 1]
    row = scores(hits)
    assert [row[name] for name in ("acc_25", "acc_50", "oracle_acc_50")] == [1, 0, 1]


def test_scores_by_name_put_the_worst_first() -> None:
    hits = [Hit(scene="a", name=name, iou=iou, oracle_iou=1.0) for name, iou in (("x", 0.9), ("y", 0.1), ("x", 0.2))]
    assert list(scores_by_name(hits)) == ["y", "x"]
    assert scores(hits)["acc_25"] == pytest.approx(1 / 3)
    assert scores(hits)["oracle_acc_50"] == 1
    assert np.isnan(scores([])["mean_iou"])


def test_a_field_has_no_error_against_itself_whatever_the_basis(rng: np.random.Generator) -> None:
    values = rng.normal(size=(50, 4))
    whole = field(values, np.ones(50))
    axes = np.linalg.qr(rng.normal(size=(4, 4)))[0].astype(np.float32)
    mean = np.array([3.0, 1, 0, 2], np.float32)
    basis = FeatureBasis(mean=mean, components=axes, energy_kept=1.0, space=SPACE)
    coded = field((values - mean) @ axes.T, np.ones(50), basis)
    error = field_error(coded, whole)
    assert error.centered == pytest.approx(0, abs=1e-5)
    assert error.raw == pytest.approx(0, abs=1e-5)
    assert error.covered == 1


def test_centered_error_sees_what_raw_cosine_hides() -> None:
    values = np.array([[100.0, 1, 0, 0]])
    turned = np.array([[100.0, -1, 0, 0]])
    space_mean = {"mean": np.array([100.0, 0, 0, 0], np.float32), "space": SPACE, "basis": None}
    one, other = (
        GaussianFeatures(features=v.astype(np.float32), weights=np.ones(1, np.float32), **space_mean)  # type: ignore[arg-type]
        for v in (values, turned)
    )
    error = field_error(other, one)
    assert error.centered == pytest.approx(2)
    assert error.raw < 1e-3


def test_what_only_the_reference_saw_counts_as_missed(rng: np.random.Generator) -> None:
    values = rng.normal(size=(4, 4))
    error = field_error(field(values, np.array([1, 0, 1, 1])), field(values, np.array([1, 1, 0, 1])))
    assert error.covered == pytest.approx(2 / 3)
    assert error.centered == pytest.approx(0, abs=1e-6)
    assert error.total == pytest.approx(1 / 3, abs=1e-6)
    with pytest.raises(InputError, match="saw no Gaussian"):
        field_error(field(values, np.ones(4)), field(values, np.zeros(4)))
    with pytest.raises(InputError, match="expected 4 Gaussians"):
        field_error(field(values[:3], np.ones(3)), field(values, np.ones(4)))


def test_memory_growth_sees_an_array_that_is_gone_at_the_end() -> None:
    with memory_growth() as growth:
        large = np.ones(64 << 17)  # 64 MiB
        time.sleep(0)
        del large
    assert np.isnan(growth.mib) or 60 < growth.mib < 90


def test_tables_leave_missing_numbers_empty() -> None:
    text = csv_text([{"a": 1, "b": 0.123456789, "c": "x,y"}, {"a": None, "b": float("nan"), "c": ""}])
    assert text == 'a,b,c\n1,0.123457,"x,y"\n,,\n'
    assert csv_text([]) == ""
