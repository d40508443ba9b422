"""Posed images with the faults mended that a check found and whose cause is certain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.check.agreement import RegistrationFit
from gsencoder.data.check.findings import Finding, other_poses
from gsencoder.data.readers.posed import PosedImage, PosedImages
from gsencoder.data.readers.undistort import CameraModel, focal_count

LEFT_OUT = ("stray view", "other picture")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Repair:
    """A mended scene.

    Attributes:
        posed: its posed images.
        changes: what was changed, one line each.
    """

    posed: PosedImages
    changes: tuple[str, ...]


def repair_posed(
    posed: PosedImages, findings: Sequence[Finding], registration: RegistrationFit | None = None
) -> Repair:
    """Posed images read as the findings say they should be, without the views that do not fit.

    Args:
        registration: of the same check, for the finding "color registration".
    """
    if not findings:
        raise InputError(f"{posed.source}: nothing wrong was seen, so there is nothing to repair")
    images, changes = list(posed.images), []
    for finding in findings:
        if finding.cause in LEFT_OUT:
            continue
        images, change = _mend(images, finding, registration, posed.source)
        changes.append(change)
    astray = {finding.view for finding in findings if finding.cause in LEFT_OUT}
    remaining = [image for image in images if image.name not in astray]
    if astray:
        changes.append(f"left out, since they do not fit: {', '.join(sorted(map(str, astray)))}")
    return Repair(posed=replace(posed, images=tuple(remaining)), changes=tuple(changes))


def _mend(
    images: list[PosedImage], finding: Finding, registration: RegistrationFit | None, source: str
) -> tuple[list[PosedImage], str]:
    cause, factor = finding.cause, finding.factor
    poses = np.stack([image.cam_from_world for image in images])
    if cause in ("axes", "inverse", "inverse and axes"):
        return _with_poses(images, other_poses(poses)[cause]), f"poses: {cause} exchanged"
    if cause == "order":
        assert factor is not None
        return _with_poses(images, np.roll(poses, round(factor), axis=0)), f"poses moved by {factor:+.0f} places"
    if cause == "ray length":
        return [replace(image, depth_measure="ray") for image in images], 'depth_measure is "ray"'
    if cause == "depth scale":
        assert factor is not None
        scaled = [replace(image, depth_scale=image.depth_scale * factor) for image in images]
        return scaled, f"depth_unit_scale_factor times {factor:.4g}"
    if cause == "depth focal length":
        assert factor is not None
        return [_with_depth_focal(image, factor) for image in images], f"focal length of the depth times {factor:.4g}"
    if cause == "picture size":
        assert factor is not None
        return [
            replace(image, camera=focal_times(image.camera, factor, principal_point=True)) for image in images
        ], f"intrinsics times {factor:.4g}"
    if cause == "focal length":
        assert factor is not None
        mended = [
            replace(
                _with_depth_focal(image, factor) if image.depth_camera is not None else image,
                camera=focal_times(image.camera, factor),
            )
            for image in images
        ]
        return mended, f"focal length times {factor:.4g}"
    if cause == "color registration" and registration is not None:
        if any(image.depth_from_color is not None for image in images):
            raise InputError(
                f"{source}: depth is carried over by a depth_from_color of the files that does not fit; "
                "calibrate the cameras anew, or give data.depth_from_color="
            )
        mended = [_with_color_camera(image, registration) for image in images]
        return mended, (
            f"focal length of the photographs times {registration.focal_factor:.4g}, depth_from_color with a shift of "
            f"{np.hypot(*registration.shift):.3g} units"
        )
    raise InputError(f"{source}: {finding.message}; this cannot be repaired here")


def _with_poses(images: list[PosedImage], poses: Float64[np.ndarray, "V 4 4"]) -> list[PosedImage]:
    return [replace(image, cam_from_world=pose) for image, pose in zip(images, poses, strict=True)]


def focal_times(camera: CameraModel, factor: float, *, principal_point: bool = False) -> CameraModel:
    """A camera with its focal lengths multiplied; its distortion is that of directions, and stays."""
    count = focal_count(camera) + 2 * principal_point
    params = tuple(value * factor if index < count else value for index, value in enumerate(camera.params))
    return replace(camera, params=params)


def _with_depth_focal(image: PosedImage, factor: float) -> PosedImage:
    return replace(image, depth_camera=focal_times(image.depth_camera or image.camera, factor))


def _with_color_camera(image: PosedImage, fit: RegistrationFit) -> PosedImage:
    """The poses were the depth camera's; the photograph's stands beside it."""
    color_from_depth, depth_from_color = np.eye(4), np.eye(4)
    color_from_depth[:2, 3], depth_from_color[:2, 3] = fit.shift, -fit.shift
    return replace(
        image,
        depth_camera=image.depth_camera or image.camera,
        depth_from_color=depth_from_color,
        camera=focal_times(image.camera, fit.focal_factor),
        cam_from_world=color_from_depth @ image.cam_from_world,
    )
