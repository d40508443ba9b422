"""Features that share the rows of a table, as a package: one or two bytes a Gaussian, and the table."""

from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.archive import LONGEST_NUMBER, Archive, archive_bytes, shape_only, write_archive
from gsencoder.core.errors import InputError
from gsencoder.data.scene_arrays import read_space, scaled_halves, scene_parts, space_parts
from gsencoder.data.splats.files import FINGERPRINT_DIGITS
from gsencoder.types import GaussianFeatures, Scene

INDEX_FORM = 2
"""Form of a package, in its header, of an index and a table."""


def write_index(path: Path, scene: Scene, features: GaussianFeatures, *, fingerprint: str, error: float) -> None:
    """Writes an index and its table. Weights are not written: those of Gaussians that were seen are read as 1.

    Args:
        path: the file.
        scene: of the features.
        features: with an index.
        fingerprint: of the splat beside the file.
        error: 1 − mean centered cosine with the features that the table was made from.

    Raises:
        InputError: the table has more rows than two bytes can number, or the disk is full.
    """
    assert features.index is not None
    rows = len(features.features)
    dtype = _index_dtype(rows)
    unseen = int(np.iinfo(dtype).max)
    if rows > unseen:
        raise InputError(f"{path}: expected a table of up to {unseen:,} rows, got {rows:,}")
    table, channel_scale = scaled_halves(features.features)
    arrays, header = _contents(
        scene,
        features,
        index=np.where(features.index < 0, unseen, features.index).astype(dtype),
        table=table,
        channel_scale=channel_scale,
        fingerprint=fingerprint,
        error=error,
    )
    write_archive(path, arrays, header)


def _index_dtype(rows: int) -> str:
    """The type of the numbers of a table's rows; its largest value stands for Gaussians that were never seen."""
    return "uint8" if rows < 256 else "uint16"


def _contents(
    scene: Scene,
    features: GaussianFeatures,
    *,
    index: np.ndarray,
    table: np.ndarray,
    channel_scale: np.ndarray,
    fingerprint: str,
    error: float,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a package; of the features it takes the space, the mean and the basis."""
    arrays, header = scene_parts(scene)
    space_arrays, space_header = space_parts(features.space, features.mean, features.basis)
    arrays |= {**space_arrays, "index": index, "table": table, "channel_scale": channel_scale}
    return arrays, header | space_header | {"form": INDEX_FORM, "fingerprint": fingerprint, "error": error}


def index_bytes(scene: Scene, features: GaussianFeatures, rows: int) -> int:
    """The size of the file that `write_index` would write, with a table of so many rows.

    Args:
        scene: of the features.
        features: without an index.
        rows: of the table.
    """
    columns = features.features.shape[1]
    arrays, header = _contents(
        scene,
        features,
        index=shape_only(_index_dtype(rows), (len(features),)),
        table=shape_only("float16", (rows, columns)),
        channel_scale=shape_only("float32", (columns,)),
        fingerprint="0" * FINGERPRINT_DIGITS,
        error=LONGEST_NUMBER,
    )
    return archive_bytes(arrays, header)


def read_index(file: Archive) -> GaussianFeatures:
    """Reads an index and its table.

    Raises:
        InputError: damaged, or numbers beyond the table.
    """
    space, mean, basis = read_space(file)
    columns = space.channels if basis is None else basis.rank
    scale = file.array("channel_scale", "float32", (columns,))
    table = file.array("table", "float16", ("M", columns)).astype(np.float32) * scale
    dtype = _index_dtype(len(table))
    stored = file.array("index", dtype, ("N",))
    unseen = stored == np.iinfo(dtype).max
    index = np.where(unseen, -1, stored.astype(np.int32)).astype(np.int32)
    return GaussianFeatures(
        features=table,
        weights=(~unseen).astype(np.float32),
        mean=mean,
        space=space,
        basis=basis,
        index=index,
    )
