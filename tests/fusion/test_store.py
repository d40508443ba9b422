"""Folders of features and of memories: what comes back is what went in, and nothing else is taken for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import header_of, rewrite
from feature_fields import SPACE, make_features, make_scene
from memory_samples import make_memory
from safetensors.numpy import load_file
from splats import random_gaussians

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import (
    FEATURES_FILE,
    MEMORY_FILE,
    SCENE_FILE,
    load_features,
    load_memories,
    save_features,
    save_memories,
)
from gsencoder.types import FeatureBasis, FeatureSpace, QueryMemory, Scene

N = 40


def saved(folder: Path) -> None:
    save_features(folder, make_scene(N), make_features(N, rank=3), {})


@pytest.mark.parametrize("basis", [True, False])
@pytest.mark.parametrize("magnitude", [1e-8, 1e6])
def test_scene_and_features_come_back_within_half_precision(tmp_path: Path, magnitude: float, basis: bool) -> None:
    scene, features = make_scene(N, (1e6, -2e6, 3.0)), make_features(N, 3, magnitude, basis)
    save_features(tmp_path, scene, features, {"lift": "blend"})
    loaded = load_features(tmp_path)
    got = loaded.features["s"]
    np.testing.assert_allclose(got.features, features.features, rtol=1e-3, atol=1e-3 * magnitude)
    assert (got.weights == features.weights).all()
    assert got.space == SPACE
    assert (got.basis is not None) == basis
    assert loaded.origin.tolist() == scene.origin.tolist()
    assert loaded.metres_per_unit == 0.5
    assert (loaded.gaussians.means == scene.gaussians.means).all()
    assert loaded.views.names == ("a",)
    with open_archive(tmp_path / FEATURES_FILE) as file:
        assert file.value("settings", dict) == {"lift": "blend"}


@pytest.mark.parametrize("name", [SCENE_FILE, FEATURES_FILE])
@pytest.mark.parametrize("keep", [7, 900])
def test_truncated_files_are_errors(tmp_path: Path, name: str, keep: int) -> None:
    saved(tmp_path)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[:keep])
    with pytest.raises(InputError, match="damaged"):
        load_features(tmp_path)


def test_missing_folders_and_files_say_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder of features"):
        load_features(tmp_path / "nothing")
    with pytest.raises(InputError, match=r"an empty folder, without scene\.safetensors"):
        load_features(tmp_path)


def test_features_that_are_not_finite_are_not_stored(tmp_path: Path) -> None:
    features = make_features(N)
    with pytest.raises(InputError, match="need as many Gaussians"):
        save_features(tmp_path, make_scene(N - 1), features, {})
    features.features[1, 0] = np.nan
    with pytest.raises(InputError, match="1 of 32 rows are not finite"):
        save_features(tmp_path, make_scene(N), features, {})


def changed(path: Path, **arrays: np.ndarray) -> None:
    """Writes a file again with some of its arrays replaced."""
    rewrite(path, load_file(path) | arrays)


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("rows", np.zeros(32, np.int32), "row numbers that rise"),
        ("rows", np.arange(29, dtype=np.int32), r"expected features float16|expected weights float32\[29\]"),
        ("weights", np.zeros(32, np.float32), "weights above 0"),
        ("weights", np.full(32, np.nan, np.float32), "not finite"),
        ("channel_scale", -np.ones(3, np.float32), "channel_scale and weights above 0"),
        ("mean", np.zeros(7, np.float32), r"expected components float32\[3, 7\]"),
        ("components", np.full((3, 12), np.inf, np.float32), "36 of 36 values of components are not finite"),
    ],
)
def test_features_that_do_not_belong_together_are_named(tmp_path, name, values, problem):
    saved(tmp_path)
    changed(tmp_path / FEATURES_FILE, **{name: values})
    with pytest.raises(InputError, match=f"{FEATURES_FILE}: .*({problem})"):
        load_features(tmp_path)


ROOM = Scene(name="room", gaussians=random_gaussians(200))


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


@pytest.mark.parametrize("scoring", ["centered", "dot"])
def test_one_memory_is_read_back_and_decoded_as_features(tmp_path: Path, scoring: str) -> None:
    memory = make_memory(scoring)  # type: ignore[arg-type]
    save_memories(tmp_path, ROOM, {"only": memory}, {"made": "here"})
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
    save_memories(tmp_path, ROOM, {"first": replace(one, basis=basis), "second": other})
    read = load_memories(tmp_path)
    assert_near(read["first"], one)
    assert_near(read["second"], other)
    assert read["first"].basis is not None
    scene = load_features(tmp_path)
    assert set(scene.features) == {"first", "second"}
    assert scene.features["first"].features.shape == (200, 5)


def test_memories_of_another_splat_or_number_of_gaussians_are_refused(tmp_path: Path) -> None:
    memory = make_memory()
    with pytest.raises(InputError, match="200 queries need as many Gaussians, got 150"):
        save_memories(tmp_path / "a", Scene(name="b", gaussians=random_gaussians(150)), {"a": memory})
    with pytest.raises(InputError, match="has no Gaussians"):
        save_memories(tmp_path / "b", Scene(name="b"), {"a": memory})
    save_memories(tmp_path / "c", ROOM, {"a": memory})
    gaussians = random_gaussians(200)
    changed = replace(gaussians, opacities=gaussians.opacities[::-1].copy())
    save_memories(tmp_path / "d", Scene(name="b", gaussians=changed), {"a": memory})
    (tmp_path / "c" / MEMORY_FILE).write_bytes((tmp_path / "d" / MEMORY_FILE).read_bytes())
    for load in (load_features, load_memories):
        with pytest.raises(InputError, match="the features belong to splat .* make the memory of this splat again"):
            load(tmp_path / "c")


def test_two_kinds_of_features_and_two_runs_are_refused(tmp_path: Path) -> None:
    memory = make_memory()
    save_memories(tmp_path / "a", ROOM, {"a": memory})
    save_features(tmp_path / "a", ROOM, memory.features())
    with pytest.raises(InputError, match="holds features and memories, two kinds of features; keep one"):
        load_features(tmp_path / "a")
    save_memories(tmp_path / "b", ROOM, {"a": memory, "b": memory})
    save_memories(tmp_path / "b", ROOM, {"a": memory})
    with pytest.raises(InputError, match=r"holds memory\.safetensors and those of a, b, of two runs"):
        load_features(tmp_path / "b")
    save_features(tmp_path / "c", ROOM, memory.features())
    with pytest.raises(InputError, match=r"features, without memory\.safetensors; expected a folder with a memory"):
        load_memories(tmp_path / "c")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("rows", lambda rows: rows[::-1].copy(), "row numbers that rise"),
        ("weights", lambda weights: weights * 0, "weights above 0"),
        ("bank", lambda bank: bank[:-1].copy(), "sources"),
        ("bank", lambda bank: bank * np.float16(np.inf), "finite"),
    ],
)
@pytest.mark.usefixtures("no_jaxtyping")
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, name: str, change: object, message: str) -> None:
    assert callable(change)
    save_memories(tmp_path, ROOM, {"a": make_memory()})
    path = tmp_path / MEMORY_FILE
    arrays = load_file(path)
    write_archive(path, arrays | {name: change(arrays[name])}, header_of(path))
    with pytest.raises(InputError, match=message):
        load_features(tmp_path)
    write_archive(path, arrays, header_of(path) | {"scoring": "magic"})
    with pytest.raises(InputError, match="expected scoring centered, cosine or dot in the header, got 'magic'"):
        load_features(tmp_path)
