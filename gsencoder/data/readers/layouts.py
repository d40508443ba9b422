"""The layouts of scenes with posed photographs, in the order in which they are recognized."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.posed import PosedImages, ReadOptions, choose_origin
from gsencoder.data.readers.rgbd import (
    is_replica,
    is_scannet_export,
    is_seven_scenes,
    is_tum,
    read_replica,
    read_scannet,
    read_seven_scenes,
    read_tum,
)
from gsencoder.data.readers.scannetpp import is_scannetpp, read_scannetpp
from gsencoder.data.readers.transforms_json import TRANSFORMS, read_transforms
from gsencoder.data.splats.files import gaussians_from_raw, is_ply_of_splat, read_raw
from gsencoder.data.video import refuse_video
from gsencoder.types import Gaussians

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


def _in_place(
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
        _in_place(read_scannetpp),
    ),
    Layout("ScanNet", "color/, pose/, depth/ and intrinsic/ of ScanNet", is_scannet_export, _in_place(read_scannet)),
    Layout(
        "7-Scenes",
        "frame-NNNNNN.color.png, .depth.png and .pose.txt of 7-Scenes",
        is_seven_scenes,
        _in_place(read_seven_scenes),
    ),
    Layout("TUM RGB-D", "rgb.txt, depth.txt and groundtruth.txt of TUM RGB-D", is_tum, _in_place(read_tum)),
    Layout("Replica", "results/ and traj.txt of Replica (NICE-SLAM)", is_replica, _in_place(read_replica)),
)


def layout_of(folder: Path) -> Layout | None:
    return next((layout for layout in LAYOUTS if layout.matches(folder)), None)


def describe_layouts() -> str:
    return f"a scene holds one of: {'; '.join(layout.files for layout in LAYOUTS)}; a splat"


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=4)


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


def warn_of_unused_splat(folder: Path) -> None:
    """Says so where a reconstruction lies with the views and is not used."""
    splats = [name for name in SPLAT_NAMES if (folder / name).is_file()]
    if splats:
        warnings.warn(
            f"{folder}: {splats[0]} lies with the views and is not used; say splat={splats[0]} if it belongs to them",
            SceneWarning,
            stacklevel=3,
        )
