"""Splat files: round trips, conventions, other libraries as oracles; bad files and failed writes in one clear line."""

import errno
import gzip
import json
import os
import struct
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import splat_samples as samples

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splats import files as splats
from gsencoder.data.splats import ply
from gsencoder.data.splats.files import fingerprint, load_splat, read_raw, save_splat
from gsencoder.data.splats.repair import inspect_splat

C0 = 0.28209479177387814
SPZ = {"quats": 2e-3, "log_scales": 0.03126, "opacities": 0.00197, "dc": 0.01308, "rest": 0.00391}


@pytest.mark.parametrize("degree", [0, 3])
def test_an_inria_ply_comes_back_exactly_but_for_logarithms(tmp_path, degree):
    gaussians = samples.make_gaussians(9000, degree)
    save_splat(tmp_path / "a.ply", gaussians)
    loaded = load_splat(tmp_path / "a.ply")
    assert np.array_equal(loaded.means, gaussians.means)
    assert np.array_equal(loaded.sh, gaussians.sh)
    samples.assert_close(loaded, gaussians, means=0, quats=1e-6, log_scales=1e-5, opacities=1e-6, dc=0, rest=0)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 3])
def test_an_spz_comes_back_within_its_steps(tmp_path, version, degree):
    gaussians = samples.make_gaussians(2000, degree)
    save_splat(tmp_path / "a.spz", gaussians, spz_version=version)
    loaded = load_splat(tmp_path / "a.spz")
    assert read_raw(tmp_path / "a.spz").format == f".spz version {version}"
    samples.assert_close(loaded, gaussians, means=2.0**-13 * 1.001, **SPZ)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_compressed_ply_in_order_comes_back_within_the_steps_of_each_chunk(tmp_path, degree):
    gaussians = samples.make_gaussians(1000, degree)
    save_splat(tmp_path / "a.compressed.ply", gaussians, keep_order=True)
    loaded = load_splat(tmp_path / "a.compressed.ply")

    def half_steps(values: np.ndarray, levels: int) -> np.ndarray:
        chunks = [values[start : start + 256] for start in range(0, len(values), 256)]
        spans = [np.broadcast_to(np.ptp(chunk, axis=0), chunk.shape) for chunk in chunks]
        return np.concatenate(spans) / levels * 0.51 + 1e-6

    means, log_scales = (half_steps(values, 1023) for values in (gaussians.means, np.log(gaussians.scales)))
    steps = {"means": means, "log_scales": log_scales, "dc": half_steps(gaussians.sh[:, 0], 255)}
    samples.assert_close(loaded, gaussians, quats=2e-3, opacities=0.00197, rest=1 / 64 + 1e-6, **steps)


def test_a_compressed_ply_is_reordered_into_compact_chunks_which_is_more_precise(tmp_path):
    gaussians = samples.make_gaussians(30_000, 0)
    errors = {}
    for keep_order in (True, False):
        save_splat(tmp_path / "a.compressed.ply", gaussians, keep_order=keep_order)
        loaded = load_splat(tmp_path / "a.compressed.ply")
        order = splats.morton_order(gaussians.means.astype(np.float64))
        want = gaussians.means if keep_order else gaussians.means[order]
        errors[keep_order] = np.median(np.abs(loaded.means - want))
    assert sorted(order) == list(range(30_000))
    assert errors[False] < errors[True] / 3


def test_opacities_0_and_1_are_written_as_finite_logits_and_come_back(tmp_path):
    gaussians = replace(samples.make_gaussians(6, 0), opacities=np.array([0, 1, 0.5, 1e-12, 1 - 6e-8, 1], np.float32))
    for name, tolerance in (("a.ply", 1e-8), ("a.spz", 0.00197), ("a.compressed.ply", 0.00197)):
        save_splat(tmp_path / name, gaussians, keep_order=True)
        assert np.isfinite(read_raw(tmp_path / name).logit_opacities).all()
        assert np.abs(load_splat(tmp_path / name).opacities - gaussians.opacities).max() <= tolerance


def test_a_scene_a_million_metres_away_is_the_scene_at_zero_when_its_ply_has_doubles(tmp_path):
    gaussians = samples.make_gaussians(100, 0)
    origin = np.array([1e6, -2e6, 3e5])
    save_splat(tmp_path / "far.ply", gaussians, origin=origin)
    assert b"property double x" in (tmp_path / "far.ply").read_bytes()
    loaded = load_splat(tmp_path / "far.ply", origin=origin)
    assert np.abs(loaded.means - gaussians.means).max() < 1e-6
    with pytest.warns(SceneWarning, match="origin"):
        load_splat(tmp_path / "far.ply")


def test_packed_formats_refuse_or_announce_a_far_origin(tmp_path):
    gaussians, origin = samples.make_gaussians(50, 0), np.full(3, 1e6)
    with pytest.raises(InputError, match=r"save as \.ply"):
        save_splat(tmp_path / "a.compressed.ply", gaussians, origin=origin)
    with pytest.warns(SceneWarning, match="leave steps of 0.125"):
        save_splat(tmp_path / "a.spz", gaussians, origin=origin)
    assert np.abs(load_splat(tmp_path / "a.spz", origin=origin).means - gaussians.means).max() <= 0.0626
    with pytest.raises(InputError, match=r"beyond what \.spz can hold"):
        save_splat(tmp_path / "b.spz", gaussians, origin=origin * 100)
    assert sorted(os.listdir(tmp_path)) == ["a.spz"]


def test_spz_spends_more_bits_on_a_tiny_scene(tmp_path):
    tiny = samples.make_gaussians(100, 0)
    tiny = replace(tiny, means=tiny.means * np.float32(0.1))
    save_splat(tmp_path / "a.spz", tiny)
    largest = np.abs(tiny.means).max()
    assert np.abs(load_splat(tmp_path / "a.spz").means - tiny.means).max() <= largest * 2.0**-17


def test_values_beyond_a_packed_range_are_clipped_with_one_counted_warning(tmp_path):
    gaussians = samples.make_gaussians(100, 1)
    sh = gaussians.sh.copy()
    sh[:7, 1:] = 5
    for name, count in (("a.spz", 63), ("a.compressed.ply", 63)):
        with pytest.warns(SceneWarning, match=f"{count} values were clipped") as caught:
            save_splat(tmp_path / name, replace(gaussians, sh=sh))
        assert len(caught) == 1


@pytest.mark.parametrize(
    ("encoding", "kinds"), [("binary_little_endian", "double"), ("binary_big_endian", "float"), ("ascii", "double")]
)
def test_any_byte_order_number_type_and_property_order_reads_the_same(tmp_path, encoding, kinds):
    raw = samples.make_raw(20, 2)
    columns = samples.ply_columns(raw)
    columns["nx"] = columns["confidence"] = np.zeros(20)
    shuffled = {name: columns[name] for name in np.random.default_rng(1).permutation(sorted(columns))}
    (tmp_path / "a.ply").write_bytes(samples.ply_bytes(shuffled, encoding, kinds))
    got = read_raw(tmp_path / "a.ply")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        # An ascii file keeps the digits of its text, whatever its columns are declared to be.
        assert np.array_equal(getattr(got, name).astype(np.float32), getattr(raw, name).astype(np.float32)), name
    if kinds == "double":
        assert np.array_equal(got.means, raw.means)


def test_crlf_headers_and_elements_around_the_vertices_are_skipped(tmp_path):
    raw = samples.make_raw(9, 0)
    data = samples.ply_bytes(samples.ply_columns(raw))
    head, body = data.split(b"end_header\n")
    camera = b"element camera 2\nproperty double a\nproperty uchar b\nelement vertex"
    face = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    head = (head.replace(b"element vertex", camera) + face).replace(b"\n", b"\r\n")
    (tmp_path / "a.ply").write_bytes(head + bytes(18) + body + bytes(13))
    assert np.array_equal(read_raw(tmp_path / "a.ply").means, raw.means)


def test_quaternions_of_any_length_are_normalised_without_a_word(tmp_path):
    raw = samples.make_raw(30, 0)
    lengths = np.geomspace(1e-6, 1e6, 30, dtype=np.float32)[:, None]
    (tmp_path / "a.ply").write_bytes(samples.ply_bytes(samples.ply_columns(replace(raw, quats=raw.quats * lengths))))
    assert np.abs(load_splat(tmp_path / "a.ply").quats - raw.quats).max() < 1e-6


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("means", np.nan, "3 with NaN or Inf"),
        ("quats", 0, "3 with a zero quaternion"),
        ("log_scales", -200, "3 with scales that are 0 or overflow"),
        ("logit_opacities", np.inf, "3 with infinite opacity logits"),
    ],
)
def test_a_defect_is_a_counted_error_that_points_to_repair(tmp_path, field, value, words):
    raw = samples.make_raw(10, 1)
    array = getattr(raw, field).copy()
    array[[2, 5, 7]] = value
    (tmp_path / "a.ply").write_bytes(samples.ply_bytes(samples.ply_columns(replace(raw, **{field: array}))))
    with pytest.raises(InputError, match=f"of 10 rows {words}.*gsencoder repair"):
        load_splat(tmp_path / "a.ply")
    assert len(read_raw(tmp_path / "a.ply")) == 10


def test_the_content_decides_and_the_suffix_only_where_there_is_no_magic(tmp_path):
    files = samples.valid_files(tmp_path)
    for name, data in files.items():
        disguise = tmp_path / ("x.splat" if name.endswith(".splat") else "x.sog")
        disguise.write_bytes(data)
        (tmp_path / name).write_bytes(data)
        assert fingerprint(load_splat(disguise)) == fingerprint(load_splat(tmp_path / name))


def test_dotsplat_rows_mean_what_their_bytes_say(tmp_path):
    row = struct.pack("<6f8B", 1, 2, 3, 0.5, 0.25, 2, 255, 0, 51, 102, 128 + 64, 128 - 64, 128, 128)
    (tmp_path / "a.splat").write_bytes(row)
    got = load_splat(tmp_path / "a.splat")
    assert got.means.tolist() == [[1, 2, 3]]
    assert np.allclose(got.scales, [[0.5, 0.25, 2]], rtol=1e-6)
    assert np.allclose(got.opacities, [102 / 255], rtol=1e-6)
    assert np.allclose(0.5 + C0 * got.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    assert np.allclose(got.quats, [[np.sqrt(0.5), -np.sqrt(0.5), 0, 0]], atol=1e-6)
    (tmp_path / "a.splat").write_bytes(struct.pack("<6f8B", 1, 2, 3, 0.5, 0, -2, *range(8)))
    assert read_raw(tmp_path / "a.splat").log_scales[0, 1:].tolist() == [-np.inf, -np.inf]


def test_spz_version_2_stores_three_bytes_of_a_quaternion(tmp_path):
    (tmp_path / "a.spz").write_bytes(samples.spz2_bytes(np.tile([255, 127, 128], (5, 1))))
    raw = read_raw(tmp_path / "a.spz")
    assert raw.format == ".spz version 2"
    assert np.allclose(raw.quats, [[0, 1, -1 / 255, 1 / 255]], atol=1e-6)
    assert (raw.log_scales == -10).all()
    assert (raw.logit_opacities == -20).all()


def test_spz_extensions_and_sh_degree_4_are_left_out_with_a_warning(tmp_path):
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 4, 4, 12, 2, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes((20 + 72) * 4) + b"extension"))
    with pytest.warns(SceneWarning) as caught:
        raw = read_raw(tmp_path / "a.spz")
    assert raw.sh_degree == 3
    assert sorted("extensions of other" in str(warning.message) for warning in caught) == [False, True]


def test_a_fingerprint_changes_with_one_bit_and_with_the_order_of_rows():
    gaussians = samples.make_gaussians(10, 1)
    assert fingerprint(gaussians) == fingerprint(samples.make_gaussians(10, 1))
    sh = gaussians.sh.copy()
    sh[9, 3, 2] = np.nextafter(sh[9, 3, 2], np.float32(9))
    others = [replace(gaussians, sh=sh), gaussians.select(np.arange(10)[::-1]), gaussians.select(np.arange(9))]
    assert len({fingerprint(gaussians), *map(fingerprint, others)}) == 4


def spz4(count: int, sizes: list[tuple[int, int]], body: bytes = b"", degree: int = 0) -> bytes:
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(sizes), 32)
    return head + b"".join(struct.pack("<QQ", *size) for size in sizes) + body


def spz4_bomb(count: int) -> bytes:
    wanted = [9 * count, count, 3 * count, 3 * count, 4 * count]
    frames = [imagecodecs.zstd_encode(bytes(size), level=1) for size in wanted]
    return spz4(count, list(zip(map(len, frames), wanted, strict=True)), b"".join(frames))


def sog_with(**changes: object) -> bytes:
    """The sample with parts of meta.json replaced: section__field=value, or field=value."""
    files = samples.sog_files()
    meta = json.loads(files["meta.json"])
    for key, value in changes.items():
        *section, name = key.split("__")
        (meta[section[0]] if section else meta)[name] = value
    return samples.zipped({**files, "meta.json": json.dumps(meta).encode()})


GOOD_PLY = samples.ply_bytes(samples.ply_columns(samples.make_raw(8, 1)))
ASCII_PLY = samples.ply_bytes(samples.ply_columns(samples.make_raw(2, 0)), "ascii")
SPZ3_BOMB = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 5_000_000, 0, 12, 0, 0) + bytes(100_000_000), 9)
BIG_WEBP = bytes(imagecodecs.webp_encode(np.zeros((4000, 4000, 4), np.uint8), lossless=True))
HOSTILE = {
    "empty.ply": (b"", "empty"),
    "magic.ply": (b"not a ply at all", "no known splat format"),
    "what.xyz": (b"1 2 3\n", "no known splat format"),
    "cut_header.ply": (GOOD_PLY[:200], "no 'end_header'"),
    "cut.ply": (GOOD_PLY[:-1], "1 missing"),
    "huge.ply": (GOOD_PLY.replace(b"vertex 8", b"vertex 999999999999"), "999,999,999,999 rows"),
    "none.ply": (GOOD_PLY.replace(b"vertex 8", b"vertex 0"), "no Gaussians"),
    "points.ply": (GOOD_PLY.replace(b"f_dc_", b"color_"), "expected a Gaussian splat"),
    "surfels.ply": (GOOD_PLY.replace(b"scale_2", b"thick"), "2D splat"),
    "rest.ply": (GOOD_PLY.replace(b"f_rest_8", b"other_8"), "8 f_rest"),
    "twice.ply": (GOOD_PLY.replace(b"f_rest_8", b"f_rest_7"), "repeats a property"),
    "list.ply": (GOOD_PLY.replace(b"property float y", b"property list uchar int y"), "no element 'vertex' of plain"),
    "ascii_huge.ply": (ASCII_PLY.replace(b"ex 2", b"ex 99999999999"), "99,999,999,999 rows"),
    "ascii_word.ply": (ASCII_PLY.replace(b"header\n", b"header\nx"), "cannot be read"),
    "odd.splat": (bytes(33), "32-byte rows"),
    "version.spz": (struct.pack("<4sI24x", b"NGSP", 9), "version 9"),
    "streams.spz": (spz4(3, [(1, 1)] * 2), "expected 5 streams"),
    "sizes.spz": (spz4(3, [(2**63, 27)] * 5, bytes(50)), "truncated or damaged"),
    "garbage.spz": (spz4(3, [(4, 27), (4, 3), (4, 9), (4, 9), (4, 12)], bytes(20)), "cannot be unpacked"),
    "degree.spz": (spz4(3, [(1, 1)] * 6, degree=200), "SH degree 200"),
    "bomb4.spz": (spz4_bomb(3_000_000), "exhaust memory"),
    "gzip.spz": (gzip.compress(b"something else"), "NGSP"),
    "gzip_cut.spz": (samples.spz2_bytes(np.zeros((5, 3)))[:-9], "truncated"),
    "gzip_bad.spz": (b"\x1f\x8b\x08" + b"\xff" * 50, "gzip data"),
    "bomb3.spz": (SPZ3_BOMB, "exhaust memory"),
    "zip_cut.sog": (samples.zipped(samples.sog_files())[:-30], "damaged"),
    "no_meta.sog": (samples.zipped({"a": b"b"}), "no member 'meta.json'"),
    "json.sog": (samples.zipped({"meta.json": b"{" * 100_000}), "not JSON"),
    "meta_bomb.sog": (samples.zipped({"meta.json": bytes(50_000_000)}), "more than the"),
    "version.sog": (sog_with(version=1), "version 1"),
    "count.sog": (sog_with(count=10**12), "exhaust memory"),
    "few_pixels.sog": (sog_with(count=4000), "too few"),
    "leaves.sog": (sog_with(quats__files=["../../etc/passwd"]), "expected a file name"),
    "missing.sog": (sog_with(quats__files=["gone.webp"]), "no member"),
    "codebook.sog": (sog_with(scales__codebook=[0.0] * 9), "codebook with 9"),
    "mins.sog": (sog_with(means__mins=[1.0]), "expected 3 numbers as means.mins"),
    "palette.sog": (sog_with(shN__count=1), "beyond the 1 entries"),
    "bands.sog": (sog_with(shN__bands=9), "shN.bands 9"),
    "pixels.sog": (samples.zipped({**samples.sog_files(), "quats.webp": BIG_WEBP}), "4000×4000"),
    "image.sog": (samples.zipped({**samples.sog_files(), "quats.webp": b"RIFF" + bytes(40)}), "WebP"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_bad_files_end_in_one_clear_line_soon_and_without_large_memory(tmp_path, name):
    data, words = HOSTILE[name]
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    began = time.perf_counter()
    try:
        with pytest.raises(InputError, match=words) as caught:
            load_splat(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - began < 3
    assert peak < 24 << 20
    assert "\n" not in str(caught.value)
    assert str(caught.value).count(str(tmp_path)) == 1


def test_a_null_in_a_codebook_is_a_defect_of_the_rows_that_use_it(tmp_path):
    codebook = [None] * 10 + np.linspace(-8, -2, 246).tolist()
    (tmp_path / "a.sog").write_bytes(sog_with(scales__codebook=codebook))
    raw = read_raw(tmp_path / "a.sog")
    assert 0 < np.isnan(raw.log_scales).any(axis=1).sum() < 20


def test_paths_that_are_not_files_are_told_apart(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    for path, words in (
        (tmp_path / "gone.ply", "no such file"),
        (tmp_path, "folder without meta.json"),
        (tmp_path / "pipe.ply", "not a regular file"),
        (Path("/dev/zero"), "not a regular file"),
        (tmp_path / ("x" * 300), "cannot be read"),
        ("a\0b.ply", "cannot be read"),
    ):
        with pytest.raises(InputError, match=words):
            load_splat(path)


def test_a_link_out_of_a_sog_folder_is_not_followed(tmp_path):
    folder = tmp_path / "sog"
    folder.mkdir()
    for name, data in samples.sog_files().items():
        (folder / name).write_bytes(data)
    assert len(load_splat(folder)) == 40
    (folder / "quats.webp").rename(tmp_path / "quats.webp")
    (folder / "quats.webp").symlink_to(tmp_path / "quats.webp")
    with pytest.raises(InputError, match="leads out of the folder"):
        load_splat(folder)


def test_what_cannot_be_written_is_refused_with_what_can(tmp_path):
    gaussians = samples.make_gaussians(3, 0)
    for name in ("a.splat", "a.sog", "a", "a.ply.gz"):
        with pytest.raises(InputError, match=r"expected \.ply, \.compressed\.ply or \.spz"):
            save_splat(tmp_path / name, gaussians)
    with pytest.raises(InputError, match="expected 3 or 4"):
        save_splat(tmp_path / "a.spz", gaussians, spz_version=2)
    with pytest.raises(InputError, match="no Gaussians to write"):
        save_splat(tmp_path / "a.ply", samples.no_gaussians())
    with pytest.raises(InputError, match="does not exist"):
        save_splat(tmp_path / "gone" / "a.ply", gaussians)
    with pytest.raises(InputError, match="finite"):
        save_splat(tmp_path / "a.ply", gaussians, origin=np.array([0, np.nan, 0]))
    (tmp_path / "dir.ply").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        save_splat(tmp_path / "dir.ply", gaussians)
    assert os.listdir(tmp_path) == ["dir.ply"]


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_full_disk_or_a_kill_in_mid_write_leaves_the_old_file(tmp_path, monkeypatch, failure):
    gaussians = samples.make_gaussians(50, 0)
    save_splat(tmp_path / "a.spz", gaussians)
    before = (tmp_path / "a.spz").read_bytes()

    def fails(path: Path, stream: object, raw: object, *, version: int) -> None:
        stream.write(b"half")  # type: ignore[attr-defined]
        raise failure

    monkeypatch.setattr(splats, "write_spz", fails)
    expected = InputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        save_splat(tmp_path / "a.spz", gaussians)
    assert os.listdir(tmp_path) == ["a.spz"]
    assert (tmp_path / "a.spz").read_bytes() == before


def test_a_ply_that_is_cut_off_while_it_is_read_is_refused_with_the_row(tmp_path, monkeypatch):
    save_splat(tmp_path / "a.ply", samples.make_gaussians(9000, 0))
    row_bytes = ply.inria_row_bytes(0, double_means=False)
    start_of = ply.element_start

    def cut_after_check(*args: Any) -> int:
        start = start_of(*args)
        os.truncate(tmp_path / "a.ply", start + 5000 * row_bytes + 7)
        return start

    monkeypatch.setattr(ply, "element_start", cut_after_check)
    with pytest.raises(InputError, match="ended while it was read, at row 5,000 of 9,000"):
        read_raw(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["a.ply", "a.splat"])
def test_a_signalling_nan_in_any_column_is_counted(tmp_path, name):
    data = bytearray(samples.valid_files(tmp_path)[name])
    start = data.find(b"end_header\n") + len(b"end_header\n") if name == "a.ply" else 0
    data[start : start + 24] = np.full(6, 0x7F800001, np.uint32).tobytes()
    (tmp_path / name).write_bytes(data)
    assert inspect_splat(read_raw(tmp_path / name)).defects[0].first_rows == (0,)
