"""Making scenes ready for training: everything that does not depend on the encoder is worked out once, and kept."""

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from gsencoder.core.errors import InputError, advised
from gsencoder.core.files.archive import first_difference, open_archive, write_archive
from gsencoder.core.files.atomic import atomic_file
from gsencoder.core.runtime.tracking import Track
from gsencoder.fusion.basis import encode
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import capped
from gsencoder.fusion.teacher_maps import CachedTeacher
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.visibility import row_mask
from gsencoder.models.output_space import OutputSpace, output_space_parts, read_output_space
from gsencoder.render import blend
from gsencoder.train.class_balance import Rarity, cluster_targets, count_targets
from gsencoder.train.dataset_space import dataset_space
from gsencoder.train.prepared_scene import PreparedScene, ViewRows, write_prepared
from gsencoder.types import FeatureMap, Scene

SPACE_FILE, SETTINGS_FILE, RARITY_FILE = "space.safetensors", "settings.json", "rarity.safetensors"
MAPS_PREFIX, MAPS_SECONDS = ".maps.", 24 * 3600.0
"""Folders of maps of scenes that are being prepared; older ones were left by runs that were killed."""
SAMPLED_TARGETS = 200_000
"""Targets of all scenes together that clusters are sought in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareConfig:
    """How targets and the matrices of the render loss are made."""

    fusion: FuseConfig = field(default_factory=FuseConfig)
    render_cell: int = field(
        default=8, metadata={"help": "smallest cell of the render loss, pixels; finer teacher maps are averaged"}
    )
    render_min_weight: float = field(
        default=1e-3, metadata={"help": "smallest blending weight that is kept for the render loss"}
    )
    basis_views: int = field(default=256, metadata={"help": "maps of a dense teacher that its basis is found from"})

    def __post_init__(self) -> None:
        if self.render_cell < 1 or self.basis_views < 1:
            raise InputError(
                f"render_cell and basis_views: expected 1 or more, got {self.render_cell} and {self.basis_views}"
            )
        if not 0 <= self.render_min_weight < 1:
            raise InputError(f"render_min_weight: expected a number in [0, 1), got {self.render_min_weight}")


class PreparedDataset:
    """A folder of prepared scenes that share an output space.

    Scenes are prepared one by one and appear whole or not at all, so that a run that was cut off goes on where it
    stopped, and several processes may share the work.
    """

    def __init__(self, folder: Path, settings: dict[str, Any] | None = None) -> None:
        """Args:
        folder: made if it does not exist and settings are given.
        settings: all that the preparation depends on; what the folder holds must have been made with the same. None =
            what is there, whatever it was made with.

        Raises:
            InputError: it was made with others, cannot be used, or holds nothing where it must.
        """
        self.folder = folder
        path = folder / SETTINGS_FILE
        try:
            if settings is not None:
                folder.mkdir(parents=True, exist_ok=True)
            found: Any = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: cannot be used: {error}; give another folder as prepared=") from error
        if path.is_file() and not isinstance(found, dict):
            raise InputError(f"{path}: expected settings, got {str(found)[:40]}; give another folder as prepared=")
        if found is None and settings is None:
            raise InputError(f"{folder}: expected prepared scenes, found no {SETTINGS_FILE}")
        if found is None and any(not entry.name.startswith(".") for entry in folder.iterdir()):
            raise InputError(
                f"{folder}: holds something else than prepared scenes (no {SETTINGS_FILE}); give another folder as "
                "prepared="
            )
        wanted: dict[str, Any] = found if settings is None else json.loads(json.dumps(settings, default=str))
        self.settings = wanted
        if found is not None and found != wanted:
            difference = first_difference(found, wanted)
            raise InputError(f"{folder}: was prepared with {difference}; give another folder as prepared=")
        if found is None:
            with atomic_file(path) as stream:
                stream.write(json.dumps(wanted, indent=1).encode())

    def find_space(
        self, scenes: Sequence[Path], open_scene: Callable[[Path], tuple[Scene, Teacher]], config: PrepareConfig
    ) -> None:
        """Finds the output space of the training scenes, unless it has been found."""
        if (self.folder / SPACE_FILE).is_file():
            return
        if (self.folder / "scenes").is_dir() and any((self.folder / "scenes").iterdir()):
            raise InputError(
                f"{self.folder}: holds scenes, and not the space that they were prepared for ({SPACE_FILE}); give "
                "another folder as prepared="
            )
        outputs, codebook = dataset_space(scenes, open_scene, config.fusion, views=config.basis_views)
        arrays, header = output_space_parts(outputs)
        if codebook is not None:
            arrays["codebook"] = codebook
        write_archive(self.folder / SPACE_FILE, arrays, header)

    def fingerprint(self) -> str:
        """Of the output space: what was trained towards another one cannot go on towards this."""
        return hashlib.sha256((self.folder / SPACE_FILE).read_bytes()).hexdigest()[:16]

    def load_space(self) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None]:
        """The output space, and the vectors of a coded teacher's codes.

        Raises:
            InputError: missing or damaged.
        """
        with advised("give another folder as prepared="), open_archive(self.folder / SPACE_FILE) as file:
            outputs = read_output_space(file)
            codebook = file.array("codebook", "float32", ("C", outputs.channels)) if "codebook" in file else None
        return outputs, codebook

    def path_of(self, name: str) -> Path:
        """The file of a scene; it is there once the scene has been prepared."""
        return self.folder / "scenes" / f"{name}.safetensors"

    def holds(self, source: Path) -> bool:
        """Whether the scene of this folder has been prepared.

        Raises:
            InputError: another scene of the same name has been.
        """
        path = self.path_of(source.name)
        if not path.is_file():
            return False
        with advised("remove the file, and it is prepared again"), open_archive(path) as file:
            made_from = file.value("source", str)
        if made_from != str(source.resolve()):
            raise InputError(
                f"{path}: was prepared from {made_from}, and this run means {source.resolve()}; scenes are told apart "
                "by name: rename one, or give another folder as prepared="
            )
        return True

    def prepare(self, scene: Scene, teacher: Teacher, config: PrepareConfig, *, source: Path = Path()) -> None:
        """Fuses one scene and keeps its targets and matrices; the file appears whole or not at all.

        Args:
            scene: with Gaussians and views.
            teacher: of the dataset's space.
            config: see there.
            source: where the scene was read from.

        Raises:
            InputError: whatever `fuse` refuses, or the disk is full.
        """
        outputs, _ = self.load_space()
        path = self.path_of(scene.name)
        path.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix=MAPS_PREFIX) as maps:
            prepare_scene(path, scene, CachedTeacher(teacher, Path(maps)), outputs, config, source=source)

    def remove_leftovers(self) -> None:
        """Removes maps that killed runs left behind."""
        for path in self.folder.glob(f"{MAPS_PREFIX}*"):
            if time.time() - path.stat().st_mtime > MAPS_SECONDS:
                shutil.rmtree(path, ignore_errors=True)

    def find_rarity(self, names: Sequence[str], track: Track) -> None:
        """Counts how often each kind of target occurs in the training scenes, unless that has been done."""
        if (self.folder / RARITY_FILE).is_file():
            return
        _, codebook = self.load_space()
        scenes = self.scenes(names)

        def seen_targets(scene: PreparedScene, most: int = 0) -> Float32[np.ndarray, "n channels"]:
            rows = np.flatnonzero(scene.weights)
            targets = scene.targets(rows[:: -(-len(rows) // most)] if most else rows)
            scene.close()
            return targets

        if codebook is None:
            share = max(1, SAMPLED_TARGETS // len(scenes))
            codebook = cluster_targets(np.concatenate([seen_targets(scene, share) for scene in scenes]))
        rarity = count_targets((seen_targets(scene) for scene in track(scenes, "counting targets")), codebook)
        write_archive(self.folder / RARITY_FILE, {"codebook": rarity.codebook, "counts": rarity.counts}, {})

    def load_rarity(self) -> Rarity:
        """What `find_rarity` found.

        Raises:
            InputError: missing or damaged.
        """
        channels = self.load_space()[0].channels
        path = self.folder / RARITY_FILE
        with advised("remove the file, and it is counted again"), open_archive(path) as file:
            codebook = file.array("codebook", "float32", ("C", channels))
            counts = file.array("counts", "float64", ("C",))
            if not len(counts) or not (counts >= 0).all():
                raise InputError("expected kinds of target with counts from 0")
            return Rarity(codebook=codebook, counts=counts)

    def scenes(self, names: Sequence[str]) -> list[PreparedScene]:
        """Prepared scenes by name."""
        return [PreparedScene(self.path_of(name)) for name in names]


def prepare_scene(
    path: Path,
    scene: Scene,
    teacher: Teacher,
    outputs: OutputSpace,
    config: PrepareConfig,
    *,
    source: Path = Path(),
) -> None:
    """Writes a scene's Gaussians, fused targets, and for every view the rows of its render loss.

    Args:
        path: the file.
        scene: with Gaussians and views.
        teacher: of the space of `outputs`.
        outputs: the dataset's.
        config: see there.
        source: where the scene was read from.

    Raises:
        InputError: whatever `fuse` refuses.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    fusion = replace(config.fusion, basis=outputs.basis is not None)
    fused = fuse(scene, teacher, fusion, basis=outputs.basis).features
    blending = replace(config.fusion.blend, min_weight=config.render_min_weight)
    rows = []
    for view in range(len(scene.views)):
        targets, valid, grid = _pooled(teacher.feature_map(scene.views, view), outputs, config.render_cell)
        b = blend(scene.gaussians, scene.views.cameras, view, like=grid, config=capped(blending, grid))
        if scene.views.masks is not None:
            valid &= row_mask(scene.views.masks[view], b.lattice) == 1
        arrays = (b.crow.numpy(), b.col.numpy(), b.weight.numpy())
        rows.append(ViewRows(crow=arrays[0], col=arrays[1], weight=arrays[2], targets=targets, valid=valid))
    write_prepared(path, scene, fused, outputs, rows, source=source)


def _pooled(
    feature_map: FeatureMap, outputs: OutputSpace, cell: int
) -> tuple[Float32[np.ndarray, "P channels"], Bool[np.ndarray, " P"], FeatureMap]:
    """A map in standard units on cells of at least `cell` pixels, which cells have a vector, and a map of that grid.

    Cells over the right and lower border of the pooled grid are left out.
    """
    affine = feature_map.grid_from_image
    side = 1 / float(np.sqrt(affine[0, 0] * affine[1, 1]))
    factor = max(1, round(cell / side))
    height, width = feature_map.height // factor, feature_map.width // factor
    if not height or not width:
        raise InputError(f"prepare: a map of {feature_map.width}×{feature_map.height} has no cell of {cell} pixels")
    if feature_map.codes is not None:
        assert feature_map.table is not None
        # Shares of the codes in each cell, and not vectors in each pixel: the same by linearity, and far smaller.
        codes = feature_map.codes[: height * factor, : width * factor]
        line, column = np.divmod(np.arange(codes.size), codes.shape[1])
        cell_of = (line // factor) * width + column // factor
        count = len(feature_map.table) + 1
        counts = np.bincount(cell_of * count + codes.ravel() + 1, minlength=height * width * count)
        shares = counts.reshape(height * width, count) / factor**2
        valid = shares[:, 0] == 0
        vectors = (shares[:, 1:] @ _standard(feature_map.table, outputs)).astype(np.float32)
    else:
        assert feature_map.features is not None
        grid = _standard(feature_map.features, outputs)[: height * factor, : width * factor]
        vectors = grid.reshape(height, factor, width, factor, -1).mean(axis=(1, 3)).reshape(height * width, -1)
        valid = np.isfinite(vectors).all(axis=1)
    like = FeatureMap(
        codes=np.zeros((height, width), np.int32),
        table=np.zeros((1, feature_map.space.channels), np.float32),
        grid_from_image=affine / factor,
        space=feature_map.space,
    )
    return np.where(valid[:, None], vectors, np.float32(0)), valid, like


def _standard(vectors: np.ndarray, outputs: OutputSpace) -> np.ndarray:
    flat = vectors.reshape(-1, vectors.shape[-1])
    coordinates = encode(outputs.basis, flat) if outputs.basis is not None else flat
    return outputs.standardize(coordinates).reshape(*vectors.shape[:-1], -1)
