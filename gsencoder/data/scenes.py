"""Loading of scenes in any supported layout, or of a splat alone, and which paths are scenes, by names of files."""

import json
import math
import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import SUMMARY_NAME, UNFINISHED_FILE, file_of_scene, read_foreign_text
from gsencoder.core.settings import check_limits, option
from gsencoder.data.labels.scans import (
    labels_of_layout,
    objects_of_labels,
    with_archived_instances,
    with_mesh_instances,
)
from gsencoder.data.readers.depth_images import DepthFiles
from gsencoder.data.readers.images import (
    ImageFiles,
    PixelGrid,
    picture_info,
    picture_size,
    pinhole_of,
)
from gsencoder.data.readers.label_images import LabelFiles
from gsencoder.data.readers.layouts import (
    SPLAT_SUFFIXES,
    describe_layouts,
    find_splat,
    layout_of,
    read_bare_splat,
    warn_of_unused_splat,
)
from gsencoder.data.readers.masks import MaskFiles, find_background
from gsencoder.data.readers.posed import (
    MAX_COORDINATE,
    DepthMeasure,
    PosedImage,
    PosedImages,
    ReadOptions,
    choose_origin,
    rigid_pose,
)
from gsencoder.data.readers.transforms_json import TRANSFORMS, read_objects, read_transforms
from gsencoder.data.readers.undistort import CameraModel, pinhole_for, remap_between
from gsencoder.data.splats.files import load_splat
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.checks import invert_rigid, move_origin
from gsencoder.types.orientation import EXCHANGED, INVERSE, UNMIRRORED

FEATURES_FILE = "scene.safetensors"  # The file by which a folder of features, or of a memory of a scene, is recognized


def find_scenes(paths: Iterable[str | Path]) -> tuple[Path, ...]:
    """The scenes at paths: a path is a scene, a folder of scenes, which are sorted by name, or a list of paths (.txt).

    A folder is a scene if `load_scene` recognizes it; of any other folder the direct subfolders are searched.
    """
    scenes: list[Path] = []
    for path in listed_paths(paths):
        try:
            if not path.exists():
                raise InputError(f"{path}: no such file or folder")
            inner = [path]
            if not is_scene(path):
                folders = [each for each in path.iterdir() if each.is_dir() and not each.name.startswith(".")]
                inner = sorted(filter(is_scene, folders))
        except InputError:
            raise
        except (OSError, ValueError) as error:
            raise InputError(f"{str(path)[:200]!r} cannot be read ({type(error).__name__})") from error
        if not inner and (path / FEATURES_FILE).is_file():
            raise InputError(f"{path}: a folder of features, not a scene; localize, views, ask and pack take it")
        if not inner:
            kind = kind_of_path(path)
            raise InputError(f"{path}: {kind}, neither a scene nor a folder of scenes; {describe_layouts()}")
        scenes += inner
    return distinct_paths(scenes)


def distinct_paths(paths: Iterable[Path]) -> tuple[Path, ...]:
    """The paths; InputError where one is given twice, also under another name or by a link."""
    by_target: dict[Path, Path] = {}
    for path in paths:
        target = path.resolve()
        if (first := by_target.get(target)) is not None:
            if first == path:
                raise InputError(f"{path}: is given twice; give it once")
            raise InputError(f"{path}: is the same as {first}, which is given as well; give one of them")
        by_target[target] = path
    return tuple(by_target.values())


def listed_paths(paths: Iterable[str | Path]) -> list[Path]:
    """Paths, with those in list files in place of the files: text files (.txt) with one path a line, relative to the
    file; blank lines and comments (#) are left out."""
    result: list[Path] = []
    for path in map(Path, paths):
        try:
            is_list = path.suffix.lower() == ".txt" and path.is_file()
        except (OSError, ValueError):
            is_list = False
        if not is_list:
            result.append(path)
            continue
        try:
            lines = read_foreign_text(path).splitlines()
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: not a readable list of scenes ({type(error).__name__})") from error
        names = [line.strip() for line in lines if line.strip() and not line.strip().startswith("#")]
        if not names:
            raise InputError(f"{path}: lists no scene; expected one path a line")
        result += [path.parent / name for name in names]
    return result


def is_scene(path: Path) -> bool:
    """Whether `load_scene` recognizes a folder itself as a scene; True for any file."""
    if path.is_file():
        return True
    return (
        (path / "meta.json").is_file()
        or layout_of(path) is not None
        or any(entry.suffix.lower() in SPLAT_SUFFIXES and entry.is_file() for entry in path.iterdir())
    )


def has_views(path: Path) -> bool:
    """Whether a path is a scene with posed views, as opposed to a splat, by names of files alone."""
    return is_transforms_file(path) if path.is_file() else layout_of(path) is not None


def is_transforms_file(path: Path) -> bool:
    """Whether a file is to be read as transforms.json: any .json but the meta.json of an unpacked .sog."""
    return path.suffix.lower() == ".json" and path.name != "meta.json"


def scene_name(path: Path) -> str:
    """The name that `load_scene` gives the scene at an existing path."""
    if path.is_file():
        return name_of_folder(path.absolute().parent) if is_transforms_file(path) else path.stem
    return name_of_folder(path)


def name_of_folder(folder: Path) -> str:
    """The name of a scene and of its output folder; "." and ".." are resolved."""
    return (folder if folder.name not in ("", "..") else folder.resolve()).name or "scene"


def check_names(paths: Sequence[Path]) -> None:
    """Checks that no two scenes have the same name, since their results would be in one folder."""
    first: dict[str, Path] = {}
    for path in paths:
        name = scene_name(path)
        if name in first:
            raise InputError(
                f"{path} and {first[name]} are both called {name!r}; rename one, or run them with different out="
            )
        first[name] = path


def kind_of_path(path: str | Path) -> str:
    """What a path is, by names of files and by the record of the run that wrote it: such as "a folder that
    `gsencoder fuse` wrote", or "an empty folder"."""
    path = Path(path)
    with suppress(OSError, ValueError):
        if path.is_dir():
            return _kind_of_folder(path)
        if path.is_file():
            if path.suffix.lower() in SPLAT_SUFFIXES:
                return "a splat"
            return f"a {path.suffix.lower()} file" if path.suffix else "a file"
    return "no file or folder"


def _kind_of_folder(folder: Path) -> str:
    with suppress(OSError, ValueError, TypeError, AttributeError):
        command = json.loads(read_foreign_text(folder / SUMMARY_NAME))["command"]
        if isinstance(command, str) and command.isalpha() and len(command) < 20:
            return f"a folder that `gsencoder {command}` wrote"
    if (folder / UNFINISHED_FILE).is_file():
        return "the state of an unfinished run, which its command continues"
    if (folder / FEATURES_FILE).is_file():
        return "a folder of features"
    if is_scene(folder):
        return "a scene"
    entries = list(folder.iterdir())
    if not entries:
        return "an empty folder"
    inner = sorted(entry for entry in entries if entry.is_dir() and (entry / FEATURES_FILE).is_file())
    if inner:
        return f"a folder of folders of features ({inner[0].name}, …)"
    return "a folder of other files"


FEW_CAMERAS = 8
MEASURED = 0.05  # Where depth was measured on a larger share of it, what looks like a background is a wall


def make_views(
    posed: PosedImages, *, max_views: int = 0, image_scale: float = 1.0, mask_background: bool = False
) -> tuple[Views, Float64[np.ndarray, "3"]]:
    """Cameras without distortion and lazy pictures, and the origin that was subtracted from the cameras.

    Args:
        mask_background: whether a background of one color is looked for, and masked with a warning.
    """
    images = posed.images
    if not images:
        raise InputError(f"{posed.source}: no view")
    if max_views:
        images = tuple(images[row] for row in even_indices(len(images), max_views))
    cam_from_world = np.stack([image.cam_from_world for image in images])
    origin = choose_origin(invert_rigid(cam_from_world)[:, :3, 3])
    pinholes: dict[CameraModel, CameraModel] = {}
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
    cameras = Cameras(
        cam_from_world=move_origin(cam_from_world, origin).astype(np.float32),
        Ks=np.array([grid.pinhole.matrix(grid.width, grid.height) for grid in grids]).astype(np.float32),
        widths=np.array([grid.width for grid in grids], np.int32),
        heights=np.array([grid.height for grid in grids], np.int32),
    )
    masks = [image.mask for image in images]
    instances = [image.instance for image in images]
    partial = _have_empty_pixels({(grid.pinhole, grid.source, grid.reduction) for grid in grids})
    background = None
    # A fisheye picture may be a disc in a black frame.
    is_plain = not (_any(masks) or _any(transparent) or any("FISHEYE" in image.camera.model for image in images))
    if mask_background and is_plain:
        background = find_background([image.image for image in images])
    outlined = transparent if background is None else [image.image for image in images]
    has_outlines = _any(outlined)
    views = Views(
        cameras=cameras,
        names=tuple(image.name for image in images),
        images=ImageFiles([image.image for image in images], grids),
        depths=DepthFiles(images, depth_grids) if _any([image.depth for image in images]) else None,
        masks=MaskFiles(masks, grids, outlined, background) if _any(masks) or has_outlines or partial else None,
        empty=MaskFiles(masks, grids, outlined, background, empty=True) if has_outlines else None,
        instances=LabelFiles(instances, grids) if _any(instances) else None,
        orientations=tuple(orientations) if max(orientations) > 1 else None,
    )
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


def _is_measured(views: Views) -> bool:
    """Whether a sensor saw surfaces where the background is."""
    if views.depths is None or views.empty is None:
        return False
    rows = even_indices(len(views), 4)
    shares = [float((views.depths[int(row)][views.empty[int(row)]] > 0).mean()) for row in rows]
    return float(np.nan_to_num(shares).mean()) > MEASURED


def _any(paths: Sequence[Path | None]) -> bool:
    return any(path is not None for path in paths)


def _check_sizes(image: PosedImage, grid: PixelGrid, depth_grid: PixelGrid, size: tuple[int, int], where: str) -> None:
    """Checks the sizes in the headers of the files; `size` is the photograph's."""
    camera = image.camera
    if image.depth is not None and image.depth == image.image:
        raise InputError(f"{where}: {image.image} is listed as photograph and as depth image; list the photograph")
    if (size[::-1] if grid.is_exchanged(*size) else size) != (camera.width, camera.height):
        raise InputError(
            f"{where}: {image.image} has {size[0]}×{size[1]} pixels but its camera {camera.width}×{camera.height}"
        )
    for file, expected in ((image.depth, depth_grid), (image.mask, grid), (image.instance, grid)):
        if file is not None and not expected.fits(*(actual := picture_size(file))):
            raise InputError(
                f"{where}: {file} has {actual[0]}×{actual[1]} pixels but {image.image} has {size[0]}×{size[1]}"
            )


def _have_empty_pixels(cameras: set[tuple[CameraModel, CameraModel, int]]) -> bool:
    """Whether some pixel of a pinhole camera is outside the distorted picture."""
    distorted = [camera for camera in cameras if not camera[1].is_pinhole]
    if len(distorted) > FEW_CAMERAS:
        return True
    maps = [remap_between(*camera) for camera in distorted]
    return any(remap is not None and not remap.valid.all() for remap in maps)


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=3)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Options of reading a scene."""

    allow_outside: bool = option(False, "allow files outside the folder of the scene")
    max_views: int = option(0, "largest number of views, evenly spaced; 0 = all", ge=0)
    depth_measure: DepthMeasure | None = option(
        None, "what depth files hold: z, or ray, the distance from the camera; empty = that of the files"
    )
    image_scale: float = option(
        1.0, "factor in (0, 1] by which pictures, depth maps, masks and intrinsics are downscaled", gt=0, le=1
    )
    metres_per_unit: float | None = option(None, "meters in a world unit; empty = that of the files", gt=0, lt=math.inf)
    up: tuple[float, float, float] | None = option(
        None, "the world's up, three numbers of any length; empty = that of the files, else an estimate"
    )
    images: str = option("", "folder of the photographs of a COLMAP model; empty = images/ next to the model")
    background: Literal["auto", "none"] = option(
        "auto",
        "auto = a background of one color, around the object in nearly all photographs, is masked and taken for empty "
        "space; none = photographs are used as they are (transparency is masked in any case)",
    )
    check_fit: bool = option(True, "refuse a splat that does not fit the photographs, where it fits in another frame")
    intrinsics: tuple[float, float, float, float] | None = option(
        None, "fx, fy, cx, cy of the photographs, pixels, no distortion; empty = those of the files"
    )
    depth_intrinsics: tuple[float, float, float, float] | None = option(
        None, "fx, fy, cx, cy of the depth images; empty = those of the files"
    )
    depth_from_color: tuple[float, ...] | None = option(
        None,
        "where the depth sensor stands: 12 or 16 numbers of the rigid transform from the photograph's camera axes to "
        "its own, row by row, world units; empty = that of the files",
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if self.up is not None and not 1e-6 < math.hypot(*self.up) < 1e6:
            raise InputError(f"up: expected three finite numbers that are not all zero, got {list(self.up)}")
        if self.depth_from_color is not None and len(self.depth_from_color) not in (12, 16):
            raise InputError(f"depth_from_color: expected 12 or 16 numbers, got {len(self.depth_from_color)}")


def load_scene(path: str | Path, *, splat: str | Path | None = None, options: SceneConfig = SceneConfig()) -> Scene:
    """Reads a scene; of pictures the size is read now, and they are decoded on access.

    Recognized, in this order: the layouts of `gsencoder.data.readers.layouts` (transforms.json, COLMAP, ScanNet++,
    ScanNet, 7-Scenes, TUM RGB-D, Replica), a splat file, or a folder with one splat file or an unpacked .sog.

    Cameras and Gaussians are relative to `Scene.origin`: the mean of the camera centers (for a bare splat the median
    of its means), each coordinate rounded to a multiple of 1000 units. It is subtracted in float64.

    Args:
        splat: the Gaussians of a scene that has views; relative to the scene or else to the current folder, with
            {scene} for the name of the scene's folder. They must be in the world of the cameras. Without it a splat
            next to the views is not used.

    Returns:
        A scene with views, or with Gaussians only, or both. A ScanNet or ScanNet++ scene whose label files lie with
        it has objects, and where there are no pictures of instances, maps that are drawn from the labeled mesh on
        access. `views.masks` exists if there are mask files, transparency, a background of one color, or pinhole
        pixels that the distorted picture does not cover.

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
    of the layout; None and "splat" where there are no views."""
    read_options = ReadOptions(
        allow_outside=options.allow_outside, images=options.images, intrinsics=options.intrinsics
    )
    if root.is_file():
        if not is_transforms_file(root):
            return None, root.parent, "splat"
        name = "transforms.json"
        posed, folder = read_transforms(root, read_options), root.parent
    else:
        layout = layout_of(root)
        if layout is None:
            return None, root, "splat"
        name = layout.name
        posed, folder = layout.read(root, read_options)
    images = tuple(_with_given_sensors(image, options) for image in posed.images)
    return replace(posed, images=images), folder, name


def _with_given_sensors(image: PosedImage, options: SceneConfig) -> PosedImage:
    """A view with the intrinsics and the depth sensor that the user gives."""
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
