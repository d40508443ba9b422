"""How cameras, feature spaces and bases lie in an archive: written and read here by every file that holds them."""

from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.data.archive import Archive
from gsencoder.errors import InputError
from gsencoder.types import Cameras, FeatureBasis, FeatureSpace


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
    components, kept = file.array("components", "float32", ("R", "D")), file.value("energy_kept", float, int)
    return space, mean, FeatureBasis(mean=mean, components=components, energy_kept=kept, space=space)
