"""Successive halving: rungs grow, what goes on is the best, and without noise the best of all is left."""

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.tradeoff.sweep import HalvingConfig, draw_settings, successive_halving

VALUES = {"size": (4, 1, 2, 8), "steps": (10, 1, 100)}


def cost_and_error(knobs: dict[str, int]) -> tuple[float, float]:
    """A toy with a known front: time grows with both knobs, error falls with both."""
    return knobs["size"] * knobs["steps"], 1 / knobs["size"] + 1 / knobs["steps"]


@pytest.mark.parametrize("scenes", [1, 3, 10])
def test_the_best_in_each_column_reaches_the_last_rung_without_noise(scenes: int) -> None:
    drawn = draw_settings(VALUES, 100, seed=0)
    rungs = successive_halving(
        drawn, scenes, lambda some, _: [cost_and_error(dict(each)) for each in some], HalvingConfig(settings=100)
    )
    costs = np.array([cost_and_error(each) for each in drawn])
    for column in range(2):
        assert drawn[int(costs[:, column].argmin())] in rungs[-1].settings


def test_with_one_cost_the_best_wins_from_any_start() -> None:
    generator = np.random.default_rng(0)
    for _ in range(20):
        losses = generator.permutation(30)
        rungs = successive_halving(
            [{"number": number} for number in range(30)],
            9,
            lambda some, _, losses=losses: [(float(losses[each["number"]]),) for each in some],  # type: ignore[misc]
            HalvingConfig(settings=30),
        )
        assert rungs[-1].survivors[0] == {"number": int(losses.argmin())}


def test_rungs_grow_in_scenes_and_shrink_in_settings() -> None:
    calls: list[tuple[int, int]] = []

    def evaluate(some: object, scenes: int) -> list[tuple[float]]:
        calls.append((len(some), scenes))  # type: ignore[arg-type]
        return [(float(number),) for number in range(len(some))]  # type: ignore[arg-type]

    rungs = successive_halving([{"n": number} for number in range(27)], 12, evaluate, HalvingConfig(settings=27))
    assert calls == [(27, 1), (9, 3), (4, 9), (4, 12)]
    assert [rung.scenes for rung in rungs] == [1, 3, 9, 12]
    assert rungs[-1].survivors == tuple({"n": number} for number in range(4))


def test_settings_are_all_combinations_or_a_choice_by_the_seed() -> None:
    everything = draw_settings(VALUES, 12, seed=0)
    assert len(everything) == len({tuple(each.items()) for each in everything}) == 12
    some, again, other = (draw_settings(VALUES, 5, seed=seed) for seed in (0, 0, 1))
    assert some == again != other
    assert len({tuple(each.items()) for each in some}) == 5
    assert all(each in everything for each in some)


@pytest.mark.parametrize("wrong", [{"first": 0}, {"settings": -1}])
def test_rungs_that_would_not_end_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"^.*{next(iter(wrong))}.*: expected"):
        HalvingConfig(**wrong)  # type: ignore[arg-type]
