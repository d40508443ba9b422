"""Features on disk: a folder that holds the Gaussians, the cameras and their features.

Features of one teacher are in `features.safetensors`, those of several in a file each, `features.TEACHER.safetensors`.
Memories, which are decoded to features when they are read, are in `memory.safetensors` or `memory.TEACHER.safetensors`.
Arrays are safetensors files, memory-mapped on load; features are float16 for seen rows only. The folder is all that
localization needs: no photographs, no teacher. Next to them may lie text tables, and adapter heads, whose layers
`gsencoder.fusion.measured_heads` reads with torch.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float16, Float32, Int32

from gsencoder.core.archive import (
    LONGEST_SHARE,
    Archive,
    archive_bytes,
    copy_checked,
    open_archive,
    shape_only,
    verify_archive,
    write_archive,
)
from gsencoder.core.arrays import is_strictly_increasing
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
from gsencoder.text.table import TextTable, load_text_table, save_text_table
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
WORDS_FILE = "words.safetensors"
"""The text table whose words lead into the features, where there is one."""
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
    around, header = scene_parts(scene)
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
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
    """The size of the file that `save_features` would write for a number of seen Gaussians; `basis` is whether the
    coordinates are in one."""
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
        return GaussianFeatures(features=values, weights=weights, mean=mean, space=space, basis=basis)


def save_tables(
    folder: Path,
    tables: Mapping[str, TextTable],
    teachers: Iterable[str],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes text tables, by the teacher in whose space they are, next to features or weights. `teachers` are all of
    the features or the encoder, with tables or not; a single one is not named in files."""
    single = len(list(teachers)) == 1
    for teacher, table in tables.items():
        save_text_table(folder / file_of_teacher(WORDS_FILE, None if single else teacher), table, dtype=dtype)


def load_tables(folder: Path, teachers: Iterable[str]) -> dict[str, TextTable]:
    """The text tables of a folder by teacher; teachers without a file are left out."""
    names = list(teachers)
    paths = {name: folder / file_of_teacher(WORDS_FILE, name if len(names) > 1 else None) for name in names}
    return {name: load_text_table(path) for name, path in paths.items() if path.is_file()}


def table_path(folder: Path, text_encoder: str) -> Path | None:
    """The file in a folder of features whose words lead into the features of a space with this text encoder; None where
    there is none, and an InputError where there are only those of other spaces."""
    if (folder / WORDS_FILE).is_file():
        return folder / WORDS_FILE
    if not text_encoder:
        return None
    paths = [folder / file_of_teacher(WORDS_FILE, teacher) for teacher in teachers_in(folder, WORDS_FILE)]
    encoders = {path: load_text_table(path).space.text_encoder for path in paths}
    fitting = [path for path, encoder in encoders.items() if encoder == text_encoder]
    if paths and not fitting:
        raise InputError(
            f"{folder}: no {file_of_teacher(WORDS_FILE, 'TEACHER')} holds words of {text_encoder}, which lead into "
            f"these features (there are words of {', '.join(sorted(set(encoders.values())))}): the file was lost; give "
            "words= or text=, or name other features with space="
        )
    return fitting[0] if fitting else None


HEADS_FILE = "heads.safetensors"
"""The adapter heads that take the features, where there are some."""


def find_heads(weights: Path) -> Path | None:
    """The file of adapter heads of an encoder's file, or None: heads.safetensors in its folder, and for an exported
    graph `heads_of_graph`."""
    path = heads_of_graph(weights) if weights.suffix.lower() == ".onnx" else weights.with_name(HEADS_FILE)
    return path if path.is_file() else None


def heads_of_graph(graph: Path) -> Path:
    """Where the adapter heads of an exported graph lie: FILE.onnx.heads.safetensors."""
    return graph.with_name(f"{graph.name}.{HEADS_FILE}")


def copy_heads(
    source: Path, target: Path, spaces: Sequence[FeatureSpace], *, left_out: Sequence[FeatureSpace] = ()
) -> None:
    """Copies a file of adapter heads; an earlier one is replaced once the copy is whole.

    Args:
        spaces: of the features or the weights, one for each teacher; the heads take features of one of them.
        left_out: spaces of the other teachers of the source; heads that take features of these are not copied.
    """
    with open_archive(source) as file:
        heads = read_heads_space(file)
        if heads in left_out:
            return
        check_heads_space(heads, next((space for space in spaces if space == heads), spaces[0]))
        file.verify()
    copy_checked(source, target, verify_archive)


def read_heads_space(file: Archive) -> FeatureSpace:
    """The space of the features that the heads of a file take."""
    values = file.value("space", dict)
    if set(values) != set(FeatureSpace.__dataclass_fields__):
        raise InputError(f"expected a feature space with {', '.join(FeatureSpace.__dataclass_fields__)}")
    return FeatureSpace(**values)


def check_heads_space(heads: FeatureSpace, features: FeatureSpace) -> None:
    if heads != features:
        raise InputError(
            f"the heads take features of ({heads.describe()}), and these are of ({features.describe()}); expected "
            "heads of the same backbone with the same settings"
        )
