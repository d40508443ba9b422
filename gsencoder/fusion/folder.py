"""Features on disk: a folder that holds the Gaussians, the cameras and their features.

Features of one teacher are in `features.safetensors`, those of several in a file each, `features.TEACHER.safetensors`.
Memories, which are decoded to features when they are read, are in `memory.safetensors` or `memory.TEACHER.safetensors`.
Arrays are safetensors files, memory-mapped on load; features are float16 for seen rows only. The folder is all that
localization needs: no photographs, no teacher. Next to them may lie text tables (`gsencoder.text.table`) and adapter
heads (`gsencoder.models.output_space`). Features with fewer coordinates, along principal axes, take fewer bytes.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int32

from gsencoder.core.archive import (
    LONGEST_SHARE,
    Archive,
    archive_bytes,
    open_archive,
    shape_only,
    write_archive,
)
from gsencoder.core.arrays import even_indices, is_strictly_increasing
from gsencoder.core.budget import MEGABYTE, Budget
from gsencoder.core.errors import InputError
from gsencoder.core.threads import parallel
from gsencoder.data.scene_arrays import (
    bank_parts,
    check_splat,
    read_bank,
    read_scene,
    read_space,
    scaled_halves,
    scene_parts,
    space_parts,
)
from gsencoder.data.scenes import kind_of_path
from gsencoder.data.splats.files import FINGERPRINT_DIGITS, fingerprint
from gsencoder.fusion.package import PACKAGE_FILE, load_package
from gsencoder.fusion.quantize import centered_rows
from gsencoder.text.table import file_of_teacher, teachers_in
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, Gaussians, QueryMemory, Scene

MEMORY_FILE = "memory.safetensors"


def write_memory(path: Path, memory: QueryMemory, gaussians: Gaussians, more: Mapping[str, Any] = {}) -> None:
    """Writes a memory of Gaussians: queries of seen ones and components as float16, each channel divided by its largest
    magnitude. `more` are further entries of the header, as JSON values."""
    if len(memory) != len(gaussians):
        raise InputError(f"{path}: {len(memory):,} queries need as many Gaussians, got {len(gaussians):,}")
    rows, bank = np.flatnonzero(memory.weights > 0), memory.bank
    arrays, header = space_parts(memory.space, memory.mean, memory.basis)
    queries, query_scale = scaled_halves(memory.queries[rows])
    components, component_scale = scaled_halves(bank.components)
    arrays |= {
        "rows": rows.astype(np.int32),
        "queries": queries,
        "query_scale": query_scale,
        "weights": memory.weights[rows],
        "projection": memory.projection,
        "bank": components,
        "bank_scale": component_scale,
    }
    of_bank, figures = bank_parts(bank)
    header |= {
        "fingerprint": fingerprint(gaussians),
        "scoring": memory.scoring,
        "temperature": memory.temperature,
        **figures,
    }
    write_archive(path, arrays | of_bank, header | dict(more))


def read_memory(file: Archive, gaussians: Gaussians) -> QueryMemory:
    check_splat(file, gaussians, "make the memory of this splat again")
    space, mean, basis = read_space(file)
    rows, count = file.array("rows", "int32", ("n",)), len(gaussians)
    if not is_strictly_increasing(rows, count):
        raise InputError(f"expected row numbers that rise from 0 to at most {count - 1}")
    seen = file.array("weights", "float32", (len(rows),))
    if (seen <= 0).any():
        raise InputError("expected weights above 0")
    projection = file.array("projection", "float32", ("s", space.channels))
    scale = file.array("query_scale", "float32", (len(projection),))
    queries, weights = np.zeros((count, len(projection)), np.float32), np.zeros(count, np.float32)
    queries[rows] = file.array("queries", "float16", (len(rows), len(projection))).astype(np.float32) * scale
    weights[rows] = seen
    components = file.array("bank", "float16", ("M", space.channels)).astype(np.float32)
    bank = read_bank(file, components * file.array("bank_scale", "float32", (space.channels,)), space)
    scoring = file.value("scoring", str)
    if scoring not in ("centered", "cosine", "dot"):
        raise InputError(f"expected scoring centered, cosine or dot in the header, got {scoring[:40]!r}")
    return QueryMemory(
        queries=queries,
        weights=weights,
        projection=projection,
        bank=bank,
        scoring=scoring,
        temperature=file.value("temperature", float, int),
        mean=mean,
        basis=basis,
    )


SCENE_FILE, FEATURES_FILE = "scene.safetensors", "features.safetensors"
BLOCK = 16_384
"""Rows that are turned into half precision at a time."""


def save_features(
    folder: str | Path,
    scene: Scene,
    features: GaussianFeatures | Mapping[str, GaussianFeatures],
    settings: Mapping[str, Any] = {},
) -> None:
    """Writes a scene and its features, as every command that takes features reads them.

    float16 holds values up to 65,504, so each channel is stored divided by its largest magnitude.

    Args:
        folder: made if it does not exist. Each file appears completely or not at all; that the folder does is up to the
            caller.
        scene: the Gaussians, cameras and names are written; photographs are not.
        features: of the scene's Gaussians; by teacher where there are several.
        settings: what made the features, as JSON values.
    """
    folder, gaussians = Path(folder), scene.gaussians
    if isinstance(features, GaussianFeatures):
        features = {features.space.name: features}
    single = len(features) == 1
    by_file = {FEATURES_FILE if single else file_of_teacher(FEATURES_FILE, name): features[name] for name in features}
    wrong = [len(each) for each in by_file.values() if gaussians is None or len(gaussians) != len(each)]
    if gaussians is None or wrong:
        raise InputError(f"save_features: {wrong[0]} features need as many Gaussians in scene {scene.name}")
    _write_scene(folder, scene, gaussians)
    for name, each in by_file.items():
        _write_rows(folder / name, each, settings, fingerprint(gaussians))


def save_memories(
    folder: str | Path, scene: Scene, memories: Mapping[str, QueryMemory], settings: Mapping[str, Any] = {}
) -> None:
    """Writes a scene and its memories as `save_features` writes features; every command reads them as such."""
    folder, gaussians = Path(folder), scene.gaussians
    if gaussians is None:
        raise InputError(f"save_memories: scene {scene.name} has no Gaussians")
    _write_scene(folder, scene, gaussians)
    for name, memory in memories.items():
        file = file_of_teacher(MEMORY_FILE, None if len(memories) == 1 else name)
        write_memory(folder / file, memory, gaussians, {"settings": dict(settings)})


def _write_scene(folder: Path, scene: Scene, gaussians: Gaussians) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror or error}") from error
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    around, header = scene_parts(scene)
    write_archive(folder / SCENE_FILE, arrays | around, header)


def _write_rows(path: Path, features: GaussianFeatures, settings: Mapping[str, Any], fingerprint: str) -> None:
    rows = np.flatnonzero(features.weights > 0)
    # By blocks: a million rows of many channels are gigabytes, and no second copy of them is made.
    blocks = [rows[start : start + BLOCK] for start in range(0, len(rows), BLOCK)]

    def measure(number: int) -> tuple[int, Float32[np.ndarray, " channels"]]:
        vectors = features.stored(blocks[number])
        return int((~np.isfinite(vectors).all(axis=1)).sum()), np.abs(vectors).max(axis=0)

    measured = parallel(measure, range(len(blocks)))
    if bad := sum(bad for bad, _ in measured):
        raise InputError(f"save_features: {bad} of {len(rows)} rows are not finite")
    largest = np.max([np.zeros(features.features.shape[1], np.float32), *(values for _, values in measured)], axis=0)
    channel_scale = np.where(largest > 0, largest, 1).astype(np.float32)
    halves = np.empty((len(rows), len(largest)), np.float16)

    def convert(number: int) -> None:
        block = blocks[number]
        halves[number * BLOCK : number * BLOCK + len(block)] = features.stored(block) / channel_scale

    parallel(convert, range(len(blocks)))
    arrays, header = _contents(
        features.space,
        features.mean,
        features.basis,
        rows=rows.astype(np.int32),
        halves=halves,
        channel_scale=channel_scale,
        weights=features.weights[rows],
        confidence=None if features.confidence is None else features.confidence[rows].astype(np.float16),
        settings=settings,
        fingerprint=fingerprint,
    )
    write_archive(path, arrays, header)


def _contents(
    space: FeatureSpace,
    mean: Float32[np.ndarray, " D"],
    basis: FeatureBasis | None,
    *,
    rows: Int32[np.ndarray, " n"],
    halves: Float16[np.ndarray, "n channels"],
    channel_scale: Float32[np.ndarray, " channels"],
    weights: Float32[np.ndarray, " n"],
    confidence: Float16[np.ndarray, " n"] | None,
    settings: Mapping[str, Any],
    fingerprint: str,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a file of features of the seen rows."""
    arrays, header = space_parts(space, mean, basis)
    arrays |= {"rows": rows, "features": halves, "channel_scale": channel_scale, "weights": weights}
    if confidence is not None:
        arrays["confidence"] = confidence
    return arrays, header | {"settings": dict(settings), "fingerprint": fingerprint}


def features_bytes(
    space: FeatureSpace,
    rows: int,
    rank: int,
    settings: Mapping[str, Any] = {},
    *,
    basis: bool = True,
    confidence: bool = False,
) -> int:
    """The size of the file that `save_features` would write for a number of seen Gaussians; `basis` and `confidence`
    are whether the coordinates are in one, and whether the features have it."""
    mean, components = (shape_only("float32", shape) for shape in ((space.channels,), (rank, space.channels)))
    arrays, header = _contents(
        space,
        mean,
        FeatureBasis(mean=mean, components=components, energy_kept=LONGEST_SHARE, space=space) if basis else None,
        rows=shape_only("int32", (rows,)),
        halves=shape_only("float16", (rows, rank)),
        channel_scale=shape_only("float32", (rank,)),
        weights=shape_only("float32", (rows,)),
        confidence=shape_only("float16", (rows,)) if confidence else None,
        settings=settings,
        fingerprint="0" * FINGERPRINT_DIGITS,
    )
    return archive_bytes(arrays, header)


def holds_features(folder: Path) -> bool:
    """Whether a folder holds the features of a scene itself."""
    return (folder / SCENE_FILE).is_file() or (folder / PACKAGE_FILE).is_file()


def load_features(folder: str | Path) -> Scene:
    """The scene and its features from a folder that `save_features`, `save_memories` or `save_package` wrote: by the
    name of their space, or, where there are those of several teachers, by teacher."""
    folder = Path(folder)
    if not holds_features(folder):
        raise InputError(
            f"{folder}: {kind_of_path(folder)}, without {SCENE_FILE}; expected a folder of features, which "
            "`gsencoder fuse`, `encode`, `memory` and `pack` write"
        )
    if (folder / PACKAGE_FILE).is_file():
        if (folder / SCENE_FILE).is_file():
            raise InputError(f"{folder}: holds {SCENE_FILE} and {PACKAGE_FILE}, two kinds of features; keep one")
        return load_package(folder)
    scene, gaussians = _load_scene(folder)
    files = _files_of_teachers(folder, FEATURES_FILE)
    if _files_of_teachers(folder, MEMORY_FILE):
        if files:
            raise InputError(f"{folder}: holds features and memories, two kinds of features; keep one")
        features = {name: each.features() for name, each in _read_memories(folder, gaussians).items()}
    else:
        files = files or {None: FEATURES_FILE}
        features = {name: _load_rows(folder, file, gaussians) for name, file in files.items()}
    return replace(scene, features={name or each.space.name: each for name, each in features.items()})


def load_memories(folder: str | Path) -> dict[str | None, QueryMemory]:
    """The memories of a folder that `save_memories` wrote, by teacher; the name of a single one is None."""
    folder = Path(folder)
    if not folder.is_dir() or not _files_of_teachers(folder, MEMORY_FILE):
        raise InputError(
            f"{folder}: {kind_of_path(folder)}, without {MEMORY_FILE}; expected a folder with a memory, which "
            "`gsencoder memory` writes"
        )
    return _read_memories(folder, _load_scene(folder)[1])


def _read_memories(folder: Path, gaussians: Gaussians) -> dict[str | None, QueryMemory]:
    memories = {}
    for name, file in (_files_of_teachers(folder, MEMORY_FILE) or {None: MEMORY_FILE}).items():
        with _open(folder, file) as archive:
            memories[name] = read_memory(archive, gaussians)
    return memories


def _files_of_teachers(folder: Path, file: str) -> dict[str | None, str]:
    """The files of a kind in a folder by teacher; the name of a single one is None."""
    teachers = teachers_in(folder, file)
    if not (folder / file).is_file():
        return {name: file_of_teacher(file, name) for name in teachers}
    if teachers:
        raise InputError(f"{folder}: holds {file} and those of {', '.join(teachers)}, of two runs; keep one")
    return {None: file}


def _load_scene(folder: Path) -> tuple[Scene, Gaussians]:
    """The scene of a folder, and its Gaussians."""
    with _open(folder, SCENE_FILE) as file:
        gaussians = Gaussians(
            means=file.array("means", "float32", ("N", 3)),
            quats=file.array("quats", "float32", ("N", 4)),
            scales=file.array("scales", "float32", ("N", 3)),
            opacities=file.array("opacities", "float32", ("N",)),
            sh=file.array("sh", "float32", ("N", "K", 3)),
        )
        return read_scene(file, gaussians), gaussians


def _open(folder: Path, name: str) -> AbstractContextManager[Archive]:
    if not (folder / name).is_file():
        raise InputError(f"{folder}: {name} is missing; expected a folder written by fuse, encode, pack or memory")
    return open_archive(folder / name)


def _load_rows(folder: Path, name: str, gaussians: Gaussians) -> GaussianFeatures:
    with _open(folder, name) as file:
        check_splat(file, gaussians, "fuse or encode this splat again")
        rows, n = file.array("rows", "int32", ("n",)), len(gaussians)
        if not is_strictly_increasing(rows, n):
            raise InputError(f"expected row numbers that rise from 0 to at most {n - 1}")
        scale = file.array("channel_scale", "float32", ("R",))
        seen = file.array("weights", "float32", ("n",))
        if (scale <= 0).any() or (seen <= 0).any():
            raise InputError("expected channel_scale and weights above 0")
        values, weights = np.zeros((n, len(scale)), np.float32), np.zeros(n, np.float32)
        values[rows] = file.array("features", "float16", ("n", "R")).astype(np.float32) * scale
        weights[rows] = seen
        space, mean, basis = read_space(file)
        confidence = None
        if "confidence" in file:
            confidence = np.zeros(n, np.float32)
            confidence[rows] = file.array("confidence", "float16", ("n",))
        return GaussianFeatures(
            features=values, weights=weights, mean=mean, space=space, basis=basis, confidence=confidence
        )


SAMPLE = 20_000
"""Gaussians from which axes are computed."""
AXES_BLOCK = 65_536
"""Rows that are turned to their principal axes at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PrincipalAxes:
    """The axes of some features.

    Attributes:
        axes: in the coordinates of the features, those with most energy first.
        errors: mean of 1 − centered cosine with the first 1, 2, … of them.
        energies: shares of the energy of directions that these keep.
    """

    axes: Float64[np.ndarray, "R R"]
    errors: Float64[np.ndarray, " R"]
    energies: Float64[np.ndarray, " R"]

    def rank_within(self, error: float) -> int:
        """The smallest number of axes that keeps an error; all of them where none does."""
        within = np.flatnonzero(self.errors <= error)
        return int(within[0]) + 1 if len(within) else len(self.errors)

    def reduced(self, features: GaussianFeatures, rank: int) -> GaussianFeatures:
        """The features that the axes are of, with `rank` coordinates."""
        axes, basis = self.axes[:rank], features.basis
        values = np.zeros((len(features), rank), np.float32)
        seen = np.flatnonzero(features.seen)
        for start in range(0, len(seen), AXES_BLOCK):
            rows = seen[start : start + AXES_BLOCK]
            values[rows] = centered_rows(features, rows) @ axes.T
        reduced = FeatureBasis(
            mean=features.mean,
            components=np.ascontiguousarray(axes if basis is None else axes @ basis.components, np.float32),
            energy_kept=float(self.energies[rank - 1]) * (1.0 if basis is None else basis.energy_kept),
            space=features.space,
        )
        return replace(features, features=values, basis=reduced)


def principal_axes(features: GaussianFeatures) -> PrincipalAxes:
    """The axes of features without an index, on an evenly spaced sample; each direction counts the same."""
    seen = np.flatnonzero(features.seen)
    values = centered_rows(features, seen[even_indices(len(seen), SAMPLE)])
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    unit = values[norms[:, 0] > 0] / norms[norms[:, 0] > 0]
    _, vectors = np.linalg.eigh(unit.T @ unit)
    axes = vectors[:, ::-1].T
    shares = np.square(unit @ axes.T).cumsum(axis=1)
    if not len(unit):
        return PrincipalAxes(axes=axes, errors=np.zeros(len(axes)), energies=np.ones(len(axes)))
    return PrincipalAxes(
        axes=axes,
        errors=np.maximum(1 - np.sqrt(shares).mean(axis=0), 0),
        energies=np.minimum(shares.mean(axis=0), 1),
    )


class Reduced(NamedTuple):
    """Features whose files keep a limit of megabytes.

    Attributes:
        error: that leaving out coordinates adds, of the teacher that loses most.
    """

    features: dict[str, GaussianFeatures]
    ranks: dict[str, int]
    error: float
    megabytes: float


def reduce_to_fit(
    features: Mapping[str, GaussianFeatures], budget: Budget, header: Mapping[str, Any], *, error: float = 0.0
) -> Reduced:
    """Features with as many coordinates as fit into a limit of megabytes, or as a limit of error needs. Teachers share
    the bytes in proportion to what all their coordinates take.

    Args:
        header: the settings that `save_features` writes with them, which take bytes.
        error: what features may lose where the budget limits the error.
    """
    limit = budget.limit("megabytes") * MEGABYTE

    def size(name: str, rank: int) -> int:
        each = features[name]
        # All channels have no basis, which takes bytes of its own.
        all_channels = each.basis is None and rank == each.features.shape[1]
        stated = each.confidence is not None
        return features_bytes(each.space, int(each.seen.sum()), rank, header, basis=not all_channels, confidence=stated)

    full = {name: each.features.shape[1] for name, each in features.items()}
    full_sizes = {name: size(name, rank) for name, rank in full.items()}
    ranks, lost, reduced = dict(full), 0.0, dict(features)
    if sum(full_sizes.values()) > limit:
        for name, each in features.items():
            axes, share = principal_axes(each), limit * full_sizes[name] / sum(full_sizes.values())
            fitting = [rank for rank in range(1, full[name] + 1) if size(name, rank) <= share]
            needed = axes.rank_within(error) if "error" in budget.limits else 1
            ranks[name] = rank = max([needed, *fitting])
            if rank < full[name]:
                reduced[name] = axes.reduced(each, rank)
                lost = max(lost, float(axes.errors[rank - 1]))
    megabytes = sum(size(name, rank) for name, rank in ranks.items()) / MEGABYTE
    if megabytes > budget.limit("megabytes") and "error" not in budget.limits:
        raise budget.too_small(megabytes)
    return Reduced(reduced, ranks, lost, megabytes)
