"""Words to points from a pose by rays at a stride, in views of any size, of features and of memories."""

import numpy as np
import pytest
import torch
from posed_words import CHANNELS, NAMES, SPACE, opaque_ball, plain_relevancy, scene_of, some_features, two_kinds, words
from splats import front_camera, one_gaussian

from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, from_pose, pose_picture, view_picture
from gsencoder.render import blend
from gsencoder.types import MemoryBank, QueryMemory


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
    gaussians, cameras, text = opaque_ball(), front_camera(), words()
    scene = scene_of(gaussians, some_features(len(gaussians), "basis"))
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
