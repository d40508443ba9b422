"""Inspecting and repairing: every defect is found where it was planted, and only what was asked changes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import splat_samples as samples
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.check.agreement import Finding, RegistrationFit, repair_posed
from gsencoder.data.readers.posed import CameraModel, PosedImage, PosedImages
from gsencoder.data.readers.transforms_json import DISTORTION, read_transforms, transforms_of
from gsencoder.data.splats.files import RawSplat, gaussians_from_raw, read_raw
from gsencoder.data.splats.repair import FIXES, inspect_splat, repair_splat
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid

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


def test_an_unknown_fix_lists_the_names_and_a_repair_that_leaves_nothing_is_an_error():
    for wrong in (["quat"], [], "quats"):
        with pytest.raises(InputError, match="nonfinite, quats, scales, opacities, huge, duplicates, floaters, or all"):
            repair_splat(samples.make_raw(9), wrong)
    with pytest.raises(InputError, match="drop all 9"):
        repair_splat(put("means", list(range(9)), np.nan)(samples.make_raw(9)), ["nonfinite"])


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
    far = replace(right, means=right.means + np.array([4651.0, 5428.0, 100.0]))
    for good in (right, far, surface(12, step=2.0, scale=1.3)):
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


PINHOLE = CameraModel(model="PINHOLE", width=64, height=48, params=(50.0, 51.0, 32.0, 24.0))


def posed(count: int = 4, **changes: Any) -> PosedImages:
    images = []
    for view in range(count):
        pose = np.eye(4)
        angle = 0.3 * view
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = view, 2, 3
        image = {"depth": Path(f"/d/{view}.png"), "depth_scale": 1e-3} | changes
        files = {"name": f"{view}.png", "image": Path(f"/c/{view}.png")}
        images.append(PosedImage(camera=PINHOLE, cam_from_world=pose, **files, **image))
    return PosedImages(source="here", images=tuple(images), metres_per_unit=0.5, up=np.array([0.0, 1, 0]))


def finding(cause: str, *, factor: float | None = None, view: str | None = None) -> Finding:
    return Finding(cause=cause, message=cause, factor=factor, view=view)


def with_poses(scene: PosedImages, change: Any) -> PosedImages:
    poses = change(np.stack([image.cam_from_world for image in scene.images]))
    images = tuple(replace(image, cam_from_world=pose) for image, pose in zip(scene.images, poses, strict=True))
    return replace(scene, images=images)


@pytest.mark.parametrize(
    ("cause", "factor", "break_it"),
    [
        ("axes", None, lambda poses: OPENCV_FROM_OPENGL @ poses),
        ("inverse", None, invert_rigid),
        ("inverse and axes", None, lambda poses: invert_rigid(OPENCV_FROM_OPENGL @ poses)),
        ("order", -1.0, lambda poses: np.roll(poses, 1, axis=0)),
        ("order", 2.0, lambda poses: np.roll(poses, -2, axis=0)),
    ],
)
def test_poses_are_mended_by_undoing_the_fault(cause, factor, break_it):
    right = posed()
    repaired, changes = repair_posed(with_poses(right, break_it), [finding(cause, factor=factor)])
    for mended, image in zip(repaired.images, right.images, strict=True):
        np.testing.assert_allclose(mended.cam_from_world, image.cam_from_world, atol=1e-12)
    assert len(changes) == 1


def test_depth_is_mended_in_its_scale_its_measure_and_its_focal_length():
    right = posed()
    scaled, changes = repair_posed(right, [finding("depth scale", factor=0.2)])
    assert {image.depth_scale for image in scaled.images} == {0.2 * 1e-3}
    assert changes == ["depth_unit_scale_factor times 0.2"]
    ray, _ = repair_posed(right, [finding("ray length")])
    assert {image.depth_measure for image in ray.images} == {"ray"}
    focal, _ = repair_posed(right, [finding("depth focal length", factor=1.1)])
    assert {image.camera for image in focal.images} == {PINHOLE}
    for image in focal.images:
        assert image.depth_camera.params == pytest.approx((55.0, 56.1, 32.0, 24.0))


def test_a_focal_length_is_wrong_for_the_depth_too_where_that_has_a_camera():
    alone = repair_posed(posed(), [finding("focal length", factor=2.0)])[0].images[0]
    assert (alone.camera.params, alone.depth_camera) == ((100.0, 102.0, 32.0, 24.0), None)
    other = replace(PINHOLE, params=(40.0, 40.0, 30.0, 20.0))
    both = repair_posed(posed(depth_camera=other), [finding("focal length", factor=2.0)])[0].images[0]
    assert both.depth_camera.params == (80.0, 80.0, 30.0, 20.0)


def test_a_color_camera_beside_the_depth_camera_leaves_the_depth_where_it_was():
    right = posed()
    fit = RegistrationFit(focal_factor=0.9, shift=np.array([0.02, -0.01]), given=0.1, best=0.9, pairs=9)
    repaired, changes = repair_posed(right, [finding("color registration", factor=0.9)], fit)
    for mended, image in zip(repaired.images, right.images, strict=True):
        np.testing.assert_allclose(mended.depth_from_color @ mended.cam_from_world, image.cam_from_world, atol=1e-12)
        moved = mended.cam_from_world - image.cam_from_world
        np.testing.assert_allclose(moved[:3, 3], (0.02, -0.01, 0), atol=1e-12)
        assert mended.depth_camera == PINHOLE
        assert mended.camera.params == pytest.approx((45.0, 45.9, 32.0, 24.0))
    assert "0.0224 units" in changes[0]
    with pytest.raises(InputError, match="calibrate the cameras again"):
        repair_posed(repaired, [finding("color registration", factor=0.9)], fit)


def test_views_that_do_not_fit_are_left_out_and_the_others_mended():
    findings = [finding("stray view", view="2.png"), finding("ray length"), finding("other picture", view="0.png")]
    repaired, changes = repair_posed(posed(), findings)
    assert [image.name for image in repaired.images] == ["1.png", "3.png"]
    assert changes == ['depth_measure is "ray"', "left out, since they do not fit: 0.png, 2.png"]
    for findings in ([], [finding("unknown")], [finding("color registration")]):
        with pytest.raises(InputError, match=r"^here: "):
            repair_posed(posed(), findings)


def model(name: str, extra: tuple[float, ...]) -> CameraModel:
    focal = (50.0,) if name.startswith("SIMPLE") or name == "RADIAL" else (50.0, 51.0)
    return CameraModel(model=name, width=64, height=48, params=(*focal, 33.0, 23.0, *extra))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", DISTORTION)
def test_every_camera_that_can_be_written_is_read_back(tmp_path, name):
    extra = tuple(0.01 * (1 + index) for index in range(len(DISTORTION[name])))
    camera = model(name, (*extra, *((0.0,) * 3 if name == "FULL_OPENCV" else ())))
    for kind in ("c", "d"):
        (tmp_path / kind).mkdir()
        for view in range(2):
            Image.new("RGB" if kind == "c" else "I;16", (64, 48)).save(tmp_path / kind / f"{view}.png")
    beside = np.eye(4)
    beside[0, 3] = 0.1
    scene = posed(2)
    images = []
    for image in scene.images:
        color, depth = tmp_path / "c" / image.name, tmp_path / "d" / image.name
        files = {"image": color, "mask": color, "depth": depth, "instance": depth}
        measure = {"depth_from_color": beside, "no_depth": 65535, "depth_measure": "ray"}
        images.append(replace(image, camera=camera, depth_camera=PINHOLE, **files, **measure))
    content = transforms_of(replace(scene, images=tuple(images)), tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    read = read_transforms(tmp_path / "transforms.json")
    assert read.metres_per_unit == 0.5
    np.testing.assert_array_equal(read.up, [0, 1, 0])
    for back, image in zip(read.images, images, strict=True):
        np.testing.assert_allclose(back.cam_from_world, image.cam_from_world, atol=1e-9)
        assert back.camera.pinhole_params() == camera.pinhole_params()
        assert [value for value in back.camera.params if value][4:] == list(extra)
        for field in ("image", "depth", "mask", "instance", "depth_scale", "no_depth", "depth_measure"):
            assert getattr(back, field) == getattr(image, field)
        assert back.depth_camera.pinhole_params() == PINHOLE.pinhole_params()
        np.testing.assert_array_equal(back.depth_from_color, beside)


@pytest.mark.parametrize("camera", [model("FULL_OPENCV", (0.0,) * 5 + (0.1, 0.0, 0.0)), model("FOV", (0.5,))])
def test_a_camera_that_a_transforms_json_cannot_express_is_refused(tmp_path, camera):
    scene = posed(1)
    with pytest.raises(InputError, match=f"camera model {camera.model} cannot be written"):
        transforms_of(replace(scene, images=(replace(scene.images[0], camera=camera),)), tmp_path)
