"""Memory banks: what they cover, where their components come from, and what cannot be reduced; cells at the mean, rare
kinds, many names, and small samples."""

from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.memory import bank as bank_module
from gsencoder.memory import reduction
from gsencoder.memory.bank import BankConfig, MapStream, build_bank, draw_sample, raw_features
from gsencoder.memory.reduction import CoverReduction, reduce_algorithm1, unit_rows
from gsencoder.types import FeatureMap, FeatureSpace, MemoryBank

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
    return lambda: iter(enumerate(maps))


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
        features = maps[view].features
        np.testing.assert_allclose(component, features[row, column], rtol=1e-5, atol=1e-6)


def test_the_published_bank_states_the_share_that_it_covers() -> None:
    maps = dense_maps()
    rows = all_rows(maps)
    mean = rows.mean(axis=0)
    bank = build_bank(stream(maps), SPACE, mean, BankConfig(method="paper", threshold=0.85, drop_last=100))
    expected, _ = reduce_algorithm1(unit_rows(rows - mean), 0.85, drop_last=100)
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
        with pytest.raises(InputError, match="view 1: 20 of 20 features of s are not finite"):
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


MEAN = (3 * np.random.default_rng(7).normal(size=16)).astype(np.float32)


def map_of(rows: np.ndarray, height: int, width: int) -> FeatureMap:
    features = rows.reshape(height, width, 16).astype(np.float32)
    return FeatureMap(features=features, grid_from_image=GRID, space=SPACE)


def kinds(count: int, seed: int = 0) -> np.ndarray:
    """Directions of length 1, far from each other."""
    rows = np.random.default_rng(seed).normal(size=(count, 16))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def best_cosines(rows: np.ndarray, bank: MemoryBank) -> np.ndarray:
    """Of features with the nearest component, about the mean of the bank."""
    lengths = np.linalg.norm(bank.components.astype(np.float64) - bank.mean, axis=1)
    off_mean = lengths > 1e-3 * np.linalg.norm(bank.mean.astype(np.float64))
    return cosines(rows, bank.components[off_mean], bank.mean).max(axis=1)


def mixed_maps(rounding: float = 0.0) -> tuple[list[FeatureMap], np.ndarray]:
    """Two maps in which every third cell, from the second one on, is at the mean but for rounding; and which are."""
    rng = np.random.default_rng(1)
    rows = MEAN + kinds(30)[rng.integers(0, 30, 120)] + 0.02 * rng.normal(size=(120, 16))
    at_mean = np.arange(120) % 3 == 1
    rows[at_mean] = MEAN * (1 + rounding * rng.uniform(-1, 1, (at_mean.sum(), 1)))
    return [map_of(rows[:60], 6, 10), map_of(rows[60:], 6, 10)], at_mean


@pytest.mark.parametrize("rounding", [0.0, 1e-5])
@pytest.mark.parametrize("config", [BankConfig(), BankConfig(threshold=0.95), BankConfig(components=40)])
def test_cells_at_the_mean_have_one_component_and_take_no_part_in_the_cover(rounding, config):
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
    with pytest.raises(InputError, match="cells at the mean need a component besides that of others; give 2 or more"):
        build_bank(stream([map_of(two, 2, 2)]), SPACE, MEAN, BankConfig(components=1))
    assert len(build_bank(stream([map_of(two, 2, 2)]), SPACE, MEAN, BankConfig(components=2))) == 2
    at_mean = np.repeat(MEAN[None], 4, axis=0)
    assert len(build_bank(stream([map_of(at_mean, 2, 2)]), SPACE, MEAN, BankConfig(components=1))) == 1


def redundant_rows(rng: np.random.Generator, count: int, channels: int = 16) -> np.ndarray:
    """Rows between pairs of a few directions, most near one of them, of many lengths."""
    centers = rng.normal(size=(12, channels))
    one, other = centers[rng.integers(0, 12, (2, count))]
    share = rng.random((count, 1)) ** 3
    rows = one * (1 - share) + other * share + 0.08 * rng.normal(size=(count, channels))
    return (rows * np.exp(rng.normal(size=(count, 1)))).astype(np.float32)


def cover_of(features: np.ndarray, threshold: float) -> np.ndarray:
    cover = CoverReduction(features.shape[1], threshold)
    cover.add(features)
    return cover.rows


def published(features: np.ndarray, threshold: float) -> np.ndarray:
    return reduce_algorithm1(unit_rows(features), threshold)[0]


def transcription(features: np.ndarray, threshold: float, chunk: int, *, drop_last: bool) -> tuple[list, np.ndarray]:
    """Algorithm 1, line by line; the code that M3's authors published does not drop the last chunk."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    components, used = [], np.zeros(len(unit), bool)
    for k in range(len(unit) // chunk if drop_last else -(-len(unit) // chunk)):
        similarities = unit[k * chunk : (k + 1) * chunk] @ unit.T
        for j, row in enumerate(similarities, start=k * chunk):
            if not used[j]:
                neighbors = np.flatnonzero(row >= threshold)
                if not used[neighbors].any():
                    components.append(j)
                    used[neighbors] = True
    return components, used


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize("threshold", [0.5, 0.9, 0.98])
def test_the_published_algorithm_gives_what_its_transcription_gives(rng, monkeypatch, threshold, drop_last):
    # Few witnesses and small products, so that rows are settled in all three ways.
    monkeypatch.setattr(reduction, "WITNESSES", 20)
    monkeypatch.setattr(reduction, "BLOCK", 100)
    monkeypatch.setattr(reduction, "PRODUCT_VALUES", 30_000)
    features = redundant_rows(rng, 1070)
    components, used = transcription(features, threshold, 100, drop_last=drop_last)
    rows, in_use = reduce_algorithm1(unit_rows(features), threshold, drop_last=100 if drop_last else 0)
    assert 5 <= len(components) < 1000
    assert rows.tolist() == components
    np.testing.assert_array_equal(in_use, used)


@pytest.mark.parametrize("threshold", [0.3, 0.9, 0.99])
def test_every_feature_is_within_the_threshold_of_a_component_of_a_cover(rng, threshold):
    features = redundant_rows(rng, 3000)
    rows = cover_of(features, threshold)
    unit = features.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    cosines = unit @ unit[rows].T
    assert cosines.max(axis=1).min() >= threshold
    assert 1 < len(rows) < 3000
    # No component stands for another one.
    among = np.triu(cosines[rows], k=1)
    assert among.max() < threshold + 2 * reduction.ROUNDING


def test_a_feature_whose_cosine_only_rounds_to_the_threshold_has_a_component_of_its_own(rng):
    """So that a cover holds in exact arithmetic."""
    leader = rng.normal(size=96)
    leader /= np.linalg.norm(leader)
    across = rng.normal(size=(150, 96))
    across -= (across @ leader)[:, None] * leader
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    cosine = 0.5 + rng.uniform(-1e-7, 1e-7, (150, 1))
    features = np.concatenate([leader[None], cosine * leader + np.sqrt(1 - cosine**2) * across]).astype(np.float32)
    unit = features.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    assert ((unit @ unit[0])[1:] < 0.5).sum() > 30
    assert (unit @ unit[cover_of(features, 0.5)].T).max(axis=1).min() >= 0.5


def test_a_cover_is_the_same_however_features_are_divided(rng: np.random.Generator) -> None:
    features, whole = redundant_rows(rng, 3000), CoverReduction(16, 0.8)
    whole.add(features)
    parts = CoverReduction(16, 0.8)
    for part in np.split(features, [1, 500, 501, 2600]):
        parts.add(part)
    assert parts.rows.tolist() == whole.rows.tolist()
    np.testing.assert_array_equal(whole.components, features[whole.rows])
    np.testing.assert_array_equal(whole.unit, unit_rows(features)[whole.rows])


@pytest.mark.parametrize("reduce", [published, cover_of])
def test_equal_directions_are_one_component_and_others_each_at_a_threshold_of_one(rng, reduce):
    """Though the product of a row with itself may round to less than 1."""
    direction = np.linspace(-1, 2, 384, dtype=np.float32)
    features = np.stack([direction * length for length in (1e-30, 1, 3e37, 7, 1e-3)]).astype(np.float32)
    for threshold in (0.5, 1.0):
        assert reduce(features, threshold).tolist() == [0]
        assert reduce(features[:1], threshold).tolist() == [0]
    assert reduce(rng.normal(size=(300, 17)).astype(np.float32), 1.0).tolist() == list(range(300))


def test_what_has_no_direction_is_refused() -> None:
    for value, what in ((0.0, "zero"), (np.nan, "not finite"), (np.inf, "not finite")):
        broken = np.ones((4, 3), np.float32)
        broken[2] = value
        with pytest.raises(InputError, match=f"1 of 4 rows have no direction: row 2 is {what}"):
            cover_of(broken, 0.5)


NUMBERS = FeatureSpace(name="numbers", channels=2)
AFFINE = np.array([[0.5, 0, 0], [0, 0.25, 0]])


def numbered_maps(*sizes: tuple[int, int], missing: float = 0.0) -> list[FeatureMap]:
    """Maps whose features are the number of the map and that of the cell."""
    maps, rng = [], np.random.default_rng(0)
    for number, (height, width) in enumerate(sizes):
        cells = np.arange(height * width).reshape(height, width)
        features = np.stack([np.full_like(cells, number), cells], axis=2).astype(np.float32)
        features[rng.random((height, width)) < missing] = np.nan
        maps.append(FeatureMap(features=features, grid_from_image=AFFINE * (number + 1), space=NUMBERS))
    return maps


@pytest.mark.parametrize("limit", [1, 59, 60, 61])
def test_a_sample_has_so_many_different_features_of_the_maps_in_their_order(limit: int) -> None:
    maps = numbered_maps((4, 5), (3, 10), (2, 5))
    sample = draw_sample(stream(maps), NUMBERS, limit)
    assert sample.total == 60
    assert len(sample.features) == min(limit, 60)
    keys = [(view, cell) for view, cell in sample.features.tolist()]
    assert keys == sorted(set(keys))
    assert set(keys) <= {(view, cell) for view, cells in enumerate((20, 30, 10)) for cell in range(cells)}


def test_cells_without_a_feature_are_in_no_sample_and_not_counted() -> None:
    maps = numbered_maps((20, 20), (20, 20), missing=0.5)
    sample = draw_sample(stream(maps), NUMBERS, 10_000)
    rows = np.concatenate([raw_features(view, each)[0] for view, each in enumerate(maps)])
    np.testing.assert_array_equal(sample.features, rows)
    assert sample.total == len(rows) < 500
    empty = draw_sample(stream(numbered_maps((3, 3), missing=1.1)), NUMBERS, 5)
    assert (empty.features.shape, empty.total) == ((0, 2), 0)


def test_every_feature_is_drawn_equally_often() -> None:
    """Views of any size and columns of any map: counts over seeds are those of independent draws."""
    maps = numbered_maps((2, 32), (1, 4), (4, 8))
    seeds, limit = 300, 25
    counts = {}
    for seed in range(seeds):
        for key in map(tuple, draw_sample(stream(maps), NUMBERS, limit, seed=seed).features.tolist()):
            counts[key] = counts.get(key, 0) + 1
    drawn = np.array([counts.get((view, cell), 0) for view, n in enumerate((64, 4, 32)) for cell in range(n)])
    share = limit / 100
    deviation = (drawn - seeds * share) / np.sqrt(seeds * share * (1 - share))
    assert np.abs(deviation).max() < 4.5
    assert np.square(deviation).mean() == pytest.approx(1, abs=0.5)


def test_a_view_is_sampled_whatever_cells_another_view_gives() -> None:
    sample = draw_sample(stream(numbered_maps((20, 20), (20, 20))), NUMBERS, 200)
    first, second = (set(sample.features[sample.features[:, 0] == view, 1].tolist()) for view in (0, 1))
    # A quarter of all cells is drawn, and a quarter of these in the other view as well.
    assert len(first & second) < 0.5 * min(len(first), len(second))


def test_a_seed_gives_the_same_sample_again_and_another_seed_another_one() -> None:
    maps = stream(numbered_maps((10, 10), (10, 10)))
    first, again, other = (draw_sample(maps, NUMBERS, 20, seed=seed).features for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_cell_of_a_component_is_where_the_affine_of_its_map_puts_its_source() -> None:
    maps = numbered_maps((4, 5), (3, 10), (2, 5))
    bank = build_bank(stream(maps), NUMBERS, np.zeros(2, np.float32))
    assert len(bank) > 2
    assert len(set(bank.sources[:, 0].tolist())) > 1
    for (view, row, column), (left, top, right, bottom) in zip(bank.sources.tolist(), bank.cells, strict=True):
        affine = maps[view].grid_from_image
        corners = affine @ np.array([[left, right], [top, bottom], [1, 1]])
        np.testing.assert_allclose(corners, [[column, column + 1], [row, row + 1]], atol=1e-12)
