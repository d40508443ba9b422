"""Affine colors: they are recovered where photographs differ, and change nothing where they agree."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walls import wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.exposure import (
    IDENTITY,
    ROUNDS,
    SAME,
    Exposures,
    apply_colors,
    compared_pixels,
    fitted_colors,
)
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.score import describe_exposure, score
from gsencoder.types import Views

GAINS = np.array([0.7, 1.25, 1.0, 0.9, 1.15, 1.0])
HELD_OUT = 2
TRAINING = [0, 1, 3, 4, 5]
CONFIG = OptimizeConfig(steps=60, sh_degree=1, shrinks=(1,), shares=(1.0,))


def exposed_views(gains: np.ndarray) -> Views:
    views = wall_views(len(gains), depth=True)
    assert views.images is not None
    # A third of the range, so that no gain makes a color white.
    images = [
        (np.asarray(image) / 1.5 * gain + 0.5).astype(np.uint8) for image, gain in zip(views.images, gains, strict=True)
    ]
    return replace(views, images=images)


def fitted(views: Views, config: OptimizeConfig = CONFIG) -> Optimizer:
    adam = RowAdam(parameters_from(seed_from_depth(wall_views(6, depth=True), voxel=0.1), config.sh_degree))
    one = Optimizer(adam, Photographs(views), TRAINING, config, prune=PruneConfig(at=()))
    for _ in range(config.steps):
        one.advance()
    return one


def random_pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    made = torch.Generator().manual_seed(seed)
    render = torch.rand(24, 32, 3, generator=made)
    affine = IDENTITY + 0.2 * torch.randn(3, 4, generator=made)
    return render, affine


def test_an_affine_map_is_recovered_from_a_picture_and_its_image() -> None:
    render, affine = random_pair()
    colors = fitted_colors(render, apply_colors(render, affine), torch.ones(24, 32, dtype=torch.bool))
    torch.testing.assert_close(colors, affine, atol=0.02, rtol=0)
    again = fitted_colors(render, render, torch.ones(24, 32, dtype=torch.bool))
    torch.testing.assert_close(again, IDENTITY, atol=1e-6, rtol=0)


def test_pixels_that_are_masked_or_not_covered_do_not_count() -> None:
    render, affine = random_pair(1)
    image = apply_colors(render, affine)
    alpha, mask = torch.ones(24, 32), torch.ones(24, 32, dtype=torch.bool)
    alpha[:6], mask[:, :9] = 0.4, False
    spoiled = image.clone()
    spoiled[:6] = 0
    spoiled[:, :9] = 1
    known = compared_pixels(alpha, mask)
    assert int(known.sum()) == 18 * 23
    torch.testing.assert_close(fitted_colors(render, spoiled, known), fitted_colors(render, image, known))
    assert bool(compared_pixels(alpha, None)[6:].all())


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_a_picture_of_one_color_or_of_nothing_gives_a_finite_map(value: float) -> None:
    render, image = torch.full((8, 8, 3), value), torch.full((8, 8, 3), 0.5)
    everything, nothing = torch.ones(8, 8, dtype=torch.bool), torch.zeros(8, 8, dtype=torch.bool)
    colors = fitted_colors(render, image, everything)
    assert bool(torch.isfinite(colors).all())
    torch.testing.assert_close(apply_colors(render, colors), image, atol=0.01, rtol=0)
    assert torch.equal(fitted_colors(render, image, nothing), IDENTITY)


def test_what_all_maps_have_in_common_is_not_applied() -> None:
    _, affine = random_pair(2)
    shared = Exposures([4, 7, 9], affine.repeat(3, 1, 1))
    torch.testing.assert_close(shared.relative(7, affine), IDENTITY)
    torch.testing.assert_close(shared.brightness(), torch.ones(3))
    own = IDENTITY * 1.3
    torch.testing.assert_close(shared.relative(7, own), IDENTITY + 2 / 3 * (own - affine))
    before = shared.maps.clone()
    moved = shared.moved(9, own)
    torch.testing.assert_close(moved, (affine + own) / 2)
    assert torch.equal(shared.maps, before)
    shared.set(9, moved)
    torch.testing.assert_close(shared.maps[2], moved)
    assert torch.equal(shared.maps[:2], before[:2])


def test_photographs_differ_where_one_channel_of_one_does() -> None:
    maps = IDENTITY.repeat(50, 1, 1)
    assert not Exposures(range(50), maps).differ()
    for gain, expected in ((1 + 0.9 * SAME, False), (1 + 1.1 * SAME, True), (1 - 1.1 * SAME, True)):
        for channel in range(3):
            one = maps.clone()
            one[7, channel] *= gain
            assert Exposures(range(50), one).differ() == expected
    # Warmer, and as bright.
    maps[7, 0] *= 1.1
    maps[7, 2] *= 0.9
    warm = Exposures(range(50), maps)
    assert warm.differ()
    torch.testing.assert_close(warm.brightness(), torch.ones(50), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("gains", "stays"), [(np.ones(6), False), (GAINS, True)])
def test_maps_are_given_up_after_three_looks_at_each_photograph_if_they_do_not_differ(
    gains: np.ndarray, stays: bool
) -> None:
    rounds = len(TRAINING) * ROUNDS
    early, late = (fitted(exposed_views(gains), replace(CONFIG, steps=steps)) for steps in (rounds - 1, rounds))
    assert early.exposures is not None
    assert (late.exposures is not None) == stays
    again = Optimizer(late.adam, late.photographs, TRAINING, CONFIG, prune=PruneConfig(), step=rounds)
    assert again.exposures is None
    if late.exposures is not None:
        maps = late.exposures.maps
        again = Optimizer(
            late.adam, late.photographs, TRAINING, CONFIG, prune=PruneConfig(), exposures=maps, step=rounds
        )
        assert again.exposures is not None
        assert again.exposures.maps is maps


@pytest.mark.slow
def test_gains_of_photographs_are_found_and_the_held_out_view_gains() -> None:
    views, config = exposed_views(GAINS), replace(CONFIG, steps=100)
    on, off = fitted(views, config), fitted(views, replace(config, exposure=False))
    assert on.exposures is not None
    assert off.exposures is None
    expected = GAINS[TRAINING] / GAINS[TRAINING].mean()
    np.testing.assert_allclose(on.exposures.brightness().numpy(), expected, atol=0.03)
    matched = [score(one, [HELD_OUT]).matched_psnr for one in (on, off)]
    assert matched[0] > matched[1] + 1
    brightness = on.exposures.brightness()
    line = describe_exposure(float(brightness.min()), float(brightness.max()), "mean")
    assert line is not None
    assert "0.7" in line


@pytest.mark.slow
def test_photographs_of_one_exposure_are_fitted_as_well_as_without() -> None:
    views = exposed_views(np.ones(6))
    on, off = fitted(views), fitted(views, replace(CONFIG, exposure=False))
    assert on.exposures is None
    scores = [score(one, [HELD_OUT]) for one in (on, off)]
    assert scores[0].psnr > scores[1].psnr - 0.1


def test_brightness_within_the_limit_is_no_difference() -> None:
    assert describe_exposure(1 - 0.9 * SAME, 1 + 0.9 * SAME, "order") is None
    assert "before and after" in (describe_exposure(1 - 1.1 * SAME, 1.0, "order") or "")
    assert describe_exposure(1.0, 1 + 1.1 * SAME, "cameras") is not None
