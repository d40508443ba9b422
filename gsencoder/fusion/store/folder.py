"""Features on disk: a folder that holds the Gaussians, the cameras and their features.

Features of one teacher are in `features.safetensors`, those of several in a file each, `features.TEACHER.safetensors`.
Memories, which are decoded to features when they are read, are in `memory.safetensors` or `memory.TEACHER.safetensors`.
Arrays are safetensors files, memory-mapped on load; features are float16 for seen rows only. The folder is all that
localization needs: no photographs, no teacher.
"""

import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float16, Float32, Int32

from gsencoder.core.archive import (
    LONGEST_SHARE,
    Archive,
    archive_bytes,
    open_archive,
    shape_only,
    write_archive,
)
from gsencoder.core.arrays import rise_within
from gsencoder.core.errors import InputError
from gsencoder.core.process import parallel
from gsencoder.data.scene_arrays import check_splat, read_scene, read_space, scene_parts, space_parts
from gsencoder.data.scenes import kind_of_path
from gsencoder.data.splats.files import FINGERPRINT_DIGITS, fingerprint
from gsencoder.fusion.store.memory_file import MEMORY_FILE, read_memory, write_memory
from gsencoder.fusion.store.package import PACKAGE_FILE, load_package
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, Gaussians, QueryMemory, Scene

SCENE_FILE, FEATURES_FILE = "scene.safetensors", "features.safetensors"
BLOCK = 16_384
"""Rows that are turned into half precision at a time."""
WORDS_FILE = "words.safetensors"
"""The text table whose words lead into the features, beside them where there is one."""
TEACHER_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
"""Form of the names of teachers, which are parts of names of files."""


def file_of_teacher(file: str, teacher: str | None) -> str:
    """The name of a file for one of several teachers, such as `features.labels.safetensors`; None = the only one."""
    stem, dot, suffix = file.partition(".")
    return file if teacher is None else f"{stem}.{teacher}{dot}{suffix}"


def teachers_in(folder: Path, file: str) -> list[str]:
    """The teachers of which a folder has such files."""
    stem, dot, suffix = file.partition(".")
    form = re.compile(re.escape(stem) + rf"\.({TEACHER_NAME})" + re.escape(dot + suffix))
    return sorted(match[1] for path in folder.iterdir() if (match := form.fullmatch(path.name)))


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

    Raises:
        InputError: features of another number of Gaussians, or not finite, or a folder that cannot be written.
    """
    folder, gaussians = Path(folder), scene.gaussians
    if isinstance(features, GaussianFeatures):
        features = {features.space.name: features}
    single = len(features) == 1
    by_file = {file_of_teacher(FEATURES_FILE, None if single else name): each for name, each in features.items()}
    wrong = [len(each) for each in by_file.values() if gaussians is None or len(gaussians) != len(each)]
    if gaussians is None or wrong:
        raise InputError(f"save_features: {wrong[0]} features need as many Gaussians in scene {scene.name}")
    _write_scene(folder, scene, gaussians)
    for name, each in by_file.items():
        _write_rows(folder / name, each, settings, fingerprint(gaussians))


def save_memories(
    folder: str | Path, scene: Scene, memories: Mapping[str, QueryMemory], settings: Mapping[str, Any] = {}
) -> None:
    """Writes a scene and its memories, which every command that takes features reads as features.

    Args:
        folder: made if it does not exist, as in `save_features`.
        scene: with the Gaussians that the queries belong to.
        memories: by teacher.
        settings: what made them, as JSON values.

    Raises:
        InputError: queries of another number of Gaussians, or a folder that cannot be written.
    """
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
    around, header = scene_parts(scene)
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    write_archive(folder / SCENE_FILE, arrays | around, header)


def _write_rows(path: Path, features: GaussianFeatures, settings: Mapping[str, Any], fingerprint: str) -> None:
    """Writes the features of seen rows."""
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
    settings: Mapping[str, Any],
    fingerprint: str,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a file of features of the seen rows."""
    arrays, header = space_parts(space, mean, basis)
    arrays |= {"rows": rows, "features": halves, "channel_scale": channel_scale, "weights": weights}
    return arrays, header | {"settings": dict(settings), "fingerprint": fingerprint}


def features_bytes(
    space: FeatureSpace, rows: int, rank: int, settings: Mapping[str, Any] = {}, *, basis: bool = True
) -> int:
    """The size of the file that `save_features` would write.

    Args:
        space: of the features.
        rows: number of Gaussians that were seen.
        rank: coordinates of each.
        settings: as `save_features` takes them.
        basis: whether the coordinates are in a basis.
    """
    mean, components = (shape_only("float32", shape) for shape in ((space.channels,), (rank, space.channels)))
    arrays, header = _contents(
        space,
        mean,
        FeatureBasis(mean=mean, components=components, energy_kept=LONGEST_SHARE, space=space) if basis else None,
        rows=shape_only("int32", (rows,)),
        halves=shape_only("float16", (rows, rank)),
        channel_scale=shape_only("float32", (rank,)),
        weights=shape_only("float32", (rows,)),
        settings=settings,
        fingerprint="0" * FINGERPRINT_DIGITS,
    )
    return archive_bytes(arrays, header)


def holds_features(folder: Path) -> bool:
    """Whether a folder holds the features of a scene itself."""
    return (folder / SCENE_FILE).is_file() or (folder / PACKAGE_FILE).is_file()


def load_features(folder: str | Path) -> Scene:
    """The scene and its features from a folder that `save_features`, `save_memories` or `save_package` wrote: by the
    name of their space, or, where there are those of several teachers, by teacher.

    Raises:
        InputError: not such a folder, damaged, of another version, or features of another splat.
    """
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
    """The memories of a folder that `save_memories` wrote, by teacher; the name of a single one is None.

    Raises:
        InputError: not such a folder, damaged, of another version, or memories of another splat.
    """
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
    """The files of a kind in a folder by teacher; the name of a single one is None.

    Raises:
        InputError: there are those of one teacher and of several.
    """
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
        if not rise_within(rows, n):
            raise InputError(f"expected row numbers that rise from 0 to at most {n - 1}")
        scale = file.array("channel_scale", "float32", ("R",))
        seen = file.array("weights", "float32", ("n",))
        if (scale <= 0).any() or (seen <= 0).any():
            raise InputError("expected channel_scale and weights above 0")
        values, weights = np.zeros((n, len(scale)), np.float32), np.zeros(n, np.float32)
        values[rows] = file.array("features", "float16", ("n", "R")).astype(np.float32) * scale
        weights[rows] = seen
        space, mean, basis = read_space(file)
        return GaussianFeatures(features=values, weights=weights, mean=mean, space=space, basis=basis)
