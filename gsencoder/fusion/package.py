"""Scene packages: a splat that any viewer opens, and the features of its Gaussians.

Three forms are for other programs: an .npz, a safetensors file, or properties of the .ply itself. The compact one is
for gsencoder: codes of a few bytes (`compact`), memory-mapped, checked by a sum, bound to its splat by a fingerprint.
So is the smallest one, where Gaussians share the rows of a table (`index_file`).
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int64

from gsencoder.core.archive import (
    LONGEST_NUMBER,
    LONGEST_SHARE,
    Archive,
    MappedArrays,
    archive_bytes,
    open_archive,
    shape_only,
    write_archive,
)
from gsencoder.core.budget import Budget
from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file
from gsencoder.core.settings import Knob, option
from gsencoder.data.scene_arrays import check_splat, read_scene, read_space, scaled_halves, scene_parts, space_parts
from gsencoder.data.splats.files import FINGERPRINT_DIGITS, fingerprint, load_splat, save_splat
from gsencoder.fusion.quantize import CompactFeatures, compact, compact_within
from gsencoder.types import FeatureBasis, GaussianFeatures, Scene

INDEX_FORM = 2
"""Form of a package, in its header, of an index and a table."""


def write_index(path: Path, scene: Scene, features: GaussianFeatures, *, fingerprint: str, error: float) -> None:
    """Writes an index and its table. Weights are not written: those of Gaussians that were seen are read as 1."""
    assert features.index is not None
    rows = len(features.features)
    dtype = _index_dtype(rows)
    unseen = int(np.iinfo(dtype).max)
    if rows > unseen:
        raise InputError(f"{path}: expected a table of up to {unseen:,} rows, got {rows:,}")
    table, channel_scale = scaled_halves(features.features)
    arrays, header = _index_contents(
        scene,
        features,
        index=np.where(features.index < 0, unseen, features.index).astype(dtype),
        table=table,
        channel_scale=channel_scale,
        fingerprint=fingerprint,
        error=error,
    )
    write_archive(path, arrays, header)


def _confidence_bytes(features: GaussianFeatures) -> dict[str, np.ndarray]:
    """A byte a Gaussian, for features with confidence."""
    confidence = features.confidence
    return {} if confidence is None else {"confidence": np.rint(255 * confidence).astype(np.uint8)}


def _index_dtype(rows: int) -> str:
    """The type of the numbers of a table's rows; its largest value stands for Gaussians that were never seen."""
    return "uint8" if rows < 256 else "uint16"


def _index_contents(
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
    arrays |= _confidence_bytes(features)
    return arrays, header | space_header | {"form": INDEX_FORM, "fingerprint": fingerprint, "error": error}


def index_bytes(scene: Scene, features: GaussianFeatures, rows: int) -> int:
    """The size of the file that `write_index` would write, with a table of `rows`; the features have no index."""
    columns = features.features.shape[1]
    arrays, header = _index_contents(
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
    """Reads an index and its table."""
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


Form = Literal["compact", "index", "npz", "safetensors", "ply"]
SPLAT_FILE, PACKAGE_FILE = "splat.ply", "features.gsf"
NPZ_FILE, SAFETENSORS_FILE, BASIS_FILE = "features.npz", "features.safetensors", "basis.npz"
FORMAT = 1
NUMBERS = ("lightest", "heaviest", "error", "lowest")
"""Numbers of `CompactFeatures` that stand in the header of a package."""


def save_package(folder: Path, scene: Scene, features: GaussianFeatures, *, error: float) -> CompactFeatures:
    """Writes splat and compact features, within an error of 1 − mean centered cosine, into an existing folder, which
    the caller makes appear whole or not at all."""
    return _save_compact(folder, scene, features, compact(features, error=error))


def save_package_within(folder: Path, scene: Scene, features: GaussianFeatures, budget: Budget) -> CompactFeatures:
    """Writes the most exact package whose file of features keeps a limit of megabytes, as `save_package` does."""
    space, seen = features.space, int(features.seen.sum())

    def bytes_of(bits: Int64[np.ndarray, " R"]) -> int:
        mean, components = (shape_only("float32", shape) for shape in ((space.channels,), (len(bits), space.channels)))
        basis = FeatureBasis(mean=mean, components=components, energy_kept=LONGEST_SHARE, space=space)
        coded = {
            "bits": shape_only("uint8", (len(bits),)),
            "levels": shape_only("float32", (int((1 << bits).sum()),)),
            "codes": shape_only("uint8", (seen, -(-int(bits.sum()) // 8))),
            "weight_codes": shape_only("uint8", (seen,)),
            **_confidence_bytes(features),
        }
        numbers, unknown = dict.fromkeys(NUMBERS, LONGEST_NUMBER), "0" * FINGERPRINT_DIGITS
        return archive_bytes(*_contents(scene, features.seen, basis, coded, numbers, fingerprint=unknown))

    return _save_compact(folder, scene, features, compact_within(features, budget, bytes_of))


def _save_compact(
    folder: Path, scene: Scene, features: GaussianFeatures, compacted: CompactFeatures
) -> CompactFeatures:
    splat = _save_splat(folder, scene)
    seen = np.zeros(len(compacted), bool)
    seen[compacted.rows] = True
    coded = {name: getattr(compacted, name) for name in ("bits", "levels", "codes", "weight_codes")}
    coded |= _confidence_bytes(features)
    numbers = {name: getattr(compacted, name) for name in NUMBERS}
    arrays, header = _contents(scene, seen, compacted.basis, coded, numbers, fingerprint=splat)
    write_archive(folder / PACKAGE_FILE, arrays, header)
    return compacted


def _contents(
    scene: Scene,
    seen: Bool[np.ndarray, " N"],
    basis: FeatureBasis,
    coded: Mapping[str, np.ndarray],
    numbers: Mapping[str, float],
    *,
    fingerprint: str,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a compact package; `coded` are bits, levels, codes and weight_codes of
    `CompactFeatures`, and the confidence of the features; `numbers` its `NUMBERS`."""
    arrays, header = scene_parts(scene)
    space_arrays, space_header = space_parts(basis.space, basis.mean, basis)
    arrays |= {**coded, "seen": np.packbits(seen), **space_arrays}
    header |= space_header | {"form": FORMAT, "fingerprint": fingerprint, "total": len(seen), **numbers}
    return arrays, header


def save_index_package(folder: Path, scene: Scene, features: GaussianFeatures, *, error: float) -> None:
    """Writes splat and features that share the rows of a table (`gsencoder.memory.index.index_features`) into an
    existing folder. `error` is 1 − mean centered cosine with the features that the table was made from."""
    written = _save_splat(folder, scene)
    write_index(folder / PACKAGE_FILE, scene, features, fingerprint=written, error=error)


def open_package(file: Path) -> CompactFeatures:
    """The features of a package, its codes memory-mapped."""
    with open_archive(file) as archive:
        form = archive.value("form", int)
        if form != FORMAT:
            raise InputError(
                f"expected form {FORMAT} or {INDEX_FORM} of a package, got {form}; pack the features again"
            )
        archive.verify()
        _, _, basis = read_space(archive)
        if basis is None:
            raise InputError("expected components of a basis; the file is damaged or from another program")
        mapped = MappedArrays(file, {"codes": ("uint8", 2), "weight_codes": ("uint8", 1)})
        seen, total = archive.array("seen", "uint8", ("S",)), archive.value("total", int)
        if not 0 <= total <= 8 * len(seen) < total + 8:
            raise InputError(f"expected marks of {total} Gaussians, got {8 * len(seen)}")
        return CompactFeatures(
            codes=mapped.array("codes"),
            bits=archive.array("bits", "uint8", ("R",)),
            levels=archive.array("levels", "float32", ("L",)),
            weight_codes=mapped.array("weight_codes"),
            lightest=archive.value("lightest", float, int),
            heaviest=archive.value("heaviest", float, int),
            rows=np.flatnonzero(np.unpackbits(seen, count=total)),
            total=total,
            basis=basis,
            error=archive.value("error", float, int),
            lowest=archive.value("lowest", float, int),
        )


def load_package(folder: Path) -> Scene:
    """The scene and its features from a folder of `save_package` or `save_index_package`."""
    file = folder / PACKAGE_FILE
    with open_archive(file) as archive:
        indexed = archive.value("form", int) == INDEX_FORM
        features = read_index(archive) if indexed else open_package(file).features()
        gaussians = load_splat(folder / SPLAT_FILE, origin=archive.array("origin", "float64", (3,)))
        check_splat(archive, gaussians, "pack this splat's own features")
        if len(gaussians) != len(features):
            raise InputError(f"expected features of {len(gaussians):,} Gaussians, got {len(features):,}")
        if "confidence" in archive:
            stated = archive.array("confidence", "uint8", (len(gaussians),))
            features = replace(features, confidence=stated / np.float32(255))
        scene = read_scene(archive, gaussians)
    return replace(scene, features={features.space.name: features})


def save_arrays(
    folder: Path, scene: Scene, features: GaussianFeatures, form: Literal["npz", "safetensors"], *, decoded: bool
) -> None:
    """Writes the splat, and plain arrays that other programs read: features [N, R] float32, or [N, D] float16 where
    decoded; weights [N]; mean [D]; components [R, D] (a vector is mean + features @ components); about, as JSON."""
    arrays = _plain(features, decoded="float16" if decoded else "")
    about = _about(features, _save_splat(folder, scene), decoded=decoded)
    if form == "npz":
        with atomic_file(folder / NPZ_FILE) as stream:
            np.savez(stream, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
    else:
        write_archive(folder / SAFETENSORS_FILE, arrays, about)


def save_ply(folder: Path, scene: Scene, features: GaussianFeatures, *, decoded: bool) -> None:
    """Writes the splat with properties feature_0, feature_1, … and feature_weight, float32, and what they mean in
    `basis.npz`, as `save_arrays` has it."""
    arrays = _plain(features, decoded="float32" if decoded else "")
    columns = np.ascontiguousarray(arrays.pop("features").T)
    further = {f"feature_{number}": column for number, column in enumerate(columns)}
    written = _save_splat(folder, scene, {**further, "feature_weight": arrays.pop("weights")})
    about = _about(features, written, decoded=decoded)
    with atomic_file(folder / BASIS_FILE) as stream:
        np.savez(stream, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)


def _save_splat(folder: Path, scene: Scene, further: Mapping[str, np.ndarray] | None = None) -> str:
    """Writes the splat; its fingerprint, as it will be read."""
    if scene.gaussians is None:
        raise InputError(f"{scene.name}: has no Gaussians")
    save_splat(folder / SPLAT_FILE, scene.gaussians, origin=scene.origin, further=further)
    return fingerprint(load_splat(folder / SPLAT_FILE, origin=scene.origin))


def _plain(features: GaussianFeatures, *, decoded: str) -> dict[str, np.ndarray]:
    """The arrays; `decoded` is the type of whole vectors, or empty for coordinates."""
    arrays = {"weights": features.weights, "mean": features.mean}
    if not decoded:
        components = {} if features.basis is None else {"components": features.basis.components}
        return {"features": features.stored(), **arrays, **components}
    vectors = np.zeros((len(features), features.space.channels), decoded)
    seen = np.flatnonzero(features.seen)
    for rows in np.array_split(seen, max(1, len(seen) // 65536)):
        with np.errstate(over="ignore"):
            vectors[rows] = features.decode(rows)
        if not np.isfinite(vectors[rows]).all():
            raise InputError(f"decoded=true: the vectors do not fit into {decoded}; take decoded=false, or form=ply")
    return {"features": vectors, **arrays}


def _about(features: GaussianFeatures, belongs: str, *, decoded: bool) -> dict[str, Any]:
    kind = "vectors" if decoded or features.basis is None else "coordinates: vector = mean + features @ components"
    return {"space": asdict(features.space), "features": kind, "fingerprint": belongs}


FUSION_KNOBS = (
    Knob(name="view_share", key="view_share", values=(0.17, 0.33, 0.5, 0.67), exact=1.0),
    Knob(name="views", key="views", values=(4, 8, 16), exact=0),
    Knob(name="view_choice", key="view_choice", values=("coverage",), needs={"view_share": 0.5}),
    Knob(name="rays_per_patch", key="blend.rays_per_patch", values=(1, 4, 9, 16, 36), exact=196),
    Knob(name="min_weight", key="blend.min_weight", values=(1e-4, 1e-3, 1e-2), exact=0.0),
    Knob(name="stop_transmittance", key="blend.stop_transmittance", values=(1e-3, 1e-2, 0.1), exact=1e-6),
    Knob(name="tolerance", key="visibility.relative", values=(0.005, 0.01, 0.05, 0.1)),
    Knob(name="energy", key="energy", values=(0.95, 0.99, 0.995)),
    Knob(name="max_rank", key="max_rank", values=(8, 16, 32, 64)),
    Knob(name="basis", key="basis", values=(False,), exact=False),
)
"""Knobs of `gsencoder.fusion.fuse.FuseConfig`. A tolerance of visibility has no exact value: a wider one takes in what
is hidden, and a narrower one leaves out what is seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PackageSettings:
    """How features are packed."""

    form: Form = option("compact", "see `pack form=`")
    error: float = option(0.01, "largest mean loss of centered cosine, for form=compact")
    threshold: float = option(0.9, "centered cosine that the rows of form=index reach")

    def __post_init__(self) -> None:
        if not 0 < self.error < 1:
            raise InputError(f"error: expected a budget between 0 and 1, got {self.error}")


PACKAGE_KNOBS = (
    Knob(name="form", key="form", values=("index", "npz")),
    Knob(name="error", key="error", values=(0.001, 0.003, 0.03, 0.1), exact=0.001),
    Knob(name="threshold", key="threshold", values=(0.8, 0.95, 0.98), needs={"form": "index"}),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PackBudget(Budget):
    """What a package may lose, or how large it may be. Where both limits conflict, the error wins.

    With a budget of error the smallest package that keeps it is made; with one of megabytes alone, the most exact one.
    """

    error: float | None = option(
        None,
        "largest mean of 1 − centered cosine to the features that are packed, over Gaussians and over "
        "kinds of features; without a budget 0.01 for form=compact",
    )
    megabytes: float | None = option(None, "largest size of features.gsf, in units of 1,000,000 bytes")
