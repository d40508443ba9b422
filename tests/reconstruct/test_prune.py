"""What is taken out, against column sums of B and the settings themselves."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import ScaledPhotograph
from gsencoder.reconstruct.optimize import OptimizeConfig, PruneConfig, rows_to_keep
from gsencoder.reconstruct.parameters import parameters_from
from gsencoder.render import blend
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Cameras

NOTHING = PruneConfig(opacity=0.0, screen=0.0, contribution=0.0)


def two_cameras() -> Cameras:
    """One looks along +z, the other stands two units to its left."""
    one = front_camera(64, 48, 50.0)
    poses = np.repeat(one.cam_from_world, 2, axis=0)
    poses[1, 0, 3] = 2
    repeated = {name: np.repeat(getattr(one, name), 2, axis=0) for name in ("Ks", "widths", "heights")}
    return Cameras(cam_from_world=poses, **repeated)


def photos(cameras: Cameras, shrink: int) -> list[tuple[int, ScaledPhotograph]]:
    scale = torch.diag(torch.tensor([1 / shrink, 1 / shrink, 1]))
    return [
        (
            view,
            ScaledPhotograph(
                image=torch.zeros(48 // shrink, 64 // shrink, 3), mask=None, depth=None, K=scale @ torch.from_numpy(K)
            ),
        )
        for view, K in enumerate(cameras.Ks)
    ]


@pytest.mark.parametrize("shrink", [1, 2])
def test_a_contribution_is_counted_in_pixels_of_the_photograph_whatever_size_it_is_looked_at(shrink: int) -> None:
    splat, cameras = random_gaussians(150, log_scale=-1.5), two_cameras()
    columns = [torch.bincount(b.col.long(), b.weight, 150) for b in (blend(splat, cameras, view) for view in range(2))]
    pixels = torch.maximum(*columns).numpy()
    least = float(np.median(pixels))
    config = replace(NOTHING, contribution=least)
    rows = rows_to_keep(parameters_from(splat, 0), cameras, photos(cameras, shrink), config, RasterConfig()).numpy()
    # Coarser pixels round.
    slack = 1.02 if shrink == 1 else 1.5
    clear = (pixels > slack * least) | (pixels < least / slack)
    assert clear.mean() > 0.6
    np.testing.assert_array_equal(np.isin(np.arange(150), rows)[clear], pixels[clear] > least)


def test_opacities_below_the_least_are_taken_out_and_all_others_stay() -> None:
    splat, cameras = random_gaussians(150), two_cameras()
    rows = rows_to_keep(
        parameters_from(splat, 0), cameras, photos(cameras, 1), replace(NOTHING, opacity=0.4), RasterConfig()
    )
    np.testing.assert_array_equal(rows.numpy(), np.flatnonzero(splat.opacities >= 0.4))


@pytest.mark.parametrize("shrink", [1, 2])
def test_what_is_wider_than_a_share_of_some_picture_is_taken_out(shrink: int) -> None:
    """Spheres whose radius of three standard deviations (3.3 are drawn) is so many widths of the first picture."""
    radii = np.array([0.05, 0.2, 0.8, 1.1, 3.0])
    one = random_gaussians(5)
    depth = 100.0
    splat = replace(
        one,
        means=np.tile(np.float32([0, 0, depth]), (5, 1)),
        scales=np.repeat(radii[:, None] * 64 / 50 * depth / 3, 3, axis=1).astype(np.float32),
        opacities=np.full(5, 0.99, np.float32),
    )
    cameras = two_cameras()
    raw, some = parameters_from(splat, 0), photos(cameras, shrink)
    everything = rows_to_keep(raw, cameras, some, NOTHING, RasterConfig())
    assert everything.tolist() == list(range(5))
    for screen, count in ((0.5, 2), (1.0, 3), (4.0, 5)):
        rows = rows_to_keep(raw, cameras, some, replace(NOTHING, screen=screen), RasterConfig())
        assert rows.tolist() == list(range(count))


def test_pruning_is_due_once_for_each_share_of_the_steps() -> None:
    config = PruneConfig(at=(0.25, 0.5, 1.0))
    assert [step for step in range(41) if config.due(step, OptimizeConfig(steps=40))] == [10, 20, 40]


def test_a_share_of_less_than_a_step_is_due_after_the_first() -> None:
    config = PruneConfig(at=(0.01,))
    assert [step for step in range(41) if config.due(step, OptimizeConfig(steps=40))] == [1]


@pytest.mark.parametrize("at", [0.0, -0.5, 1.01])
def test_shares_of_the_steps_outside_0_to_1_are_refused(at: float) -> None:
    with pytest.raises(InputError, match="at: expected above 0 and at most 1"):
        PruneConfig(at=(0.5, at))


@pytest.mark.parametrize("name", ["opacity", "screen", "contribution"])
def test_limits_below_0_are_refused(name: str) -> None:
    assert getattr(PruneConfig(**{name: 0.0}), name) == 0
    with pytest.raises(InputError, match=name):
        PruneConfig(**{name: -1e-9})
