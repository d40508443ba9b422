"""Memory banks: what they cover, where their components come from, and what cannot be reduced."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import BankConfig, MapStream, build_bank, raw_features
from gsencoder.memory.reduction import reduce_as_published, unit_rows
from gsencoder.types import FeatureMap, FeatureSpace

SPACE = FeatureSpace(name="s", channels=16)
GRID = np.array([[0.1, 0, 0], [0, 0.1, 0]])


def dense_maps(views: int = 5, *, seed: int = 0, holes: bool = True) -> list[FeatureMap]:
    """Maps of cells between a few directions about a mean that is longer than they are."""
    rng = np.random.default_rng(seed)
    mean, centers = 3 * rng.normal(size=16), rng.normal(size=(9, 16))
    maps = []
    for _ in range(views):
        one, other = centers[rng.integers(0, 9, (2, 12, 20))]
        share = rng.random((12, 20, 1)) ** 3
        features = (mean + one * (1 - share) + other * share + 0.1 * rng.normal(size=(12, 20, 16))).astype(np.float32)
        if holes:
            features[rng.random((12, 20)) < 0.1] = np.nan
        maps.append(FeatureMap(features=features, grid_from_image=GRID, space=SPACE))
    return maps


def stream(maps: list[FeatureMap]) -> MapStream:
    def give() -> Iterator[tuple[int, FeatureMap]]:
        return iter([(2 * number, each) for number, each in enumerate(maps)])

    return give


def all_rows(maps: list[FeatureMap]) -> np.ndarray:
    return np.concatenate([raw_features(0, each)[0] for each in maps])


def cosines(rows: np.ndarray, components: np.ndarray, mean: np.ndarray) -> np.ndarray:
    a, b = ((each.astype(np.float64) - mean) for each in (rows, components))
    return np.asarray((a / np.linalg.norm(a, axis=1)[:, None]) @ (b / np.linalg.norm(b, axis=1)[:, None]).T)


@pytest.mark.parametrize("center", [True, False])
@pytest.mark.parametrize("threshold", [0.6, 0.9])
def test_every_raw_feature_is_within_the_threshold_of_a_component(center: bool, threshold: float) -> None:
    maps = dense_maps()
    rows = all_rows(maps)
    mean = rows.mean(axis=0)
    bank = build_bank(stream(maps), SPACE, mean, BankConfig(threshold=threshold, center=center))
    best = cosines(rows, bank.components, mean if center else np.zeros_like(mean)).max(axis=1)
    assert best.min() >= threshold
    assert bank.coverage == 1
    assert bank.cosine == pytest.approx(best.mean(), abs=1e-6)
    assert bank.threshold == threshold
    assert 1 <= len(bank) < len(rows) / 2
    np.testing.assert_array_equal(bank.mean, mean if center else 0)


@pytest.mark.parametrize("method", ["cover", "paper"])
@pytest.mark.parametrize("center", [True, False])
def test_components_are_the_raw_features_at_their_sources(method: Any, center: bool) -> None:
    maps = dense_maps()
    mean = all_rows(maps).mean(axis=0)
    bank = build_bank(stream(maps), SPACE, mean, BankConfig(method=method, threshold=0.8, center=center))
    for component, (view, row, column) in zip(bank.components, bank.sources.tolist(), strict=True):
        features = maps[view // 2].features
        np.testing.assert_allclose(component, features[row, column], rtol=1e-5, atol=1e-6)


def test_the_published_bank_states_the_share_that_it_covers() -> None:
    maps = dense_maps()
    rows = all_rows(maps)
    mean = rows.mean(axis=0)
    config = BankConfig(method="paper", threshold=0.85, drop_last=100)
    bank = build_bank(stream(maps), SPACE, mean, config)
    expected, _ = reduce_as_published(unit_rows(rows - mean), 0.85, drop_last=100)
    np.testing.assert_allclose(bank.components, rows[expected], rtol=1e-5, atol=1e-6)
    best = cosines(rows, bank.components, mean).max(axis=1)
    assert bank.coverage == pytest.approx((best >= 0.85).mean())
    assert bank.coverage < 0.99
    with pytest.raises(InputError, match="drop_last=5000: all 1,0.. features are in the last, incomplete chunk"):
        build_bank(stream(maps), SPACE, mean, BankConfig(method="paper", threshold=0.85, drop_last=5000))


def test_the_threshold_is_chosen_for_a_number_of_components_or_for_a_mean_cosine() -> None:
    maps = dense_maps()
    mean = all_rows(maps).mean(axis=0)
    for components in (20, 150):
        bank = build_bank(stream(maps), SPACE, mean, BankConfig(components=components))
        assert components / 2 <= len(bank) <= components
        more = build_bank(stream(maps), SPACE, mean, BankConfig(threshold=bank.threshold + 2 / 4096))
        assert len(more) > components
    sizes = []
    for cosine in (0.8, 0.9, 0.97):
        bank = build_bank(stream(maps), SPACE, mean, BankConfig(cosine=cosine))
        assert cosine <= bank.cosine < cosine + 0.1
        sizes.append(len(bank))
    assert sizes[0] < sizes[1] < sizes[2]
    with pytest.raises(InputError, match="components=1: the features point in more directions than that even at"):
        build_bank(stream(maps), SPACE, mean, BankConfig(components=1))


def test_a_coded_map_gives_each_vector_that_occurs_once() -> None:
    table = np.random.default_rng(0).normal(size=(5, 16)).astype(np.float32)
    codes = np.array([[-1, 3, 3], [1, 1, -1]], np.int32)
    rows, sources = raw_features(7, FeatureMap(codes=codes, table=table, grid_from_image=GRID, space=SPACE))
    np.testing.assert_array_equal(rows, table[[1, 3]])
    np.testing.assert_array_equal(sources, [[7, 1, 0], [7, 0, 1]])


def test_names_are_all_components_however_alike_they_are_unless_fewer_are_asked_for() -> None:
    rng = np.random.default_rng(0)
    table = (rng.normal(size=16) + 0.1 * rng.normal(size=(40, 16))).astype(np.float32)
    codes = rng.integers(0, 40, (2, 12, 20)).astype(np.int32)
    maps = [FeatureMap(codes=each, table=table, grid_from_image=GRID, space=SPACE) for each in codes]
    mean = np.zeros(16, np.float32)
    bank = build_bank(stream(maps), SPACE, mean)
    assert len(bank) == 40
    assert {row.tobytes() for row in bank.components} == {row.tobytes() for row in table}
    assert len(build_bank(stream(maps), SPACE, mean, BankConfig(components=20))) <= 20


def test_equal_features_are_one_component_and_no_features_are_refused() -> None:
    equal = FeatureMap(features=np.full((4, 5, 16), 2, np.float32), grid_from_image=GRID, space=SPACE)
    mean = np.full(16, 2, np.float32)
    for config in (BankConfig(), BankConfig(threshold=1.0), BankConfig(components=1), BankConfig(center=False)):
        bank = build_bank(stream([equal] * 3), SPACE, mean, config)
        np.testing.assert_array_equal(bank.components, np.full((1, 16), 2))
        assert (bank.coverage, bank.cosine) == (1, pytest.approx(1))
        assert bank.sources.tolist() == [[0, 0, 0]]
    empty = FeatureMap(features=np.full((4, 5, 16), np.nan, np.float32), grid_from_image=GRID, space=SPACE)
    infinite = FeatureMap(features=np.full((4, 5, 16), np.inf, np.float32), grid_from_image=GRID, space=SPACE)
    for method in ("cover", "paper"):
        config = BankConfig(method=method, threshold=0.5)
        for maps in ([], [empty, empty]):
            with pytest.raises(InputError, match="memory: no view has a cell with a feature of s"):
                build_bank(stream(maps), SPACE, mean, config)
        with pytest.raises(InputError, match="view 2: 20 of 20 features of s are not finite"):
            build_bank(stream([equal, infinite]), SPACE, mean, config)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threshold": 1.01}, "threshold: expected 0 to 1"),
        ({"threshold": 0.5, "components": 5}, "threshold, components: expected one of the two, got 0.5 and 5"),
        ({"drop_last": 10}, "drop_last: expected 0 with method=cover"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        BankConfig(**settings)
