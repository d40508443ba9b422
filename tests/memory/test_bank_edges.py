"""Banks at the ends of the range: cells at the mean, rare kinds, many names, few views that differ, small samples."""

from collections.abc import Iterator

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.memory import bank as bank_module
from gsencoder.memory.bank import BankConfig, MapStream, build_bank
from gsencoder.types import FeatureMap, FeatureSpace, MemoryBank

SPACE = FeatureSpace(name="s", channels=16)
GRID = np.array([[0.1, 0, 0], [0, 0.1, 0]])
MEAN = (3 * np.random.default_rng(7).normal(size=16)).astype(np.float32)


def map_of(rows: np.ndarray, height: int, width: int) -> FeatureMap:
    features = rows.reshape(height, width, 16).astype(np.float32)
    return FeatureMap(features=features, grid_from_image=GRID, space=SPACE)


def stream(maps: list[FeatureMap]) -> MapStream:
    def give() -> Iterator[tuple[int, FeatureMap]]:
        return iter(enumerate(maps))

    return give


def kinds(count: int, seed: int = 0) -> np.ndarray:
    """Directions of length 1, far from each other."""
    rows = np.random.default_rng(seed).normal(size=(count, 16))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def best_cosines(rows: np.ndarray, bank: MemoryBank) -> np.ndarray:
    """Of features with the nearest component, about the mean of the bank."""
    a, b = (each.astype(np.float64) - bank.mean for each in (rows, bank.components))
    b = b[np.linalg.norm(b, axis=1) > 1e-3 * np.linalg.norm(bank.mean.astype(np.float64))]
    return np.asarray(((a / np.linalg.norm(a, axis=1)[:, None]) @ (b / np.linalg.norm(b, axis=1)[:, None]).T).max(1))


def mixed_maps(rounding: float = 0.0) -> tuple[list[FeatureMap], np.ndarray]:
    """Two maps in which every third cell, from the second one on, is at the mean but for rounding; and which are."""
    rng = np.random.default_rng(1)
    rows = MEAN + kinds(30)[rng.integers(0, 30, 120)] + 0.02 * rng.normal(size=(120, 16))
    at_mean = np.arange(120) % 3 == 1
    rows[at_mean] = MEAN * (1 + rounding * rng.uniform(-1, 1, (at_mean.sum(), 1)))
    return [map_of(rows[:60], 6, 10), map_of(rows[60:], 6, 10)], at_mean


@pytest.mark.parametrize("rounding", [0.0, 1e-5])
@pytest.mark.parametrize("config", [BankConfig(), BankConfig(threshold=0.95), BankConfig(components=40)])
def test_cells_at_the_mean_have_one_component_and_take_no_part_in_the_cover(
    rounding: float, config: BankConfig
) -> None:
    maps, at_mean = mixed_maps(rounding)
    rows = np.concatenate([each.features.reshape(-1, 16) for each in maps if each.features is not None])
    bank = build_bank(stream(maps), SPACE, MEAN, config)
    numbers = bank.sources[:, 0] * 60 + bank.sources[:, 1] * 10 + bank.sources[:, 2]
    np.testing.assert_allclose(bank.components, rows[numbers], rtol=1e-6, atol=1e-6)
    assert at_mean[numbers].sum() == 1
    assert 1 in numbers
    assert 20 <= len(bank) <= (40 if config.components else 60)
    best = best_cosines(rows[~at_mean], bank)
    assert bank.coverage == 1
    assert bank.cosine == pytest.approx((best.sum() + at_mean.sum()) / 120, abs=1e-5)


def test_the_component_of_cells_at_the_mean_counts_among_those_that_are_asked_for() -> None:
    maps, _ = mixed_maps()
    for components in (20, 31, 40):
        assert components / 2 <= len(build_bank(stream(maps), SPACE, MEAN, BankConfig(components=components)))
        assert len(build_bank(stream(maps), SPACE, MEAN, BankConfig(components=components))) <= components


def test_the_published_algorithm_leaves_cells_at_the_mean_out_and_says_so() -> None:
    maps, at_mean = mixed_maps()
    bank = build_bank(stream(maps), SPACE, MEAN, BankConfig(method="paper", threshold=0.5))
    numbers = bank.sources[:, 0] * 60 + bank.sources[:, 1] * 10 + bank.sources[:, 2]
    assert not at_mean[numbers].any()
    assert bank.coverage <= 2 / 3


def test_a_threshold_of_one_covers_all_features_and_each_is_its_own_component() -> None:
    rows = MEAN + np.random.default_rng(0).normal(size=(300, 16))
    bank = build_bank(stream([map_of(rows, 15, 20)]), SPACE, MEAN, BankConfig(threshold=1.0))
    assert len(bank) == 300
    assert bank.coverage == 1
    assert bank.cosine == pytest.approx(1, abs=1e-6)


def test_kinds_that_few_cells_have_come_as_near_to_a_component_as_the_others() -> None:
    rng = np.random.default_rng(2)
    common = kinds(1, seed=5)[[0] * 5000] + 0.01 * rng.normal(size=(5000, 16))
    rare = kinds(60, seed=3)
    rows = MEAN + np.concatenate([common, rare, common[:40]])
    bank = build_bank(stream([map_of(rows, 51, 100)]), SPACE, MEAN, BankConfig(cosine=0.9))
    assert best_cosines((MEAN + rare).astype(np.float32), bank).mean() > 0.88


def test_more_names_than_a_bank_takes_whole_are_reduced_for_the_mean_cosine(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    table = (rng.normal(size=16) + 0.1 * rng.normal(size=(40, 16))).astype(np.float32)
    codes = rng.permutation(np.arange(240) % 40).reshape(12, 20).astype(np.int32)
    maps = [FeatureMap(codes=codes, table=table, grid_from_image=GRID, space=SPACE)]
    for most, reduced in ((39, True), (40, False)):
        monkeypatch.setattr(bank_module, "MAX_NAMES", most)
        bank = build_bank(stream(maps), SPACE, np.zeros(16, np.float32))
        assert (len(bank) < 40) == reduced
        assert bank.cosine >= 0.9 - 1e-6


def test_a_threshold_is_searched_among_features_of_all_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bank_module, "SAMPLE", 100)
    rng = np.random.default_rng(4)
    same = MEAN + kinds(1)[[0] * 200] + 0.001 * rng.normal(size=(200, 16))
    maps = [map_of(same, 10, 20), *(map_of(MEAN + kinds(200, seed=seed), 10, 20) for seed in (1, 2, 3))]
    bank = build_bank(stream(maps), SPACE, MEAN, BankConfig(cosine=0.8))
    assert bank.cosine > 0.75


def test_one_component_is_refused_where_cells_at_the_mean_need_one_of_their_own() -> None:
    row = MEAN + kinds(1)[0]
    two = np.stack([row, MEAN, row, row]).astype(np.float32)
    with pytest.raises(InputError, match="cells at the mean need a component beside that of others; give 2 or more"):
        build_bank(stream([map_of(two, 2, 2)]), SPACE, MEAN, BankConfig(components=1))
    assert len(build_bank(stream([map_of(two, 2, 2)]), SPACE, MEAN, BankConfig(components=2))) == 2
    at_mean = np.repeat(MEAN[None], 4, axis=0)
    assert len(build_bank(stream([map_of(at_mean, 2, 2)]), SPACE, MEAN, BankConfig(components=1))) == 1
