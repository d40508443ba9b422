"""gsply and open3d as oracles: they read what we write, we read what they write, and all agree on the real files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import splat_samples as samples
from scipy.special import expit

from gsencoder.data.splats import files as splats
from gsencoder.data.splats.files import fingerprint, load_splat, read_raw, save_splat

pytestmark = pytest.mark.slow


def open3d_point_cloud(open3d: Any, path: Path) -> dict[str, np.ndarray]:
    points = open3d.t.io.read_point_cloud(str(path)).point
    return {name: points[name].numpy() for name in points}


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("name", ["a.ply", "a.spz", "v3.spz"])
def test_open3d_reads_what_we_write_and_sees_the_same(tmp_path, open3d, name, degree):
    gaussians = samples.make_gaussians(500, degree)
    save_splat(tmp_path / name, gaussians, spz_version=3 if "v3" in name else 4)
    seen, ours = open3d_point_cloud(open3d, tmp_path / name), load_splat(tmp_path / name)
    assert np.array_equal(seen["positions"], ours.means)
    assert np.allclose(seen["scale"], ours.scales, rtol=1e-5)
    assert np.allclose(samples.same_sign(seen["rot"], ours.quats), ours.quats, atol=1e-6)
    assert np.allclose(1 / (1 + np.exp(-seen["opacity"][:, 0].astype(np.float64))), ours.opacities, atol=1e-6)
    assert np.allclose(seen["f_dc"].reshape(-1, 3), ours.sh[:, 0], atol=1e-6)
    if degree:
        assert np.array_equal(seen["f_rest"].reshape(500, -1, 3), ours.sh[:, 1:])


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat"])
def test_we_read_what_open3d_writes(tmp_path, open3d, name):
    gaussians = samples.make_gaussians(200, 0)
    gaussians = replace(gaussians, sh=gaussians.sh.clip(-1.5, 1.5))
    save_splat(tmp_path / "ours.ply", gaussians)
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "ours.ply"))
    assert open3d.t.io.write_point_cloud(str(tmp_path / name), cloud)
    loaded = load_splat(tmp_path / name)
    if name == "a.splat":  # open3d sorts the rows of a .splat by size and opacity.
        order = [int(np.abs(loaded.means - mean).sum(axis=1).argmin()) for mean in gaussians.means]
        loaded = loaded.select(np.array(order))
    steps = {"means": 1.3e-4, "quats": 0.012, "log_scales": 0.0313, "opacities": 0.004, "dc": 0.015, "rest": 0.0}
    samples.assert_close(loaded, gaussians, **steps)


def assert_same_raw(ours: splats.RawSplat, theirs: Any, opacity: float) -> None:
    """`theirs` is a gsply.GSData; gsply holds logits of packed files to ±10 or ±13.8, so opacities are compared."""
    assert np.abs(ours.means - theirs.means).max() < 5e-6
    assert np.abs(ours.quats - theirs.quats).max() < 5e-6
    assert np.abs(ours.log_scales - theirs.scales).max() < 5e-6
    opacities = [expit(each.astype(np.float64).ravel()) for each in (ours.logit_opacities, theirs.opacities)]
    assert np.abs(opacities[0] - opacities[1]).max() < opacity
    assert np.abs(ours.sh[:, 0] - theirs.sh0).max() < 1e-6
    rest = theirs.shN
    assert np.array_equal(ours.sh[:, 1:], rest if rest is not None else np.empty((len(ours), 0, 3), np.float32))


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "v3.spz"])
def test_gsply_reads_what_we_write_and_sees_the_same(tmp_path, name, degree):
    import gsply

    save_splat(tmp_path / name, samples.make_gaussians(500, degree), spz_version=3)
    read = gsply.read_spz if name.endswith(".spz") else gsply.plyread
    assert_same_raw(read_raw(tmp_path / name), read(str(tmp_path / name)), 5e-5)


def test_gsply_reads_our_sog_sample_as_we_do(tmp_path):
    import gsply

    (tmp_path / "a.sog").write_bytes(samples.zipped(samples.sog_files(200, bands=2)))
    assert_same_raw(read_raw(tmp_path / "a.sog"), gsply.sogread(str(tmp_path / "a.sog")), 2e-6)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "count", "degree"),
    [("guitar.compressed.ply", 90_854, 0), ("biker.spz", 152_746, 0), ("playbot_sog", 8_406, 2)],
)
def test_real_files_load_whole(shared, name, count, degree):
    gaussians = load_splat(shared / "fixtures" / name)
    assert (len(gaussians), gaussians.sh_degree) == (count, degree)
    assert 0.5 < np.ptp(gaussians.means, axis=0).max() < 10
    assert 1e-4 < np.median(gaussians.scales) < 0.1


@pytest.mark.shared
def test_gsply_and_open3d_agree_with_us_on_the_real_files(shared, open3d):
    import gsply

    folder = shared / "fixtures"
    guitar = str(folder / "guitar.compressed.ply")
    assert_same_raw(read_raw(guitar), gsply.plyread(guitar), 5e-5)
    assert_same_raw(read_raw(folder / "playbot_sog"), gsply.sogread(str(folder / "playbot_sog")), 2e-6)
    biker, seen = load_splat(folder / "biker.spz"), open3d_point_cloud(open3d, folder / "biker.spz")
    assert np.array_equal(seen["positions"], biker.means)
    assert np.allclose(seen["scale"], biker.scales, rtol=1e-5)
    assert np.allclose(seen["f_dc"], biker.sh[:, 0], atol=1e-6)


@pytest.mark.shared
def test_a_sog_folder_its_meta_json_and_its_zip_are_one_splat(shared, tmp_path):
    folder = shared / "fixtures" / "playbot_sog"
    (tmp_path / "a.sog").write_bytes(samples.zipped({file.name: file.read_bytes() for file in folder.iterdir()}))
    prints = {fingerprint(load_splat(path)) for path in (folder, folder / "meta.json", tmp_path / "a.sog")}
    assert len(prints) == 1
