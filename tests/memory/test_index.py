"""Index memory and queries without training: what they stand for, here and on disk."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from feature_fields import SPACE, make_features
from memory_samples import make_bank, memory_of_features
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splats.files import load_splat, save_splat
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.package import PACKAGE_FILE, SPLAT_FILE, save_index_package
from gsencoder.memory import index as index_module
from gsencoder.memory.bank import principal_queries
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.memory.reduction import CoverReduction
from gsencoder.text.table import WORDS_FILE, make_text_table, save_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, MemoryBank, Scene
from gsencoder.types.features import Scoring


def centered_cosines(one: GaussianFeatures, other: GaussianFeatures) -> np.ndarray:
    """Of decoded features that were seen, in float64."""
    a, b = (each.decode(one.seen).astype(np.float64) - each.mean for each in (one, other))
    return np.asarray((a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1))


@pytest.mark.parametrize("basis", [True, False])
def test_the_stated_error_is_that_of_the_rows_that_gaussians_have(basis: bool) -> None:
    features = make_features(basis=basis)
    coarse, fine = (index_features(features, IndexConfig(threshold=threshold)) for threshold in (0.7, 0.95))
    assert 5 < len(coarse.features.features) < len(fine.features.features) < 1500
    assert coarse.error > 3 * fine.error > 0
    for made in (coarse, fine):
        assert len(made.features) == len(features)
        np.testing.assert_array_equal(made.features.seen, features.seen)
        np.testing.assert_array_equal(made.features.stored(~features.seen), 0)
        cosines = centered_cosines(features, made.features)
        assert made.error == pytest.approx(1 - cosines.mean(), abs=1e-6)
        assert made.lowest == pytest.approx(np.quantile(cosines, 0.001), abs=1e-6)
    assert fine.lowest > coarse.lowest


def test_a_rare_kind_among_many_gaussians_keeps_its_row() -> None:
    features = make_features(n=20_000, kinds=3)
    values = features.features.copy()
    rare = np.flatnonzero(features.seen)[1234]
    values[rare] = -4 * values[0 if features.seen[0] else 1]
    features = replace(features, features=values)
    made = index_features(features, IndexConfig(threshold=0.0, rows=5))
    np.testing.assert_allclose(made.features.stored(np.array([rare])), values[[rare]], rtol=1e-5)


@pytest.mark.parametrize("basis", [True, False])
def test_features_at_the_mean_but_for_rounding_have_a_row_of_their_own_and_no_cosine(basis: bool) -> None:
    features = make_features(basis=basis, kinds=4)
    values, middle = features.features.copy(), np.zeros(6) if basis else features.mean
    at_mean = np.flatnonzero(features.seen)[:50]
    values[at_mean] = middle * (1 + 1e-5 * np.random.default_rng(0).uniform(-1, 1, (50, 1)))
    made = index_features(replace(features, features=values), IndexConfig(threshold=0.99))
    assert len(made.features.features) == 5
    np.testing.assert_array_equal(made.features.stored(at_mean), np.tile(middle, (50, 1)))
    assert made.error < 1e-6
    nothing = index_features(replace(features, features=np.tile(np.float32(middle), (len(features), 1))))
    assert len(nothing.features.features) == 1
    assert nothing.error == 0


@pytest.mark.parametrize("basis", [True, False])
def test_every_gaussian_has_the_row_that_is_nearest_to_it_and_every_row_is_used(basis: bool) -> None:
    features = make_features(basis=basis)
    made = index_features(features, IndexConfig(threshold=0.8)).features
    table, seen = made.features.astype(np.float64), features.seen
    distances = np.linalg.norm(features.features[seen][:, None] - table, axis=2)
    own = distances[np.arange(seen.sum()), made.index[seen]]
    np.testing.assert_allclose(own, distances.min(axis=1), atol=1e-5)
    np.testing.assert_array_equal(np.unique(made.index[seen]), np.arange(len(table)))
    np.testing.assert_array_equal(made.weights, features.weights)


def test_a_row_is_the_mean_of_the_gaussians_that_have_it() -> None:
    features = make_features(kinds=7)
    noise = 0.01 * np.random.default_rng(0).normal(size=features.features.shape)
    values = (features.features + noise).astype(np.float32) * features.seen[:, None]
    made = index_features(replace(features, features=values), IndexConfig(threshold=0.97)).features
    assert len(made.features) == 7
    for row, vector in enumerate(made.features):
        np.testing.assert_allclose(vector, values[made.index == row].mean(axis=0, dtype=np.float64), atol=1e-5)


def test_the_threshold_that_is_stated_is_the_largest_one_whose_table_has_so_few_rows() -> None:
    features = make_features(n=1000)
    made = index_features(features, IndexConfig(threshold=0.0, rows=60))
    centered = features.features[features.seen]
    for threshold, few in ((made.threshold, True), (made.threshold + 2 / 4096, False)):
        cover = CoverReduction(centered.shape[1], threshold)
        cover.add(centered)
        assert (len(cover) <= 60) == few


def test_the_number_of_rows_is_a_limit_and_more_than_two_bytes_number_are_refused(monkeypatch):
    features = make_features()
    for rows in (30, 300):
        made = index_features(features, IndexConfig(threshold=0.0, rows=rows))
        assert rows / 3 <= len(made.features.features) <= rows
    with pytest.raises(InputError, match=r"rows=2: the features point in more directions than that even at"):
        index_features(features, IndexConfig(threshold=0.0, rows=2))
    monkeypatch.setattr(index_module, "MAX_ROWS", 40)
    with pytest.raises(InputError, match=r"more than 40 rows; give threshold=0\.\d+, or rows="):
        index_features(features, IndexConfig(threshold=0.99))
    with pytest.raises(InputError, match="no Gaussian has features"):
        index_features(replace(features, weights=np.zeros_like(features.weights)))
    for config in ({"threshold": 0.0}, {"rows": 9}, {"threshold": 1.5}, {"threshold": 0.0, "rows": 1}):
        with pytest.raises(InputError, match="threshold|rows"):
            IndexConfig(**config)


@pytest.mark.parametrize(("rows", "row_bytes"), [(255, 1), (256, 2)])
def test_a_package_of_an_index_is_read_back(tmp_path: Path, rows: int, row_bytes: int) -> None:
    source = make_features()
    table = make_features(n=rows).features
    index = np.where(source.seen, np.arange(len(source)) % rows, -1).astype(np.int32)
    features = replace(source, features=table, index=index)
    scene = Scene(name="room", gaussians=random_gaussians(len(source)))
    save_index_package(tmp_path, scene, features, error=0.01)
    read = load_features(tmp_path).features["s"]
    np.testing.assert_array_equal(read.index, index)
    np.testing.assert_allclose(read.features, table, rtol=2e-3, atol=1e-3)
    np.testing.assert_array_equal(read.weights, source.seen)
    assert read.space == SPACE
    beyond = (tmp_path / PACKAGE_FILE).stat().st_size - row_bytes * len(source)
    assert rows * 12 < beyond < rows * 12 + 4000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = Scene(name="room", gaussians=random_gaussians(3000))
    save_features(tmp_path / "features", scene, make_features())
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(12, 2)))[0].T
    save_text_table(tmp_path / "features" / WORDS_FILE, make_text_table(["mug", "chair"], vectors, "words"))
    return tmp_path / "features"


def test_pack_writes_an_index_that_localize_and_pack_read(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["pack", str(folder), "form=index", "index.threshold=0.8", f"out={out}"]) == 0
    results = json.loads((out / "summary.json").read_text())["results"]
    assert f"one of {results['rows']} rows in one byte; centered cosines lose" in capsys.readouterr().out
    assert results["bytes"] == (out / PACKAGE_FILE).stat().st_size
    assert results["threshold"] == 0.8
    made = index_features(make_features(), IndexConfig(threshold=0.8))
    assert (results["rows"], results["row_bytes"]) == (len(made.features.features), 1)
    assert (results["error"], results["lowest"]) == pytest.approx((made.error, made.lowest), abs=1e-3)
    assert results["share_of_float16"] == results["bytes"] / (2 * 12 * 3000)
    assert 0 < results["error"] < 0.2
    assert cli.main(["localize", str(out), "query=mug", f"out={tmp_path / 'boxes'}", "pictures=0"]) == 0
    for form in ("compact", "npz", "index"):
        assert cli.main(["pack", str(out), f"form={form}", f"out={tmp_path / form}", "quiet=true"]) == 0
    stored = np.load(tmp_path / "npz" / "features.npz")["features"]
    np.testing.assert_array_equal(stored, load_features(out).features["s"].stored())


def test_settings_of_an_index_and_another_splat_are_refused(folder, tmp_path, capsys):
    out = tmp_path / "out"
    for words, message in (
        (["index.threshold=1.2"], "index.threshold: expected 0 to 1, got 1.2"),
        (["index.threshold=0"], "index.threshold: 0 needs rows=2 or more as well"),
        (["index.rows=8", "budget.error=0.1"], "index.rows: 8 rows need threshold=0 as well, got 0.9; with a budget"),
        (["decoded=true"], "form=index holds codes"),
    ):
        assert cli.main(["pack", str(folder), "form=index", f"out={out}", *words]) == 2
        assert message in capsys.readouterr().err
        assert not out.exists()
    assert cli.main(["pack", str(folder), "form=index", f"out={out}"]) == 0
    splat = load_splat(out / SPLAT_FILE)
    save_splat(out / SPLAT_FILE, replace(splat, opacities=splat.opacities[::-1].copy()))
    with pytest.warns(SceneWarning, match="not as it was written"), pytest.raises(InputError, match="belong to splat"):
        load_features(out)


def test_two_rows_hold_two_opposite_kinds_where_nothing_lies_at_the_mean() -> None:
    directions = np.repeat(np.float32([[1, 0, 0], [-1, 0, 0]]), 5, axis=0)
    space, mean = FeatureSpace(name="s", channels=3), np.zeros(3, np.float32)
    features = GaussianFeatures(features=directions, weights=np.ones(10, np.float32), mean=mean, space=space)
    made = index_features(features, IndexConfig(threshold=0.0, rows=2))
    assert len(made.features.features) == 2
    np.testing.assert_allclose(made.features.stored(), directions, atol=1e-6)
    at_mean = np.concatenate([directions, np.zeros((1, 3), np.float32)])
    more = replace(features, features=at_mean, weights=np.ones(11, np.float32))
    with pytest.raises(InputError, match="rows=2: the features point in more directions"):
        index_features(more, IndexConfig(threshold=0.0, rows=2))


def bank_of(features: GaussianFeatures, scoring: Scoring = "centered") -> MemoryBank:
    """Every seventh feature that was seen."""
    rows = features.decode(np.flatnonzero(features.seen)[::7])
    mean = features.mean if scoring == "centered" else np.zeros_like(features.mean)
    return make_bank(rows, mean, features.space)


@pytest.mark.parametrize("basis", [True, False])
@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
def test_queries_of_all_directions_stand_for_the_features(basis: bool, scoring: Scoring) -> None:
    features = make_features(basis=basis)
    queries, projection = principal_queries(features, bank_of(features), 13, scoring)
    seen = features.seen
    np.testing.assert_array_equal(queries[~seen], 0)
    products = queries[seen].astype(np.float64) @ projection
    expected = features.decode(seen) - (features.mean if scoring == "centered" else 0)
    cosines = (products * expected).sum(axis=1) / np.linalg.norm(products, axis=1) / np.linalg.norm(expected, axis=1)
    np.testing.assert_allclose(cosines, 1, atol=1e-5)
    if scoring == "dot":
        np.testing.assert_allclose(products, expected, rtol=1e-3, atol=1e-4)
    else:
        assert queries[seen].std() == pytest.approx(1, abs=1e-5)
        directions = projection[int(scoring == "cosine") :]
        lengths = np.linalg.norm(directions, axis=1)
        np.testing.assert_allclose(lengths[lengths > 1e-3], np.sqrt(12), rtol=1e-5)


def test_fewer_channels_keep_the_directions_in_which_the_components_differ_most() -> None:
    features = make_features(basis=False)
    bank = bank_of(features)
    keys = (bank.components - features.mean).astype(np.float64)
    keys /= np.linalg.norm(keys, axis=1, keepdims=True)
    values = np.linalg.eigvalsh(keys.T @ keys)[::-1]
    for channels in (1, 3, 6):
        queries, projection = principal_queries(features, bank, channels)
        unit = projection / np.linalg.norm(projection, axis=1, keepdims=True)
        assert ((keys @ unit.T) ** 2).sum() == pytest.approx(values[:channels].sum(), rel=1e-5)
        assert queries.shape == (3000, channels)


def test_with_cosines_the_directions_are_those_about_the_mean_of_the_features_whatever_the_bank_subtracts() -> None:
    features = make_features(basis=False)
    bank = bank_of(features, "cosine")
    assert not bank.mean.any()
    keys = (bank.components - features.mean).astype(np.float64)
    keys /= np.linalg.norm(keys, axis=1, keepdims=True)
    _, projection = principal_queries(features, bank, 4, "cosine")
    unit = projection[1:] / np.linalg.norm(projection[1:], axis=1, keepdims=True)
    expected = np.linalg.eigvalsh(keys.T @ keys)[::-1][:3].sum()
    assert ((keys @ unit.T) ** 2).sum() == pytest.approx(expected, rel=1e-5)
    # The first channel is the mean, and 1 for every Gaussian before all channels are divided by their spread.
    length = np.linalg.norm(projection[0]) * np.linalg.norm(features.mean)
    assert projection[0] @ features.mean == pytest.approx(length, rel=1e-5)


def test_rare_kinds_are_told_apart_where_most_gaussians_are_of_one_kind() -> None:
    rng = np.random.default_rng(0)
    kinds = np.linalg.qr(rng.normal(size=(12, 6)))[0].T.astype(np.float32)
    features = make_features(basis=False)
    number = np.where(rng.random(3000) < 0.99, 0, rng.integers(0, 6, 3000))
    values = features.mean + kinds[number] + 0.3 * rng.normal(size=(3000, 1)).astype(np.float32) * kinds[0]
    values[~features.seen] = 0
    features = replace(features, features=values.astype(np.float32))
    memory = memory_of_features(features, make_bank(features.mean + kinds, features.mean, SPACE), channels=5)
    seen = np.flatnonzero(features.seen)
    nearest = memory.attention(memory.queries[seen]).argmax(axis=1)
    assert (nearest == number[seen])[number[seen] > 0].mean() > 0.95


@pytest.mark.parametrize("scoring", ["centered", "cosine"])
def test_a_memory_without_training_decodes_to_features_near_those_it_was_made_of(scoring: Scoring) -> None:
    features = make_features()
    memory = memory_of_features(features, bank_of(features, scoring), channels=7, scoring=scoring, temperature=0.01)
    decoded = memory.features()
    np.testing.assert_array_equal(decoded.seen, features.seen)
    assert np.median(centered_cosines(features, decoded)) > 0.95


def test_an_index_is_taken_as_the_features_that_it_stands_for() -> None:
    features = make_features(kinds=5)
    seen = np.flatnonzero(features.seen)
    table, index = np.unique(features.features[seen], axis=0, return_inverse=True)
    full = np.full(len(features), -1, np.int32)
    full[seen] = index
    indexed = replace(features, features=table, index=full)
    one, other = (principal_queries(each, bank_of(features), 4) for each in (features, indexed))
    np.testing.assert_allclose(np.abs(one[0]), np.abs(other[0]), atol=1e-4)


def test_equal_features_have_finite_queries() -> None:
    features = make_features(basis=False)
    equal = replace(features, features=np.repeat(features.mean[None], len(features), axis=0))
    for scoring in ("centered", "cosine", "dot"):
        queries, projection = principal_queries(equal, bank_of(features), 4, scoring)
        assert np.isfinite(queries).all()
        assert np.isfinite(projection).all()


def test_features_and_banks_of_different_spaces_are_refused() -> None:
    features = make_features()
    bank = replace(bank_of(features), space=FeatureSpace(name="other", channels=SPACE.channels))
    with pytest.raises(InputError, match=r"the features are of \(s .*, and the bank is of \(other"):
        principal_queries(features, bank, 4)
    nothing = replace(features, weights=np.zeros_like(features.weights))
    with pytest.raises(InputError, match="no Gaussian has features"):
        principal_queries(nothing, bank_of(features), 4)
