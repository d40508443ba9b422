"""Cameras and lazy pictures of a scene from its views as files describe them: undistorted, resized, masked."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.background import find_background
from gsencoder.data.readers.depth_images import DepthFiles, DepthSensor
from gsencoder.data.readers.image_file import is_deep_grey, picture_info, picture_size, read_integers
from gsencoder.data.readers.images import ImageFiles, InstanceFiles, PixelGrid
from gsencoder.data.readers.masks import EmptyFiles, MaskFiles
from gsencoder.data.readers.posed import PosedImage, PosedImages, choose_origin
from gsencoder.data.readers.undistort import CameraModel, Pinhole, RemapCache, pinhole_for
from gsencoder.types import Cameras, Views
from gsencoder.types.checks import invert_rigid, move_origin
from gsencoder.types.orientation import EXCHANGED, INVERSE, UNMIRRORED

FEW_CAMERAS = 8
FEWEST_STEPS = 64
"""Integer depth images whose largest value is smaller have lost most of what was measured."""
MEASURED = 0.05
"""Where depth was measured on a larger share of it, what looks like a background is a wall."""


def make_views(
    posed: PosedImages, *, max_views: int = 0, image_scale: float = 1.0, mask_background: bool = False
) -> tuple[Views, Float64[np.ndarray, "3"]]:
    """Cameras without distortion and lazy pictures, and the origin that was subtracted from the cameras.

    Args:
        posed: views as their files describe them.
        max_views: see SceneConfig.
        image_scale: see SceneConfig.
        mask_background: whether a background of one color is looked for, and masked with a warning.

    Raises:
        InputError: no picture, a picture or depth of the wrong size, a camera that cannot be undistorted.
    """
    images = posed.images
    if not images:
        raise InputError(f"{posed.source}: no view")
    if max_views:
        images = tuple(images[row] for row in even_indices(len(images), max_views))
    cam_from_world = np.stack([image.cam_from_world for image in images])
    origin = choose_origin(invert_rigid(cam_from_world)[:, :3, 3])
    pinholes: dict[CameraModel, Pinhole] = {}
    grids, depth_grids = [], []
    transparent: list[Path | None] = []
    orientations: list[int] = []
    for image in images:
        where = f"{posed.source}: view {image.name[:120]!r}"
        if image.camera not in pinholes:
            pinholes[image.camera] = pinhole_for(image.camera, where)
        pinhole = pinholes[image.camera]
        width = max(1, round(pinhole.width * image_scale))
        height = max(1, round(pinhole.height * image_scale))
        size, is_transparent, orientation = picture_info(image.image)
        # A photograph that is stored sideways, with the camera of the upright picture, is turned on load. With the
        # camera of its stored pixels it is not, and a mask whose sides are exchanged belongs to the upright picture.
        camera_size = image.camera.width, image.camera.height
        exchanged = orientation in EXCHANGED and size[::-1] == camera_size != size
        turn = orientation if exchanged else INVERSE[orientation]
        orientations.append(1 if exchanged else orientation)
        grids.append(PixelGrid(source=image.camera, pinhole=pinhole, width=width, height=height, turn=turn))
        depth_grids.append(replace(grids[-1], source=image.depth_camera or image.camera))
        _check_sizes(image, grids[-1], depth_grids[-1], size, where)
        transparent.append(image.image if is_transparent else None)
    remaps = RemapCache()
    cameras = Cameras(
        cam_from_world=move_origin(cam_from_world, origin).astype(np.float32),
        Ks=np.array([grid.pinhole.matrix(grid.width, grid.height) for grid in grids]).astype(np.float32),
        widths=np.array([grid.width for grid in grids], np.int32),
        heights=np.array([grid.height for grid in grids], np.int32),
    )
    depths = [image.depth for image in images]
    masks = [image.mask for image in images]
    instances = [image.instance for image in images]
    partial = _have_empty_pixels({(grid.pinhole, grid.source, grid.reduction) for grid in grids}, remaps)
    background = None
    if mask_background and not _any(masks) and not _any(transparent) and not any(map(_is_fisheye, images)):
        background = find_background([image.image for image in images])
    outlined = transparent if background is None else [image.image for image in images]
    has_outlines = _any(outlined)
    views = Views(
        cameras=cameras,
        names=tuple(image.name for image in images),
        images=ImageFiles([image.image for image in images], grids, remaps),
        depths=DepthFiles(depths, depth_grids, remaps, [_depth_sensor(image) for image in images])
        if _any(depths)
        else None,
        masks=MaskFiles(masks, grids, remaps, outlined, background) if _any(masks) or has_outlines or partial else None,
        empty=EmptyFiles(masks, grids, remaps, outlined, background) if has_outlines else None,
        instances=InstanceFiles(instances, grids, remaps) if _any(instances) else None,
        orientations=tuple(orientations) if max(orientations) > 1 else None,
    )
    _warn_of_odd_files(posed.source, images)
    mirrored = sum(UNMIRRORED[orientation] != orientation for orientation in orientations)
    if mirrored:
        _warn(
            f"{posed.source}: {mirrored} of {len(images)} photographs are stored mirrored (EXIF orientation 2, 4, 5, "
            "7), and poses belong to the stored pixels: the scene may be a mirror image"
        )
    if background is not None:
        if _is_measured(views):
            return make_views(posed, max_views=max_views, image_scale=image_scale)
        _warn(
            f"{posed.source}: the photographs have a background of one color ({background.describe()}); it is masked "
            "and taken for empty space (data.background=none uses it)"
        )
    return views, origin


def _warn_of_odd_files(source: str, images: Sequence[PosedImage]) -> None:
    """Warns if photographs look like depth images, or depth images like meters in integers; one file of each is
    looked at."""
    middle = images[len(images) // 2]
    if is_deep_grey(middle.image):
        _warn(
            f"{source}: {middle.image.name} has one channel of 16 bits, as depth images have; is it listed as a "
            "photograph by mistake?"
        )
    depths = [image.depth for image in images if image.depth is not None and image.depth.suffix.lower() != ".npy"]
    if depths:
        file = depths[len(depths) // 2]
        largest = 0
        # A file that cannot be read is an error when the depth of its view is.
        with suppress(InputError):
            largest = int(read_integers(file, "depth", wide=True).max(initial=0))
        if 0 < largest < FEWEST_STEPS:
            _warn(
                f"{source}: {file.name} holds depths of at most {largest} steps; if these are meters, the rest was "
                "lost when they were saved as integers: save millimeters in 16 bits, or floating-point numbers as .npy"
            )


def _is_fisheye(image: PosedImage) -> bool:
    """Whether the picture may be a disc in a black frame."""
    return "FISHEYE" in image.camera.model


def _is_measured(views: Views) -> bool:
    """Whether a sensor saw surfaces where the background is."""
    if views.depths is None or views.empty is None:
        return False
    rows = even_indices(len(views), 4)
    shares = [float((views.depths[int(row)][views.empty[int(row)]] > 0).mean()) for row in rows]
    return float(np.nan_to_num(shares).mean()) > MEASURED


def _depth_sensor(image: PosedImage) -> DepthSensor:
    transform = image.depth_from_color
    return DepthSensor(
        scale=image.depth_scale,
        no_depth=image.no_depth,
        measure=image.depth_measure,
        color_from_depth=None if transform is None else invert_rigid(transform),
    )


def _any(paths: Sequence[Path | None]) -> bool:
    return any(path is not None for path in paths)


def _check_sizes(image: PosedImage, grid: PixelGrid, depth_grid: PixelGrid, size: tuple[int, int], where: str) -> None:
    """Checks the sizes in the headers of the files; `size` is the photograph's."""
    camera = image.camera
    if image.depth is not None and image.depth == image.image:
        raise InputError(f"{where}: {image.image} is listed as photograph and as depth image; list the photograph")
    if (size[::-1] if grid.is_exchanged(*size) else size) != (camera.width, camera.height):
        raise InputError(
            f"{where}: {image.image} has {size[0]}×{size[1]} pixels but its camera {camera.width}×{camera.height}; "
            "give the images at the size of the intrinsics (image_scale makes them smaller on load)"
        )
    for file, expected in ((image.depth, depth_grid), (image.mask, grid), (image.instance, grid)):
        if file is not None and not expected.fits(*(actual := picture_size(file))):
            raise InputError(
                f"{where}: {file} has {actual[0]}×{actual[1]} pixels but {image.image} has {size[0]}×{size[1]}; "
                "both must have the same shape"
            )


def _have_empty_pixels(cameras: set[tuple[Pinhole, CameraModel, int]], remaps: RemapCache) -> bool:
    """Whether some pixel of a pinhole camera is outside the distorted picture. With many cameras the check would cost
    more than masks do, and the result is True."""
    distorted = [camera for camera in cameras if not camera[1].is_pinhole]
    if len(distorted) > FEW_CAMERAS:
        return True
    maps = [remaps.get(*camera) for camera in distorted]
    return any(remap is not None and not remap.valid.all() for remap in maps)


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=3)
