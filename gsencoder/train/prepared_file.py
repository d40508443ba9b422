"""The file of a prepared scene: Gaussians, their targets, and the rows of the render loss of every view.

Targets and the teacher's vectors in the rows are float16, or integers of eight bits and a scale for each column.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from gsencoder.core.archive import Archive, MappedArrays, write_archive
from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError
from gsencoder.data.scene_arrays import camera_arrays
from gsencoder.fusion.errors import ProjectionSums
from gsencoder.models.output_space import OutputSpace
from gsencoder.types import GaussianFeatures, Scene

Precision = Literal["float16", "int8"]
"""The types in which targets, and the teacher's vectors in the rows, can be stored."""
SCALES = {"targets": "target_scales", "row_targets": "row_target_scales"}
"""The arrays of which each column is quantized with `int8`, and where its scales are."""
ARRAYS = {
    "means": ("float32", 2),
    "quats": ("float32", 2),
    "scales": ("float32", 2),
    "opacities": ("float32", 1),
    "sh_dc": ("float32", 2),
    "targets": ("float16", 2),
    "weights": ("float32", 1),
    "rows": ("int64", 1),
    "crow": ("int64", 1),
    "col": ("int32", 1),
    "weight": ("float16", 1),
    "row_targets": ("float16", 2),
    "row_valid": ("uint8", 1),
}
"""Type and number of axes of each array of a file of float16 targets."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewRows:
    """The blending matrix B of one view, with a row for each cell of the teacher's grid, and the teacher's vectors.

    Attributes:
        crow, col, weight: B in compressed rows, as in `gsencoder.render.Blend`.
        targets: the teacher's vectors in the cells, standard units.
        valid: cells in which the teacher has a vector.
    """

    crow: Int64[np.ndarray, " P_plus_1"]
    col: Int32[np.ndarray, " nnz"]
    weight: Float32[np.ndarray, " nnz"]
    targets: Float32[np.ndarray, "P channels"]
    valid: Bool[np.ndarray, " P"]


def write_prepared(
    path: Path,
    scene: Scene,
    features: GaussianFeatures,
    outputs: OutputSpace,
    views: list[ViewRows],
    *,
    source: Path | None = None,
    precision: Precision = "float16",
    projections: ProjectionSums | None = None,
) -> None:
    """Writes a prepared scene.

    Args:
        path: the file.
        scene: the scene, with Gaussians and cameras.
        features: fused features, in the basis of `outputs`.
        outputs: output space of the dataset.
        views: matrix and teacher's vectors for each camera.
        source: the path that the scene was read from, by which the file is recognized; None if nobody looks for it.
        precision: of the targets, and of the teacher's vectors in the rows.
        projections: how well the basis represents the teacher's vectors in this scene; None without a basis.

    Raises:
        InputError: the features are of another space, or the disk is full.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    if features.space != outputs.space or features.features.shape[1] != outputs.channels:
        raise InputError(
            f"prepare: expected features of ({outputs.space.describe()}), got ({features.space.describe()})"
        )
    gaussians = scene.gaussians
    targets = [np.where(features.seen[:, None], outputs.standardize(features.stored()), 0)]
    targets += [view.targets for view in views]
    largest = max(float(np.abs(values).max(initial=0)) for values in targets)
    # Samples hold float16 in any case.
    if not largest <= np.finfo(np.float16).max:
        raise InputError(f"prepare: targets of up to {largest:.3g} do not fit into float16; use prepare.scale=true")
    sizes = [len(view.valid) for view in views]
    entries = np.cumsum([0, *(len(view.col) for view in views)])
    arrays = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "sh_dc": gaussians.sh[:, 0],
        **_stored_as("targets", targets[0], precision),
        "weights": features.weights,
        "rows": np.cumsum([0, *sizes]).astype(np.int64),
        "crow": np.concatenate(
            [view.crow[:-1] + start for view, start in zip(views, entries[:-1], strict=True)] + [entries[-1:]]
        ).astype(np.int64),
        "col": np.concatenate([view.col for view in views]),
        "weight": np.concatenate([view.weight for view in views]).astype(np.float16),
        **_stored_as("row_targets", np.concatenate(targets[1:]), precision),
        "row_valid": np.concatenate([view.valid for view in views]).astype(np.uint8),
        **camera_arrays(scene.views.cameras),
    }
    header = {
        "source": "" if source is None else str(source.resolve()),
        "source_files": "" if source is None else digest_of_files(source),
        "views": list(scene.views.names),
        "metres_per_unit": scene.metres_per_unit,
        "up": None if scene.up is None else scene.up.tolist(),
    }
    if projections is not None:
        arrays |= {"cosines_of_projections": projections.histogram, "sums_of_projections": projections.sums}
    write_archive(path, arrays, header)


def _stored_as(name: str, values: Float32[np.ndarray, "n channels"], precision: Precision) -> dict[str, np.ndarray]:
    """An array of the file, with its scales if it has any."""
    if precision == "float16":
        return {name: values.astype(np.float16)}
    integers, scales = round_columns(values)
    return {name: integers, SCALES[name]: scales}


def stored_precision(file: Archive) -> Precision:
    """The type in which a file holds its targets."""
    return "int8" if SCALES["targets"] in file else "float16"


def array_types(precision: Precision) -> Mapping[str, tuple[str, int]]:
    """Type and number of axes of each array of a file."""
    return {name: (precision if name in SCALES else dtype, axes) for name, (dtype, axes) in ARRAYS.items()}


def check_arrays(arrays: MappedArrays, views: int) -> None:
    """Checks the shapes of all arrays, and the values of those that are read for all Gaussians.

    Entries of B and targets are checked when they are read; checking them here would read the entire file.

    Raises:
        InputError: shapes or values are inconsistent.
    """
    shapes = {name: arrays.shape(name) for name in ARRAYS}
    sizes = {name: shape[0] for name, shape in shapes.items()}
    columns = {name: shape[1:] for name, shape in shapes.items()}
    n, rows, crow = sizes["means"], arrays.array("rows"), arrays.array("crow")
    width = columns["targets"]
    expected = [("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("opacities", ()), ("sh_dc", (3,)), ("weights", ())]
    consistent = all(
        sizes[name] == n and columns[name] == trailing for name, trailing in [*expected, ("targets", width)]
    )
    consistent &= columns["row_targets"] == width
    consistent &= sizes["rows"] == views + 1 and bool((np.diff(rows) >= 0).all()) and rows[0] == 0
    cells = int(rows[-1]) if sizes["rows"] else 0
    consistent &= sizes["crow"] == cells + 1 and sizes["row_targets"] == sizes["row_valid"] == cells
    consistent = bool(consistent) and crow[0] == 0 and bool((np.diff(crow) >= 0).all())
    if not consistent or not crow[-1] == sizes["col"] == sizes["weight"]:
        raise InputError("its arrays do not fit together")
    if not np.isfinite(arrays.array("means")).all() or not (arrays.array("weights") >= 0).all():
        raise InputError("it has positions that are not finite, or weights that are negative or NaN")


def digest_of_files(source: Path) -> str:
    """A hash of the names and sizes of the files of a scene, by which it is recognized where it was moved to.

    Contents are not read: thousands of scenes are looked at before a training begins.
    """
    if source.is_dir():
        files = (Path(folder) / name for folder, _, names in os.walk(source) for name in names)
        rows = sorted(f"{path.relative_to(source).as_posix()} {path.stat().st_size}" for path in files)
    else:
        rows = [str(source.stat().st_size)] if source.exists() else []
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()[:16] if rows else ""
