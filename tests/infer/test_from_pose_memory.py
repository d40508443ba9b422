"""Words to points from a pose where the features are a memory."""

import numpy as np
import pytest
from posed_words import CHANNELS, NAMES, SPACE, memory_of, opaque_ball, scene_of, two_kinds, words
from splats import front_camera, one_gaussian

from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, from_pose
from gsencoder.infer.relevancy import word_directions
from gsencoder.memory.attention import render_features
from gsencoder.render import blend
from gsencoder.types import MemoryBank, QueryMemory, Scene


@pytest.mark.parametrize("components", [9, 90])
def test_the_features_of_a_memory_are_those_that_blended_queries_attend_to(components: int) -> None:
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    memory = memory_of(len(gaussians), components=components)
    scene = Scene(name="toy", gaussians=gaussians)
    field = FeatureField(scene, memory=memory, config=FromPoseConfig(stride=1))
    maps = field.at(cameras).relevancy(NAMES, text)
    plain, _ = render_features(memory, blend(gaussians, cameras))
    local = plain.astype(np.float64) - memory.mean
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    expected = (word_directions(text.encode(NAMES), text.mean) @ local.T).reshape(maps.shape)
    opaque = np.isfinite(maps)
    assert opaque.any()
    np.testing.assert_allclose(maps[opaque], expected[opaque], atol=1e-4)
    for point in field.at(cameras).find(NAMES, text):
        column, row = (point.pixel - 0.5).astype(int)
        scores = np.where(opaque, expected, -2)[NAMES.index(point.query)]
        assert scores[row, column] == pytest.approx(scores.max(), abs=1e-4)


def test_a_memory_answers_as_features_where_its_attention_is_exact() -> None:
    """Queries that fit one component each, and no pixel that blends two kinds."""
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    local = features.features - features.mean
    bank = MemoryBank(
        components=features.features,
        sources=np.zeros((2, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (2, 1, 1)),
        mean=features.mean,
        threshold=0.9,
        coverage=1.0,
        cosine=1.0,
        space=SPACE,
    )
    memory = QueryMemory(
        queries=local, weights=features.weights, projection=np.eye(CHANNELS, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.01, mean=features.mean,
    )  # fmt: skip
    scene, config = scene_of(gaussians, features), FromPoseConfig(stride=1)
    plain, remembered = (
        FeatureField(scene, memory=each, config=config).at(front_camera()).relevancy(NAMES[:2], words())
        for each in (None, memory)
    )
    assert np.isfinite(plain).any()
    np.testing.assert_allclose(remembered, plain, atol=1e-5)
    for a, b in zip(
        from_pose(scene, front_camera(), NAMES[:2], words(), config),
        from_pose(scene, front_camera(), NAMES[:2], words(), config, memory=memory),
        strict=True,
    ):
        assert a.visible
        assert b.visible
        assert a.threshold == pytest.approx(b.threshold, abs=1e-5)
        np.testing.assert_allclose(b.position, a.position, atol=0.3)
    assert FeatureField(scene, memory=memory).stride_in(front_camera(), 0) == 4
