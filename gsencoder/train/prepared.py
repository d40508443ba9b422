"""Prepared scenes on disk: Gaussians, their targets, and the rows of the render loss of every view; and their classes.

A scene's file is memory-mapped: a sample reads only its Gaussians and views, and data workers on one machine share the
page cache. Data is verified against checksums when it is first read.

Loss weights are by class frequency, since a floor has 10⁵ Gaussians and a spoon has forty. The class of a target is the
nearest vector of a codebook: the vectors of a coded teacher's table, or cluster centers of a dense teacher's features.
A Gaussian of a class with n Gaussians in the dataset is weighted by n^−power.
"""

import hashlib
import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Float64, Int32, Int64

from gsencoder.core.archive import Archive, MappedArrays, open_archive, write_archive
from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError, error_hint, error_prefix, listed, readable
from gsencoder.core.files import read_foreign
from gsencoder.core.settings import first_difference
from gsencoder.data.scene_arrays import camera_arrays, read_cameras
from gsencoder.fusion.basis import BINS, ProjectionSums
from gsencoder.models.output_space import OutputSpace, read_output_space
from gsencoder.types import Cameras, GaussianFeatures, Gaussians, Scene, Teacher

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
    """The blending matrix B of one view, in compressed rows as in `gsencoder.render.Blend`, with a row for each cell of
    the teacher's grid; the teacher's vectors in the cells, in standard units, and the cells in which it has one."""

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
        features: fused features, in the basis of `outputs`.
        views: matrix and teacher's vectors for each camera.
        source: the path that the scene was read from, by which the file is recognized; None if nobody looks for it.
        precision: of the targets, and of the teacher's vectors in the rows.
        projections: how well the basis represents the teacher's vectors in this scene; None without a basis.
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
    header = {
        "source": "" if source is None else str(source.resolve()),
        "source_files": "" if source is None else digest_of_files(source),
        "views": list(scene.views.names),
        "metres_per_unit": scene.metres_per_unit,
        "up": None if scene.up is None else scene.up.tolist(),
    }
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
    """Checks the shapes of all arrays, and the values of those that are read for all Gaussians. Entries of B and
    targets are checked when they are read."""
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
    """A hash of the names and sizes of the files of a scene, by which it is recognized where it was moved to. Contents
    are not read: thousands of scenes are looked at before a training begins."""
    if source.is_dir():
        files = (Path(folder) / name for folder, _, names in os.walk(source) for name in names)
        rows = sorted(f"{path.relative_to(source).as_posix()} {path.stat().st_size}" for path in files)
    else:
        rows = [str(source.stat().st_size)] if source.exists() else []
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()[:16] if rows else ""


class ScenePart(ABC):
    """What one teacher says of a scene, by Gaussian and by view; targets are in standard units of the encoder."""

    path: Path
    name: str
    voxel: float | None = None
    """Edge of the token grid that the Gaussians are meant for, metres; None = any."""

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    @abstractmethod
    def cameras(self) -> Cameras: ...

    @property
    @abstractmethod
    def view_names(self) -> tuple[str, ...]: ...

    @property
    @abstractmethod
    def metres_per_unit(self) -> float | None: ...

    @property
    @abstractmethod
    def up(self) -> Float64[np.ndarray, "3"] | None: ...

    @property
    @abstractmethod
    def means(self) -> Float32[np.ndarray, "N 3"]: ...

    @property
    @abstractmethod
    def weights(self) -> Float32[np.ndarray, " N"]:
        """The weight of each Gaussian's target; 0 = it has none."""

    @abstractmethod
    def gaussians(self, rows: np.ndarray) -> Gaussians:
        """Gaussians by row, with degree-0 colors."""

    @abstractmethod
    def targets(self, rows: np.ndarray) -> Float32[np.ndarray, "n channels"]:
        """Targets by row; zero for Gaussians without a target."""

    @abstractmethod
    def float16_targets(self, rows: np.ndarray) -> Float16[np.ndarray, "n channels"]:
        """The same in float16, as samples hold them."""

    @abstractmethod
    def codes(self, codebook: Float32[np.ndarray, "C channels"]) -> Int32[np.ndarray, " N"]:
        """The class of each Gaussian's target, −1 without a target."""

    @abstractmethod
    def view(self, view: int) -> ViewRows:
        """The blending matrix and the teacher's vectors of one view."""

    @abstractmethod
    def close(self) -> None:
        """Closes what is open; the next access opens it again."""


class PreparedScene(ScenePart):
    """A prepared scene, opened on first access, so that it can be sent to data workers."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        self._closed: MappedArrays | None = None

    def __reduce__(self) -> tuple[type["PreparedScene"], tuple[Path]]:
        return PreparedScene, (self.path,)

    @cached_property
    def _arrays(self) -> MappedArrays:
        with self._error_context():
            types, views = array_types(self.precision), len(self.cameras)
            arrays = MappedArrays(self.path, types, self._closed)
            check_arrays(arrays, views)
        return arrays

    @cached_property
    def _header(self) -> tuple[Cameras, float | None, list[float] | None, tuple[str, ...]]:
        with self._error_context(), open_archive(self.path) as file:
            names = tuple(str(name) for name in file.value("views", list))
            cameras, unit, up = (
                read_cameras(file),
                file.value("metres_per_unit", float, int, None),
                file.value("up", list, None),
            )
            if len(names) != len(cameras):
                raise InputError(f"expected as many names of views as cameras, got {len(names)} and {len(cameras)}")
            if unit is not None and not 0 < unit < math.inf:
                raise InputError(f"metres_per_unit: expected a positive number, got {unit}")
            if up is not None and (len(up) != 3 or not all(isinstance(value, (int, float)) for value in up)):
                raise InputError(f"up: expected three numbers, got {str(up)[:60]}")
        return cameras, unit, up, names

    @cached_property
    def _scales(self) -> dict[str, Float32[np.ndarray, " channels"]]:
        """The scales of the columns of quantized arrays; none of float16."""
        with self._error_context(), open_archive(self.path) as file:
            if stored_precision(file) == "float16":
                return {}
            scales = {name: file.array(stored, "float32", ("channels",)) for name, stored in SCALES.items()}
            if not all((of_columns > 0).all() for of_columns in scales.values()):
                raise InputError("expected positive scales of the columns of its targets")
            return scales

    @contextmanager
    def _error_context(self) -> Iterator[None]:
        """Adds the path and the remedy to errors of reading."""
        with error_prefix(self.path), error_hint("remove the file to prepare the scene again"):
            yield

    def projections(self) -> ProjectionSums | None:
        """How well the basis represents the teacher's vectors in this scene; None without a basis."""
        with self._error_context(), open_archive(self.path) as file:
            if "sums_of_projections" not in file:
                return None
            histogram = file.array("cosines_of_projections", "float64", (BINS,))
            return ProjectionSums(histogram, file.array("sums_of_projections", "float64", (3,)))

    def close(self) -> None:
        """Closes the file; the next access opens it again."""
        arrays: MappedArrays | None = self.__dict__.pop("_arrays", None)
        if arrays is not None:
            arrays.close()
            self._closed = arrays

    def __len__(self) -> int:
        return self._arrays.shape("means")[0]

    @property
    def cameras(self) -> Cameras:
        return self._header[0]

    @property
    def metres_per_unit(self) -> float | None:
        return self._header[1]

    @property
    def up(self) -> Float64[np.ndarray, "3"] | None:
        return None if self._header[2] is None else np.array(self._header[2], np.float64)

    @property
    def view_names(self) -> tuple[str, ...]:
        return self._header[3]

    @property
    def precision(self) -> Precision:
        """The type in which targets, and the teacher's vectors in the rows, are stored."""
        return "int8" if self._scales else "float16"

    @property
    def means(self) -> Float32[np.ndarray, "N 3"]:
        return self._arrays.array("means")

    @property
    def weights(self) -> Float32[np.ndarray, " N"]:
        """The fusion weight of each Gaussian; 0 = not seen in any view, and without a target."""
        return self._arrays.array("weights")

    def gaussians(self, rows: np.ndarray) -> Gaussians:
        """Reads Gaussians by row, with degree-0 colors."""
        with self._error_context():
            columns = {
                name: self._arrays.rows(name, rows) for name in ("means", "quats", "scales", "opacities", "sh_dc")
            }
        sh = columns.pop("sh_dc")[:, None]
        return Gaussians(**columns, sh=sh)

    def targets(self, rows: np.ndarray) -> Float32[np.ndarray, "n channels"]:
        """Reads targets of the encoder by row, standard units; zero for Gaussians without a target."""
        with self._error_context():
            return self._scaled("targets", self._arrays.rows("targets", rows)).astype(np.float32, copy=False)

    def codes(self, codebook: Float32[np.ndarray, "C channels"]) -> Int32[np.ndarray, " N"]:
        """The class of each Gaussian's target, −1 without a target; it reads all targets."""
        codes = np.full(len(self), -1, np.int32)
        seen = np.flatnonzero(self.weights)
        codes[seen] = nearest_codes(codebook, self.targets(seen))
        return codes

    def float16_targets(self, rows: np.ndarray) -> Float16[np.ndarray, "n channels"]:
        """The same in float16, as samples hold them."""
        with self._error_context():
            stored = self._arrays.rows("targets", rows)
        if not self._scales:
            return stored
        # In torch, which converts to float16 several times faster than numpy.
        return (torch.from_numpy(stored).float() * torch.from_numpy(self._scales["targets"])).half().numpy()

    def _scaled(self, name: str, stored: np.ndarray) -> Float[np.ndarray, "n channels"]:
        """Rows of an array in standard units: float16 as they are stored, or float32 of integers."""
        return np.multiply(stored, self._scales[name], dtype=np.float32) if name in self._scales else stored

    def view(self, view: int) -> ViewRows:
        """Reads the blending matrix and the teacher's vectors of one view."""
        first, last = (int(row) for row in self._arrays.array("rows")[view : view + 2])
        crow = np.array(self._arrays.array("crow")[first : last + 1])
        start, end = int(crow[0]), int(crow[-1])
        with self._error_context():
            targets = self._scaled("row_targets", self._arrays.rows("row_targets", slice(first, last)))
            view_rows = ViewRows(
                crow=crow - start,
                col=np.array(self._arrays.rows("col", slice(start, end))),
                weight=self._arrays.rows("weight", slice(start, end)).astype(np.float32),
                targets=targets.astype(np.float32, copy=False),
                valid=self._arrays.rows("row_valid", slice(first, last)).astype(bool),
            )
            in_range = (view_rows.col >= 0) & (view_rows.col < len(self))
            if not in_range.all() or not (view_rows.weight >= 0).all() or not np.isfinite(view_rows.targets).all():
                raise InputError(f"view {self.view_names[view]!r}: its columns, weights or targets are out of range")
        return view_rows


CHUNK_ROWS = 16_384
"""Rows of targets that are compared with the codebook in one matrix product."""
MAX_CLUSTERS = 128
"""Largest number of target classes of a dense teacher."""


def nearest_codes(
    codebook: Float32[np.ndarray, "C channels"], targets: Float32[np.ndarray, "n channels"]
) -> Int64[np.ndarray, " n"]:
    """The class of each target: the row of the nearest vector of the codebook."""
    half = 0.5 * np.square(codebook, dtype=np.float64).sum(axis=1).astype(np.float32)
    codes = [
        (targets[start : start + CHUNK_ROWS] @ codebook.T - half).argmax(axis=1)
        for start in range(0, len(targets), CHUNK_ROWS)
    ]
    return np.concatenate(codes) if codes else np.zeros(0, np.int64)


def cluster_targets(sample: Float32[np.ndarray, "n channels"], *, seed: int = 0) -> Float32[np.ndarray, "C channels"]:
    """A codebook for targets of a dense teacher: cluster centers of a sample of them."""
    from sklearn.cluster import MiniBatchKMeans

    subsample = sample[:: max(1, len(sample) // 4096)]
    count = min(MAX_CLUSTERS, len(np.unique(subsample, axis=0)))
    kmeans = MiniBatchKMeans(n_clusters=count, random_state=seed, batch_size=4096, n_init=3).fit(sample)
    return np.asarray(kmeans.cluster_centers_, dtype=np.float32)


SPACE_FILE, CODEBOOK_FILE = "space.safetensors", "codebook.safetensors"
CLUSTERED_TARGETS = 200_000
"""Approximate number of targets, over all scenes, from which classes of a dense teacher are clustered."""


class PreparedDataset:
    """A folder of prepared scenes that share an output space, whose file holds what the preparation depends on.

    The file of each scene is written atomically, so that an interrupted preparation can be continued, and several
    processes can share the work.
    """

    def __init__(self, folder: Path, settings: dict[str, Any] | None = None) -> None:
        """Opens the folder, which is created with the space; `settings` are everything that the preparation depends on,
        compared with those stored in it, and None = open an existing dataset with any settings."""
        self.folder, path = folder, folder / SPACE_FILE
        self.settings: dict[str, Any] = json.loads(json.dumps(settings, default=str)) if settings is not None else {}
        with error_hint("give another folder as prepared="):
            if not path.is_file():
                if settings is None:
                    raise InputError(f"{folder}: expected prepared scenes, found no {SPACE_FILE}")
                with readable(folder):
                    if folder.exists() and any(not entry.name.startswith(".") for entry in folder.iterdir()):
                        raise InputError(f"{folder}: holds something else than prepared scenes (no {SPACE_FILE})")
                return
            with open_archive(path) as file:
                stored = file.value("made_with", dict)
            if settings is not None and stored != self.settings:
                raise InputError(f"{folder}: was prepared with {first_difference(stored, self.settings)}")
            self.settings = stored

    def fingerprint(self) -> str:
        """A hash of the output space, by which a resumed training checks that its targets are the same."""
        with readable(self.folder / SPACE_FILE):
            return hashlib.sha256(read_foreign(self.folder / SPACE_FILE)).hexdigest()[:16]

    def digest_of_scenes(self, names: Sequence[str]) -> str:
        """A hash of the headers of prepared scenes, which hold the checksums of all arrays."""
        digest = hashlib.sha256()
        for name in names:
            path = self.scene_path(name)
            if path.is_file():
                with open_archive(path) as file:
                    digest.update(f"{name} {file.value('digest', str)}".encode())
        return digest.hexdigest()[:16]

    def load_kinds(self) -> tuple[str, ...]:
        """Loads the names of the things that the teacher tells apart; none for a teacher without names."""
        with error_hint("give another folder as prepared="), open_archive(self.folder / SPACE_FILE) as file:
            kinds = file.value("kinds", list)
            if not all(isinstance(kind, str) for kind in kinds):
                raise InputError("expected names as the kinds in the header")
        return tuple(kinds)

    def load_space(self) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None]:
        """Loads the output space, and for a coded teacher the vectors of its codes in standard units, else None."""
        with error_hint("give another folder as prepared="), open_archive(self.folder / SPACE_FILE) as file:
            outputs = read_output_space(file)
            codebook = file.array("codebook", "float32", ("C", outputs.channels)) if "codebook" in file else None
        return outputs, codebook

    @property
    def precision(self) -> Precision:
        """How the targets of its scenes are stored."""
        return "int8" if dict(self.settings.get("prepare") or {}).get("targets") == "int8" else "float16"

    def scene_path(self, name: str) -> Path:
        """The path of a scene's file, which exists once the scene is prepared."""
        return self.folder / "scenes" / f"{name}.safetensors"

    def has_scene(self, source: Path) -> bool:
        """Whether the scene at this path is prepared, from this path or from another one with the same files."""
        path = self.scene_path(source.name)
        if not path.is_file():
            return False
        with error_hint("remove the file to prepare the scene again"), open_archive(path) as file:
            stored_source = file.value("source", str)
            files = file.value("source_files", str)
            if (got := stored_precision(file)) != self.precision:
                raise InputError(f"expected targets of {self.precision}, as the settings of its folder say, got {got}")
        # A data set that was moved, or is mounted elsewhere on another machine, holds the same files.
        if stored_source != str(source.resolve()) and not (files and files == digest_of_files(source)):
            raise InputError(
                f"{path}: was prepared from {stored_source}, but this run uses {source.resolve()}; prepared scenes "
                "need distinct names: rename one, or give another folder as prepared="
            )
        return True

    def check_kinds(self, teacher: Teacher) -> None:
        """Checks that a scene to train on has no names that the dataset's classes lack, such as those of labels that
        were added since."""
        if teacher.table is None:
            return
        kinds = self.load_kinds()
        new = [kind for kind in getattr(teacher, "kinds", ()) if kind not in kinds]
        if kinds and new:
            raise InputError(
                f"{self.folder}: the classes of this dataset lack {listed(new, 3)}, since the scene has changed; give "
                "another folder as prepared="
            )

    def cluster_classes(self, names: Sequence[str]) -> None:
        """Stores the classes of targets that have no names, clusters of those of the training scenes, unless they are
        stored already; the first process of a training calls this."""
        path = self.folder / CODEBOOK_FILE
        if self.load_space()[1] is not None or path.is_file():
            return
        scenes = self.scenes(names)
        share = max(1, CLUSTERED_TARGETS // len(scenes))
        codebook = cluster_targets(np.concatenate([_seen_targets(scene, share) for scene in scenes]))
        write_archive(path, {"codebook": codebook}, {"scenes": [scene.name for scene in scenes]})

    def load_codebook(self) -> Float32[np.ndarray, "C channels"]:
        """The vectors of the target classes, in standard units."""
        outputs, codebook = self.load_space()
        if codebook is not None:
            return codebook
        path = self.folder / CODEBOOK_FILE
        with error_hint("remove the file to cluster targets again"), open_archive(path) as file:
            return file.array("codebook", "float32", ("C", outputs.channels))

    def find_scene(self, name: str) -> PreparedScene | None:
        """Opens a prepared scene by name; None if it is not prepared, for lack of what the teacher needs."""
        path = self.scene_path(name)
        return PreparedScene(path) if path.is_file() else None

    def scenes(self, names: Sequence[str]) -> list[PreparedScene]:
        """Opens prepared scenes by name; those that are not prepared are left out."""
        return [scene for name in names if (scene := self.find_scene(name)) is not None]


def _seen_targets(scene: PreparedScene, max_targets: int) -> Float32[np.ndarray, "n channels"]:
    """The targets of the seen Gaussians of a scene, at most `max_targets` of them, evenly spaced; it is closed."""
    rows = np.flatnonzero(scene.weights)
    targets = scene.targets(rows[:: -(-len(rows) // max_targets)])
    scene.close()
    return targets
