"""Words to points from a pose: beside the plain definition in float64, in moved worlds, and what is not visible."""

from dataclasses import replace

import numpy as np
import pytest
from feature_fields import plain_features
from posed_words import (
    CHANNELS,
    NAMES,
    SPACE,
    ball_scene,
    memory_of,
    opaque_ball,
    plain_relevancy,
    scene_of,
    two_kinds,
    words,
)
from scipy.spatial.transform import Rotation
from splats import front_camera, one_gaussian, random_rotation

from gsencoder.core.errors import InputError
from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, PosePoint, from_pose
from gsencoder.infer.relevancy import ThresholdConfig, relevancy
from gsencoder.text.table import make_text_table
from gsencoder.types import Cameras, Gaussians

EVERYTHING = FromPoseConfig(threshold=ThresholdConfig(kind="fixed", fixed=-1.0))


@pytest.mark.parametrize("kind", ["vectors", "basis", "table"])
def test_the_pixel_is_where_an_exhaustive_search_over_the_plain_definition_finds_it(kind: str) -> None:
    scene, cameras, text = ball_scene(kind), front_camera(), words()
    plain = plain_relevancy(scene, cameras, text, NAMES)
    assert (plain > -2).any()
    for point, scores in zip(from_pose(scene, cameras, NAMES, text), plain, strict=True):
        column, row = (point.pixel - 0.5).astype(int)
        at = row * 61 + column
        # Of pixels that are even but for rounding either may be found.
        assert scores[at] == pytest.approx(scores.max(), abs=5e-6)
        assert point.relevancy == pytest.approx(scores[at], abs=5e-6)
        assert (point.pixel % 1 == 0.5).all()


def test_maps_of_relevancy_are_the_plain_definition_and_nan_where_there_is_no_surface() -> None:
    scene, cameras, text = ball_scene(), front_camera(), words()
    maps = FeatureField(scene).at(cameras).relevancy(NAMES[:3], text)
    plain = plain_relevancy(scene, cameras, text, NAMES[:3]).reshape(maps.shape)
    assert np.array_equal(np.isnan(maps), plain == -2)
    assert 0 < np.isnan(maps).sum() < maps.size
    np.testing.assert_allclose(maps[plain > -2], plain[plain > -2], atol=5e-6)


def test_relevancy_is_from_minus_1_to_1_also_where_a_cosine_is_rounded_beyond() -> None:
    text = words()
    direction = text.encode(NAMES[:1]) - text.mean
    for sign in (1, -1):
        features = plain_features(np.repeat(text.mean + sign * direction, 60, axis=0), SPACE, mean=text.mean)
        maps = FeatureField(scene_of(opaque_ball(60), features)).at(front_camera()).relevancy(NAMES[:1], text)
        assert np.nanmax(sign * maps) == 1
        assert np.nanmin(sign * maps) > 1 - 1e-5


def test_depth_and_position_agree_with_the_camera_and_with_the_gaussians_of_the_pixel() -> None:
    text, origin = words(), (10.0, -20.0, 5.0)
    scene = ball_scene(origin=origin)
    seen = FeatureField(scene).at(front_camera())
    own = relevancy(scene.features["toy"], text.encode(NAMES), text.mean)
    both = [0, 0]
    for point, scores in zip(seen.find(NAMES, text), own, strict=True):
        pixels, depths = seen.cameras.project(point.position[None] - origin, 0)
        np.testing.assert_allclose(pixels[0], point.pixel, atol=1e-6)
        assert depths[0] == pytest.approx(point.depth, rel=1e-9)
        column, row = (point.pixel - 0.5).astype(int)
        at = row * 61 + column
        assert point.alpha == pytest.approx(float(seen.b.alpha[at]), abs=1e-6)
        entries = slice(int(seen.b.crow[at]), int(seen.b.crow[at + 1]))
        columns, weights = seen.b.col[entries].numpy(), seen.b.weight[entries].numpy()
        relevant = scores[columns] >= point.threshold
        both[int(relevant.any())] += 1
        chosen = relevant if relevant.any() else np.isfinite(scores[columns])
        depths = seen.b.depths.numpy()[columns]
        assert point.depth in depths[chosen]
        masks = depths < point.depth, depths <= point.depth
        before, until = (weights[chosen & mask].sum() / weights[chosen].sum() for mask in masks)
        assert before <= 0.5 + 1e-6
        assert until >= 0.5 - 1e-6
    assert both[1] > 0


def moved_world(gaussians: Gaussians, cameras: Cameras, R: np.ndarray, t: np.ndarray) -> tuple[Gaussians, Cameras]:
    """Gaussians and cameras after x ↦ R x + t."""
    turned = Rotation.from_matrix(R) * Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]])
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = R.T, -R.T @ t
    poses = cameras.cam_from_world.astype(np.float64) @ inverse
    quats = turned.as_quat()[:, [3, 0, 1, 2]].astype(np.float32)
    moved = replace(gaussians, means=(gaussians.means @ R.T + t).astype(np.float32), quats=quats)
    return moved, replace(cameras, cam_from_world=poses.astype(np.float32))


def test_a_world_that_is_rotated_and_moved_moves_the_positions(rng: np.random.Generator) -> None:
    scene, cameras, text = ball_scene(), front_camera(), words()
    R, t = random_rotation(rng), rng.normal(size=3)
    before = from_pose(scene, cameras, NAMES, text)
    others, looking = moved_world(scene.gaussians, cameras, R, t)
    after = from_pose(replace(scene, gaussians=others), looking, NAMES, text)
    same = [np.array_equal(a.pixel, b.pixel) for a, b in zip(before, after, strict=True)]
    assert np.mean(same) >= 0.9  # Rounding may prefer another of two even pixels.
    for a, b, alike in zip(before, after, same, strict=True):
        assert a.relevancy == pytest.approx(b.relevancy, abs=1e-4)
        if alike:
            np.testing.assert_allclose(b.position, R @ a.position + t, atol=1e-4)


def test_an_origin_a_thousand_kilometres_away_loses_nothing() -> None:
    cameras, text, origin = front_camera(), words(), (1e6, -2e6, 3e6)
    near, far = (from_pose(scene, cameras, NAMES, text) for scene in (ball_scene(), ball_scene(origin=origin)))
    for a, b in zip(near, far, strict=True):
        assert np.array_equal(a.pixel, b.pixel)
        np.testing.assert_allclose(b.position - origin, a.position, atol=1e-9)


def assert_nothing(point: PosePoint) -> None:
    assert not point.visible
    values = [point.relevancy, point.alpha, point.depth, *point.pixel, *point.position]
    assert np.isnan(values).all()


@pytest.mark.parametrize("case", ["behind", "faint", "never seen", "no Gaussians", "empty table"])
def test_where_no_surface_with_features_is_in_view_nothing_is_visible(case: str) -> None:
    gaussians = one_gaussian((0, 0, -2 if case == "behind" else 2), opacity=0.4 if case == "faint" else 0.9)
    mean, seen = np.ones(CHANNELS, np.float32), np.full(1, case != "never seen")
    features = plain_features(np.zeros((1, CHANNELS)), SPACE, seen, mean)
    if case == "no Gaussians":
        gaussians = gaussians.select(np.zeros(0, int))
        features = replace(features, features=features.features[:0], weights=features.weights[:0])
    if case == "empty table":
        index = np.full(1, -1, np.int32)
        features = replace(features, features=features.features[:0], weights=np.zeros(1, np.float32), index=index)
    scene = scene_of(gaussians, features)
    (point,) = from_pose(scene, front_camera(), NAMES[:1], words(), EVERYTHING)
    assert_nothing(point)
    assert np.isnan(FeatureField(scene).at(front_camera()).relevancy(NAMES[:1], words())).all()


def test_a_word_whose_object_is_behind_the_camera_is_not_visible_until_the_camera_turns() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2)), one_gaussian((0, 0, -2)))
    scene, camera = scene_of(gaussians, features), front_camera()
    ahead, behind = from_pose(scene, camera, NAMES[:2], words())
    assert ahead.visible
    assert ahead.relevancy == pytest.approx(1, abs=1e-5)
    assert not behind.visible
    assert behind.relevancy < behind.threshold
    turned = replace(camera, cam_from_world=np.diag([-1, 1, -1, 1]).astype(np.float32)[None])
    a, b = from_pose(scene, turned, NAMES[:2], words())
    assert (a.visible, b.visible) == (False, True)
    assert b.position[2] == pytest.approx(-2)


def test_a_word_behind_something_opaque_is_not_visible() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2), 0.5, 0.999), one_gaussian((0, 0, 4), 0.05, 0.999))
    front, hidden = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words())
    assert front.visible
    assert not hidden.visible


def test_the_depth_is_that_of_what_is_relevant_and_not_between_it_and_the_background() -> None:
    """Each ray ends partly at the near Gaussian: the mean of both depths is in empty space."""
    for opacity in (0.7, 0.3):
        near, far = one_gaussian((0, 0, 2), 3.0, opacity), one_gaussian((0, 0, 8), 9.0, 0.999)
        gaussians, features = two_kinds(near, far)
        point, _ = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words(), EVERYTHING)
        assert point.depth == (2.0 if opacity == 0.7 else 8.0)  # All reach this threshold.
        least = FromPoseConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.5))
        a, b = from_pose(scene_of(gaussians, features), front_camera(), NAMES[:2], words(), least)
        assert (a.depth, b.depth) == (2.0, 8.0)


def test_words_together_are_as_one_by_one() -> None:
    cameras, text, field = front_camera(), words(), FeatureField(ball_scene())
    frame = field.at(cameras)
    assert len(NAMES) > 16
    for together, name in zip(frame.find(NAMES, text), NAMES, strict=True):
        (alone,) = field.at(cameras).find([name], text)
        assert np.array_equal(together.pixel, alone.pixel)
        assert together.relevancy == pytest.approx(alone.relevancy, abs=1e-6)
        assert together.threshold == pytest.approx(alone.threshold, abs=1e-6)


def test_cameras_are_answered_in_order_each_with_all_words() -> None:
    gaussians, features = two_kinds(one_gaussian((0, 0, 2)), one_gaussian((0, 0, -2)))
    poses = np.stack([np.eye(4), np.diag([-1.0, 1, -1, 1])]).astype(np.float32)
    cameras = replace(front_camera().select([0, 0]), cam_from_world=poses)
    points = from_pose(scene_of(gaussians, features), cameras, NAMES[:2], words())
    assert [(point.camera, point.query) for point in points] == [(view, word) for view in (0, 1) for word in NAMES[:2]]
    assert [point.visible for point in points] == [True, False, False, True]


def test_wrong_input_is_refused() -> None:
    scene, cameras, text = ball_scene(), front_camera(), words()
    field = FeatureField(scene)
    with pytest.raises(InputError, match="one or more words"):
        field.at(cameras).find([], text)
    with pytest.raises(InputError, match="one or more words"):
        field.at(cameras).find("word a", text)
    with pytest.raises(InputError):
        field.at(cameras).find(["unheard of"], text)
    with pytest.raises(InputError):
        field.at(cameras).find(["a"], make_text_table(("a",), np.eye(1, CHANNELS, dtype=np.float32), "other"))
    with pytest.raises(InputError, match="queries of 3 Gaussians"):
        FeatureField(scene, memory=memory_of(3, components=4))
    with pytest.raises(InputError, match="view: expected 0 to 0"):
        field.at(cameras, 1)
    with pytest.raises(InputError, match="no features"):
        FeatureField(replace(scene, features={}))
    with pytest.raises(InputError, match="stride"):
        FromPoseConfig(stride=0)
