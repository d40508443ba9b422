"""Bad splat files and failed writes: one clear line, soon, without large memory, and nothing half-written."""

import errno
import gzip
import json
import os
import struct
import time
import tracemalloc
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import splat_samples as samples

from gsencoder.core.errors import InputError
from gsencoder.data.splats import files as splats
from gsencoder.data.splats.files import load_splat, read_raw, save_splat
from gsencoder.data.splats.repair import inspect_splat


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
    "ascii_huge.ply": (
        samples.ply_bytes(samples.ply_columns(samples.make_raw(2, 0)), "ascii").replace(b"ex 2", b"ex 99999999999"),
        "99,999,999,999 rows",
    ),
    "ascii_word.ply": (
        samples.ply_bytes(samples.ply_columns(samples.make_raw(2, 0)), "ascii").replace(b"header\n", b"header\nx"),
        "cannot be read",
    ),
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
    "bomb3.spz": (
        gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 5_000_000, 0, 12, 0, 0) + bytes(100_000_000), 9),
        "exhaust memory",
    ),
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


@pytest.mark.parametrize("name", ["a.ply", "a.splat"])
def test_a_signalling_nan_in_any_column_is_counted(tmp_path, name):
    data = bytearray(samples.valid_files(tmp_path)[name])
    start = data.find(b"end_header\n") + len(b"end_header\n") if name == "a.ply" else 0
    data[start : start + 24] = np.full(6, 0x7F800001, np.uint32).tobytes()
    (tmp_path / name).write_bytes(data)
    assert inspect_splat(read_raw(tmp_path / name)).defects[0].first_rows == (0,)
