"""Loading of scenes in any supported layout, or of a splat alone."""

import math
import os
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.posed_views import make_views
from gsencoder.data.readers.depth_images import DepthMeasure
from gsencoder.data.readers.frames import pinhole_of
from gsencoder.data.readers.layouts import ReadOptions, layout_of, read_transforms_file
from gsencoder.data.readers.objects_json import read_objects
from gsencoder.data.readers.posed import MAX_COORDINATE, PosedImage, PosedImages, rigid_pose
from gsencoder.data.readers.scene_splat import (
    file_of_scene,
    find_splat,
    read_bare_splat,
    warn_of_unused_splat,
)
from gsencoder.data.readers.transforms_json import TRANSFORMS
from gsencoder.data.scene_paths import is_transforms_file, name_of_folder
from gsencoder.data.splats import load_splat
from gsencoder.data.truth.scene_labels import (
    labels_of_layout,
    objects_of_labels,
    with_archived_instances,
    with_mesh_instances,
)
from gsencoder.types import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Options of reading a scene."""

    allow_outside: bool = field(default=False, metadata={"help": "allow files outside the folder of the scene"})
    max_views: int = field(default=0, metadata={"help": "largest number of views, evenly spaced; 0 = all"})
    depth_scale: float | None = field(
        default=None, metadata={"help": "world units for one step of a depth file; empty = that of the format"}
    )
    depth_measure: DepthMeasure | None = field(
        default=None,
        metadata={"help": "what depth files hold: z, or ray, the distance from the camera; empty = that of the files"},
    )
    image_scale: float = field(
        default=1.0,
        metadata={"help": "factor in (0, 1] by which pictures, depth maps, masks and intrinsics are downscaled"},
    )
    metres_per_unit: float | None = field(
        default=None, metadata={"help": "meters in a world unit; empty = that of the files"}
    )
    up: tuple[float, float, float] | None = field(
        default=None,
        metadata={"help": "the world's up, three numbers of any length; empty = that of the files, else an estimate"},
    )
    images: str = field(
        default="", metadata={"help": "folder of the photographs of a COLMAP model; empty = images/ beside the model"}
    )
    background: Literal["auto", "none"] = field(
        default="auto",
        metadata={
            "help": "auto = a background of one color, around the object in nearly all photographs, is masked and "
            "taken for empty space; none = photographs are used as they are (transparency is masked in any case)"
        },
    )
    check_fit: bool = field(
        default=True,
        metadata={"help": "refuse a splat that does not fit the photographs, where it fits in another frame"},
    )
    intrinsics: tuple[float, float, float, float] | None = field(
        default=None,
        metadata={"help": "fx, fy, cx, cy of the photographs, pixels, no distortion; empty = those of the files"},
    )
    depth_intrinsics: tuple[float, float, float, float] | None = field(
        default=None, metadata={"help": "fx, fy, cx, cy of the depth images; empty = those of the files"}
    )
    depth_from_color: tuple[float, ...] | None = field(
        default=None,
        metadata={
            "help": "where the depth sensor stands: 12 or 16 numbers of the rigid transform from the photograph's "
            "camera "
            "axes to its own, row by row, world units; empty = that of the files"
        },
    )

    def __post_init__(self) -> None:
        if self.max_views < 0:
            raise InputError(f"max_views: expected 0 (all) or more, got {self.max_views}")
        if not 0 < self.image_scale <= 1:
            raise InputError(f"image_scale: expected a number above 0 and at most 1, got {self.image_scale}")
        for name in ("depth_scale", "metres_per_unit"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name}: expected a positive number, got {value}")
        if self.up is not None and not 1e-6 < math.hypot(*self.up) < 1e6:
            raise InputError(f"up: expected three finite numbers that are not all zero, got {list(self.up)}")
        if self.background not in ("auto", "none"):
            raise InputError(f"background: expected auto or none, got {self.background!r}")
        if self.depth_from_color is not None and len(self.depth_from_color) not in (12, 16):
            raise InputError(f"depth_from_color: expected 12 or 16 numbers, got {len(self.depth_from_color)}")


def load_scene(path: str | Path, *, splat: str | Path | None = None, options: SceneConfig = SceneConfig()) -> Scene:
    """Reads a scene; of pictures the size is read now, and they are decoded on access.

    Recognized, in this order: the layouts of `gsencoder.data.readers.layouts` (transforms.json, COLMAP, ScanNet++,
    ScanNet, 7-Scenes, TUM RGB-D, Replica), a splat file, or a folder with one splat file or an unpacked .sog.

    Cameras and Gaussians are relative to `Scene.origin`: the mean of the camera centers (for a bare splat the median
    of its means), each coordinate rounded to a multiple of 1000 units. It is subtracted in float64.

    Args:
        path: a folder or file.
        splat: the Gaussians of a scene that has views; relative to the scene or else to the current folder, with
            {scene} for the name of the scene's folder. They must be in the world of the cameras. Without it a splat
            beside the views is not used.
        options: see SceneConfig.

    Returns:
        A scene with views, or with Gaussians only, or both. A ScanNet or ScanNet++ scene whose label files lie beside
        it has objects, and where there are no pictures of instances, maps that are drawn from the labeled mesh on
        access. `views.masks` exists if there are mask files, transparency, a background of one color, or pinhole
        pixels that the distorted picture does not cover.

    Raises:
        InputError: no scene is recognized, no view is left, or a file is wrong.

    Warns:
        SceneWarning: a background of one color is masked.
    """
    path = Path(path)
    try:
        root = path.absolute()
        exists = root.exists()
    except (OSError, ValueError) as error:
        raise InputError(f"{str(path)[:200]!r} is not a path ({type(error).__name__})") from error
    if not exists:
        raise InputError(f"{path}: no such file or folder")
    posed, folder, layout = read_posed(root, options)
    if posed is None:
        if splat is not None:
            raise InputError(f"{path}: splat= is for scenes with views, and here there are none; give one splat only")
        name = name_of_folder(root) if root.is_dir() else root.stem
        bare, origin = read_bare_splat(find_splat(root))
        return Scene(
            name=name,
            gaussians=bare,
            origin=origin,
            metres_per_unit=options.metres_per_unit,
            up=_unit(options.up),
            folder=folder,
        )
    views, origin = make_views(
        posed,
        max_views=options.max_views,
        image_scale=options.image_scale,
        mask_background=options.background == "auto",
    )
    gaussians = load_splat(file_of_scene("splat", splat, folder), origin=origin) if splat is not None else None
    if splat is None:
        warn_of_unused_splat(folder)
    objects_file = folder / "objects.json"
    beside_transforms = root.suffix.lower() == ".json" or any((folder / file).is_file() for file in TRANSFORMS)
    objects = read_objects(objects_file) if beside_transforms and os.path.lexists(objects_file) else ()
    labels = labels_of_layout(folder, layout)
    if labels is not None:
        if layout == "ScanNet":
            views = with_archived_instances(views, folder)
        views = with_mesh_instances(views, labels, origin)
        objects = objects_of_labels(labels)
    points, colors = _finite_points(posed)
    return Scene(
        name=name_of_folder(folder),
        gaussians=gaussians,
        views=views,
        origin=origin,
        metres_per_unit=options.metres_per_unit or posed.metres_per_unit,
        up=posed.up if options.up is None else _unit(options.up),
        objects=objects,
        sfm_points=(points - origin).astype(np.float32) if len(points) else None,
        sfm_colors=colors if len(colors) else None,
        folder=folder,
    )


def _finite_points(posed: PosedImages) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "_ 3"]]:
    """The points that are finite, and their colors if they have any."""
    with np.errstate(invalid="ignore"):
        good = np.abs(posed.points).max(axis=1, initial=0) <= MAX_COORDINATE
    if not good.all():
        message = f"{int((~good).sum())} of {len(good)} points are not finite and are left out"
        warnings.warn(f"{posed.source}: {message}", SceneWarning, stacklevel=3)
    return posed.points[good], posed.colors[good] if len(posed.colors) else posed.colors


def _unit(direction: tuple[float, float, float] | None) -> Float64[np.ndarray, "3"] | None:
    return None if direction is None else np.array(direction) / math.hypot(*direction)


def read_posed(root: Path, options: SceneConfig = SceneConfig()) -> tuple[PosedImages | None, Path, str]:
    """The posed images of an existing folder or file as its files describe them, the folder of the scene, and the name
    of the layout; None and "splat" where there are no views.

    Raises:
        InputError: a file is wrong.
    """
    read_options = ReadOptions(
        allow_outside=options.allow_outside,
        depth_scale=options.depth_scale,
        images=options.images,
        intrinsics=options.intrinsics,
    )
    if root.is_file():
        if not is_transforms_file(root):
            return None, root.parent, "splat"
        name = "transforms.json"
        posed, folder = read_transforms_file(root, read_options)
    else:
        layout = layout_of(root)
        if layout is None:
            return None, root, "splat"
        name = layout.name
        posed, folder = layout.read(root, read_options)
    images = tuple(_with_stated_sensors(image, options) for image in posed.images)
    return replace(posed, images=images), folder, name


def _with_stated_sensors(image: PosedImage, options: SceneConfig) -> PosedImage:
    """A view with the intrinsics and the depth sensor that the user states."""
    if options.intrinsics is not None:
        fx, fy, cx, cy = options.intrinsics
        size = image.camera.width, image.camera.height
        image = replace(image, camera=pinhole_of(fx, fy, cx, cy, image.image, "data.intrinsics", size=size))
    if image.depth is not None and options.depth_intrinsics is not None:
        fx, fy, cx, cy = options.depth_intrinsics
        image = replace(image, depth_camera=pinhole_of(fx, fy, cx, cy, image.depth, "data.depth_intrinsics"))
    if options.depth_measure is not None:
        image = replace(image, depth_measure=options.depth_measure)
    if options.depth_from_color is not None:
        rows = np.vstack((np.array(options.depth_from_color).reshape(-1, 4)[:3], (0, 0, 0, 1)))
        image = replace(image, depth_from_color=rigid_pose(rows, "data.depth_from_color"))
    return image
