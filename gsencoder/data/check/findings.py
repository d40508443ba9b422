"""What can be wrong with the files of a scene, how it is said, and how it is mended."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.check.agreement import Agreement, DepthViews, RegistrationFit, agreement, residuals
from gsencoder.data.readers.posed import PosedImage, PosedImages
from gsencoder.data.readers.undistort import CameraModel, focal_count
from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid

ADVICE = {
    "axes": "the poses are in OpenGL's camera axes where OpenCV's are expected, or the reverse",
    "inverse": "the matrices are cam_from_world where world_from_cam is expected, or the reverse",
    "inverse and axes": "the matrices are the inverse of what is expected, in the other camera axes",
    "order": "the poses belong to other photographs: each is that of the photograph {factor:+.0f} places away",
    "ray length": "depth is the length of the ray where the coordinate z is expected",
    "depth scale": "the depth scale is wrong: depths should be {factor:.4g} times as large",
    "depth focal length": "depth has the focal length of another sensor: {factor:.4g} times the given one",
    "focal length": "the focal length of the photographs is {factor:.4g} times the given one",
    "picture size": "the intrinsics are those of pictures of another size: times {factor:.4g} they would fit these",
}
"""Causes that concern all views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong."""

    cause: str  # a key of `ADVICE`, "color registration", "stray view", "other picture", "photographs" or "unknown"
    message: str  # for people
    view: str | None = None  # name of the view, if it is one alone
    # Of the depth scale or a focal length, or how many places the poses are moved by, where the cause has one.
    factor: float | None = None


PLACES = (-2, -1, 1, 2)  # Places in the order of the views by which poses may be moved


def other_poses(cam_from_world: Float64[np.ndarray, "V 4 4"]) -> dict[str, Float64[np.ndarray, "V 4 4"]]:
    """cam_from_world if the files' matrices mean something else, by the cause in `ADVICE`."""
    inverse = invert_rigid(cam_from_world)
    return {
        "axes": OPENCV_FROM_OPENGL @ cam_from_world,
        "inverse": inverse,
        "inverse and axes": OPENCV_FROM_OPENGL @ inverse,
    }


def other_orders(poses: Float[np.ndarray, "V 4 4"]) -> Iterator[tuple[int, Float[np.ndarray, "V 4 4"]]]:
    """The poses if each belongs to the photograph some places further on, and by how many places; ends are wrapped."""
    if len(poses) > 2:
        for shift in PLACES:
            yield shift, np.roll(poses, shift, axis=0)


SCALES = (1e-3, 1e-2, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 1e2, 1e3)
"""Depth scales that files are mistaken by: other units, and steps of other sensors."""
NEAR_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.8, 1.25, 25), 4).tolist())
"""Factors of the depth scale and of the focal length that are tried first; the best is refined."""
REFINEMENTS = 6
MIN_COMPARED = 0.02  # A reading under which fewer samples than this share of all pairs can be compared says nothing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """One way to take the numbers of a scene."""

    cause: str  # what would be wrong with the files if this reading is right; empty for the files' own
    views: DepthViews  # the depth images under this reading
    agreement: Agreement  # of them
    # Of the depth scale or of the focal length, or the places that poses are moved by, where the cause has one.
    factor: float | None = None


def reading_of_files(views: DepthViews) -> Reading:
    """The files' own reading."""
    return Reading(cause="", views=views, agreement=agreement(residuals(views)))


def other_readings(
    views: DepthViews, rows: Int64[np.ndarray, " V"], all_poses: Float[np.ndarray, "n 4 4"]
) -> list[Reading]:
    """Every other reading, those with a factor at the factor where depths agree best."""
    fixed: list[tuple[str, float | None, DepthViews]] = [
        (cause, None, replace(views, cam_from_world=poses))
        for cause, poses in other_poses(views.cam_from_world).items()
    ]
    fixed += [
        ("order", float(shift), replace(views, cam_from_world=poses[rows].astype(np.float64)))
        for shift, poses in other_orders(all_poses)
    ]
    fixed.append(("ray length", None, views.of_rays()))
    readings = [
        Reading(cause=cause, views=other, agreement=agreement(residuals(other)), factor=factor)
        for cause, factor, other in fixed
    ]
    readings.append(_best_factor("depth scale", lambda factor: replace(views, scale=factor), (*SCALES, *NEAR_FACTORS)))
    readings.append(_best_factor("depth focal length", views.with_focal_times, NEAR_FACTORS))
    return readings


def _best_factor(cause: str, apply: Callable[[float], DepthViews], factors: Sequence[float]) -> Reading:
    """The reading of the factor with the smallest spread, refined by golden sections between its neighbors."""

    def spread(factor: float) -> float:
        measured = agreement(residuals(apply(factor)))
        return measured.spread if measured.compared >= min_compared else np.inf

    min_compared = MIN_COMPARED * len(apply(1.0)) * (len(apply(1.0)) - 1) * apply(1.0).values.shape[1]
    spreads = {factor: spread(factor) for factor in sorted(factors)}
    best = min(spreads, key=lambda factor: spreads[factor])
    step = 1.02
    for _ in range(REFINEMENTS):
        for factor in (best / step, best * step):
            spreads.setdefault(factor, spread(factor))
        best = min(spreads, key=lambda factor: spreads[factor])
        step = step**0.5
    corrected = apply(best)
    return Reading(cause=cause, views=corrected, agreement=agreement(residuals(corrected)), factor=best)


LEFT_OUT = ("stray view", "other picture")
CHANGES = {
    "axes": "poses: axes exchanged",
    "inverse": "poses: inverse exchanged",
    "inverse and axes": "poses: inverse and axes exchanged",
    "order": "poses moved by {0:+.0f} places",
    "ray length": 'depth_measure is "ray"',
    "depth scale": "depth_unit_scale_factor times {0:.4g}",
    "depth focal length": "focal length of the depth times {0:.4g}",
    "focal length": "focal length times {0:.4g}",
    "picture size": "intrinsics times {0:.4g}",
    "color registration": "focal length of photographs times {0:.4g}, depth_from_color with a shift of {1:.3g} units",
}


def repair_posed(
    posed: PosedImages, findings: Sequence[Finding], registration: RegistrationFit | None = None
) -> tuple[PosedImages, list[str]]:
    """Posed images read as the findings say they should be, without the views that do not fit, and what was changed.

    Args:
        registration: of the same check, for the finding "color registration".
    """
    if not findings:
        raise InputError(f"{posed.source}: nothing wrong was seen, so there is nothing to repair")
    images, changes = list(posed.images), []
    for finding in findings:
        cause, factor = finding.cause, finding.factor or 1.0
        if cause in LEFT_OUT:
            continue
        if cause not in CHANGES or (cause == "color registration" and registration is None):
            raise InputError(f"{posed.source}: {finding.message}; this cannot be repaired here")
        if cause == "color registration" and any(image.depth_from_color is not None for image in images):
            raise InputError(
                f"{posed.source}: depth is carried over by a depth_from_color of the files that does not fit; "
                "calibrate the cameras again, or give data.depth_from_color="
            )
        poses = np.stack([image.cam_from_world for image in images])
        poses = other_poses(poses).get(cause, poses)
        if cause == "order":
            poses = np.roll(poses, round(factor), axis=0)
        images = [
            _mended(replace(image, cam_from_world=pose), cause, factor, registration)
            for image, pose in zip(images, poses, strict=True)
        ]
        changes.append(CHANGES[cause].format(factor, 0.0 if registration is None else np.hypot(*registration.shift)))
    astray = {str(finding.view) for finding in findings if finding.cause in LEFT_OUT}
    if astray:
        changes.append(f"left out, since they do not fit: {', '.join(sorted(astray))}")
    return replace(posed, images=tuple(image for image in images if image.name not in astray)), changes


def _mended(image: PosedImage, cause: str, factor: float, fit: RegistrationFit | None) -> PosedImage:
    depth_camera = image.depth_camera or image.camera
    if cause == "ray length":
        return replace(image, depth_measure="ray")
    if cause == "depth scale":
        return replace(image, depth_scale=image.depth_scale * factor)
    if cause == "depth focal length":
        return replace(image, depth_camera=focal_times(depth_camera, factor))
    if cause == "picture size":
        return replace(image, camera=focal_times(image.camera, factor, principal_point=True))
    if cause == "focal length":
        depth = None if image.depth_camera is None else focal_times(depth_camera, factor)
        return replace(image, camera=focal_times(image.camera, factor), depth_camera=depth)
    if cause == "color registration" and fit is not None:
        # The poses were the depth camera's; the photograph's stands next to it.
        color_from_depth, depth_from_color = np.eye(4), np.eye(4)
        color_from_depth[:2, 3], depth_from_color[:2, 3] = fit.shift, -fit.shift
        return replace(
            image,
            depth_camera=depth_camera,
            depth_from_color=depth_from_color,
            camera=focal_times(image.camera, fit.focal_factor),
            cam_from_world=color_from_depth @ image.cam_from_world,
        )
    return image


def focal_times(camera: CameraModel, factor: float, *, principal_point: bool = False) -> CameraModel:
    """A camera with its focal lengths multiplied; its distortion is that of directions, and stays."""
    count = focal_count(camera) + 2 * principal_point
    params = tuple(value * factor if index < count else value for index, value in enumerate(camera.params))
    return replace(camera, params=params)
