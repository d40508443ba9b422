"""How cameras, scenes, feature spaces and bases lie in an archive: written and read here for every file."""

from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import Archive
from gsencoder.data.readers.images import PIXEL_LIMIT
from gsencoder.data.splats import fingerprint
from gsencoder.types import Cameras, FeatureBasis, FeatureSpace, Gaussians, Scene, Views


def check_splat(file: Archive, gaussians: Gaussians, advice: str) -> None:
    """Raises an error with advice unless a file of features was made for exactly these Gaussians.

    Raises:
        InputError: the fingerprint in its header is of others.
    """
    belongs, actual = file.value("fingerprint", str), fingerprint(gaussians)
    if belongs != actual:
        raise InputError(f"the features belong to splat {belongs[:8]}…, the folder holds {actual[:8]}…; {advice}")


def camera_arrays(cameras: Cameras) -> dict[str, np.ndarray]:
    """The arrays that hold cameras."""
    return {name: getattr(cameras, name) for name in ("cam_from_world", "Ks", "widths", "heights")}


def read_cameras(file: Archive) -> Cameras:
    """The cameras that a file holds.

    Raises:
        InputError: missing, damaged, or no cameras.
    """
    return Cameras(
        cam_from_world=file.array("cam_from_world", "float32", ("V", 4, 4)),
        Ks=file.array("Ks", "float32", ("V", 3, 3)),
        widths=file.array("widths", "int32", ("V",)),
        heights=file.array("heights", "int32", ("V",)),
    )


def space_parts(
    space: FeatureSpace, mean: Float32[np.ndarray, " D"], basis: FeatureBasis | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header values that hold a feature space, its mean, and a basis where there is one."""
    arrays: dict[str, np.ndarray] = {"mean": mean}
    header: dict[str, Any] = {"space": {name: getattr(space, name) for name in space.__dataclass_fields__}}
    if basis is not None:
        arrays["components"] = basis.components
        header["energy_kept"] = basis.energy_kept
    return arrays, header


def read_space(file: Archive) -> tuple[FeatureSpace, Float32[np.ndarray, " D"], FeatureBasis | None]:
    """The feature space that a file holds, its mean, and its basis.

    Raises:
        InputError: missing, damaged, or other fields than a feature space has.
    """
    values = file.value("space", dict)
    if set(values) != set(FeatureSpace.__dataclass_fields__):
        raise InputError(f"expected a feature space with {', '.join(FeatureSpace.__dataclass_fields__)}")
    space, mean = FeatureSpace(**values), file.array("mean", "float32", ("D",))
    if "components" not in file and "energy_kept" not in file:
        return space, mean, None
    components, energy_kept = file.array("components", "float32", ("R", "D")), file.value("energy_kept", float, int)
    return space, mean, FeatureBasis(mean=mean, components=components, energy_kept=energy_kept, space=space)


def scene_parts(scene: Scene) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header values that hold what a scene is beside its Gaussians and features."""
    arrays: dict[str, np.ndarray] = {"origin": scene.origin}
    header: dict[str, Any] = {"name": scene.name, "metres_per_unit": scene.metres_per_unit}
    header["up"] = None if scene.up is None else scene.up.tolist()
    if scene.views is not None:
        arrays |= camera_arrays(scene.views.cameras)
        header["views"] = list(scene.views.names)
    return arrays, header


def read_scene(file: Archive, gaussians: Gaussians) -> Scene:
    """The scene that a file holds, of Gaussians that may lie elsewhere.

    Raises:
        InputError: missing or damaged.
    """
    up = file.value("up", list, None)
    if up is not None and not (len(up) == 3 and all(type(part) in (int, float) and abs(part) < 2 for part in up)):
        raise InputError(f"expected three numbers for up in the header, got {str(up)[:60]}")
    return Scene(
        name=file.value("name", str),
        gaussians=gaussians,
        views=_read_views(file) if "views" in file else None,
        origin=file.array("origin", "float64", (3,)),
        metres_per_unit=file.value("metres_per_unit", float, int, None),
        up=None if up is None else np.array(up, np.float64),
    )


def _read_views(file: Archive) -> Views:
    names = file.value("views", list)
    if not all(isinstance(name, str) for name in names):
        raise InputError("expected the names of views to be text")
    cameras = read_cameras(file)
    pixels = cameras.widths.astype(np.int64) * cameras.heights
    if len(pixels) and pixels.max() > PIXEL_LIMIT:
        raise InputError(f"expected views of at most {PIXEL_LIMIT:,} pixels, got one of {pixels.max():,}")
    return Views(cameras=cameras, names=tuple(names))
