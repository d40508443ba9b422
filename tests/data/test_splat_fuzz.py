"""Readers against damaged files: a splat, or an InputError of one line, and nothing else."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import splat_samples as samples
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splats.files import RawSplat, gaussians_from_raw, load_splat, read_raw
from gsencoder.data.splats.repair import inspect_splat, repair_splat

pytestmark = pytest.mark.slow

NAMES = ("a.ply", "a.compressed.ply", "a.spz", "v3.spz", "a.splat", "a.sog")
FUZZ = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
Edit = tuple[float, int]
EDITS = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=6)


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return samples.valid_files(tmp_path_factory.mktemp("valid"))


def edited(data: bytes, edits: list[Edit], length: float = 1.0) -> bytes:
    """`data` with bytes replaced at shares of its length, cut to a share of it."""
    changed = bytearray(data)
    for place, value in edits:
        if changed:
            changed[int(place * len(changed))] = value
    return bytes(changed[: round(length * len(changed))])


def read_or_message(path: Path) -> RawSplat | str:
    try:
        return read_raw(path)
    except InputError as error:
        return str(error)


def assert_holds(path: Path) -> None:
    """Whatever the file is: reading, inspecting, repairing and loading it end well or in an InputError."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        raw = read_or_message(path)
        if isinstance(raw, str):
            assert "\n" not in raw
            assert len(raw) < 1000
            return
        report = inspect_splat(raw)
        json.dumps(report.to_dict(), allow_nan=False)
        assert len(raw) == report.count <= 100_000
        try:
            gaussians = load_splat(path)
        except InputError:
            assert not report.loadable
        else:
            assert report.loadable
            assert len(gaussians) == len(raw)
        try:
            fixed, _ = repair_splat(raw, ["all"])
        except InputError:
            return
        assert len(gaussians_from_raw(fixed)) == len(fixed)


# 0x7f in the third byte of a .splat's float makes a signalling NaN, which warns when it is cast.
@pytest.mark.parametrize("name", NAMES)
@FUZZ
@example(edits=[(1227 / 1280, 127)], length=1.0)
@given(edits=EDITS, length=st.one_of(st.just(1.0), st.floats(0, 1)))
def test_changed_and_cut_bytes(valid, tmp_path, name, edits, length):
    (tmp_path / name).write_bytes(edited(valid[name], edits, length))
    assert_holds(tmp_path / name)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just("quats.webp"),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
META_KEYS = ("version", "count", "means", "scales", "quats", "sh0", "shN")
FIELDS = ("", "mins", "maxs", "files", "codebook", "count", "bands")


@FUZZ
@example(key="count", field="", value=2**31)
@example(key="means", field="maxs", value=[1e308, -1e308, 1e308])
@example(key="scales", field="codebook", value=[10**400] * 256)
@example(key="shN", field="count", value=2**16)
@given(key=st.sampled_from(META_KEYS), field=st.sampled_from(FIELDS), value=JSON)
def test_any_json_in_the_place_of_a_sog_field(tmp_path, key, field, value):
    files = samples.sog_files(9)
    meta = json.loads(files["meta.json"])
    if field and isinstance(meta[key], dict):
        meta[key][field] = value
    else:
        meta[key] = value
    (tmp_path / "a.sog").write_bytes(samples.zipped({**files, "meta.json": json.dumps(meta).encode()}))
    assert_holds(tmp_path / "a.sog")


@pytest.mark.parametrize("name", ["a.ply", "a.splat"])
def test_a_signalling_nan_in_any_column_is_counted(valid, tmp_path, name):
    data = bytearray(valid[name])
    start = data.find(b"end_header\n") + len(b"end_header\n") if name == "a.ply" else 0
    data[start : start + 24] = np.full(6, 0x7F800001, np.uint32).tobytes()
    (tmp_path / name).write_bytes(data)
    assert_holds(tmp_path / name)
    assert inspect_splat(read_raw(tmp_path / name)).defects[0].first_rows == (0,)
