"""What views are worth: what they show of a target, what a set of them covers, and what one more adds."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from rooms import corner_cameras, cube, sheet, splat
from viewed_targets import cube_in_room

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views import choose
from gsencoder.infer.views.choose import CoverageObjective, coverage, score_views, view_utility
from gsencoder.infer.views.targets import CONSTANTS, target_of

pytestmark = pytest.mark.slow


def test_a_target_by_itself_is_seen_whole_and_fills_what_it_should() -> None:
    # A plate of side 0.4 two units in front of a camera.
    plate = splat(sheet((0, 0, 2.0), (0, 1), (0.2, 0.2), 0.02), 0.012)
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([0, -1.0, 0]), 200.0, 160, 120)
    (seen,) = score_views(plate, cameras, [target_of("plate", plate, np.arange(len(plate)))])
    assert seen.visible[0] == pytest.approx(1)
    assert seen.inside[0] == 1
    # At least the means' square, at most that with two standard deviations on every side.
    least, most = ((side * 200 / 2) ** 2 / (160 * 120) for side in (0.4, 0.4 + 4 * 0.012))
    assert least < seen.share[0] < most
    assert seen.blur[0] == pytest.approx(200 * 0.012 / 2 / 160, rel=1e-3)
    assert 0.2 < seen.alpha[0] < 0.4
    assert seen.target.shape == (1, len(plate))
    assert seen.context.shape == (1, 0)


def test_what_stands_before_a_target_hides_it_by_its_share() -> None:
    plate = sheet((0, 0, 2.0), (0, 1), (0.2, 0.2), 0.02)
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([0, -1.0, 0]), 200.0, 160, 120)
    visible = []
    for edge in (-0.4, 0.0, 0.4):
        # A screen at half the distance whose right edge covers none, half, or all of the plate.
        screen = sheet((edge / 2 - 0.5, 0, 1.0), (0, 1), (0.5, 0.5), 0.02)
        both = splat(np.concatenate([plate, screen]), 0.012)
        (seen,) = score_views(both, cameras, [target_of("plate", both, np.arange(len(plate)))])
        visible.append(seen.visible[0])
    assert visible[0] > 0.98
    # The screen's rim is twice as wide on the plate.
    assert 0.38 < visible[1] < 0.52
    assert visible[2] < 0.02


def test_views_of_two_targets_are_judged_as_each_by_itself() -> None:
    scene, target = cube_in_room(cube((-0.6, 0.2, 0.8)))
    other = target_of(
        "other", scene.gaussians, np.arange(len(scene.gaussians) - len(target.rows), len(scene.gaussians))
    )
    cameras = corner_cameras(5)
    both = score_views(scene.gaussians, cameras, [target, other])
    for number, one in enumerate((target, other)):
        (alone,) = score_views(scene.gaussians, cameras, [one])
        for name in ("visible", "share", "inside", "alpha", "blur", "target", "context"):
            assert (getattr(both[number], name) == getattr(alone, name)).all()


def test_gains_never_grow_and_the_choice_is_near_the_best_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, target = cube_in_room()
    cameras = corner_cameras(10, 160, 120)
    weights = {"cover_weight": 1.0, "context_weight": 0.5, "spread_weight": 1.0}
    monkeypatch.setattr(choose, "CONSTANTS", replace(CONSTANTS, **weights))
    values = CoverageObjective(cameras, [target], score_views(scene.gaussians, cameras, [target]), 3)
    order, gains = values.greedy(10)
    assert (np.diff(gains) <= 1e-12).all()
    assert sorted(order.tolist()) == list(range(10))
    best = max(values.value_of(each) for each in itertools.combinations(range(10), 3))
    assert values.value_of(order[:3]) == pytest.approx(gains[:3].sum())
    assert values.value_of(order[:3]) >= (1 - 1 / np.e) * best
    assert values.value_of(order[:3]) >= 0.95 * best


def test_what_a_view_is_worth_grows_with_what_it_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "CONSTANTS", replace(CONSTANTS, least_share=0.1, most_share=0.5))
    scene, target = cube_in_room()
    (seen,) = score_views(scene.gaussians, corner_cameras(1), [target])

    def value(**changed: float) -> float:
        base = {"visible": 1.0, "share": 0.3, "inside": 1.0, "alpha": 1.0, "blur": 0.0} | changed
        return float(view_utility(replace(seen, **{name: np.array([number]) for name, number in base.items()}))[0])

    # Half from the least share on, all from half of the most on; less beyond the most.
    expected = {0.0: 0, 0.05: 0.5 * (0.5 + 0.5 * 0.2), 0.1: 0.5 + 0.5 * 0.4, 0.2: 0.5 + 0.5 * 0.8, 0.25: 1.0}
    for share, worth in (expected | {0.5: 1.0, 0.75: 0.5, 0.9: 0.2, 1.0: 0.0}).items():
        assert value(share=share) == pytest.approx(worth)
    # In proportion to what is not hidden, half of it for means outside the picture, and by the opacity's square.
    assert value(visible=0.3) == pytest.approx(0.3 * value())
    assert value(inside=0.0) == pytest.approx(0.5 * value())
    assert value(inside=0.5) == pytest.approx(0.75 * value())
    assert value(alpha=0.45) == pytest.approx(value() / 4)
    assert value(alpha=0.9) == value()
    assert value(blur=CONSTANTS.half_blur) == pytest.approx(value() / 2)
    assert value(blur=2 * CONSTANTS.half_blur) == pytest.approx(value() / 5)


def test_a_set_is_worth_its_views_and_what_they_cover_of_targets_context_and_directions(rng, monkeypatch):
    """Written out for two targets, one of them without surroundings."""
    constants = replace(CONSTANTS, cover_weight=1.0, context_weight=0.5, spread_weight=0.25)
    monkeypatch.setattr(choose, "CONSTANTS", constants)
    scene, first = cube_in_room(cube((-0.6, 0.2, 0.8)))
    count = len(scene.gaussians)
    second = target_of("other", scene.gaussians, np.arange(count - len(first.rows), count))
    cameras = corner_cameras(6, 32, 24)
    seen = []
    for target, others in zip((first, second), (7, 0), strict=True):
        (one,) = score_views(scene.gaussians, cameras, [target])
        weights = {"target": rng.random((6, 9)), "context": rng.random((6, others))}
        seen.append(replace(one, **{name: value.astype(np.float32) for name, value in weights.items()}))
    values = CoverageObjective(cameras, [first, second], seen, 3)
    for views in ([0], [1, 4], [0, 2, 5]):
        total, covered = 0.0, 0.0
        for target, each in zip((first, second), seen, strict=True):
            own = view_utility(each)
            good = own / max(own.max(), 0.1)
            away = cameras.centers.astype(np.float64) - target.center
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            parts = {
                1.0: coverage(each.target) * good[:, None],
                0.5: coverage(each.context) * good[:, None],
                0.25: np.clip(away @ away.T, 0, 1) * good[:, None],
            }
            total += own[views].sum() / 3
            total += sum(weight * part[views].max(axis=0).mean() for weight, part in parts.items() if part.size)
            covered += coverage(each.target)[views].max(axis=0).mean()
        assert values.value_of(views) == pytest.approx(total / 2, rel=1e-5)
        assert values.covered(np.array(views)) == pytest.approx(covered / 2, rel=1e-5)
    assert values.greedy(6)[1].sum() == pytest.approx(values.value_of(values.greedy(6)[0]))


@pytest.mark.parametrize("best", [1.0, 0.01])
def test_a_view_adds_something_from_a_small_share_of_the_first_one_on_or_of_the_best_there_can_be(best, monkeypatch):
    none = {"cover_weight": 0.0, "context_weight": 0.0, "spread_weight": 0.0}
    monkeypatch.setattr(choose, "CONSTANTS", replace(CONSTANTS, **none))
    scene, target = cube_in_room()
    cameras = corner_cameras(4, 32, 24)
    (seen,) = score_views(scene.gaussians, cameras, [target])
    least = max(CONSTANTS.min_relative_gain * best, CONSTANTS.min_gain)
    full = {"share": CONSTANTS.most_share / 2, "inside": 1.0, "alpha": 1.0, "blur": 0.0}
    arrays = {name: np.full(4, value) for name, value in full.items()}
    # All else being perfect, a view is worth what it shows of the target.
    visible = np.array([0.9 * least, 1.1 * least, best, 2 * least])
    values = CoverageObjective(cameras, [target], [replace(seen, visible=visible, **arrays)], 4)
    np.testing.assert_allclose(values.utilities[0], visible)
    order, gains = values.greedy(4)
    assert order.tolist() == [2, 3, 1]
    np.testing.assert_allclose(gains * 4, visible[order])
