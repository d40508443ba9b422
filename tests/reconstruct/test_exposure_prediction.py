"""Exposures of held-out photographs: predicted where they drift, the mean where they do not, and never looked up."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walls import cameras, wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.exposure import (
    IDENTITY,
    Exposures,
    apply_colors,
    camera_weights,
    map_error,
    mean_weights,
    order_weights,
    predict_exposures,
)
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.score import compare, score

COUNT = 25
HELD_OUT = np.arange(0, COUNT, 8)
TRAINING = np.setdiff1d(np.arange(COUNT), HELD_OUT)


def exposures(gains: np.ndarray, training: np.ndarray = TRAINING) -> Exposures:
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
    for weights in (
        mean_weights(TRAINING, TRAINING),
        order_weights(TRAINING, TRAINING),
        camera_weights(TRAINING, TRAINING, centers),
    ):
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


@pytest.mark.parametrize("row", range(3))
def test_colors_are_equally_frequent_in_the_error_of_maps(row: int) -> None:
    """Of independent values from 0 to 1 the mean is 1/2, the mean square 1/3 and the mean product 1/4."""
    for first in range(4):
        for second in range(first + 1):
            difference = torch.zeros(1, 3, 4, dtype=torch.float64)
            difference[0, row, first] += 1
            difference[0, row, second] += 2
            squares = [1.0 if column == 3 else 1 / 3 for column in (first, second)]
            product = 1 / 4 if first < 3 else 1 / 2
            expected = 9 * squares[0] if first == second else squares[0] + 4 * squares[1] + 4 * product
            assert map_error(difference) == pytest.approx((expected / 3) ** 0.5)


def test_exposures_that_drift_along_the_recording_are_interpolated() -> None:
    gains = 1 + 0.3 * np.sin(np.arange(COUNT) / 4)
    prediction = predict_exposures(exposures(gains), cameras(COUNT), HELD_OUT.tolist())
    assert prediction.source == "order"
    assert prediction.errors["order"] < 0.3 * prediction.errors["mean"]
    relative = gains[HELD_OUT] - gains[TRAINING].mean() + 1
    # The first and the last photograph have a neighbor on one side alone.
    np.testing.assert_allclose(prediction.maps[1:-1, 0, 0], relative[1:-1], atol=0.01)
    np.testing.assert_allclose(prediction.maps[:, 0, 0], relative, atol=0.08)
    assert not prediction.maps[:, 0, 1:].any()


def test_exposures_that_follow_nothing_are_taken_to_be_the_mean() -> None:
    gains = np.random.default_rng(0).uniform(0.7, 1.4, COUNT)
    for one in (exposures(gains), exposures(np.ones(COUNT)), exposures(gains, np.array([1, 2]))):
        prediction = predict_exposures(one, cameras(COUNT), HELD_OUT.tolist())
        assert prediction.source == "mean"
        torch.testing.assert_close(prediction.maps, IDENTITY.repeat(len(HELD_OUT), 1, 1))
    assert predict_exposures(None, cameras(COUNT), [3, 4]).maps.shape == (2, 3, 4)
    assert predict_exposures(exposures(gains, np.array([1])), cameras(COUNT), []).maps.shape == (0, 3, 4)


def test_two_photographs_are_enough_to_predict_from_and_one_is_not() -> None:
    gains = np.linspace(0.5, 1.5, COUNT)
    assert predict_exposures(exposures(gains, np.array([4])), cameras(COUNT), [5]).errors == {}
    two = predict_exposures(exposures(gains, np.array([4, 6])), cameras(COUNT), [5])
    # Each is the only one that predicts the other, whatever the source.
    assert two.errors.keys() == {"mean", "order", "cameras"}
    assert len({round(error, 6) for error in two.errors.values()}) == 1
    assert two.errors["mean"] > 0


def test_where_the_order_is_none_the_nearest_cameras_tell() -> None:
    shuffled = np.random.default_rng(0).permutation(COUNT)
    gains = (1 + 0.3 * np.sin(np.arange(COUNT) / 4))[shuffled]
    prediction = predict_exposures(exposures(gains), cameras(COUNT).select(shuffled), HELD_OUT.tolist())
    assert prediction.source == "cameras"
    np.testing.assert_allclose(prediction.maps[:, 0, 0], gains[HELD_OUT] - gains[TRAINING].mean() + 1, atol=0.12)


def test_scores_and_pictures_are_in_the_exposure_that_is_predicted() -> None:
    held_out, training = [1, 8], np.array([0, 2, 3, 4, 5, 6, 7, 9])
    views = wall_views(10, depth=True)
    assert views.images is not None
    gains = np.linspace(0.7, 1.3, 10)
    relative = gains - gains[training].mean() + 1
    images = [(np.asarray(image) / 1.5).astype(np.uint8) for image in views.images]
    seeds = seed_from_depth(replace(views, images=images), voxel=0.1)
    images = [(image * gain).astype(np.uint8) for image, gain in zip(images, relative, strict=True)]
    photographs = Photographs(replace(views, images=images))

    def fitted(gain: np.ndarray) -> Optimizer:
        adam = RowAdam(parameters_from(seeds, 0))
        maps, config = exposures(gain, training).maps, OptimizeConfig(steps=4, sh_degree=0)
        return Optimizer(adam, photographs, training.tolist(), config, prune=PruneConfig(at=()), exposures=maps)

    drifting, none = fitted(gains), fitted(np.ones(10))
    scores = [score(one, held_out) for one in (drifting, none)]
    assert scores[0].psnr > scores[1].psnr + 1
    assert scores[0].matched_psnr == scores[1].matched_psnr
    shown = compare(drifting, held_out, matched=False)
    for each, view in zip(shown, held_out, strict=True):
        bare = drifting.pictures(view, photographs.at_scale(view), IDENTITY).expected
        assert each.render.mean() / 255 / float(bare.mean()) == pytest.approx(relative[view], abs=0.01)
