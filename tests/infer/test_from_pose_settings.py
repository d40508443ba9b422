"""Settings of words to points from a pose: the mode, opacities, thresholds and accuracy that are asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_samples import render_features
from posed_words import CHANNELS, NAMES, SPACE, memory_of, opaque_ball, scene_of, some_features, words
from splats import front_camera

from gsencoder.core.errors import InputError
from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, from_pose
from gsencoder.infer.relevancy import GaussianProducts, Mode, ThresholdConfig, relevancy, word_directions
from gsencoder.render import blend
from gsencoder.types import Scene

WORDS = NAMES[:3]
MODES: list[Mode] = ["centered", "raw"]


def small_scene(kind: str = "vectors") -> Scene:
    return scene_of(opaque_ball(300), some_features(300, kind))


def cosines(rows: np.ndarray, mean: np.ndarray, mode: Mode) -> np.ndarray:
    """Of the words with rows of features, by the definition."""
    local = rows.astype(np.float64) - (mean if mode == "centered" else 0)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return np.asarray(word_directions(words().encode(WORDS), words().mean, mode) @ local.T)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("basis", [True, False])
def test_cosines_at_pixels_and_thresholds_are_centered_or_raw_as_they_are_asked_for(mode: Mode, basis: bool) -> None:
    scene, text = small_scene("basis" if basis else "vectors"), words()
    features = scene.features["toy"]
    field = FeatureField(scene, config=FromPoseConfig(mode=mode, threshold=ThresholdConfig(kind="relative")))
    seen = field.at(front_camera())
    own = seen.b.render(torch.from_numpy(features.seen.astype(np.float32))).numpy()
    decoded = np.where(features.seen[:, None], features.decode(), np.float32(0))
    blended = seen.b.render(torch.from_numpy(decoded)).numpy() / np.maximum(own, 1e-9)[:, None]
    maps = seen.relevancy(WORDS, text).reshape(len(WORDS), -1)
    opaque = own >= 0.5
    assert opaque.sum() > 100
    np.testing.assert_allclose(maps[:, opaque], cosines(blended[opaque], features.mean, mode), atol=1e-4)
    expected = relevancy(features, text.encode(WORDS), text.mean, mode=mode)
    directions = word_directions(text.encode(WORDS), text.mean, mode)
    np.testing.assert_allclose(GaussianProducts(features, mode).cosines(directions), expected, atol=1e-5)
    for point, scores in zip(seen.find(WORDS, text), expected, strict=True):
        assert point.threshold == pytest.approx(0.7 * np.nanmax(scores), abs=1e-5)


@pytest.mark.parametrize(
    ("mode", "scoring", "components"),
    [("centered", "centered", 9), ("raw", "cosine", 9), ("centered", "dot", 90), ("raw", "centered", 90)],
)
def test_a_memory_is_compared_by_centered_or_by_raw_cosines_however_its_queries_are(mode, scoring, components):
    scene, text = small_scene(), words()
    memory = memory_of(300, scoring=scoring, components=components)
    field = FeatureField(replace(scene, features={}), memory=memory, config=FromPoseConfig(mode=mode, stride=1))
    maps = field.at(front_camera()).relevancy(WORDS, text).reshape(len(WORDS), -1)
    opaque = np.isfinite(maps[0])
    assert opaque.sum() > 100
    rendered, _ = render_features(memory, blend(scene.gaussians, front_camera()))
    np.testing.assert_allclose(maps[:, opaque], cosines(rendered[opaque], memory.mean, mode), atol=1e-4)


def test_cosines_of_gaussians_are_relevancies_also_in_chunks_and_near_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of features that are words, whose cosines rounding would lead beyond 1, and of features at the mean."""
    features = some_features(295, "vectors")
    values = features.features.copy()
    rng = np.random.default_rng(3)
    along = words().encode(WORDS)[rng.integers(0, 3, 295)] - words().mean
    values[:200] = features.mean + along[:200] * rng.uniform(0.5, 2, (200, 1))
    values[200:250] = features.mean * np.float32(1 + 1e-6)
    values[~features.seen] = 0
    features = replace(features, features=values.astype(np.float32))
    expected = relevancy(features, words().encode(WORDS), words().mean)
    monkeypatch.setattr("gsencoder.infer.relevancy.CHUNK_BYTES", 8 * CHANNELS * 42)
    directions = word_directions(words().encode(WORDS), words().mean)
    cosines = GaussianProducts(features).cosines(directions)
    near_mean = np.arange(295) // 50 == 4
    np.testing.assert_allclose(cosines[:, ~near_mean], expected[:, ~near_mean], atol=1e-5)
    np.testing.assert_allclose(cosines[:, near_mean], expected[:, near_mean], atol=1e-4)
    assert np.nanmax(np.abs(cosines[:, near_mean])) < 1e-2
    without_mean = replace(features, mean=np.zeros(CHANNELS, np.float32), features=along * features.seen[:, None])
    assert np.nanmax(GaussianProducts(without_mean).cosines(directions)) == 1


def test_attended_features_much_shorter_than_the_mean_have_no_direction() -> None:
    """As with features of Gaussians: a thousandth of the mean's length is rounding."""
    scene, text = small_scene(), words()
    memory = memory_of(300)
    mean = memory.mean * np.float32(100)
    for length, least, most in ((1e-6, 0.0, 1e-3), (1.0, 0.2, 1.0)):
        components = mean + np.float32(length) * words().encode(WORDS)[[0] * 9] * np.float32(100)
        bank = replace(memory.bank, components=components.astype(np.float32), mean=mean)
        field = FeatureField(
            replace(scene, features={}),
            memory=replace(memory, bank=bank, mean=mean),
            config=FromPoseConfig(stride=4),
        )
        largest = np.nanmax(np.abs(field.at(front_camera()).relevancy(WORDS, text)))
        assert least <= largest <= most


def test_a_relevancy_that_is_the_threshold_is_visible() -> None:
    scene, text = small_scene(), words()
    (point,) = from_pose(scene, front_camera(), WORDS[:1], text)
    for fixed, visible in ((point.relevancy, True), (float(np.nextafter(point.relevancy, 2)), False)):
        config = FromPoseConfig(threshold=ThresholdConfig(kind="fixed", fixed=fixed))
        (again,) = from_pose(scene, front_camera(), WORDS[:1], text, config)
        assert again.relevancy == point.relevancy
        assert again.visible == visible


def test_a_memory_of_another_text_encoder_than_the_scenes_features_is_refused() -> None:
    scene = small_scene()
    memory = memory_of(300)
    assert FeatureField(scene, memory=memory).memory is memory
    other = replace(memory, bank=replace(memory.bank, space=replace(SPACE, text_encoder="other")))
    with pytest.raises(InputError, match="other"):
        FeatureField(scene, memory=other)


def test_a_camera_is_named_by_its_number_also_where_it_is_counted_from_the_end() -> None:
    scene, one = small_scene(), front_camera()
    two = replace(
        one,
        cam_from_world=one.cam_from_world.repeat(2, 0),
        Ks=one.Ks.repeat(2, 0),
        widths=one.widths.repeat(2),
        heights=one.heights.repeat(2),
    )
    (last,) = FeatureField(scene).at(two, -1).find(WORDS[:1], words())
    (same,) = FeatureField(scene).at(two, 1).find(WORDS[:1], words())
    assert last.camera == same.camera == 1
    np.testing.assert_array_equal(last.position, same.position)
