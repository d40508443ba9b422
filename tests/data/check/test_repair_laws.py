"""A repair undoes the fault that a finding names; every mended scene survives its transforms.json."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.data.check.agreement import Finding, RegistrationFit, repair_posed
from gsencoder.data.readers.posed import CameraModel, PosedImage, PosedImages
from gsencoder.data.readers.transforms_json import DISTORTION, read_transforms, transforms_of
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid

PINHOLE = CameraModel(model="PINHOLE", width=64, height=48, params=(50.0, 51.0, 32.0, 24.0))


def posed(count: int = 4, **changes: Any) -> PosedImages:
    images = []
    for view in range(count):
        pose = np.eye(4)
        angle = 0.3 * view
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = view, 2, 3
        image = {"depth": Path(f"/d/{view}.png"), "depth_scale": 1e-3} | changes
        images.append(
            PosedImage(name=f"{view}.png", camera=PINHOLE, cam_from_world=pose, image=Path(f"/c/{view}.png"), **image)
        )
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
        np.testing.assert_allclose(
            mended.cam_from_world[:3, 3] - image.cam_from_world[:3, 3], (0.02, -0.01, 0), atol=1e-12
        )
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
