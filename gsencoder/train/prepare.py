"""Preparation of scenes for training: everything that does not depend on the encoder is computed once and stored.

Loss weights are by class frequency, since a floor has 10⁵ Gaussians and a spoon has forty. The class of a target is the
nearest vector of a codebook: the vectors of a coded teacher's table, or cluster centers of a dense teacher's features.
A Gaussian of a class with n Gaussians in the dataset is weighted by n^−power.
"""

import hashlib
import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, error_hint, listed, readable
from gsencoder.core.files import locked, read_foreign
from gsencoder.core.process import ProcessRank, Track
from gsencoder.core.settings import check_limits, first_difference, option
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.checkpoint import CachedTeacher, upright
from gsencoder.fusion.errors import project_maps
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import limit_rays, row_mask
from gsencoder.models.output_space import OutputSpace, read_output_space
from gsencoder.render import blend
from gsencoder.teachers.base import Teacher
from gsencoder.train.distributed import fail_together, summed_array, value_of_first
from gsencoder.train.prepared_file import (
    Precision,
    PreparedScene,
    ViewRows,
    digest_of_files,
    stored_precision,
    write_prepared,
)
from gsencoder.types import FeatureMap, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareConfig:
    """Settings of targets and of the matrices of the render loss."""

    fusion: FuseConfig = field(default_factory=FuseConfig)
    render_cell: int = option(
        8, "smallest side of a cell of the render loss, pixels; finer teacher maps are averaged", ge=1
    )
    render_min_weight: float = option(1e-3, "smallest blending weight in the matrices of the render loss", ge=0, lt=1)
    render_views: int = option(
        0,
        "views of a scene, evenly spaced, whose matrices are stored and from which samples draw theirs; "
        "0 = all. Targets are fused from all views in any case",
        ge=0,
    )
    basis_views: int = option(256, "number of maps from which the basis of a dense teacher is computed", ge=1)

    center: bool = option(True, "subtract the teacher's mean from targets; false needs fusion.basis=false")
    scale: bool = option(True, "divide targets by their typical distance from the mean; false = in the teacher's units")

    targets: Precision = option(
        "float16",
        "how targets and the teacher's vectors of the render loss are stored: float16, or int8 with a "
        "scale for each column, in half the bytes",
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if not self.center and self.fusion.basis:
            raise InputError(
                "center: expected fusion.basis=false with center=false; coordinates in a basis are about the mean"
            )


def prepare_scene(
    path: Path,
    scene: Scene,
    teacher: Teacher,
    outputs: OutputSpace,
    config: PrepareConfig,
    *,
    source: Path | None = None,
    device: torch.device = torch.device("cpu"),
) -> None:
    """Computes and writes a scene's Gaussians, fused targets, and rows of the render loss of `config.render_views`;
    `source` is the path that the scene was read from, and B is made and multiplied on `device`."""
    assert scene.gaussians is not None
    assert scene.views is not None
    fusion = replace(config.fusion, basis=outputs.basis is not None)
    fused = fuse(scene, teacher, fusion, basis=outputs.basis, device=device)
    chosen = even_indices(len(scene.views), config.render_views or len(scene.views))
    rows = view_rows(scene, teacher, outputs, config, chosen, device)
    projections = None if outputs.basis is None else project_maps(outputs.basis, teacher, scene.views, fused.views)
    with_rows = replace(scene, views=scene.views.select(chosen))
    write_prepared(
        path,
        with_rows,
        fused.features,
        outputs,
        rows,
        source=source,
        precision=config.targets,
        projections=projections,
    )


def view_rows(
    scene: Scene,
    teacher: Teacher,
    outputs: OutputSpace,
    config: PrepareConfig,
    views: Int64[np.ndarray, " v"],
    device: torch.device = torch.device("cpu"),
) -> list[ViewRows]:
    """The matrices B of some views on the teacher's grid, pooled to cells of `config.render_cell` pixels, with the
    teacher's vectors."""
    assert scene.gaussians is not None
    assert scene.views is not None
    blending = replace(config.fusion.blend, min_weight=config.render_min_weight)
    rows, teacher = [], upright(teacher)
    for view in views.tolist():
        targets, valid, grid = _pool_map(teacher.feature_map(scene.views, view), outputs, config.render_cell)
        b = blend(
            scene.gaussians, scene.views.cameras, view, like=grid, config=limit_rays(blending, grid), device=device
        )
        if scene.views.masks is not None:
            valid &= row_mask(scene.views.masks[view], b.lattice) == 1
        arrays = tuple(each.cpu().numpy() for each in (b.crow, b.col, b.weight))
        rows.append(ViewRows(crow=arrays[0], col=arrays[1], weight=arrays[2], targets=targets, valid=valid))
    return rows


def _pool_map(
    feature_map: FeatureMap, outputs: OutputSpace, cell: int
) -> tuple[Float32[np.ndarray, "P channels"], Bool[np.ndarray, " P"], FeatureMap]:
    """Pools a feature map to cells of about `cell` pixels or more: their mean vectors in standard units, which of them
    have a vector, and an empty map with their grid. Cells that the pooled grid would have only a part of, at the right
    and lower border, are left out."""
    affine = feature_map.grid_from_image
    side = 1 / float(np.sqrt(affine[0, 0] * affine[1, 1]))
    factor = max(1, round(cell / side))
    height, width = feature_map.height // factor, feature_map.width // factor
    if not height or not width:
        raise InputError(f"prepare: a map of {feature_map.width}×{feature_map.height} has no cell of {cell} pixels")
    if feature_map.codes is not None:
        assert feature_map.table is not None
        # By linearity the shares of the codes in each cell replace the mean over pixels, with far less memory.
        codes = feature_map.codes[: height * factor, : width * factor]
        line, column = np.divmod(np.arange(codes.size), codes.shape[1])
        cell_of = (line // factor) * width + column // factor
        count = len(feature_map.table) + 1
        counts = np.bincount(cell_of * count + codes.ravel() + 1, minlength=height * width * count)
        shares = counts.reshape(height * width, count) / factor**2
        valid = shares[:, 0] == 0
        vectors = (shares[:, 1:] @ _standardize(feature_map.table, outputs)).astype(np.float32)
    else:
        dense = feature_map.rows().reshape(feature_map.height, feature_map.width, -1)
        grid = _standardize(dense, outputs)[: height * factor, : width * factor]
        vectors = grid.reshape(height, factor, width, factor, -1).mean(axis=(1, 3)).reshape(height * width, -1)
        valid = np.isfinite(vectors).all(axis=1)
    like = FeatureMap(
        codes=np.zeros((height, width), np.int32),
        table=np.zeros((1, feature_map.space.channels), np.float32),
        grid_from_image=affine / factor,
        space=feature_map.space,
    )
    return np.where(valid[:, None], vectors, np.float32(0)), valid, like


def _standardize(vectors: np.ndarray, outputs: OutputSpace) -> np.ndarray:
    """Projects vectors [..., D] to the basis, if there is one, and converts them to standard units."""
    flat = vectors.reshape(-1, vectors.shape[-1])
    coordinates = to_coordinates(outputs.basis, flat) if outputs.basis is not None else flat
    return outputs.standardize(coordinates).reshape(*vectors.shape[:-1], outputs.channels)


CHUNK_ROWS = 16_384
"""Rows of targets that are compared with the codebook in one matrix product."""
MAX_CLUSTERS = 128
"""Largest number of target classes of a dense teacher."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassBalance:
    """A codebook of target classes, in standard units, and their numbers of Gaussians in the dataset."""

    codebook: Float32[np.ndarray, "C channels"]
    counts: Float64[np.ndarray, " C"]

    def class_weights(self, power: float) -> Float32[np.ndarray, " C"]:
        """The weight n^−power of each class, scaled so that its mean over the targets of the dataset is 1. Classes
        without Gaussians, to which cells across an edge may be nearest, get that of the most frequent class."""
        counts = np.where(self.counts > 0, self.counts, max(float(self.counts.max()), 1.0))
        weights = counts**-power
        weights *= self.counts.sum() / max(float((weights * self.counts).sum()), 1e-30)
        return weights.astype(np.float32)

    def target_weights(self, targets: Float32[np.ndarray, "n channels"], power: float) -> Float32[np.ndarray, " n"]:
        """The weight of each target's class; with the power 0 all are 1, and classes are not looked up."""
        if power == 0:
            return np.ones(len(targets), np.float32)
        return self.class_weights(power)[nearest_codes(self.codebook, targets)]


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


def count_targets(
    scenes: Iterable[Float32[np.ndarray, "_n channels"]], codebook: Float32[np.ndarray, "C channels"]
) -> ClassBalance:
    """Counts the classes of a dataset's targets, scene by scene."""
    counts = np.zeros(len(codebook))
    for targets in scenes:
        counts += np.bincount(nearest_codes(codebook, targets), minlength=len(codebook))
    return ClassBalance(codebook=codebook, counts=counts)


def cluster_targets(sample: Float32[np.ndarray, "n channels"], *, seed: int = 0) -> Float32[np.ndarray, "C channels"]:
    """A codebook for targets of a dense teacher: cluster centers of a sample of them."""
    from sklearn.cluster import MiniBatchKMeans

    subsample = sample[:: max(1, len(sample) // 4096)]
    count = min(MAX_CLUSTERS, len(np.unique(subsample, axis=0)))
    kmeans = MiniBatchKMeans(n_clusters=count, random_state=seed, batch_size=4096, n_init=3).fit(sample)
    return np.asarray(kmeans.cluster_centers_, dtype=np.float32)


SPACE_FILE, CLASS_BALANCE_FILE = "space.safetensors", "rarity.safetensors"
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

    def prepare(
        self,
        scene: Scene,
        teacher: Teacher,
        config: PrepareConfig,
        *,
        source: Path = Path(),
        device: torch.device = torch.device("cpu"),
    ) -> None:
        """Prepares one scene, which was read from `source`, and writes its file atomically."""
        outputs, _ = self.load_space()
        path, maps = self.scene_path(scene.name), self.folder / f".maps.{scene.name}"
        path.parent.mkdir(exist_ok=True)
        maps.mkdir(exist_ok=True)
        with locked(maps, wait=True):
            if path.is_file():  # Another run has prepared the scene meanwhile.
                return
            try:
                maps.mkdir(exist_ok=True)
                for stale in maps.iterdir():
                    stale.unlink()
                prepare_scene(path, scene, CachedTeacher(teacher, maps), outputs, config, source=source, device=device)
            finally:
                shutil.rmtree(maps, ignore_errors=True)

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

    def count_classes(self, names: Sequence[str], track: Track, process: ProcessRank = ProcessRank()) -> None:
        """Counts the target classes of the training scenes that are prepared, and stores the counts, unless those of
        these scenes are stored already. All processes of a training call this; each counts its share of the scenes."""
        codebook = None
        with fail_together():
            if process.is_first:
                codebook = self._classes_to_count(names)
        codebook = value_of_first(codebook)
        if codebook is None:
            return
        scenes = self.scenes(names)
        with fail_together():
            share = track(scenes[process.rank :: process.world_size], "counting targets")
            counts = count_targets((_seen_targets(scene) for scene in share), codebook).counts
        with fail_together():
            counts = summed_array(counts)
            if process.is_first:
                arrays = {"codebook": codebook, "counts": counts}
                write_archive(self.folder / CLASS_BALANCE_FILE, arrays, {"scenes": [scene.name for scene in scenes]})

    def _classes_to_count(self, names: Sequence[str]) -> Float32[np.ndarray, "C channels"] | None:
        """The codebook of the classes; None if the targets of these scenes have been counted."""
        scenes, path = self.scenes(names), self.folder / CLASS_BALANCE_FILE
        if path.is_file():
            with error_hint("remove the file to count targets again"), open_archive(path) as file:
                if {scene.name for scene in scenes} <= set(file.value("scenes", list)):
                    return None
        _, codebook = self.load_space()
        if codebook is None:
            scene_share = max(1, CLUSTERED_TARGETS // len(scenes))
            codebook = cluster_targets(np.concatenate([_seen_targets(scene, scene_share) for scene in scenes]))
        return codebook

    def load_class_balance(self) -> ClassBalance:
        """Loads the target classes and their frequencies, as stored by `count_classes`."""
        channels = self.load_space()[0].channels
        path = self.folder / CLASS_BALANCE_FILE
        with error_hint("remove the file to count targets again"), open_archive(path) as file:
            codebook = file.array("codebook", "float32", ("C", channels))
            counts = file.array("counts", "float64", ("C",))
            if not len(counts) or not (counts >= 0).all():
                raise InputError("expected one or more target classes with counts of 0 or more")
            return ClassBalance(codebook=codebook, counts=counts)

    def find_scene(self, name: str) -> PreparedScene | None:
        """Opens a prepared scene by name; None if it is not prepared, for lack of what the teacher needs."""
        path = self.scene_path(name)
        return PreparedScene(path) if path.is_file() else None

    def scenes(self, names: Sequence[str]) -> list[PreparedScene]:
        """Opens prepared scenes by name; those that are not prepared are left out."""
        return [scene for name in names if (scene := self.find_scene(name)) is not None]


def _seen_targets(scene: PreparedScene, max_targets: int = 0) -> Float32[np.ndarray, "n channels"]:
    """The targets of the seen Gaussians of a scene, at most `max_targets` of them, evenly spaced; it is closed."""
    rows = np.flatnonzero(scene.weights)
    targets = scene.targets(rows[:: -(-len(rows) // max_targets)] if max_targets else rows)
    scene.close()
    return targets
