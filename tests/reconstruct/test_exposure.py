"""Affine colors: recovered where photographs differ, unused where they agree, predicted for held-out photographs."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from walls import cameras, wall_optimizer, wall_views

from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.reconstruct.optimize import ROUNDS, Exposures, OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.score import (
    camera_weights,
    compare,
    describe_exposure,
    map_error,
    mean_weights,
    order_weights,
    predict_exposures,
    score,
)
from gsencoder.render.images import IDENTITY, apply_colors, compared_pixels, fitted_colors
from gsencoder.types import Views

GAINS = np.array([0.7, 1.25, 1.0, 0.9, 1.15, 1.0])
HELD_OUT = 2
TRAINING = (0, 1, 3, 4, 5)
CONFIG = OptimizeConfig(steps=60, sh_degree=1, shrinks=(1,), shares=(1.0,))


def exposed_views(gains: np.ndarray) -> Views:
    views = wall_views(len(gains), depth=True)
    # A third of the range, so that no gain makes a color white.
    both = zip(views.images, gains, strict=True)
    return replace(views, images=[(np.asarray(image) / 1.5 * gain + 0.5).astype(np.uint8) for image, gain in both])


def fitted(views: Views, config: OptimizeConfig, steps: int) -> Optimizer:
    one = wall_optimizer(config, seed_from_depth(wall_views(6, depth=True), voxel=0.1), views, TRAINING)
    for _ in range(steps):
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


@pytest.mark.parametrize(("gains", "stays"), [(np.ones(6), False), (GAINS, True)])
def test_maps_are_given_up_after_three_looks_at_each_photograph_if_they_do_not_differ(gains, stays):
    rounds = len(TRAINING) * ROUNDS
    one = fitted(exposed_views(gains), replace(CONFIG, steps=rounds), rounds - 1)
    one.advance()
    assert (one.exposures is not None) == stays
    going_on = partial(Optimizer, one.adam, one.photographs, TRAINING, CONFIG, prune=PruneConfig(), step=rounds)
    assert going_on().exposures is None
    if one.exposures is not None:
        maps = one.exposures.maps
        assert going_on(exposures=maps).exposures.maps is maps


@pytest.mark.slow
def test_gains_of_photographs_are_found_and_the_held_out_view_gains() -> None:
    views = exposed_views(GAINS)
    on, off = fitted(views, CONFIG, 60), fitted(views, replace(CONFIG, exposure=False), 60)
    assert off.exposures is None
    expected = GAINS[list(TRAINING)] / GAINS[list(TRAINING)].mean()
    np.testing.assert_allclose(on.exposures.brightness().numpy(), expected, atol=0.03)
    matched = [score(one, [HELD_OUT]).matched_psnr for one in (on, off)]
    assert matched[0] > matched[1] + 0.5
    brightness = on.exposures.brightness()
    assert "0.7" in describe_exposure(float(brightness.min()), float(brightness.max()), "mean")


COUNT = 25
QUERIES = np.arange(0, COUNT, 8)
FITTED = np.setdiff1d(np.arange(COUNT), QUERIES)


def exposures(gains: np.ndarray, training: np.ndarray = FITTED) -> Exposures:
    """Maps of photographs that are so many times as bright."""
    maps = torch.from_numpy(gains[training]).float().reshape(-1, 1, 1) * IDENTITY
    return Exposures(training.tolist(), maps)


def test_a_photograph_between_two_is_interpolated_and_one_beyond_them_is_as_the_nearest() -> None:
    fitted = np.array([2, 3, 7])
    expected = [[1, 0, 0], [0, 0.75, 0.25], [0, 0.25, 0.75], [0, 0, 1]]
    np.testing.assert_allclose(order_weights(np.array([0, 4, 6, 9]), fitted), expected)
    # Those that were fitted are predicted from the others.
    np.testing.assert_allclose(order_weights(fitted, fitted), [[0, 1, 0], [0.8, 0, 0.2], [0, 1, 0]])


def test_no_source_looks_at_the_photograph_that_it_predicts() -> None:
    centers = np.random.default_rng(0).normal(size=(COUNT, 3))
    among = FITTED, FITTED
    for weights in (mean_weights(*among), order_weights(*among), camera_weights(*among, centers)):
        assert not np.diagonal(weights).any()
        np.testing.assert_allclose(weights.sum(axis=1), 1)
    centers[5] = centers[4]
    nearest = camera_weights(np.array([5]), np.array([1, 4, 5]), centers)
    np.testing.assert_allclose(nearest, [[0.5, 0.5, 0]])


def test_the_error_of_maps_is_that_of_colors() -> None:
    made = torch.Generator().manual_seed(0)
    one, other = IDENTITY + 0.2 * torch.randn(2, 3, 4, generator=made)
    colors = torch.rand(100_000, 1, 3, generator=made)
    expected = (apply_colors(colors, one) - apply_colors(colors, other)).square().mean().sqrt()
    assert map_error((one - other).unsqueeze(0)) == pytest.approx(float(expected), rel=0.01)
    assert map_error(torch.stack((one - other, torch.zeros(3, 4)))) == pytest.approx(float(expected) / 2**0.5, rel=0.01)


def test_exposures_that_drift_along_the_recording_are_interpolated() -> None:
    gains = 1 + 0.3 * np.sin(np.arange(COUNT) / 4)
    prediction = predict_exposures(exposures(gains), cameras(COUNT), QUERIES.tolist())
    assert prediction.source == "order"
    assert prediction.errors["order"] < 0.3 * prediction.errors["mean"]
    relative = gains[QUERIES] - gains[FITTED].mean() + 1
    # The first and the last photograph have a neighbor on one side alone.
    np.testing.assert_allclose(prediction.maps[1:-1, 0, 0], relative[1:-1], atol=0.01)
    np.testing.assert_allclose(prediction.maps[:, 0, 0], relative, atol=0.08)
    assert not prediction.maps[:, 0, 1:].any()


def test_exposures_that_follow_nothing_are_taken_to_be_the_mean() -> None:
    gains = np.random.default_rng(0).uniform(0.7, 1.4, COUNT)
    for one in (exposures(gains), exposures(np.ones(COUNT)), exposures(gains, np.array([1, 2]))):
        prediction = predict_exposures(one, cameras(COUNT), QUERIES.tolist())
        assert prediction.source == "mean"
        torch.testing.assert_close(prediction.maps, IDENTITY.repeat(len(QUERIES), 1, 1))
    assert predict_exposures(None, cameras(COUNT), [3, 4]).maps.shape == (2, 3, 4)
    assert predict_exposures(exposures(gains, np.array([1])), cameras(COUNT), []).maps.shape == (0, 3, 4)


def test_where_the_order_is_none_the_nearest_cameras_tell() -> None:
    shuffled = np.random.default_rng(0).permutation(COUNT)
    gains = (1 + 0.3 * np.sin(np.arange(COUNT) / 4))[shuffled]
    prediction = predict_exposures(exposures(gains), cameras(COUNT).select(shuffled), QUERIES.tolist())
    assert prediction.source == "cameras"
    np.testing.assert_allclose(prediction.maps[:, 0, 0], gains[QUERIES] - gains[FITTED].mean() + 1, atol=0.12)


def test_scores_and_pictures_are_in_the_exposure_that_is_predicted() -> None:
    held_out, training = [1, 8], np.array([0, 2, 3, 4, 5, 6, 7, 9])
    views = wall_views(10, depth=True)
    gains = np.linspace(0.7, 1.3, 10)
    relative = gains - gains[training].mean() + 1
    images = [(np.asarray(image) / 1.5).astype(np.uint8) for image in views.images]
    seeds = seed_from_depth(replace(views, images=images), voxel=0.1)
    images = [(image * gain).astype(np.uint8) for image, gain in zip(images, relative, strict=True)]

    def with_maps(gain: np.ndarray) -> Optimizer:
        maps, config = exposures(gain, training).maps, OptimizeConfig(steps=4, sh_degree=0)
        return wall_optimizer(config, seeds, replace(views, images=images), tuple(training.tolist()), exposures=maps)

    drifting, none = with_maps(gains), with_maps(np.ones(10))
    scores = [score(one, held_out) for one in (drifting, none)]
    assert scores[0].psnr > scores[1].psnr + 1
    assert scores[0].matched_psnr == scores[1].matched_psnr
    shown = compare(drifting, held_out, matched=False)
    for each, view in zip(shown, held_out, strict=True):
        bare = drifting.pictures(view, drifting.photographs.at_scale(view), IDENTITY).expected
        assert each.render.mean() / 255 / float(bare.mean()) == pytest.approx(relative[view], abs=0.01)
