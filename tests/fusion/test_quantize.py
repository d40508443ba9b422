"""Features in a few bytes: the budget is met, the codes are what they say, and the ends of the range hold."""

from dataclasses import replace

import numpy as np
import pytest
from feature_fields import make_features
from sklearn.cluster import KMeans

from gsencoder.core.errors import InputError
from gsencoder.fusion import quantize as module
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.quantize import BitAllocation, CompactFeatures, compact


@pytest.mark.parametrize(("error", "basis"), [(0.3, True), (0.01, False), (1e-4, True)])
def test_the_budget_is_met_and_the_error_told_is_the_error_made(error: float, basis: bool) -> None:
    features = make_features(basis=basis)
    made = compact(features, error=error)
    assert made.error <= error
    over_rows = field_error(made.features(), features, sample=0).centered
    assert over_rows <= made.error + 1e-5
    assert over_rows >= made.error / 20
    decoded = made.features()
    np.testing.assert_array_equal(decoded.seen, features.seen)
    assert not decoded.features[~decoded.seen].any()
    np.testing.assert_allclose(decoded.weights, features.weights, rtol=0.03)


def test_a_smaller_budget_takes_more_bytes_and_one_byte_less_would_not_do() -> None:
    features = make_features(n=2000)
    sizes = [compact(features, error=error).row_bytes for error in (0.1, 0.03, 0.01, 3e-3, 1e-3)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


@pytest.mark.parametrize("magnitude", [1e-8, 1e6])
def test_magnitudes_do_not_matter(magnitude: float) -> None:
    plain, scaled = (compact(make_features(magnitude=each), error=0.01) for each in (1.0, magnitude))
    assert plain.bits.tolist() == scaled.bits.tolist()
    np.testing.assert_allclose(scaled.coordinates(), magnitude * plain.coordinates(), rtol=1e-3, atol=1e-3 * magnitude)


@pytest.mark.parametrize("n", [1, 3])
def test_few_gaussians_and_many_alike_can_be_packed(n: int) -> None:
    features = make_features(n=n)
    assert compact(features, error=0.01).error <= 0.01
    alike = replace(features, features=np.repeat(features.features[1 % n][None], n, axis=0) * features.seen[:, None])
    made = compact(alike, error=1e-6)
    assert made.row_bytes <= 2
    np.testing.assert_allclose(made.features().decode()[made.rows], alike.decode()[made.rows], atol=1e-5)


def test_a_rare_kind_is_kept_as_well_as_a_common_one() -> None:
    features = make_features(n=10_000, rank=12, kinds=12)
    rare = np.arange(0, 10_000, 2001) + 1
    values = features.features.copy()
    other = np.random.default_rng(3).normal(size=(3, 12)).astype(np.float32)
    values[rare] = other[np.arange(len(rare)) % 3]
    mixed = replace(features, features=values)
    made = compact(mixed, error=0.02)
    decoded = made.features()
    common = field_error(decoded, mixed, sample=0).centered
    common_rows = np.setdiff1d(np.arange(10_000), rare)
    alone = replace(mixed, weights=np.where(np.isin(np.arange(10_000), common_rows), 0, 1).astype(np.float32))
    assert common <= 0.02
    assert field_error(decoded, alone, sample=0).centered <= 0.06


def test_a_kind_that_the_sample_misses_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FIT_SAMPLE", 200)
    features = make_features(n=10_000, rank=12, kinds=6)
    values = features.features.copy()
    hidden = np.arange(5001, 5040)
    hidden = hidden[features.seen[hidden]]
    values[hidden] = np.random.default_rng(5).normal(size=12)
    mixed = replace(features, features=values)
    made = compact(mixed, error=0.01)
    alone = replace(mixed, weights=np.where(np.isin(np.arange(10_000), hidden), 1, 0).astype(np.float32))
    assert field_error(made.features(), alone, sample=0).centered <= 0.05
    assert made.lowest > 0.9


@pytest.mark.parametrize("zeros", [100, 2399])
def test_features_at_the_mean_count_for_nothing(zeros: int) -> None:
    features = make_features()
    values = features.features.copy()
    values[np.flatnonzero(features.seen)[:zeros]] = 0
    made = compact(replace(features, features=values), error=0.01)
    assert made.error <= 0.01
    with pytest.raises(InputError, match="all features are the space's mean"):
        compact(replace(features, features=0 * values))


@pytest.mark.parametrize(("low", "high"), [(1e-30, 1e30), (1.0, 1.0), (1e-3, 1e6)])
def test_weights_of_any_range_come_back_within_their_step(low: float, high: float) -> None:
    features = make_features()
    rng = np.random.default_rng(0)
    weights = np.exp(rng.uniform(np.log(low), np.log(high), len(features))).astype(np.float32)
    weights[:2] = low, high
    decoded = compact(replace(features, weights=weights), error=0.1).features().weights
    step = (high / low) ** (1 / 510)
    assert (decoded <= weights * step * 1.001).all()
    assert (decoded >= weights / step / 1.001).all()


def test_codes_lie_as_the_format_says() -> None:
    """Read bit by bit, without numpy's unpacking."""
    made = compact(make_features(n=200), error=0.01)
    offsets = np.concatenate(([0], np.cumsum(1 << made.bits.astype(int))))
    for index in (0, 7, 100):
        digits = "".join(f"{byte:08b}" for byte in made.codes[index])
        begin, expected = 0, []
        for number, width in enumerate(made.bits.tolist()):
            expected.append(made.levels[offsets[number] + int(digits[begin : begin + width], 2)])
            begin += width
        np.testing.assert_array_equal(made.coordinates(np.array([index]))[0], np.array(expected, np.float32))


@pytest.mark.parametrize("kinds", [False, True])
def test_levels_are_as_good_as_another_programs(kinds: bool) -> None:
    """k-means in one dimension is what the levels of a coordinate are."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=4000)
    if kinds:
        values = rng.normal(size=5)[rng.integers(0, 5, 4000)] + 0.02 * values
    for bits in (1, 2, 3, 4):
        left, levels = BitAllocation(values[:, None], np.ones(4000), np.ones(4000))._fit(0, bits)
        assert len(levels) == 1 << bits
        theirs = KMeans(1 << bits, n_init=5, random_state=0).fit(values[:, None]).inertia_
        assert left <= 1.1 * theirs


def test_impossible_budgets_and_empty_fields_are_refused() -> None:
    features = make_features()
    for error in (1.0, float("nan")):
        with pytest.raises(InputError, match="budget between 0 and 1"):
            compact(features, error=error)
    with pytest.raises(InputError, match="8 bits a coordinate reach"):
        compact(features, error=1e-12)
    nothing = replace(features, weights=0 * features.weights, features=0 * features.features)
    with pytest.raises(InputError, match="no Gaussian has features"):
        compact(nothing)


@pytest.mark.usefixtures("no_jaxtyping")
def test_codes_that_do_not_fit_their_levels_are_refused() -> None:
    made = compact(make_features(), error=0.01)
    for wrong in (
        {"codes": made.codes[:, 1:]},
        {"levels": made.levels[1:]},
        {"bits": made.bits[1:]},
        {"rows": made.rows[::-1].copy()},
        {"total": 10},
        {"heaviest": float("nan")},
        {"lightest": 0.0},
        {"error": float("nan")},
        {"weight_codes": made.weight_codes[1:]},
    ):
        with pytest.raises(InputError):
            replace(made, **wrong)
    assert isinstance(replace(made), CompactFeatures)
