"""Memories on disk: what is read is what was written, as memories and as features, and nothing else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import header_of
from memory_samples import make_memory
from safetensors.numpy import load_file
from splats import random_gaussians

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import MEMORY_FILE, SCENE_FILE, load_features, load_memories, save_features, save_memories
from gsencoder.types import FeatureBasis, FeatureSpace, QueryMemory, Scene

SCENE = Scene(name="room", gaussians=random_gaussians(200))


def assert_near(read: QueryMemory, written: QueryMemory) -> None:
    """Equal to the precision of float16."""
    scale = np.abs(written.queries).max(axis=0)
    np.testing.assert_allclose(read.queries / scale, written.queries / scale, atol=5e-4)
    np.testing.assert_allclose(read.bank.components, written.bank.components, rtol=2e-3, atol=2e-3)
    for name in ("weights", "projection", "mean"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_array_equal(read.bank.mean, written.bank.mean)
    np.testing.assert_array_equal(read.bank.sources, written.bank.sources)
    np.testing.assert_array_equal(read.bank.grid_from_image, written.bank.grid_from_image)
    for name in ("scoring", "temperature", "space"):
        assert getattr(read, name) == getattr(written, name)
    assert (read.bank.threshold, read.bank.coverage, read.bank.cosine) == (0.9, 1.0, 0.95)


@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
def test_one_memory_is_read_back_and_decoded_as_features(tmp_path: Path, scoring: str) -> None:
    memory = make_memory(scoring)  # type: ignore[arg-type]
    save_memories(tmp_path, SCENE, {"only": memory}, {"made": "here"})
    assert sorted(path.name for path in tmp_path.iterdir()) == [MEMORY_FILE, SCENE_FILE]
    read = load_memories(tmp_path)
    assert list(read) == [None]
    assert_near(read[None], memory)
    scene = load_features(tmp_path)
    features = scene.features["s"]
    np.testing.assert_array_equal(features.features, read[None].features().features)
    np.testing.assert_array_equal(features.weights, memory.weights)
    assert header_of(tmp_path / MEMORY_FILE)["settings"] == {"made": "here"}


def test_several_memories_are_read_by_teacher_and_keep_their_bases(tmp_path: Path) -> None:
    one = make_memory()
    components = np.linalg.qr(np.random.default_rng(0).normal(size=(24, 5)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=one.mean, components=components, energy_kept=0.9, space=one.space)
    space = FeatureSpace(name="t", channels=24)
    other = make_memory("dot")
    other = replace(other, bank=replace(other.bank, space=space))
    save_memories(tmp_path, SCENE, {"first": replace(one, basis=basis), "second": other})
    read = load_memories(tmp_path)
    assert_near(read["first"], one)
    assert_near(read["second"], other)
    assert read["first"].basis is not None
    scene = load_features(tmp_path)
    assert set(scene.features) == {"first", "second"}
    assert scene.features["first"].features.shape == (200, 5)


def test_channels_of_very_different_size_keep_their_precision(tmp_path: Path) -> None:
    memory = make_memory()
    size = np.logspace(-6, 5, 24).astype(np.float32)
    bank = replace(memory.bank, components=memory.bank.components * size, mean=memory.bank.mean * size)
    queries = memory.queries * np.array([1e-6, 1, 1e6, 1, 1, 0], np.float32)
    save_memories(tmp_path, SCENE, {"a": replace(memory, bank=bank, queries=queries)})
    read = load_memories(tmp_path)[None]
    np.testing.assert_allclose(read.bank.components / size, memory.bank.components, rtol=2e-3, atol=2e-3)
    np.testing.assert_array_equal(read.queries[:, 5], 0)
    np.testing.assert_allclose(read.queries[:, 0] * 1e6, memory.queries[:, 0], atol=2e-3)


def test_memories_of_another_splat_or_number_of_gaussians_are_refused(tmp_path: Path) -> None:
    memory = make_memory()
    with pytest.raises(InputError, match="200 queries need as many Gaussians, got 150"):
        save_memories(tmp_path / "a", Scene(name="b", gaussians=random_gaussians(150)), {"a": memory})
    with pytest.raises(InputError, match="has no Gaussians"):
        save_memories(tmp_path / "b", Scene(name="b"), {"a": memory})
    save_memories(tmp_path / "c", SCENE, {"a": memory})
    gaussians = random_gaussians(200)
    changed = replace(gaussians, opacities=gaussians.opacities[::-1].copy())
    save_memories(tmp_path / "d", Scene(name="b", gaussians=changed), {"a": memory})
    (tmp_path / "c" / MEMORY_FILE).write_bytes((tmp_path / "d" / MEMORY_FILE).read_bytes())
    for load in (load_features, load_memories):
        with pytest.raises(InputError, match="the features belong to splat .* make the memory of this splat again"):
            load(tmp_path / "c")


def test_two_kinds_of_features_and_two_runs_are_refused(tmp_path: Path) -> None:
    memory = make_memory()
    save_memories(tmp_path / "a", SCENE, {"a": memory})
    save_features(tmp_path / "a", SCENE, memory.features())
    with pytest.raises(InputError, match="holds features and memories, two kinds of features; keep one"):
        load_features(tmp_path / "a")
    save_memories(tmp_path / "b", SCENE, {"a": memory, "b": memory})
    save_memories(tmp_path / "b", SCENE, {"a": memory})
    with pytest.raises(InputError, match=r"holds memory\.safetensors and those of a, b, of two runs"):
        load_features(tmp_path / "b")
    save_features(tmp_path / "c", SCENE, memory.features())
    with pytest.raises(InputError, match=r"features, without memory\.safetensors; expected a folder with a memory"):
        load_memories(tmp_path / "c")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("rows", lambda rows: rows[::-1].copy(), "row numbers that rise"),
        ("rows", lambda rows: rows + 1, "row numbers that rise"),
        ("weights", lambda weights: weights * 0, "weights above 0"),
        ("queries", lambda queries: queries[:, :-1].copy(), "queries"),
        ("bank", lambda bank: bank[:-1].copy(), "sources"),
        ("bank", lambda bank: bank * np.float16(np.inf), "finite"),
    ],
)
@pytest.mark.usefixtures("no_jaxtyping")
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, name: str, change: object, message: str) -> None:
    assert callable(change)
    save_memories(tmp_path, SCENE, {"a": make_memory()})
    path = tmp_path / MEMORY_FILE
    arrays = load_file(path)
    write_archive(path, arrays | {name: change(arrays[name])}, header_of(path))
    with pytest.raises(InputError, match=message):
        load_features(tmp_path)


def test_another_scoring_is_refused(tmp_path: Path) -> None:
    save_memories(tmp_path, SCENE, {"a": make_memory()})
    path = tmp_path / MEMORY_FILE
    write_archive(path, load_file(path), header_of(path) | {"scoring": "magic"})
    with pytest.raises(InputError, match="expected scoring centered, cosine or dot in the header, got 'magic'"):
        load_features(tmp_path)
