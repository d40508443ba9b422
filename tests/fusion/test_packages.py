"""Packages: what comes back is what went in, other programs read it, and nothing damaged is taken for whole."""

import json
import mmap
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import pytest
from feature_fields import make_features, make_scene
from safetensors.numpy import load_file
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import load_splat, save_splat
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.package import PACKAGE_FILE, SPLAT_FILE, open_package, save_package
from gsencoder.text.table import WORDS_FILE, make_text_table, save_text_table
from gsencoder.types import GaussianFeatures

N = 600


ORIGIN = (1e6, -2e6, 3e6)


@pytest.fixture
def features() -> GaussianFeatures:
    return make_features(n=N)


@pytest.fixture
def package(tmp_path: Path, features: GaussianFeatures) -> Path:
    folder = tmp_path / "package"
    folder.mkdir()
    save_package(folder, make_scene(N, ORIGIN), features, error=0.01)
    return folder


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), ORIGIN])
def test_a_package_holds_scene_and_features(tmp_path: Path, features: GaussianFeatures, origin: tuple) -> None:
    scene = make_scene(N, origin)
    made = save_package(tmp_path, scene, features, error=0.01)
    loaded = load_features(tmp_path)
    got = loaded.features["s"]
    np.testing.assert_array_equal(got.features, made.features().features)
    np.testing.assert_array_equal(got.seen, features.seen)
    assert got.space == features.space
    assert loaded.origin.tolist() == scene.origin.tolist()
    assert (loaded.name, loaded.metres_per_unit) == ("room", 0.5)
    assert loaded.views.names == ("a",)
    np.testing.assert_allclose(loaded.gaussians.means, scene.gaussians.means, atol=1e-6)


def test_codes_are_mapped_and_not_read(package: Path) -> None:
    codes = open_package(package / PACKAGE_FILE).codes
    assert not codes.flags.owndata
    assert isinstance(codes.base, np.ndarray)
    assert isinstance(codes.base.base.obj, mmap.mmap)
    assert not codes.flags.writeable


def test_a_flipped_bit_anywhere_is_noticed(package: Path) -> None:
    file = package / PACKAGE_FILE
    whole = file.read_bytes()
    for offset in np.linspace(0, len(whole) - 1, 30).astype(int):
        damaged = bytearray(whole)
        damaged[offset] ^= 4
        file.write_bytes(damaged)
        with pytest.raises(InputError):
            load_features(package)
    for size in (5, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:size])
        with pytest.raises(InputError):
            load_features(package)
    file.write_bytes(whole)
    load_features(package)


def test_features_of_another_splat_are_refused(package: Path) -> None:
    other = replace(random_gaussians(N), opacities=np.full(N, 0.5, np.float32))
    save_splat(package / SPLAT_FILE, other, origin=make_scene(N, ORIGIN).origin)
    with pytest.raises(InputError, match="the features belong to splat"):
        load_features(package)
    (package / SPLAT_FILE).unlink()
    with pytest.raises(InputError, match="splat.ply"):
        load_features(package)


@pytest.mark.usefixtures("no_jaxtyping")
def test_a_package_of_another_version_is_refused(package: Path) -> None:
    file = package / PACKAGE_FILE
    arrays = load_file(file)
    with open_archive(file) as archive:
        header = {key: archive.value(key, str, int, float, dict, list, None) for key in HEADER}
    write_archive(file, arrays, header | {"form": 3})
    with pytest.raises(InputError, match="expected form 1 or 2 of a package, got 3"):
        open_package(file)
    write_archive(file, arrays, header | {"total": N + 9})
    with pytest.raises(InputError, match="expected marks"):
        open_package(file)
    write_archive(file, arrays | {"codes": arrays["codes"][1:]}, header)
    with pytest.raises(InputError, match="do not go together"):
        open_package(file)
    for lie in ({"heaviest": 10**400}, {"error": float("nan")}, {"lightest": -1.0}, {"total": -1}):
        write_archive(file, arrays, header | lie)
        with pytest.raises(InputError):
            open_package(file)
    write_archive(file, arrays, header)
    open_package(file)


HEADER = ("name", "metres_per_unit", "up", "views", "space", "energy_kept", "form", "fingerprint", "total")
HEADER += ("error", "lightest", "heaviest", "lowest")


@pytest.fixture
def folder(tmp_path: Path, features: GaussianFeatures) -> Path:
    """A folder as `fuse` and `encode` leave it."""
    folder = tmp_path / "features"
    folder.mkdir()
    save_features(folder, make_scene(N), features, {})
    table = make_text_table(["mug", "chair"], np.linalg.qr(np.random.default_rng(0).normal(size=(12, 2)))[0].T, "words")
    save_text_table(folder / WORDS_FILE, table)
    return folder


@pytest.mark.parametrize("decoded", [False, True])
@pytest.mark.parametrize("form", ["npz", "safetensors"])
def test_arrays_are_what_other_programs_read(folder: Path, tmp_path: Path, form: str, decoded: bool) -> None:
    out = tmp_path / "out"
    words = [f"form={form}", f"decoded={str(decoded).lower()}", f"out={out}", "quiet=true"]
    assert cli.main(["pack", str(folder), *words]) == 0
    file = out / f"features.{form}"
    arrays = dict(np.load(file, allow_pickle=False)) if form == "npz" else load_file(file)
    expected = load_features(folder).features["s"]
    vectors = arrays["features"].astype(np.float32)
    if not decoded:
        vectors = (vectors @ arrays["components"] + arrays["mean"]) * (arrays["weights"] > 0)[:, None]
    np.testing.assert_allclose(vectors, expected.decode() * expected.seen[:, None], atol=4e-3 if decoded else 1e-5)
    np.testing.assert_array_equal(arrays["weights"], expected.weights)
    assert (out / WORDS_FILE).is_file()
    assert len(gsply.plyread(str(out / SPLAT_FILE))) == len(load_splat(out / SPLAT_FILE)) == N
    if form == "npz":
        about = json.loads(str(arrays["about"]))
        assert about["space"]["name"] == "s"
        assert about["fingerprint"]


@pytest.mark.parametrize("decoded", [False, True])
def test_the_ply_holds_features_as_properties(folder: Path, tmp_path: Path, open3d: Any, decoded: bool) -> None:
    out = tmp_path / "out"
    assert cli.main(["pack", str(folder), "form=ply", f"decoded={decoded}", f"out={out}", "quiet=true"]) == 0
    points = open3d.t.io.read_point_cloud(str(out / SPLAT_FILE)).point
    expected = load_features(folder).features["s"]
    values = expected.decode() if decoded else expected.features
    for number in (0, values.shape[1] - 1):
        column = points[f"feature_{number}"].numpy()[:, 0]
        np.testing.assert_allclose(column[expected.seen], values[expected.seen, number], atol=4e-3)
    np.testing.assert_array_equal(points["feature_weight"].numpy()[:, 0], expected.weights)

    ours, source = load_splat(out / SPLAT_FILE), load_features(folder).gaussians
    np.testing.assert_array_equal(ours.means, source.means)
    assert set(np.load(out / "basis.npz")) == {"about", "mean", *(() if decoded else ("components",))}


def test_pack_writes_what_localize_reads(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli.main(["pack", str(folder), f"out={out}", "error=0.02"]) == 0
    assert "bytes a row" in capsys.readouterr().out
    results = json.loads((out / "summary.json").read_text())["results"]
    assert results["error"] <= 0.02
    assert results["bytes"] == (out / PACKAGE_FILE).stat().st_size
    assert cli.main(["localize", str(out), "query=mug", f"out={tmp_path / 'boxes'}", "pictures=0"]) == 0
    again = tmp_path / "again"
    assert cli.main(["pack", str(out), "form=npz", f"out={again}", "quiet=true"]) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["error=0"], "budget.error: expected a number above 0 and below 1"),
        (["error=1e-12"], "8 bits a coordinate reach"),
        (["decoded=true"], "form=compact holds codes"),
        (["form=pt"], "form"),
    ],
)
def test_settings_that_cannot_be_are_refused(folder, tmp_path, capsys, words, message):
    assert cli.main(["pack", str(folder), f"out={tmp_path / 'out'}", *words]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_package_loads_without_torch(package: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from gsencoder.fusion.folder import load_features; "
        f"load_features(Path({str(package)!r})); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
