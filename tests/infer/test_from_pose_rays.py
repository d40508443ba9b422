"""Words to points from a pose by rays at a stride, in views of any size."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from posed_words import NAMES, opaque_ball, plain_relevancy, scene_of, some_features, two_kinds, words
from splats import front_camera, one_gaussian

from gsencoder.infer.from_pose import MAX_RAYS, FeatureField, FromPoseConfig, from_pose, pose_picture, view_picture
from gsencoder.render import blend


@pytest.mark.parametrize(("width", "height"), [(61, 43), (2, 1), (8, 5), (1, 9)])
@pytest.mark.parametrize("stride", [1, 3, 4])
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


def test_a_stride_that_is_asked_for_holds_in_views_of_any_size() -> None:
    gaussians, features = two_kinds(one_gaussian((-0.7, 0, 2)), one_gaussian((0.7, 0, 2)))
    field = FeatureField(scene_of(gaussians, features), config=FromPoseConfig(stride=3))
    huge = replace(front_camera(), widths=np.array([1 << 24], np.int32), heights=np.array([1], np.int32))
    assert field.stride_in(huge, 0) == 3
    free = FeatureField(scene_of(gaussians, features)).stride_in(huge, 0)
    assert -(-(1 << 24) // free) <= MAX_RAYS
