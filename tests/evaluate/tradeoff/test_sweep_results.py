"""What results of sweeps say of scenes: times, bytes, scores, their errors, and what is chosen by them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import sem
from toy_stage import Toy, record

from gsencoder.evaluate.tradeoff.measure import Record
from gsencoder.evaluate.tradeoff.stage import Judged, Score
from gsencoder.evaluate.tradeoff.sweep import (
    estimate,
    estimate_difference,
    knobs_that_matter,
    mark_front,
    scene_row,
    summarize,
)


def test_what_scenes_do_not_agree_on_is_noise_and_a_scene_without_things_says_nothing() -> None:
    (effort, _) = Toy().stage().knobs

    def row(*hits: int, **knobs: int) -> list[Record]:
        scenes = [record(name, [1.0], {"acc_25": Score(n, 8)}, **knobs) for name, n in zip("abc", hits, strict=True)]
        return [*scenes, record("d", [1.0], {"acc_25": Score(0, 0)}, **knobs)]

    base = row(4, 4, 4)
    assert knobs_that_matter([effort], [base, row(7, 2, 4, effort=1)], base, "bytes") == []
    assert knobs_that_matter([effort], [base, row(6, 5, 6, effort=1)], base, "bytes") == ["effort"]


def test_times_are_medians_over_rounds_and_means_over_scenes_and_ratios_are_of_the_same_round() -> None:
    base = [record("a", [1.0, 2.0, 3.0]), record("b", [10.0, 20.0, 30.0])]
    half = [record("a", [0.5, 1.0, 1.5], views=1), record("b", [5.0, 10.0, 15.0], views=1)]
    result = summarize(half, base, "one at a time")
    assert (result.cpu_seconds, result.seconds) == (5.5, 11.0)
    assert result.ratio == pytest.approx(0.5)
    assert result.ratio_error == pytest.approx(0)
    assert result.spread == pytest.approx(1.4826 * 0.5)


def test_memory_is_that_of_the_largest_scene_bytes_a_mean_and_spread_a_median_over_scenes() -> None:
    rows = [
        record(name, cpu) for name, cpu in (("a", [1.0, 1.0, 1.0]), ("b", [1.0, 2.0, 4.0]), ("c", [1.0, 9.0, 17.0]))
    ]
    rows = [
        replace(
            row,
            timings=tuple(replace(timing, mib=mib) for timing in row.timings),
            judged=Judged(scores={}, bytes=size),
        )
        for row, mib, size in zip(rows, (30.0, 50.0, 10.0), (1, 2, 6), strict=True)
    ]
    result = summarize(rows, rows, "base")
    assert (result.mib, result.bytes) == (50.0, 3.0)
    assert result.spread == pytest.approx(1.4826 * 0.5)


def test_ratios_are_of_the_rounds_that_both_have_and_their_error_is_that_of_the_mean_logarithm() -> None:
    base = [record(name, [1.0, 4.0, 16.0]) for name in "abc"]
    shares = (0.5, 0.25, 0.7)
    rows = [record(name, [share, 4 * share], views=1) for name, share in zip("abc", shares, strict=True)]
    result = summarize(rows, base, "one at a time")
    assert result.ratio == pytest.approx(np.prod(shares) ** (1 / 3))
    assert result.ratio_error == pytest.approx(sem(np.log(shares)))


def test_the_row_of_a_scene_has_medians_over_rounds_and_shares_of_its_things() -> None:
    row = scene_row(record("a", [1.0, 2.0, 9.0], {"acc_25": Score(3, 4), "acc_50": Score(0, 0)}, views=1))
    assert (row["setting"], row["scene"], row["cpu_seconds"], row["seconds"]) == ("views=1", "a", 2.0, 4.0)
    assert (row["acc_25"], row["acc_25_things"], row["acc_50_things"]) == (0.75, 4, 0)
    assert np.isnan(row["acc_50"])


def test_a_score_counts_things_and_its_error_is_that_of_scenes() -> None:
    value, error, things = estimate([Score(3, 4), Score(1, 4)])
    assert (value, things) == (0.5, 8)
    # With as many things in each scene it is the standard error of the mean of the scenes' shares.
    assert error == pytest.approx(np.std([0.75, 0.25], ddof=1) / np.sqrt(2))
    assert np.isnan(estimate([Score(3, 4)]).error)
    assert np.isnan(estimate([Score(0, 0)]).value)
    # A scene without things says nothing, and changes nothing but the number of scenes.
    assert estimate([Score(3, 4), Score(1, 4), Score(0, 0)]).value == 0.5


def test_standard_errors_hold_the_truth_as_often_as_they_say() -> None:
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(1000):
        chance = generator.beta(8, 2, size=40)
        things = generator.integers(4, 15, size=40)
        hits = generator.binomial(things, chance)
        value, error, _ = estimate([Score(float(h), float(n)) for h, n in zip(hits, things, strict=True)])
        inside += abs(value - 0.8) <= 1.96 * error
    assert 0.92 < inside / 1000 < 0.98


def test_a_difference_of_scores_has_the_error_of_differences_of_scenes() -> None:
    base = [Score(3, 4), Score(1, 4), Score(2, 4)]
    # Every scene gains one thing, so that nothing about the gain is uncertain, whatever the scenes' scores are.
    assert estimate_difference([Score(4, 4), Score(2, 4), Score(3, 4)], base) == pytest.approx((0.25, 0.0, 12))
    value, error, _ = estimate_difference([Score(4, 4), Score(0, 4), Score(3, 4)], base)
    assert value == pytest.approx(1 / 12)
    assert error == pytest.approx(np.std([0.25, -0.25, 0.25], ddof=1) / np.sqrt(3))
    assert np.isnan(estimate_difference([Score(3, 4)], [Score(1, 4)]).error)
    assert np.isnan(estimate_difference([], []).value)


def test_differences_are_of_the_scenes_that_both_have_scores_of() -> None:
    base = [record("a", [1.0], {"acc_25": Score(1, 2)}), record("b", [1.0])]
    other = [record("b", [1.0], {"acc_25": Score(2, 2)}, views=1), record("a", [1.0], {"acc_25": Score(2, 2)}, views=1)]
    row = summarize(other, base, "grid").row()
    assert (row["acc_25_difference"], row["acc_25_things"]) == (0.5, 4)
    assert "acc_25_difference" not in summarize(base, base, "base").row()


def test_the_front_is_drawn_among_settings_of_as_many_scenes() -> None:
    def result(cpu: float, error: float, scenes: int = 2, **knobs: int):  # type: ignore[no-untyped-def]
        rows = [record(name, [cpu], {"error": Score(error)}, **knobs) for name in "ab"[:scenes]]
        return summarize(rows, rows, "grid")

    marked = mark_front(
        [result(1.0, 0.3), result(2.0, 0.2, n=1), result(3.0, 0.25, n=2), result(0.1, 0.0, scenes=1, n=3)],
        "error",
        "cpu_seconds",
    )
    assert [each.on_front for each in marked] == [True, True, False, False]
