"""Loading of scenes in any supported layout, or of a splat alone, and which paths are scenes, by names of files."""

import json
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

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
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.images import (
    DepthFiles,
    ImageFiles,
    have_empty_pixels,
    pinhole_of,
    pixel_grids,
)
from gsencoder.data.readers.masks import LabelFiles, MaskFiles, find_background
from gsencoder.data.readers.posed import (
    MAX_COORDINATE,
    CameraModel,
    DepthMeasure,
    PosedImage,
    PosedImages,
    ReadOptions,
    check_camera,
    choose_origin,
    pinhole_for,
    rigid_pose,
)
from gsencoder.data.readers.rgbd import (
    is_replica,
    is_scannet_export,
    is_scannetpp,
    is_seven_scenes,
    is_tum,
    read_replica,
    read_scannet,
    read_scannetpp,
    read_seven_scenes,
    read_tum,
)
from gsencoder.data.readers.transforms_json import OBJECTS_FILE, TRANSFORMS, read_transforms
from gsencoder.data.splats.files import gaussians_from_raw, is_ply_of_splat, load_splat, read_raw
from gsencoder.data.video import refuse_video
from gsencoder.types import Cameras, Gaussians, Scene, Views
from gsencoder.types.orientation import UNMIRRORED
from gsencoder.types.scene import invert_rigid, move_origin

MASKS = "masks"
COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")


class Layout(NamedTuple):
    """One way in which scenes are stored."""

    name: str
    files: str  # what is recognized, for people
    matches: Callable[[Path], bool]
    # The posed images of a folder, and the folder of the scene.
    read: Callable[[Path, ReadOptions], tuple[PosedImages, Path]]


def transforms_in(root: Path) -> Path | None:
    return next((root / file for file in TRANSFORMS if (root / file).is_file()), None)


def colmap_model_in(root: Path) -> Path | None:
    return next((root / file for file in COLMAP_FOLDERS if is_colmap_model(root / file)), None)


def _read_transforms(root: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    transforms, model = transforms_in(root), colmap_model_in(root)
    assert transforms is not None
    if model is not None and not str(model.relative_to(root)).startswith("colmap"):
        _warn(f"{root}: holds {transforms.name} and a COLMAP model; {transforms.name} is used (give {model} instead)")
    return read_transforms(transforms, options), root


def _read_colmap(root: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    model = colmap_model_in(root)
    assert model is not None
    if model.name == "0" and model != root:
        others = sorted(path.name for path in model.parent.iterdir() if path != model and is_colmap_model(path))
        if others:
            names = ", ".join(others)
            _warn(f"{model.parent}: holds {1 + len(others)} models; 0 is used (or give the folder of {names})")
    if options.images:
        images = Path(options.images)
        images = images if images.is_absolute() or images.is_dir() else root / images
        if not images.is_dir():
            raise InputError(f"images={options.images}: no such folder (looked from here and in {root})")
        # A folder that the user names may be read.
        masks = next((home / MASKS for home in (root, images.parent) if (home / MASKS).is_dir()), None)
        return read_colmap(model, images, images, options, masks=masks), root
    homes = [root, root.parent, root.parent.parent] if model == root else [root]
    home = next((home for home in homes if (home / "images").is_dir()), None)
    if home is None:
        searched = ", ".join(str(home / "images") for home in homes)
        raise InputError(f"{model}: a COLMAP model without photographs; looked for {searched}; say images=FOLDER")
    return read_colmap(model, home / "images", home, options, masks=home / MASKS), home


def _at_root(
    reader: Callable[[Path, ReadOptions], PosedImages],
) -> Callable[[Path, ReadOptions], tuple[PosedImages, Path]]:
    return lambda root, options: (reader(root, options), root)


LAYOUTS = (
    Layout(
        "transforms.json",
        f"{' or '.join(TRANSFORMS)} (nerfstudio, instant-ngp, Blender)",
        lambda root: transforms_in(root) is not None,
        _read_transforms,
    ),
    Layout(
        "COLMAP",
        "sparse/0 or sparse with a COLMAP model, and images/",
        lambda root: colmap_model_in(root) is not None,
        _read_colmap,
    ),
    Layout(
        "ScanNet++",
        "dslr/ or iphone/ of ScanNet++ (frames extracted to iphone/rgb)",
        is_scannetpp,
        _at_root(read_scannetpp),
    ),
    Layout("ScanNet", "color/, pose/, depth/ and intrinsic/ of ScanNet", is_scannet_export, _at_root(read_scannet)),
    Layout(
        "7-Scenes",
        "frame-NNNNNN.color.png, .depth.png and .pose.txt of 7-Scenes",
        is_seven_scenes,
        _at_root(read_seven_scenes),
    ),
    Layout("TUM RGB-D", "rgb.txt, depth.txt and groundtruth.txt of TUM RGB-D", is_tum, _at_root(read_tum)),
    Layout("Replica", "results/ and traj.txt of Replica (NICE-SLAM)", is_replica, _at_root(read_replica)),
)


def layout_of(folder: Path) -> Layout | None:
    return next((layout for layout in LAYOUTS if layout.matches(folder)), None)


def describe_layouts() -> str:
    return f"a scene holds one of: {'; '.join(layout.files for layout in LAYOUTS)}; a splat"


SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".sog")
SPLAT_NAMES = ("splat.ply", "point_cloud.ply")  # What a reconstruction that lies with its photographs is called


def find_splat(root: Path) -> Path:
    """The splat that `root` is or holds."""
    if root.is_file():
        if root.suffix.lower() in SPLAT_SUFFIXES or root.name == "meta.json":
            return root
        refuse_video(root)
        raise InputError(f"{root}: expected a transforms.json or a splat ({', '.join(SPLAT_SUFFIXES)})")
    if (root / "meta.json").is_file():
        return root
    files = sorted(path for path in root.iterdir() if path.is_file() and path.suffix.lower() in SPLAT_SUFFIXES)
    splats = [path for path in files if path.suffix.lower() != ".ply" or is_ply_of_splat(path)]
    if len(splats) == 1 or len(files) == 1:
        return (splats or files)[0]
    if files and not splats:
        raise InputError(f"{root}: holds {len(files)} .ply files, meshes or points, and no splat and no views")
    if splats:
        names = ", ".join(path.name for path in splats[:5])
        raise InputError(f"{root}: holds {len(splats)} splats ({names}) and no views; give one of them")
    raise InputError(f"{root}: not a scene; {describe_layouts()}")


def read_bare_splat(path: Path) -> tuple[Gaussians, Float64[np.ndarray, "3"]]:
    """A splat without views, and an origin near the median of its means, taken off before they become float32."""
    raw = read_raw(path)
    finite = raw.means[np.isfinite(raw.means).all(axis=1)]
    origin = choose_origin(np.median(finite, axis=0, keepdims=True)) if len(finite) else np.zeros(3)
    return gaussians_from_raw(raw, origin=origin, where=str(path)), origin


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
    for image in images:
        where = f"{posed.source}: view {image.name[:120]!r}"
        if image.camera not in pinholes:
            pinholes[image.camera] = pinhole_for(image.camera, where)
        if image.depth_camera is not None:
            check_camera(image.depth_camera, f"{where}: depth")
    grids, depth_grids, transparent, orientations = pixel_grids(images, pinholes, image_scale, posed.source)
    partial = have_empty_pixels(grids)
    Ks = np.array([grid.K for grid in grids])
    cameras = Cameras(
        cam_from_world=move_origin(cam_from_world, origin).astype(np.float32),
        Ks=Ks.astype(np.float32),
        widths=np.array([grid.width for grid in grids], np.int32),
        heights=np.array([grid.height for grid in grids], np.int32),
    )
    masks = [image.mask for image in images]
    instances = [image.instance for image in images]
    background = None
    # A fisheye picture may be a disc in a black frame.
    is_plain = not (any(masks) or any(transparent) or any("FISHEYE" in image.camera.model for image in images))
    if mask_background and is_plain:
        background = find_background([image.image for image in images])
    outlined = transparent if background is None else [image.image for image in images]
    views = Views(
        cameras=cameras,
        names=tuple(image.name for image in images),
        images=ImageFiles([image.image for image in images], grids),
        depths=DepthFiles(images, depth_grids) if any(image.depth for image in images) else None,
        masks=MaskFiles(masks, grids, outlined, background) if any(masks) or any(outlined) or partial else None,
        empty=MaskFiles(masks, grids, outlined, background, empty=True) if any(outlined) else None,
        instances=LabelFiles(instances, grids) if any(instances) else None,
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

    Recognized, in this order: `LAYOUTS` (transforms.json, COLMAP, ScanNet++, ScanNet, 7-Scenes, TUM RGB-D, Replica), a
    splat file, or a folder with one splat file or an unpacked .sog.

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
    left_over = [name for name in SPLAT_NAMES if splat is None and (folder / name).is_file()]
    if left_over:
        advice = f"say splat={left_over[0]} if it belongs to them"
        _warn(f"{folder}: {left_over[0]} lies with the views and is not used; {advice}")
    if layout != "transforms.json" and (folder / OBJECTS_FILE).is_file():
        _warn(f"{folder}: {OBJECTS_FILE} is not used; it names objects of transforms.json, and this is {layout}")
    objects = posed.objects
    labels = labels_of_layout(folder, layout) if layout in ("ScanNet", "ScanNet++") else None
    if labels is not None:
        if layout == "ScanNet":
            views = with_archived_instances(views, folder)
        views = with_mesh_instances(views, labels, origin)
        objects = objects_of_labels(labels)
    points, colors = posed.points, posed.colors
    with np.errstate(invalid="ignore"):
        finite = np.abs(points).max(axis=1, initial=0) <= MAX_COORDINATE
    if not finite.all():
        _warn(f"{posed.source}: {int((~finite).sum())} of {len(finite)} points are not finite and are left out")
        points, colors = points[finite], colors[finite] if len(colors) else colors
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
    images = tuple(_override_sensors(image, options) for image in posed.images)
    return replace(posed, images=images), folder, name


def _override_sensors(image: PosedImage, options: SceneConfig) -> PosedImage:
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
