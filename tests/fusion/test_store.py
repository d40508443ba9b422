"""Feature folders: what comes back is what went in, and nothing else is taken for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import rewrite
from safetensors.numpy import load_file
from splats import front_camera, random_gaussians

from gsencoder.core.archive import open_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import FEATURES_FILE, SCENE_FILE, load_features, save_features
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, Scene, Views

SPACE = FeatureSpace(name="s", channels=8, teacher="test", text_encoder="words")


def make_scene(n: int = 40) -> Scene:
    return Scene(
        name="room",
        gaussians=random_gaussians(n),
        views=Views(cameras=front_camera(), names=("a",)),
        origin=np.array([1e6, -2e6, 3.0]),
        metres_per_unit=0.5,
        up=np.array([0.0, 0, 1]),
    )


def make_features(n: int = 40, magnitude: float = 1.0, basis: bool = True) -> GaussianFeatures:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(n, 3 if basis else 8)) * magnitude
    weights = rng.uniform(0.5, 9, size=n).astype(np.float32)
    weights[::4] = 0
    values[::4] = 0
    mean = rng.normal(size=8).astype(np.float32)
    components = np.linalg.qr(rng.normal(size=(8, 3)))[0].T.astype(np.float32)
    return GaussianFeatures(
        features=values.astype(np.float32),
        weights=weights,
        mean=mean,
        space=SPACE,
        basis=FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE) if basis else None,
    )


@pytest.mark.parametrize("basis", [True, False])
@pytest.mark.parametrize("magnitude", [1e-8, 1.0, 1e6])
def test_scene_and_features_come_back_within_half_precision(tmp_path: Path, magnitude: float, basis: bool) -> None:
    scene, features = make_scene(), make_features(magnitude=magnitude, basis=basis)
    save_features(tmp_path, scene, features, {"lift": "blend"})
    loaded = load_features(tmp_path)
    got = loaded.features["s"]
    np.testing.assert_allclose(got.features, features.features, rtol=1e-3, atol=1e-3 * magnitude)
    assert (got.weights == features.weights).all()
    assert got.space == SPACE
    assert (got.basis is not None) == basis
    assert loaded.origin.tolist() == scene.origin.tolist()
    assert loaded.metres_per_unit == 0.5
    assert loaded.gaussians is not None
    assert scene.gaussians is not None
    assert (loaded.gaussians.means == scene.gaussians.means).all()
    assert loaded.views is not None
    assert loaded.views.names == ("a",)
    with open_archive(tmp_path / FEATURES_FILE) as file:
        assert file.value("settings", dict) == {"lift": "blend"}


def test_only_seen_rows_are_stored(tmp_path: Path) -> None:
    scene, features = make_scene(4000), make_features(4000)
    save_features(tmp_path, scene, features, {})
    seen = int((features.weights > 0).sum())
    assert (tmp_path / FEATURES_FILE).stat().st_size < seen * (3 * 2 + 4 + 4) + 4000


def test_features_beside_another_splat_are_refused(tmp_path: Path) -> None:
    scene = make_scene()
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    save_features(tmp_path / "a", scene, make_features(), {})
    save_features(tmp_path / "b", replace(scene, gaussians=random_gaussians(40, 9)), make_features(), {})
    (tmp_path / "b" / SCENE_FILE).replace(tmp_path / "a" / SCENE_FILE)
    with pytest.raises(InputError, match="the features belong to splat"):
        load_features(tmp_path / "a")


@pytest.mark.parametrize("name", [SCENE_FILE, FEATURES_FILE])
@pytest.mark.parametrize("keep", [0, 7, 100, 900])
def test_truncated_files_are_errors(tmp_path: Path, name: str, keep: int) -> None:
    save_features(tmp_path, make_scene(), make_features(), {})
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
    features = make_features()
    features.features[1, 0] = np.nan
    with pytest.raises(InputError, match="1 of 30 rows are not finite"):
        save_features(tmp_path, make_scene(), features, {})
    with pytest.raises(InputError, match="need as many Gaussians"):
        save_features(tmp_path, make_scene(39), make_features(), {})


def changed(path: Path, **arrays: np.ndarray) -> None:
    """Writes a file again with some of its arrays replaced."""
    rewrite(path, load_file(path) | arrays)


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("rows", np.zeros(30, np.int32), "row numbers that rise"),
        ("rows", np.arange(11, 41, dtype=np.int32), "row numbers that rise from 0 to at most 39"),
        ("rows", np.arange(29, dtype=np.int32), r"expected features float16|expected weights float32\[29\]"),
        ("weights", np.zeros(30, np.float32), "weights above 0"),
        ("weights", np.full(30, np.nan, np.float32), "not finite"),
        ("channel_scale", np.ones(1, np.float32), r"expected features float16\[30, 1\], got float16\[30, 3\]"),
        ("channel_scale", -np.ones(3, np.float32), "channel_scale and weights above 0"),
        ("mean", np.zeros(7, np.float32), r"expected components float32\[3, 7\]"),
        ("components", np.full((3, 8), np.inf, np.float32), "24 of 24 values of components are not finite"),
    ],
)
def test_features_that_do_not_belong_together_are_named(
    tmp_path: Path, name: str, values: np.ndarray, problem: str
) -> None:
    save_features(tmp_path, make_scene(), make_features(), {})
    changed(tmp_path / FEATURES_FILE, **{name: values})
    with pytest.raises(InputError, match=f"{FEATURES_FILE}: .*({problem})"):
        load_features(tmp_path)


def test_views_too_large_to_be_drawn_are_refused(tmp_path: Path) -> None:
    save_features(tmp_path, make_scene(), make_features(), {})
    changed(tmp_path / SCENE_FILE, widths=np.array([2**31 - 1], np.int32))
    with pytest.raises(InputError, match="expected views of at most 80,000,000 pixels"):
        load_features(tmp_path)


@pytest.mark.parametrize("name", ["", "..", "../elsewhere", "/tmp"])
def test_a_scene_cannot_be_called_so_that_its_output_lands_elsewhere(name: str) -> None:
    with pytest.raises(InputError, match=r"Scene\.name: expected a name that a folder can have"):
        replace(make_scene(), name=name)
