"""What the types that pass between stages do beside holding arrays."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.render import blend
from gsencoder.types import Cameras, Scene, Views


def camera(width: int, height: int) -> Cameras:
    K = np.array([[[0.7 * width, 0, 0.45 * width], [0, 0.7 * width, 0.55 * height], [0, 0, 1]]], np.float32)
    return Cameras(
        cam_from_world=np.eye(4, dtype=np.float32)[None],
        Ks=K,
        widths=np.array([width], np.int32),
        heights=np.array([height], np.int32),
    )


@pytest.mark.parametrize(("width", "height", "longest"), [(640, 480, 160), (97, 231, 50), (64, 48, 640), (1000, 1, 8)])
def test_resized_cameras_keep_their_field_of_view(width: int, height: int, longest: int) -> None:
    whole = camera(width, height)
    small = whole.resized(longest)
    assert max(small.widths[0], small.heights[0]) == longest
    assert min(small.widths[0], small.heights[0]) >= 1
    corners = np.array([[0.0, 0, 1], [width, height, 1]])
    scaled = corners * (small.widths[0] / width, small.heights[0] / height, 1)
    rays = np.linalg.solve(whole.Ks[0].astype(np.float64), corners.T)
    np.testing.assert_allclose(np.linalg.solve(small.Ks[0].astype(np.float64), scaled.T), rays, atol=1e-6)
    assert (small.cam_from_world == whole.cam_from_world).all()


def test_a_resized_picture_of_large_gaussians_shows_the_same() -> None:
    gaussians = random_gaussians(40, log_scale=-1.0)
    large, small = camera(128, 96), camera(128, 96).resized(32)
    fine = blend(gaussians, large).alpha.reshape(24, 4, 32, 4).mean(dim=(1, 3))
    coarse = blend(gaussians, small).alpha.reshape(24, 32)
    assert (fine - coarse).abs().mean() < 0.03


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf"), 10**400, True, "1"])
def test_a_scene_has_a_positive_unit_or_none(unit: Any, no_jaxtyping: None) -> None:
    with pytest.raises(InputError, match=r"Scene\.metres_per_unit: expected a positive number of metres"):
        Scene(name="room", metres_per_unit=unit)


def test_selected_views_read_what_belongs_to_them_when_it_is_asked_for() -> None:
    read = []

    class Files(Sequence[np.ndarray]):
        def __len__(self) -> int:
            return 3

        def __getitem__(self, index: Any) -> Any:
            read.append(index)
            return np.full((4, 5), index, np.float32)

    cameras = Cameras(
        cam_from_world=np.tile(np.eye(4, dtype=np.float32), (3, 1, 1)),
        Ks=np.tile(np.array([[5, 0, 2], [0, 5, 2], [0, 0, 1]], np.float32), (3, 1, 1)),
        widths=np.array([5, 6, 7], np.int32),
        heights=np.full(3, 4, np.int32),
    )
    views = Views(cameras=cameras, names=("a", "b", "c"), depths=Files())
    chosen = views.select(np.array([2, 0]))
    assert (chosen.names, chosen.cameras.widths.tolist(), chosen.images) == (("c", "a"), [7, 5], None)
    assert chosen.depths is not None
    # Runtime checks of types look at an entry of a sequence.
    read.clear()
    assert [float(depth[0, 0]) for depth in chosen.depths] == [2, 0]
    assert read == [2, 0]
    assert float(chosen.select([1]).depths[0][0, 0]) == 0  # type: ignore[index]
    assert [float(depth[0, 0]) for depth in chosen.depths[1:]] == [0]
