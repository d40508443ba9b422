"""Features that share the rows of a table, as a package: one or two bytes a Gaussian, and the table."""

from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import LONGEST_NUMBER, Archive, archive_bytes, write_archive
from gsencoder.data.archive_records import read_space, scaled_halves, scene_parts, space_parts
from gsencoder.data.splats import FINGERPRINT_DIGITS
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
    kind = np.uint8 if rows < 256 else np.uint16
    unseen = int(np.iinfo(kind).max)
    if rows > unseen:
        raise InputError(f"{path}: expected a table of up to {unseen:,} rows, got {rows:,}")
    table, channel_scale = scaled_halves(features.features)
    around, header = scene_parts(scene)
    parts, named = space_parts(features.space, features.mean, features.basis)
    arrays = {
        **around,
        **parts,
        "index": np.where(features.index < 0, unseen, features.index).astype(kind),
        "table": table,
        "channel_scale": channel_scale,
    }
    write_archive(path, arrays, header | named | {"form": INDEX_FORM, "fingerprint": fingerprint, "error": error})


def index_bytes(scene: Scene, features: GaussianFeatures, rows: int) -> int:
    """The size of the file that `write_index` would write, with a table of so many rows.

    Args:
        scene: of the features.
        features: without an index.
        rows: of the table.
    """
    around, header = scene_parts(scene)
    parts, named = space_parts(features.space, features.mean, features.basis)
    columns = features.features.shape[1]
    entries = {name: (array.dtype.name, array.shape) for name, array in {**around, **parts}.items()}
    entries |= {
        "index": ("uint8" if rows < 256 else "uint16", (len(features),)),
        "table": ("float16", (rows, columns)),
        "channel_scale": ("float32", (columns,)),
    }
    unknown = {"form": INDEX_FORM, "fingerprint": "0" * FINGERPRINT_DIGITS, "error": LONGEST_NUMBER}
    return archive_bytes(entries, header | named | unknown)


def read_index(file: Archive) -> GaussianFeatures:
    """Reads an index and its table.

    Raises:
        InputError: damaged, or numbers beyond the table.
    """
    space, mean, basis = read_space(file)
    columns = space.channels if basis is None else basis.rank
    scale = file.array("channel_scale", "float32", (columns,))
    table = file.array("table", "float16", ("M", columns)).astype(np.float32) * scale
    kind = "uint8" if len(table) < 256 else "uint16"
    stored = file.array("index", kind, ("N",))
    unseen = stored == np.iinfo(kind).max
    index = np.where(unseen, -1, stored.astype(np.int32)).astype(np.int32)
    return GaussianFeatures(
        features=table,
        weights=(~unseen).astype(np.float32),
        mean=mean,
        space=space,
        basis=basis,
        index=index,
    )
