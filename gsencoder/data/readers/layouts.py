"""The layouts of scenes with posed photographs, in the order in which they are recognized."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.posed import PosedImages
from gsencoder.data.readers.replica import is_replica, read_replica
from gsencoder.data.readers.scannet import is_scannet_export, read_scannet
from gsencoder.data.readers.scannetpp import is_scannetpp, read_scannetpp
from gsencoder.data.readers.seven_scenes import is_seven_scenes, read_seven_scenes
from gsencoder.data.readers.transforms_json import TRANSFORMS, read_transforms
from gsencoder.data.readers.tum import is_tum, read_tum

MASKS = "masks"
COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """What the user says about a scene's files, beyond the files themselves.

    Attributes:
        allow_outside: whether files may lie outside the folder of the scene.
        depth_scale: world units for each step of a depth file; None = that of the layout.
        images: folder of the photographs of a COLMAP model; empty = images/ beside the model.
        intrinsics: fx, fy, cx, cy of the photographs, for layouts that do not state them; None = those of the layout.
    """

    allow_outside: bool = False
    depth_scale: float | None = None
    images: str = ""
    intrinsics: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One way in which scenes are stored.

    Attributes:
        name: for people.
        files: what is recognized, for people.
        matches: whether a folder has this layout.
        read: the posed images of a folder, and the folder of the scene.
    """

    name: str
    files: str
    matches: Callable[[Path], bool]
    read: Callable[[Path, ReadOptions], tuple[PosedImages, Path]]


def transforms_in(root: Path) -> Path | None:
    """The transforms.json of a folder."""
    return next((root / file for file in TRANSFORMS if (root / file).is_file()), None)


def colmap_model_in(root: Path) -> Path | None:
    """The folder of the COLMAP model of a folder."""
    return next((root / file for file in COLMAP_FOLDERS if is_colmap_model(root / file)), None)


def read_transforms_file(path: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    """The posed images of a transforms.json of any name, and its folder."""
    return read_transforms(path, allow_outside=options.allow_outside, depth_scale=options.depth_scale), path.parent


def _read_transforms(root: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    transforms, model = transforms_in(root), colmap_model_in(root)
    assert transforms is not None
    if model is not None and not str(model.relative_to(root)).startswith("colmap"):
        _warn(f"{root}: holds {transforms.name} and a COLMAP model; {transforms.name} is used (give {model} instead)")
    return read_transforms_file(transforms, options)


def _read_colmap(root: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    model = colmap_model_in(root)
    assert model is not None
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
        masks = next((home / MASKS for home in (root, images.parent) if (home / MASKS).is_dir()), None)
        return read_colmap(model, images, images, allow_outside=options.allow_outside, masks=masks), root
    homes = [root, root.parent, root.parent.parent] if model == root else [root]
    home = next((home for home in homes if (home / "images").is_dir()), None)
    if home is None:
        searched = ", ".join(str(home / "images") for home in homes)
        raise InputError(f"{model}: a COLMAP model without photographs; looked for {searched}; say images=FOLDER")
    return read_colmap(model, home / "images", home, allow_outside=options.allow_outside, masks=home / MASKS), home


def _read_tum(root: Path, options: ReadOptions) -> tuple[PosedImages, Path]:
    posed = read_tum(
        root,
        allow_outside=options.allow_outside,
        depth_scale=options.depth_scale,
        intrinsics=options.intrinsics,
    )
    return posed, root


def _reader_of(reader: Callable[..., PosedImages]) -> Callable[[Path, ReadOptions], tuple[PosedImages, Path]]:
    return lambda root, options: (
        reader(root, allow_outside=options.allow_outside, depth_scale=options.depth_scale),
        root,
    )


LAYOUTS = (
    Layout(
        name="transforms.json",
        files=f"{' or '.join(TRANSFORMS)} (nerfstudio, instant-ngp, Blender)",
        matches=lambda root: transforms_in(root) is not None,
        read=_read_transforms,
    ),
    Layout(
        name="COLMAP",
        files="sparse/0 or sparse with a COLMAP model, and images/",
        matches=lambda root: colmap_model_in(root) is not None,
        read=_read_colmap,
    ),
    Layout(
        name="ScanNet++",
        files="dslr/ or iphone/ of ScanNet++ (frames extracted to iphone/rgb)",
        matches=is_scannetpp,
        read=_reader_of(read_scannetpp),
    ),
    Layout(
        name="ScanNet",
        files="color/, pose/, depth/ and intrinsic/ of ScanNet",
        matches=is_scannet_export,
        read=_reader_of(read_scannet),
    ),
    Layout(
        name="7-Scenes",
        files="frame-NNNNNN.color.png, .depth.png and .pose.txt of 7-Scenes",
        matches=is_seven_scenes,
        read=_reader_of(read_seven_scenes),
    ),
    Layout(
        name="TUM RGB-D",
        files="rgb.txt, depth.txt and groundtruth.txt of TUM RGB-D",
        matches=is_tum,
        read=_read_tum,
    ),
    Layout(
        name="Replica",
        files="results/ and traj.txt of Replica (NICE-SLAM)",
        matches=is_replica,
        read=_reader_of(read_replica),
    ),
)


def layout_of(folder: Path) -> Layout | None:
    """The layout of a folder; None if it has none of them."""
    return next((layout for layout in LAYOUTS if layout.matches(folder)), None)


def describe_layouts() -> str:
    """All layouts, for a message."""
    return "; ".join(layout.files for layout in LAYOUTS)


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=4)
