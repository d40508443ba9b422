"""Settings of words to points from a pose: the mode, opacities, thresholds and accuracy that are asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_samples import make_bank, render_features
from posed_words import (
    CHANNELS,
    NAMES,
    SPACE,
    ball_scene,
    memory_of,
    opaque_ball,
    plain_relevancy,
    scene_of,
    some_features,
    two_kinds,
    words,
)
from splats import front_camera, one_gaussian

from gsencoder.core.errors import InputError
from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, from_pose, pose_picture, view_picture
from gsencoder.infer.relevancy import GaussianProducts, Mode, ThresholdConfig, relevancy, word_directions
from gsencoder.render import blend
from gsencoder.types import QueryMemory, Scene

WORDS = NAMES[:3]
MODES: list[Mode] = ["centered", "raw"]


def small_scene(kind: str = "vectors") -> Scene:
    return ball_scene(kind, n=300)


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
        changed, bare = replace(memory, bank=bank, mean=mean), replace(scene, features={})
        field = FeatureField(bare, memory=changed, config=FromPoseConfig(stride=4))
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


@pytest.mark.parametrize(("width", "height"), [(61, 43), (2, 1), (1, 9)])
@pytest.mark.parametrize("stride", [1, 4])
def test_rays_at_a_stride_are_those_of_their_pixels(width: int, height: int, stride: int) -> None:
    gaussians, cameras = opaque_ball(), front_camera(width, height)
    full, strided = blend(gaussians, cameras), blend(gaussians, cameras, stride=stride)
    lattice = strided.lattice
    x = lattice.x0 + lattice.dx * np.arange(lattice.width)
    y = lattice.y0 + lattice.dy * np.arange(lattice.height)
    assert (x < width).all()
    assert (y < height).all()
    assert x[-1] + stride > width - stride
    of_pixels = full.alpha.reshape(full.shape)[np.ix_((y - 0.5).astype(int), (x - 0.5).astype(int))]
    torch.testing.assert_close(strided.alpha.reshape(strided.shape), of_pixels, rtol=0, atol=1e-6)


def test_at_a_stride_the_best_of_these_pixels_is_found() -> None:
    scene, cameras, text = ball_scene(), front_camera(), words()
    plain = plain_relevancy(scene, cameras, text, NAMES).reshape(len(NAMES), 43, 61)[:, 2::4, 2::4]
    for point, scores in zip(from_pose(scene, cameras, NAMES, text, FromPoseConfig(stride=4)), plain, strict=True):
        column, row = (point.pixel - 2.5).astype(int) // 4
        assert scores[row, column] == pytest.approx(scores.max(), abs=5e-6)


def test_large_views_are_looked_at_in_fewer_pixels_and_drawn_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.infer.from_pose.MAX_RAYS", 500)
    monkeypatch.setattr("gsencoder.infer.from_pose.MAX_SIDE", 40)
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    camera = front_camera()
    width, height = int(camera.widths[0]), int(camera.heights[0])
    field = FeatureField(scene_of(gaussians, features))
    stride = field.stride_in(camera, 0)
    assert stride > 1
    assert -(-width // stride) * -(-height // stride) <= 500 < -(-width // (stride - 1)) * -(-height // (stride - 1))
    seen = field.at(camera)
    (point,) = seen.find(NAMES[:1], words())
    whole = FeatureField(scene_of(gaussians, features), config=FromPoseConfig(stride=1)).at(camera)
    (exact,) = whole.find(NAMES[:1], words())
    np.testing.assert_allclose(point.position, exact.position, atol=0.1)
    rgb = view_picture(seen)
    assert max(rgb.shape[:2]) == 40
    (relevancy,) = seen.relevancy(NAMES[:1], words())
    small = pose_picture(rgb, seen, point, relevancy)
    monkeypatch.setattr("gsencoder.infer.from_pose.MAX_SIDE", 2000)
    large = pose_picture(view_picture(seen), seen, point, relevancy)
    # Both are enlarged to be legible; the ring is in one place.
    assert abs(small.shape[0] / small.shape[1] - large.shape[0] / large.shape[1]) < 0.1


def test_a_memory_answers_as_features_where_its_attention_is_exact() -> None:
    """Queries that fit one component each, and no pixel that blends two kinds."""
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    local = features.features - features.mean
    bank = make_bank(features.features, features.mean, SPACE)
    memory = QueryMemory(
        queries=local, weights=features.weights, projection=np.eye(CHANNELS, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.01, mean=features.mean,
    )  # fmt: skip
    scene, config = scene_of(gaussians, features), FromPoseConfig(stride=1)
    fields = (FeatureField(scene, memory=each, config=config).at(front_camera()) for each in (None, memory))
    plain, remembered = (field.relevancy(NAMES[:2], words()) for field in fields)
    assert np.isfinite(plain).any()
    np.testing.assert_allclose(remembered, plain, atol=1e-5)
    points = (from_pose(scene, front_camera(), NAMES[:2], words(), config, memory=each) for each in (None, memory))
    for a, b in zip(*points, strict=True):
        assert a.visible
        assert b.visible
        assert a.threshold == pytest.approx(b.threshold, abs=1e-5)
        np.testing.assert_allclose(b.position, a.position, atol=0.3)
    assert FeatureField(scene, memory=memory).stride_in(front_camera(), 0) == 4
