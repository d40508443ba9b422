"""Loading of scenes in any supported layout: transforms.json, COLMAP, ScanNet, or a splat alone."""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.even_indices import even_indices
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.images import (
    DepthFiles,
    ImageFiles,
    InstanceFiles,
    MaskFiles,
    PixelGrid,
    picture_info,
    picture_size,
)
from gsencoder.data.readers.objects_json import read_objects
from gsencoder.data.readers.posed import PosedImage, PosedImages, choose_origin
from gsencoder.data.readers.scannet import is_scannet_export, read_scannet
from gsencoder.data.readers.scene_splat import (
    SPLAT_SUFFIXES,
    file_of_scene,
    find_splat,
    read_bare_splat,
    warn_of_unused_splat,
)
from gsencoder.data.readers.transforms_json import TRANSFORMS, read_transforms
from gsencoder.data.readers.undistort import CameraModel, Pinhole, RemapCache, pinhole_for
from gsencoder.data.splats import load_splat
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.poses import invert_rigid, move_origin

COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
FEW_CAMERAS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Options of reading a scene."""

    allow_outside: bool = field(default=False, metadata={"help": "allow files outside the folder of the scene"})
    max_views: int = field(default=0, metadata={"help": "largest number of views, evenly spaced; 0 = all"})
    depth_scale: float | None = field(
        default=None, metadata={"help": "world units for one step of a depth file; empty = that of the format"}
    )
    image_scale: float = field(
        default=1.0,
        metadata={"help": "factor in (0, 1] by which pictures, depth maps, masks and intrinsics are downscaled"},
    )
    metres_per_unit: float | None = field(
        default=None, metadata={"help": "meters in a world unit; empty = that of the files"}
    )
    images: str = field(
        default="", metadata={"help": "folder of the photographs of a COLMAP model; empty = images/ beside the model"}
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


def load_scene(path: str | Path, *, splat: str | Path | None = None, options: SceneConfig = SceneConfig()) -> Scene:
    """Reads a scene; of pictures the size is read now, and they are decoded on access.

    Recognized, in this order: a transforms.json or transforms_train.json (nerfstudio, instant-ngp, Blender), a COLMAP
    model (sparse/0, sparse, or its files themselves, with images/ beside), a ScanNet export (color/, pose/, …), a
    splat file, or a folder with one splat file or an unpacked .sog.

    Cameras and Gaussians are relative to `Scene.origin`: the mean of the camera centers (for a bare splat the median
    of its means), each coordinate rounded to a multiple of 1000 units. It is subtracted in float64.

    Args:
        path: a folder or file.
        splat: the Gaussians of a scene that has views; relative to the scene or else to the current folder. They must
            be in the world of the cameras. Without it a splat beside the views is not used.
        options: see SceneConfig.

    Returns:
        A scene with views, or with Gaussians only, or both. `views.masks` exists if there are mask files,
        transparency, or pinhole pixels that the distorted picture does not cover.

    Raises:
        InputError: no scene is recognized, no view is left, or a file is wrong.
    """
    given = Path(path)
    try:
        root = given.absolute()
        exists = root.exists()
    except (OSError, ValueError) as error:
        raise InputError(f"{str(given)[:200]!r} is not a path ({type(error).__name__})") from error
    if not exists:
        raise InputError(f"{given}: no such file or folder")
    posed, folder = _read_views(root, options)
    if posed is None:
        if splat is not None:
            raise InputError(f"{given}: splat= is for scenes with views, and here there are none; give one splat only")
        name = _name_of(root) if root.is_dir() else root.stem
        bare, origin = read_bare_splat(find_splat(root))
        return Scene(name=name, gaussians=bare, origin=origin, metres_per_unit=options.metres_per_unit, folder=folder)
    views, origin = make_views(posed, max_views=options.max_views, image_scale=options.image_scale)
    gaussians = load_splat(file_of_scene("splat", splat, folder), origin=origin) if splat is not None else None
    if splat is None:
        warn_of_unused_splat(folder)
    objects = folder / "objects.json"
    beside_transforms = root.suffix.lower() == ".json" or any((folder / file).is_file() for file in TRANSFORMS)
    points = posed.points
    return Scene(
        name=_name_of(folder),
        gaussians=gaussians,
        views=views,
        origin=origin,
        metres_per_unit=options.metres_per_unit or posed.metres_per_unit,
        up=posed.up,
        objects=read_objects(objects) if beside_transforms and objects.is_file() else (),
        sfm_points=(points - origin).astype(np.float32) if len(points) else None,
        sfm_colors=posed.colors if len(points) else None,
        folder=folder,
    )


def scene_name(path: Path) -> str:
    """The name that `load_scene` gives the scene at an existing path."""
    if path.is_file():
        return _name_of(path.absolute().parent) if _is_transforms(path) else path.stem
    return _name_of(path)


def check_names(paths: Sequence[Path]) -> None:
    """Checks that no two scenes have the same name, since their results would be in one folder.

    Raises:
        InputError: two have.
    """
    first: dict[str, Path] = {}
    for path in paths:
        name = scene_name(path)
        if name in first:
            raise InputError(
                f"{path} and {first[name]} are both called {name!r}, so their results would be in one folder; "
                "rename one, or run them with different out="
            )
        first[name] = path


def _is_transforms(path: Path) -> bool:
    return path.suffix.lower() == ".json" and path.name != "meta.json"


def _name_of(folder: Path) -> str:
    """The name of a scene and of its output folder; "." and ".." are resolved."""
    return (folder if folder.name not in ("", "..") else folder.resolve()).name or "scene"


def find_scenes(paths: Iterable[str | Path]) -> tuple[Path, ...]:
    """The scenes at paths: a path is a scene, or a folder of scenes, which are sorted by name.

    A folder is a scene if `load_scene` recognizes it; of any other folder the direct subfolders are searched. A scene
    that is named twice, also by different paths, is returned once.

    Raises:
        InputError: a path does not exist, or a folder holds no scene.
    """
    scenes: dict[Path, Path] = {}
    for given in map(Path, paths):
        try:
            if not given.exists():
                raise InputError(f"{given}: no such file or folder")
            inside = [given] if is_scene(given) else sorted(entry for entry in given.iterdir() if _is_listed(entry))
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{str(given)[:200]!r} cannot be read ({type(error).__name__})") from error
        if not inside:
            raise InputError(
                f"{given}: neither a scene nor a folder of scenes; a scene holds {' or '.join(TRANSFORMS)}, a COLMAP "
                "model, a ScanNet export or a splat"
            )
        for path in inside:
            scenes.setdefault(path.resolve(), path)
    return tuple(scenes.values())


def is_scene(path: Path) -> bool:
    """Whether `load_scene` recognizes a folder itself as a scene; True for any file."""
    if path.is_file():
        return True
    return (
        any((path / file).is_file() for file in (*TRANSFORMS, "meta.json"))
        or any(is_colmap_model(path / folder) for folder in COLMAP_FOLDERS)
        or is_scannet_export(path)
        or any(entry.suffix.lower() in SPLAT_SUFFIXES and entry.is_file() for entry in path.iterdir())
    )


def _is_listed(entry: Path) -> bool:
    return entry.is_dir() and not entry.name.startswith(".") and is_scene(entry)


def _read_views(root: Path, options: SceneConfig) -> tuple[PosedImages | None, Path]:
    """The posed images, None for a bare splat, and the folder of the scene."""
    outside, scale = options.allow_outside, options.depth_scale
    if root.is_file():
        if _is_transforms(root):
            return read_transforms(root, allow_outside=outside, depth_scale=scale), root.parent
        return None, root.parent
    transforms = next((root / file for file in TRANSFORMS if (root / file).is_file()), None)
    model = next((root / file for file in COLMAP_FOLDERS if is_colmap_model(root / file)), None)
    if transforms is not None:
        if model is not None and not str(model.relative_to(root)).startswith("colmap"):
            _warn(
                f"{root}: holds {transforms.name} and a COLMAP model; {transforms.name} is used (give {model} instead)"
            )
        return read_transforms(transforms, allow_outside=outside, depth_scale=scale), root
    if model is not None:
        return _read_colmap(root, model, options)
    if is_scannet_export(root):
        return read_scannet(root, allow_outside=outside, depth_scale=scale), root
    return None, root


def _read_colmap(root: Path, model: Path, options: SceneConfig) -> tuple[PosedImages, Path]:
    if model.name == "0" and model != root:
        others = sorted(path.name for path in model.parent.iterdir() if path != model and is_colmap_model(path))
        if others:
            _warn(
                f"{model.parent}: holds {1 + len(others)} models; 0 is used (or give the folder of {', '.join(others)})"
            )
    if options.images:
        images = Path(options.images)
        images = images if images.is_absolute() or images.is_dir() else root / images
        if not images.is_dir():
            raise InputError(f"images={options.images}: no such folder (looked from here and in {root})")
        # A folder that the user names may be read.
        return read_colmap(model, images, images, allow_outside=options.allow_outside), root
    home = _home(root, model)
    if home is None:
        looked = ", ".join(str(home / "images") for home in _homes(root, model))
        raise InputError(f"{model}: a COLMAP model without photographs; looked for {looked}; say images=FOLDER")
    return read_colmap(model, home / "images", home, allow_outside=options.allow_outside), home


def _home(root: Path, model: Path) -> Path | None:
    """The folder with the photographs of a COLMAP model. If the path is that of the model, such as scene/sparse/0, it
    is up to two levels above."""
    return next((home for home in _homes(root, model) if (home / "images").is_dir()), None)


def _homes(root: Path, model: Path) -> list[Path]:
    return [root, root.parent, root.parent.parent] if model == root else [root]


def make_views(
    posed: PosedImages, *, max_views: int = 0, image_scale: float = 1.0
) -> tuple[Views, Float64[np.ndarray, "3"]]:
    """Cameras without distortion and lazy pictures, and the origin that was subtracted from the cameras.

    Raises:
        InputError: no picture, a picture or depth of the wrong size, a camera that cannot be undistorted.
    """
    chosen = posed.images
    if not chosen:
        raise InputError(f"{posed.source}: no view")
    if max_views:
        chosen = tuple(chosen[row] for row in even_indices(len(chosen), max_views))
    cam_from_world = np.stack([image.cam_from_world for image in chosen])
    origin = choose_origin(invert_rigid(cam_from_world)[:, :3, 3])
    pinholes: dict[CameraModel, Pinhole] = {}
    grids, depth_grids = [], []
    transparent: list[Path | None] = []
    for image in chosen:
        where = f"{posed.source}: view {image.name[:120]!r}"
        if image.camera not in pinholes:
            pinholes[image.camera] = pinhole_for(image.camera, where)
        pinhole = pinholes[image.camera]
        width = max(1, round(pinhole.width * image_scale))
        height = max(1, round(pinhole.height * image_scale))
        grids.append(PixelGrid(source=image.camera, pinhole=pinhole, width=width, height=height))
        depth_camera = image.depth_camera or image.camera
        depth_grids.append(PixelGrid(source=depth_camera, pinhole=pinhole, width=width, height=height))
        transparent.append(image.image if _check_sizes(image, depth_camera, where) else None)
    remaps = RemapCache()
    cameras = Cameras(
        cam_from_world=move_origin(cam_from_world, origin).astype(np.float32),
        Ks=np.array([grid.pinhole.matrix(grid.width, grid.height) for grid in grids]).astype(np.float32),
        widths=np.array([grid.width for grid in grids], np.int32),
        heights=np.array([grid.height for grid in grids], np.int32),
    )
    depths = [image.depth for image in chosen]
    masks = [image.mask for image in chosen]
    instances = [image.instance for image in chosen]
    partial = _have_empty_pixels(list({(grid.pinhole, grid.source): grid for grid in grids}), remaps)
    views = Views(
        cameras=cameras,
        names=tuple(image.name for image in chosen),
        images=ImageFiles([image.image for image in chosen], grids, remaps),
        depths=DepthFiles(depths, depth_grids, remaps, [image.depth_scale for image in chosen])
        if _any(depths)
        else None,
        masks=MaskFiles(masks, grids, remaps, transparent) if _any(masks) or _any(transparent) or partial else None,
        instances=InstanceFiles(instances, grids, remaps) if _any(instances) else None,
    )
    return views, origin


def _any(paths: Sequence[Path | None]) -> bool:
    return any(path is not None for path in paths)


def _check_sizes(image: PosedImage, depth_camera: CameraModel, where: str) -> bool:
    """Checks the sizes in the headers of the files; returns whether the photograph has transparency."""
    camera = image.camera
    size, transparent = picture_info(image.image)
    if size != (camera.width, camera.height):
        raise InputError(
            f"{where}: {image.image} has {size[0]}×{size[1]} pixels but its camera {camera.width}×{camera.height}; "
            "give the images at the size of the intrinsics (image_scale makes them smaller on load)"
        )
    for file, wanted in ((image.depth, depth_camera), (image.mask, camera), (image.instance, camera)):
        if file is not None:
            actual = picture_size(file)
            if actual != (wanted.width, wanted.height):
                raise InputError(
                    f"{where}: {file} has {actual[0]}×{actual[1]} pixels but {image.image} has {size[0]}×{size[1]}; "
                    "both must have the same size"
                )
    return transparent


def _have_empty_pixels(cameras: list[tuple[Pinhole, CameraModel]], remaps: RemapCache) -> bool:
    """Whether some pixel of a pinhole camera is outside the distorted picture. With many cameras the check would cost
    more than masks do, and the result is True."""
    distorted = [camera for camera in cameras if not camera[1].is_pinhole]
    if len(distorted) > FEW_CAMERAS:
        return True
    maps = [remaps.get(*camera) for camera in distorted]
    return any(remap is not None and not remap.valid.all() for remap in maps)


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=3)
