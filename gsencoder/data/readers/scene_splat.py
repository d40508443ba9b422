"""The splat file of a scene: at a path, in its folder, or without views."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.layouts import describe_layouts
from gsencoder.data.readers.posed import choose_origin
from gsencoder.data.splats import gaussians_from_raw, is_ply_of_splat, read_raw
from gsencoder.data.video.decode import refuse_video
from gsencoder.types import Gaussians

SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".sog")
SPLAT_NAMES = ("splat.ply", "point_cloud.ply")
"""What a reconstruction that lies beside its photographs is called."""


def find_splat(root: Path) -> Path:
    """The splat that `root` is or holds.

    Raises:
        InputError: none, or several.
    """
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
    raise InputError(f"{root}: not a scene; a scene holds one of: {describe_layouts()}; a splat")


def file_of_scene(option: str, name: str | Path, folder: Path) -> Path:
    """The file that an option of several scenes names: in each scene's own folder, or else from here. `{scene}` in it
    stands for the name of the scene's folder, as in splats/{scene}/splat.ply.

    Raises:
        InputError: neither exists.
    """
    name = str(name).replace("{scene}", folder.name)
    try:
        # An absolute path stays itself.
        for path in (folder / name, Path(name)):
            if path.exists():
                return path
    except (OSError, ValueError) as error:
        raise InputError(f"{option}={str(name)[:200]}: is not a path ({type(error).__name__})") from error
    raise InputError(f"{option}={name}: no such file (looked in {folder} and from here)")


def read_bare_splat(path: Path) -> tuple[Gaussians, Float64[np.ndarray, "3"]]:
    """A splat without views, and an origin near the median of its means, taken off before they become float32.

    Raises:
        InputError: what `load_splat` refuses.
    """
    raw = read_raw(path)
    finite = raw.means[np.isfinite(raw.means).all(axis=1)]
    origin = choose_origin(np.median(finite, axis=0, keepdims=True)) if len(finite) else np.zeros(3)
    return gaussians_from_raw(raw, origin=origin, where=str(path)), origin


def warn_of_unused_splat(folder: Path) -> None:
    """Says so where a reconstruction lies beside the views and nobody asked for it."""
    beside = [name for name in SPLAT_NAMES if (folder / name).is_file()]
    if beside:
        warnings.warn(
            f"{folder}: {beside[0]} lies beside the views and is not used; say splat={beside[0]} if it belongs to them",
            SceneWarning,
            stacklevel=3,
        )
