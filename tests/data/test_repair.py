"""Inspecting and repairing: every defect is found where it was planted, and only what was asked changes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import splat_samples as samples

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splats.files import RawSplat, gaussians_from_raw, read_raw
from gsencoder.data.splats.repair import FIXES, inspect_splat, repair_splat

Plant = Callable[[RawSplat], RawSplat]


def put(field: str, rows: list[int], value: float, column: int | None = None) -> Plant:
    def plant(raw: RawSplat) -> RawSplat:
        array = getattr(raw, field).copy()
        array[rows if column is None else (rows, column)] = value
        return replace(raw, **{field: array})

    return plant


def copy_rows(raw: RawSplat) -> RawSplat:
    order = np.arange(len(raw))
    order[[7, 90]] = [3, 3]
    return raw.select(order)


PLANTED: dict[str, tuple[str, tuple[int, ...], Plant]] = {
    "nan mean": ("nonfinite", (4, 9), put("means", [4, 9], np.nan, 1)),
    "mean beyond float32": ("nonfinite", (4,), put("means", [4], 1e39, 1)),
    "zero quaternion": ("quats", (0, 299), put("quats", [0, 299], 0)),
    "tiny quaternion": ("quats", (5,), put("quats", [5], 1e-13)),
    "zero scale": ("scales", (5,), put("log_scales", [5], -np.inf, 2)),
    "subnormal scale": ("scales", (5,), put("log_scales", [5], -88.5, 2)),
    "endless scale": ("scales", (5, 6), put("log_scales", [5, 6], 89, 2)),
    "infinite logits": ("opacities", (2,), put("logit_opacities", [2], -np.inf)),
    "huge scale": ("huge", (2,), put("log_scales", [2], 6, 1)),
    "duplicates": ("duplicates", (7, 90), copy_rows),
    "floaters": ("floaters", (1, 2), put("means", [1, 2], -500, 0)),
}


@pytest.mark.parametrize("case", PLANTED)
def test_a_planted_defect_is_reported_with_its_rows_and_nothing_else_is(case):
    name, rows, plant = PLANTED[case]
    report = inspect_splat(plant(samples.make_raw()))
    assert [(defect.name, defect.count, defect.first_rows) for defect in report.defects] == [(name, len(rows), rows)]
    stops = name in ("nonfinite", "quats", "scales", "opacities")
    assert report.defects[0].stops_loading == stops
    assert report.loadable != stops


@pytest.mark.parametrize("case", PLANTED)
def test_the_fix_of_a_defect_leaves_none_and_touches_no_other_row(case):
    name, rows, plant = PLANTED[case]
    raw = plant(samples.make_raw())
    fixed, report = repair_splat(raw, [name])
    assert inspect_splat(fixed).defects == ()
    assert len(gaussians_from_raw(fixed)) == len(fixed) == report.rows_after
    assert sum(change.count for change in report.changes) == len(rows)
    others = np.setdiff1d(np.arange(len(raw)), rows)
    unaffected = others if len(fixed) < len(raw) else np.arange(len(raw))
    touched = np.isin(unaffected, rows)
    for field in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert np.array_equal(getattr(fixed, field)[~touched], getattr(raw, field)[others]), field


def test_only_the_fixes_asked_for_are_made():
    raw = put("quats", [3], 0)(put("logit_opacities", [8], np.inf)(samples.make_raw()))
    fixed, report = repair_splat(raw, ["opacities"])
    assert [defect.name for defect in inspect_splat(fixed).defects] == ["quats"]
    assert [(change.fix, change.count) for change in report.changes] == [("opacities", 1)]
    assert fixed.logit_opacities[8] == 20
    assert np.isinf(raw.logit_opacities[8])


def test_all_mends_everything_at_once_and_a_second_run_finds_nothing():
    raw = samples.make_raw()
    for _, _, plant in PLANTED.values():
        raw = plant(raw)
    fixed, report = repair_splat(raw, ["all"])
    assert inspect_splat(fixed).defects == ()
    assert (report.rows_before, report.rows_after) == (300, len(fixed))
    dropped = sum(change.count for change in report.changes if change.action.startswith("dropped"))
    assert dropped == 300 - len(fixed)
    again, second = repair_splat(fixed, ["all"])
    assert [change.fix for change in second.changes if change.fix != "scales"] == [f for f in FIXES if f != "scales"]
    assert all(change.count == 0 for change in second.changes)
    for field in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert np.array_equal(getattr(again, field), getattr(fixed, field))


def test_an_unknown_fix_lists_the_names():
    for wrong in (["quat"], [], "quats"):
        with pytest.raises(InputError, match="nonfinite, quats, scales, opacities, huge, duplicates, floaters, or all"):
            repair_splat(samples.make_raw(9), wrong)


def test_a_repair_that_leaves_nothing_is_an_error():
    raw = put("means", list(range(9)), np.nan)(samples.make_raw(9))
    with pytest.raises(InputError, match="drop all 9"):
        repair_splat(raw, ["nonfinite"])


def test_rows_that_differ_in_one_bit_of_one_column_are_not_duplicates():
    raw = samples.make_raw()
    raw = raw.select(np.repeat(np.arange(150), 2))
    sh = raw.sh.copy()
    sh[1::2, 3, 2] = np.nextafter(sh[1::2, 3, 2], np.float32(9))
    sh[101, 3, 2] = sh[100, 3, 2]
    defects = inspect_splat(replace(raw, sh=sh)).defects
    assert [(defect.name, defect.first_rows) for defect in defects] == [("duplicates", (101,))]


def test_the_statistics_are_those_of_the_finite_rows():
    raw = put("means", [4], np.inf)(samples.make_raw())
    report = inspect_splat(raw)
    good = np.delete(np.arange(300), 4)
    assert report.extent_min == tuple(raw.means[good].min(axis=0))
    assert report.extent_max == tuple(raw.means[good].max(axis=0))
    assert (np.array(report.robust_min) >= report.extent_min).all()
    assert report.median_scale == pytest.approx(np.exp(np.median(raw.log_scales[good])), rel=1e-6)
    assert list(report.opacity_quantiles.values()) == sorted(report.opacity_quantiles.values())
    assert (report.count, report.sh_degree, report.format) == (300, 1, "made for a test")


@pytest.mark.parametrize("count", [0, 1, 2])
def test_very_small_splats_are_inspected(count):
    report = inspect_splat(samples.make_raw().select(np.arange(count)))
    assert report.count == count
    assert report.defects == ()
    assert report.loadable == (count > 0)


def test_a_file_of_nothing_but_nan_is_inspected(tmp_path):
    raw = samples.make_raw(5, 0)
    columns = {name: np.full(5, np.nan) for name in samples.ply_columns(raw)}
    (tmp_path / "nan.ply").write_bytes(samples.ply_bytes(columns))
    report = inspect_splat(read_raw(tmp_path / "nan.ply"))
    assert [(defect.name, defect.count) for defect in report.defects if defect.stops_loading] == [("nonfinite", 5)]
    assert report.extent_min is None
    assert report.median_scale is None


def surface(count: int = 40, *, step: float = 0.02, scale: float = 0.012) -> RawSplat:
    """A sheet of Gaussians that nearly touch, of opacities about 0.9."""
    rng = np.random.default_rng(0)
    rows, columns = np.divmod(np.arange(count * count), count)
    means = np.stack((step * rows, step * columns, np.zeros(count * count)), axis=1)
    return replace(
        samples.make_raw(count * count),
        means=(means + rng.normal(size=means.shape) * step / 10).astype(np.float32).astype(np.float64),
        log_scales=rng.normal(np.log(scale), 0.3, means.shape).astype(np.float32),
        logit_opacities=rng.normal(2.2, 1.0, len(means)).astype(np.float32),
    )


@pytest.mark.parametrize("columns", [("scales",), ("opacities",), ("scales", "opacities")])
def test_values_that_were_stored_activated_are_said_and_converted(columns):
    right = surface()
    wrong = right
    if "scales" in columns:
        wrong = replace(wrong, log_scales=np.exp(right.log_scales))
    if "opacities" in columns:
        wrong = replace(wrong, logit_opacities=1 / (1 + np.exp(-right.logit_opacities)))
    findings = inspect_splat(wrong).findings
    assert [finding.split()[0] for finding in findings] == list(columns)
    assert all("gsencoder repair with fix=[activated] converts them" in finding for finding in findings)
    with pytest.warns(SceneWarning) as caught:
        gaussians_from_raw(wrong)
    assert [str(warning.message) for warning in caught] == [f"splat: {finding}" for finding in findings]
    fixed, report = repair_splat(wrong, ["activated"])
    assert [change.count for change in report.changes] == [len(wrong)]
    np.testing.assert_allclose(fixed.log_scales, right.log_scales, atol=1e-5)
    np.testing.assert_allclose(fixed.logit_opacities, right.logit_opacities, atol=1e-4)
    assert inspect_splat(fixed).findings == ()


def test_a_splat_as_it_should_be_has_no_odd_values():
    right = surface()
    for good in (
        right,
        replace(right, means=right.means + np.array([4651.0, 5428.0, 100.0])),
        surface(12, step=2.0, scale=1.3),
    ):
        assert inspect_splat(good).findings == ()
    # Of large Gaussians logarithms are positive, too.
    large = replace(right, means=300 * right.means, log_scales=right.log_scales + np.float32(np.log(300)))
    assert large.log_scales.min() > 0
    assert inspect_splat(large).findings == ()


def test_a_row_with_several_defects_is_counted_once():
    raw = samples.make_raw()
    for field, value in (("quats", 0), ("log_scales", -np.inf), ("logit_opacities", np.inf)):
        raw = put(field, [4], value)(raw)
    raw = put("logit_opacities", [5], np.inf)(put("log_scales", [5], -np.inf)(raw))
    found = {defect.name: defect.first_rows for defect in inspect_splat(raw).defects}
    assert found == {"quats": (4,), "scales": (5,)}


def test_coordinates_that_float32_rounded_are_said_with_what_to_subtract():
    right = surface()
    far = right.means + np.array([465123.4, 5428765.6, 300.0])
    assert inspect_splat(replace(right, means=far)).findings == ()
    (finding,) = inspect_splat(replace(right, means=far.astype(np.float32).astype(np.float64))).findings
    assert "rounded to steps of 0.5 along y" in finding
    assert "subtracted in double precision" in finding
    assert "[465000.0, 5429000.0, 0.0]" in finding
    coarse = replace(right, means=np.round(right.means / 0.1) * 0.1)
    (finding,) = inspect_splat(coarse).findings
    assert "steps of 0.1 along" in finding
    assert "export again without rounding" in finding
