"""Cameras, scenes, feature spaces and bases in archives: the arrays and header values that all files share."""

from typing import Any

import numpy as np
from jaxtyping import Float16, Float32

from gsencoder.core.archive import Archive
from gsencoder.core.errors import InputError
from gsencoder.data.readers.images import PIXEL_LIMIT
from gsencoder.data.splats.files import fingerprint
from gsencoder.types import Cameras, FeatureBasis, FeatureSpace, Gaussians, MemoryBank, Scene, Views
from gsencoder.types.orientation import TURNS


def check_splat(file: Archive, gaussians: Gaussians, advice: str) -> None:
    """Checks that a file of features was made for exactly these Gaussians."""
    expected, actual = file.value("fingerprint", str), fingerprint(gaussians)
    if expected != actual:
        raise InputError(f"the features belong to splat {expected[:8]}…, the folder holds {actual[:8]}…; {advice}")


def camera_arrays(cameras: Cameras) -> dict[str, np.ndarray]:
    """The arrays of cameras, by name."""
    return {name: getattr(cameras, name) for name in ("cam_from_world", "Ks", "widths", "heights")}


def read_cameras(file: Archive) -> Cameras:
    """Reads cameras."""
    return Cameras(
        cam_from_world=file.array("cam_from_world", "float32", ("V", 4, 4)),
        Ks=file.array("Ks", "float32", ("V", 3, 3)),
        widths=file.array("widths", "int32", ("V",)),
        heights=file.array("heights", "int32", ("V",)),
    )


def space_parts(
    space: FeatureSpace, mean: Float32[np.ndarray, " D"], basis: FeatureBasis | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and header values of a feature space, its mean, and its basis if there is one."""
    arrays: dict[str, np.ndarray] = {"mean": mean}
    header: dict[str, Any] = {"space": {name: getattr(space, name) for name in space.__dataclass_fields__}}
    if basis is not None:
        arrays["components"] = basis.components
        header["energy_kept"] = basis.energy_kept
    return arrays, header


def read_space(file: Archive) -> tuple[FeatureSpace, Float32[np.ndarray, " D"], FeatureBasis | None]:
    """Reads a feature space, its mean, and its basis or None."""
    values = file.value("space", dict)
    if set(values) != set(FeatureSpace.__dataclass_fields__):
        raise InputError(f"expected a feature space with {', '.join(FeatureSpace.__dataclass_fields__)}")
    space, mean = FeatureSpace(**values), file.array("mean", "float32", ("D",))
    if "components" not in file and "energy_kept" not in file:
        return space, mean, None
    components, energy_kept = file.array("components", "float32", ("R", "D")), file.value("energy_kept", float, int)
    return space, mean, FeatureBasis(mean=mean, components=components, energy_kept=energy_kept, space=space)


def bank_parts(bank: MemoryBank) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """The arrays and header values of a bank, without its components and its space."""
    arrays = {"sources": bank.sources, "source_grids": bank.grid_from_image, "bank_mean": bank.mean}
    return arrays, {name: getattr(bank, name) for name in ("threshold", "coverage", "cosine")}


def read_bank(file: Archive, components: Float32[np.ndarray, "M D"], space: FeatureSpace) -> MemoryBank:
    """Reads a bank whose components and space have been read."""
    return MemoryBank(
        components=components,
        sources=file.array("sources", "int32", (len(components), 3)),
        grid_from_image=file.array("source_grids", "float64", (len(components), 2, 3)),
        mean=file.array("bank_mean", "float32", (space.channels,)),
        **{name: file.value(name, float, int) for name in ("threshold", "coverage", "cosine")},
        space=space,
    )


def scaled_halves(values: Float32[np.ndarray, "n C"]) -> tuple[Float16[np.ndarray, "n C"], Float32[np.ndarray, " C"]]:
    """Values as float16, and what each channel was divided by: its largest magnitude, or 1."""
    largest = np.abs(values).max(axis=0, initial=0)
    scale = np.where(largest > 0, largest, 1).astype(np.float32)
    return (values / scale).astype(np.float16), scale


def scene_parts(scene: Scene) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and header values of a scene, without its Gaussians and features."""
    arrays: dict[str, np.ndarray] = {"origin": scene.origin}
    header: dict[str, Any] = {"name": scene.name, "metres_per_unit": scene.metres_per_unit}
    header["up"] = None if scene.up is None else scene.up.tolist()
    if scene.views is not None:
        arrays |= camera_arrays(scene.views.cameras)
        header["views"] = list(scene.views.names)
        if scene.views.orientations is not None:
            header["orientations"] = list(scene.views.orientations)
    return arrays, header


def read_scene(file: Archive, gaussians: Gaussians) -> Scene:
    """Reads a scene; its Gaussians are given, since they may be in another file."""
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
    orientations = tuple(file.value("orientations", list)) if "orientations" in file else None
    if orientations is not None and not all(each in TURNS for each in orientations):
        raise InputError(f"expected EXIF orientations from 1 to 8, got {str(orientations)[:60]}")
    return Views(cameras=cameras, names=tuple(names), orientations=orientations)
