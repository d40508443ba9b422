"""The error of a choice of views: what the views leave unseen of what all candidates show."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from rooms import corner_cameras, sheet, splat
from viewed_targets import cube_in_room, joined

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views.budget import (
    ViewsBudget,
    choose_views_within,
    errors_after,
    fewest_views,
    measured_errors,
    order_by_error,
)
from gsencoder.infer.views.choose import ViewScores
from gsencoder.infer.views.targets import Target, ViewsConfig, target_of
from gsencoder.render import blend
from gsencoder.types import Scene, Views

DOWN = np.array([0.0, -1.0, 0.0])


def scores(*weights: np.ndarray) -> tuple[ViewScores, ...]:
    """Scores of which only the weights of the targets' Gaussians matter."""
    return tuple(
        ViewScores(
            **{name: np.zeros(len(each)) for name in ("visible", "share", "inside", "alpha", "blur")},
            target=each.astype(np.float32),
            context=np.zeros((len(each), 0), np.float32),
        )
        for each in weights
    )


def error_of(choice: tuple[int, ...], *weights: np.ndarray) -> float:
    """The definition, one Gaussian at a time."""
    errors = []
    for each in weights:
        shown = [max(row[list(choice)]) / max(row) for row in each.T if max(row) > 0]
        errors.append(1 - sum(shown) / len(shown) if shown else 0.0)
    return sum(errors) / len(errors)


def divided_plate() -> tuple[Scene, Target]:
    """A plate with a wall across its middle, and three frames: one from the left, the same from farther away, and one
    from the right. Each sees the half on its side."""
    plate = sheet((0, 0, 2.0), (0, 1), (0.4, 0.2), 0.02)
    plate = plate[np.abs(plate[:, 0]) > 0.05]
    wall = sheet((0, 0, 1.5), (1, 2), (0.6, 0.46), 0.02)
    both = splat(np.concatenate([plate, wall]), 0.012)
    centers = np.array([[-1.0, 0, 0], [-1.5, 0, -1.0], [1.0, 0, 0]])
    forward = np.array([0, 0, 2.0]) - centers
    cameras = looking_cameras(centers, forward / np.linalg.norm(forward, axis=1, keepdims=True), DOWN, 200.0, 240, 180)
    views = Views(cameras=cameras, names=("left", "far left", "right"))
    scene = Scene(name="plate", gaussians=both, views=views, up=np.array([0, -1.0, 0]), metres_per_unit=1.0)
    return scene, target_of("plate", both, np.arange(len(plate)))


def test_errors_of_an_order_are_those_of_the_definition_and_end_at_zero() -> None:
    rng = np.random.default_rng(0)
    weights = [rng.uniform(size=(7, n)) * (rng.uniform(size=(7, n)) > 0.4) for n in (11, 30)]
    # Gaussians, and a whole target, that no candidate shows are no error.
    weights[0][:, :3] = 0
    weights.append(np.zeros((7, 5)))
    order, gains = order_by_error(scores(*weights))
    errors = errors_after(gains)
    for count in range(1, len(order) + 1):
        assert errors[count - 1] == pytest.approx(error_of(tuple(order[:count]), *weights), abs=1e-6)
    assert errors[-1] == 0
    assert (np.diff(errors) < 0).all()
    assert (np.diff(gains) <= 1e-12).all()
    # The first is the best one of all, and the first three are near the best three.
    assert errors[0] == pytest.approx(min(error_of((view,), *weights) for view in range(7)), abs=1e-6)
    best = min(error_of(three, *weights) for three in itertools.combinations(range(7), 3))
    assert 1 - errors[2] >= (1 - 1 / np.e) * (1 - best)


def test_a_looser_error_never_takes_more_views_and_few_gaussians_take_more() -> None:
    rng = np.random.default_rng(1)
    weights = rng.uniform(size=(12, 400))
    counts = []
    for error in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9):
        choice, _ = fewest_views(scores(weights), ViewsBudget(error=error))
        assert choice.estimate.error <= error
        counts.append(len(choice.setting))
    assert counts == sorted(counts, reverse=True)
    # Fewer than the default, and more.
    assert counts[0] > ViewsConfig().count > counts[-1]
    # Of the same Gaussians, each a hundred times, nothing is surer; of four of them, less.
    many, _ = fewest_views(scores(np.tile(weights, 100)), ViewsBudget(error=0.2))
    few, _ = fewest_views(scores(weights[:, :4]), ViewsBudget(error=0.2))
    assert len(many.setting) <= counts[4]
    assert errors_after(order_by_error(scores(weights[:, :4]))[1])[len(few.setting) - 1] == 0


def test_candidates_that_show_nothing_leave_one_view() -> None:
    choice, _ = fewest_views(scores(np.zeros((4, 6))), ViewsBudget(error=0.1))
    assert choice.setting.tolist() == [0]


def test_what_is_measured_in_windows_is_what_whole_pictures_show() -> None:
    # A Gaussian of the target is high above the room, where no camera looks.
    scene, cube = cube_in_room(np.array([[0.3, 0.2, 9.0]]))
    gaussians = scene.gaussians
    target = replace(cube, rows=np.append(cube.rows, len(gaussians) - 1))
    # One of another size, whose weights count as shares of the picture.
    cameras = joined(corner_cameras(5, 96, 72).select([0, 1, 2, 3]), corner_cameras(5, 192, 144).select([4]))
    weights = np.zeros((5, len(target.rows)))
    for view in range(5):
        b = blend(gaussians, cameras, view)
        whole = np.bincount(b.col.numpy(), b.weight.numpy(), minlength=len(gaussians))
        weights[view] = whole[target.rows] / max(cameras.widths[view], cameras.heights[view]) ** 2
    assert (weights.max(axis=0) > 0).tolist() == [True] * len(cube.rows) + [False]
    choices = [(0,), (4,), (1, 2), (0, 1, 2, 3, 4)]
    measured = measured_errors(gaussians, [target], cameras, [np.array(each) for each in choices])
    assert measured == pytest.approx([error_of(each, weights) for each in choices], abs=1e-6)
    assert measured[-1] == 0


@pytest.mark.slow
def test_a_half_that_is_hidden_takes_a_second_view_and_the_limit_is_kept() -> None:
    scene, plate = divided_plate()
    config = ViewsConfig(source="frames")
    names, measured = [], []
    for error in (0.05, 0.2, 0.65):
        made = choose_views_within(scene, [plate], config, ViewsBudget(error=error))
        realised = made.realised_error(scene.gaussians, [plate])
        assert realised <= error
        assert made.chosen == {"count": len(made.views)}
        names.append({each.name for each in made.views.chosen})
        measured.append(realised)
    assert [len(each) for each in names] == [2, 2, 1]
    assert names[1] == {"left", "right"}
    assert measured[-1] == pytest.approx(0.5, abs=0.05)


def test_an_error_comes_before_seconds() -> None:
    scene, plate = divided_plate()
    config, ticks = ViewsConfig(source="frames"), itertools.count()
    alone = choose_views_within(scene, [plate], config, ViewsBudget(error=0.2))
    budget = ViewsBudget(error=0.2, seconds=0.5)
    both = choose_views_within(scene, [plate], config, budget, clock=lambda: float(next(ticks)))
    assert [each.name for each in both.views.chosen] == [each.name for each in alone.views.chosen]
    assert both.views.judged == alone.views.judged == 3
    assert both.notes == ("budget.error=0.2 takes about 1 s, more than budget.seconds=0.5; budget.error comes first",)
