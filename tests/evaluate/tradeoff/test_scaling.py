"""Power laws: exponents are recovered, and their intervals hold the truth as often as they say."""

import numpy as np
import pytest
from scipy.stats import linregress, t

from gsencoder.core.errors import InputError
from gsencoder.evaluate.tradeoff.scaling import ScalingConfig, fit_exponent, geometric_sizes


@pytest.mark.parametrize("exponent", [-0.5, 0.0, 1.0, 2.3])
def test_a_power_law_without_noise_is_recovered_whatever_the_units(exponent: float) -> None:
    sizes = np.array([1e3, 4e3, 7e3, 5e5])
    for unit in (1e-6, 1.0, 1e6):
        fit = fit_exponent(sizes * unit, 3e-4 * sizes**exponent)
        assert fit.value == pytest.approx(exponent, abs=1e-9)
        assert fit.high - fit.low == pytest.approx(0, abs=1e-6)
        assert fit.constant * (sizes[0] * unit) ** fit.value == pytest.approx(3e-4 * sizes[0] ** exponent)


def test_the_interval_is_that_of_linear_regression() -> None:
    generator = np.random.default_rng(1)
    sizes = np.geomspace(10, 1000, 7)
    costs = sizes**0.8 * np.exp(0.1 * generator.normal(size=7))
    fit, oracle = fit_exponent(sizes, costs), linregress(np.log(sizes), np.log(costs))
    half = t.ppf(0.975, 5) * oracle.stderr
    assert (fit.value, fit.low, fit.high) == pytest.approx((oracle.slope, oracle.slope - half, oracle.slope + half))


def test_scenes_of_other_speeds_have_constants_of_their_own() -> None:
    sizes = np.array([1.0, 2.0, 4.0, 10.0, 20.0, 40.0])
    costs = np.array([1.0] * 3 + [100.0] * 3) * sizes
    assert fit_exponent(sizes, costs, np.array([0, 0, 0, 1, 1, 1])).value == pytest.approx(1)
    assert fit_exponent(sizes, costs).value > 1.5


@pytest.mark.parametrize(
    ("sizes", "costs"), [([1, 2], [1, 2]), ([2, 2, 2], [1, 2, 3]), ([1, 2, 3], [1, 0, 1]), ([0, 1, 2], [1, 1, 1])]
)
def test_what_no_line_fits_is_refused(sizes: list[float], costs: list[float]) -> None:
    with pytest.raises(InputError, match="^fit_exponent: expected"):
        fit_exponent(np.array(sizes, np.float64), np.array(costs, np.float64))


def test_sizes_are_whole_different_and_end_at_all() -> None:
    assert geometric_sizes(24, 5) == [3, 5, 8, 14, 24]
    assert geometric_sizes(2, 5) == [1, 2]
    with pytest.raises(InputError, match="^points: expected"):
        ScalingConfig(points=2)
