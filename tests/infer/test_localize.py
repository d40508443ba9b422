"""Words to boxes on a small made-up room: laws of localization, warnings, errors, and the files it writes."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rooms import splat

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer import localize as module
from gsencoder.infer.draw import EDGES, box_corners, write_boxes_ply
from gsencoder.infer.localize import LocalizeConfig, localization_to_json, localize
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.text.table import make_text_table, unit
from gsencoder.types import Box, FeatureBasis, GaussianFeatures, Localization, Scene

WORDS = ("mug", "chair", "lamp", "spoon", "rug", "door")
PLACES = {"mug": [(0.5, 0.5, 0.8)], "chair": [(2, 0.5, 0.4), (2, 2, 0.4), (0.5, 2.5, 0.4)], "lamp": [(3, 3, 1.2)]}
SIZES = {"mug": (0.1, 0.08, 0.12), "chair": (0.2, 0.2, 0.4), "lamp": (0.2, 0.2, 0.5)}
STEP = 0.02


def lattice(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    axes = [np.arange(a, b + 1e-9, STEP) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


RNG = np.random.default_rng(5)
TABLE = make_text_table(WORDS, unit(RNG.normal(size=(len(WORDS), 32)) * 0.5 + RNG.normal(size=32) * 1.5), "toy")


def make_room_scene(*, basis: bool = False, origin: tuple[float, float, float] = (0, 0, 0)) -> Scene:
    """A floor that is nothing, and solid boxes that are words; some Gaussians were never seen."""
    parts = [lattice(np.zeros(3), np.array([4, 4, 0.0]))]
    vectors = [np.tile(TABLE.mean / np.linalg.norm(TABLE.mean), (len(parts[0]), 1))]
    for word, places in PLACES.items():
        for center in places:
            half = np.array(SIZES[word]) / 2
            parts.append(lattice(np.array(center) - half, np.array(center) + half))
            vectors.append(np.tile(TABLE.embeddings[WORDS.index(word)], (len(parts[-1]), 1)))
    means, features = np.concatenate(parts).astype(np.float32), np.concatenate(vectors).astype(np.float32)
    weights = np.ones(len(means), np.float32)
    weights[:50] = 0
    features[:50] = 0
    space, stored_basis = replace(TABLE.space, teacher="labels"), None
    if basis:
        rows = np.linalg.svd(np.unique(features[50:], axis=0) - TABLE.mean, full_matrices=False)[2][:4]
        stored_basis = FeatureBasis(mean=TABLE.mean, components=rows.astype(np.float32), energy_kept=1.0, space=space)
        features = ((features - TABLE.mean) @ rows.T).astype(np.float32) * (weights > 0)[:, None]
    fused = GaussianFeatures(features=features, weights=weights, mean=TABLE.mean, space=space, basis=stored_basis)
    places = {"origin": np.array(origin, float), "up": np.array([0.0, 0, 1])}
    return Scene(name="room", gaussians=splat(means, 0.01), features={"toy": fused}, **places)


SCENE = make_room_scene()


def first(localization: Localization, word: str) -> Box:
    return next(box for box in localization.boxes if box.query == word)


@pytest.mark.parametrize("basis", [False, True])
def test_words_are_found_where_they_are(basis: bool) -> None:
    localization = localize(make_room_scene(basis=basis), ["mug", "lamp"], TABLE)
    for word in ("mug", "lamp"):
        box, center, size = first(localization, word), np.array(PLACES[word][0]), np.array(SIZES[word])
        assert np.abs(box.aabb_min - (center - size / 2)).max() <= STEP + 1e-6
        assert np.abs(box.aabb_max - (center + size / 2)).max() <= STEP + 1e-6
        assert box.score == pytest.approx(1, abs=1e-3)
        assert box.rank == 0


def test_every_object_of_a_name_has_a_box_and_ranks_count_up(monkeypatch: pytest.MonkeyPatch) -> None:
    localization = localize(SCENE, ["chair"], TABLE)
    assert [box.rank for box in localization.boxes] == [0, 1, 2]
    centers = np.round([box.center for box in localization.boxes], 1)
    assert {tuple(center[:2]) for center in centers.tolist()} == {(2, 0.5), (2, 2), (0.5, 2.5)}
    monkeypatch.setattr(module, "MAX_BOXES", 2)
    assert len(localize(SCENE, ["chair"], TABLE).boxes) == 2


def test_words_asked_together_are_found_as_they_are_one_by_one() -> None:
    together = localize(SCENE, ["mug", "chair", "lamp"], TABLE)
    alone = [box for word in together.queries for box in localize(SCENE, [word], TABLE).boxes]
    assert localization_to_json(together) == localization_to_json(replace(together, boxes=tuple(alone)))


def test_the_order_of_the_gaussians_does_not_matter(rng: np.random.Generator) -> None:
    order, fused = rng.permutation(len(SCENE.gaussians)), SCENE.features["toy"]
    features = replace(fused, features=fused.features[order], weights=fused.weights[order])
    moved = replace(SCENE, gaussians=SCENE.gaussians.select(order), features={"toy": features})
    a, b = localize(SCENE, ["mug", "lamp"], TABLE), localize(moved, ["mug", "lamp"], TABLE)
    for one, two in zip(a.boxes, b.boxes, strict=True):
        np.testing.assert_allclose(one.aabb_min, two.aabb_min, atol=1e-6)
        assert sorted(order[two.rows].tolist()) == one.rows.tolist()


def test_the_origin_is_added_back_in_double_precision() -> None:
    far = (1e6, -2e6, 3e6)
    near_box, far_box = (localize(each, ["mug"], TABLE).boxes[0] for each in (SCENE, make_room_scene(origin=far)))
    np.testing.assert_allclose(far_box.aabb_min - far, near_box.aabb_min, atol=1e-8)
    np.testing.assert_allclose(far_box.obb_center - far, near_box.obb_center, atol=1e-8)
    assert far_box.aabb_min.dtype == np.float64


def test_gaussians_never_seen_are_never_taken_and_have_no_relevancy() -> None:
    config = LocalizeConfig(threshold=ThresholdConfig(fixed=-1.0), min_probability=0.0)
    localization = localize(SCENE, ["mug", "chair"], TABLE, config)
    assert np.isnan(localization.relevancy[:, :50]).all()
    assert np.isfinite(localization.relevancy[:, 50:]).all()
    assert min(int(box.rows.min()) for box in localization.boxes) >= 50


def test_a_word_that_is_not_there_has_no_box_and_one_warning() -> None:
    with pytest.warns(SceneWarning, match="2 of 3 words have no box \\('spoon', 'door'\\)") as caught:
        localization = localize(SCENE, ["spoon", "mug", "door"], TABLE)
    assert len(caught) == 1
    assert {box.query for box in localization.boxes} == {"mug"}
    assert localization.thresholds.shape == (3,)


def test_a_scene_that_nothing_saw_has_no_boxes() -> None:
    fused = SCENE.features["toy"]
    blind = replace(SCENE, features={"toy": replace(fused, weights=np.zeros_like(fused.weights))})
    with pytest.warns(SceneWarning, match="1 of 1 words have no box"):
        localization = localize(blind, ["mug"], TABLE)
    assert localization.boxes == ()
    assert np.isnan(localization.thresholds).all()


@pytest.mark.parametrize("kind", ["relative", "otsu"])
def test_every_kind_of_threshold_finds_the_chairs(kind: str) -> None:
    config = LocalizeConfig(threshold=ThresholdConfig(kind=kind))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        localization = localize(SCENE, ["chair"], TABLE, config)
    assert any(np.linalg.norm(localization.boxes[0].center - center) < 0.05 for center in PLACES["chair"])


def test_contrast_finds_words_and_counts_the_negative_words_that_the_table_lacks(monkeypatch):
    config = LocalizeConfig(contrast=True, threshold=ThresholdConfig(kind="fixed", fixed=0.8))
    with pytest.warns(SceneWarning, match="negative words that toy does not know .*the mean of its words stands"):
        localization = localize(SCENE, ["mug", "lamp"], TABLE, config)
    assert np.linalg.norm(first(localization, "mug").center - PLACES["mug"][0]) < 0.02
    assert np.nanmin(localization.relevancy) >= 0
    assert np.nanmax(localization.relevancy) <= 1
    monkeypatch.setattr(module, "NEGATIVES", ("rug", "door"))
    assert np.linalg.norm(first(localize(SCENE, ["lamp"], TABLE, config), "lamp").center - PLACES["lamp"][0]) < 0.02


def test_a_scene_of_coincident_gaussians_is_one_place() -> None:
    n = 4
    gaussians = make_room_scene().gaussians
    piled = replace(gaussians.select(np.arange(n)), means=np.ones((n, 3), np.float32))
    vectors = np.tile(TABLE.embeddings[:1], (n, 1))
    fused = replace(SCENE.features["toy"], features=vectors, weights=np.ones(n, np.float32))
    box = localize(replace(SCENE, gaussians=piled, features={"toy": fused}), ["mug"], TABLE).boxes[0]
    assert len(box.rows) == n
    np.testing.assert_allclose(box.center, 1, atol=1e-6)


def test_wrong_questions_are_errors_of_one_line(no_jaxtyping: None) -> None:
    for queries in ([], [" "], "mug"):
        with pytest.raises(InputError, match="a list of one or more words"):
            localize(SCENE, queries, TABLE)
    with pytest.raises(InputError, match=r"near: .*mug"):
        localize(SCENE, ["mog"], TABLE)
    with pytest.raises(InputError, match="has no features; run `gsencoder fuse`"):
        localize(replace(SCENE, features={}), ["mug"], TABLE)
    with pytest.raises(InputError, match="has no Gaussians"):
        localize(Scene(name="empty"), ["mug"], TABLE)
    other = make_text_table(WORDS, TABLE.embeddings, "another")
    with pytest.raises(InputError, match=r"toy .*another"):
        localize(SCENE, ["mug"], other)


def test_of_several_feature_sets_one_must_be_named() -> None:
    both = replace(SCENE, features={"a": SCENE.features["toy"], "b": SCENE.features["toy"]})
    with pytest.raises(InputError, match="features of a, b; name one"):
        localize(both, ["mug"], TABLE)
    with pytest.raises(InputError, match="none of 'c'"):
        localize(both, ["mug"], TABLE, space="c")
    assert len(localize(both, ["mug"], TABLE, space="b").boxes) == 1


def test_json_holds_what_the_boxes_hold() -> None:
    localization = localize(SCENE, ["mug", "chair"], TABLE)
    listed = json.loads(json.dumps(localization_to_json(localization)))
    assert [one["query"] for one in listed] == ["mug", "chair", "chair", "chair"]
    for one, box in zip(listed, localization.boxes, strict=True):
        assert one["count"] == len(box.rows)
        assert one["aabb_min"] == box.aabb_min.tolist()
        assert one["obb"]["rotation"] == box.obb_rotation.tolist()
        assert one["obb"]["center"] == box.obb_center.tolist()
        assert one["obb"]["size"] == box.obb_size.tolist()


def test_the_ply_of_boxes_opens_in_other_programs_with_all_its_points(tmp_path: Path, open3d: Any) -> None:
    far = make_room_scene(origin=(1e6, 0, 0))
    localization = localize(far, ["mug", "chair"], TABLE)
    path = tmp_path / "boxes.ply"
    write_boxes_ply(path, far, localization)
    cloud = open3d.io.read_point_cloud(str(path))
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    assert len(points) == sum(len(box.rows) for box in localization.boxes) + len(localization.boxes) * (8 + 12 * 98)
    np.testing.assert_allclose(points[:8], box_corners(localization.boxes[0], oriented=False), atol=1e-9)
    assert len(np.unique(colors, axis=0)) == 3
    assert len(open3d.io.read_line_set(str(path)).lines) == 12 * len(localization.boxes)


def test_the_edges_of_a_box_are_its_twelve_sides() -> None:
    box = localize(SCENE, ["lamp"], TABLE).boxes[0]
    for oriented, size in ((False, box.aabb_max - box.aabb_min), (True, box.obb_size)):
        corners = box_corners(box, oriented=oriented)
        lengths = np.sort(np.linalg.norm(corners[EDGES[:, 0]] - corners[EDGES[:, 1]], axis=1))
        np.testing.assert_allclose(lengths, np.sort(np.repeat(size, 4)), atol=1e-9)


def test_no_boxes_make_an_empty_ply(tmp_path: Path) -> None:
    localization = localize(SCENE, ["mug"], TABLE)
    write_boxes_ply(tmp_path / "none.ply", Scene(name="x"), replace(localization, boxes=()))
    assert b"element vertex 0\n" in (tmp_path / "none.ply").read_bytes()
    with pytest.raises(InputError, match="of 0 Gaussians"):
        write_boxes_ply(tmp_path / "wrong.ply", Scene(name="x"), localization)
    assert not (tmp_path / "wrong.ply").exists()
