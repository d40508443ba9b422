"""The folder of the prepared scenes of a training: its settings, the space of its targets, and their classes."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised, listed, readable
from gsencoder.core.files import atomic_file, locked, read_foreign, read_foreign_text
from gsencoder.core.process import ProcessRank, Track
from gsencoder.core.settings import first_difference, with_added_options
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.models.output_space import OutputSpace, read_output_space
from gsencoder.teachers.base import Teacher
from gsencoder.train.class_balance import ClassBalance, cluster_targets, count_targets
from gsencoder.train.distributed import fail_together, summed_array, value_of_first
from gsencoder.train.prepare import PrepareConfig, prepare_scene
from gsencoder.train.prepared_file import Precision, digest_of_files, stored_precision
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.types import Scene

SPACE_FILE, DATASET_SETTINGS_FILE, CLASS_BALANCE_FILE = "space.safetensors", "settings.json", "rarity.safetensors"
MAPS_PREFIX = ".maps."
"""Prefix of the folders that cache teacher maps of scenes in preparation."""
CLUSTERED_TARGETS = 200_000
"""Approximate number of targets, over all scenes, from which classes of a dense teacher are clustered."""


class PreparedDataset:
    """A folder of prepared scenes that share an output space.

    The file of each scene is written atomically, so that an interrupted preparation can be continued, and several
    processes can share the work.
    """

    def __init__(self, folder: Path, settings: dict[str, Any] | None = None) -> None:
        """Args:
        folder: the folder; created if it does not exist and settings are given.
        settings: everything that the preparation depends on, compared with the settings stored in the folder. None =
            open an existing dataset with any settings.

        Raises:
            InputError: the folder was prepared with other settings, cannot be read, or holds no prepared scenes and no
                settings are given.
        """
        self.folder = folder
        path = folder / DATASET_SETTINGS_FILE
        try:
            if settings is not None:
                folder.mkdir(parents=True, exist_ok=True)
            stored: Any = json.loads(read_foreign_text(path)) if path.is_file() else None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: cannot be used: {error}; give another folder as prepared=") from error
        if path.is_file() and not isinstance(stored, dict):
            raise InputError(f"{path}: expected settings, got {str(stored)[:40]}; give another folder as prepared=")
        if stored is None and settings is None:
            raise InputError(f"{folder}: expected prepared scenes, found no {DATASET_SETTINGS_FILE}")
        if stored is None and any(not entry.name.startswith(".") for entry in folder.iterdir()):
            raise InputError(
                f"{folder}: holds something else than prepared scenes (no {DATASET_SETTINGS_FILE}); "
                "give another folder as prepared="
            )
        stored = None if stored is None else with_added_options(stored)
        expected: dict[str, Any] = stored if settings is None else json.loads(json.dumps(settings, default=str))
        self.settings = expected
        if stored is not None and stored != expected:
            difference = first_difference(stored, expected)
            raise InputError(f"{folder}: was prepared with {difference}; give another folder as prepared=")
        if stored is None:
            with atomic_file(path) as stream:
                stream.write(json.dumps(expected, indent=1).encode())

    def fingerprint(self) -> str:
        """A hash of the output space, by which a resumed training checks that its targets are the same.

        Raises:
            InputError: its file cannot be read.
        """
        with readable(self.folder / SPACE_FILE):
            return hashlib.sha256(read_foreign(self.folder / SPACE_FILE)).hexdigest()[:16]

    def digest_of_scenes(self, names: Sequence[str]) -> str:
        """A hash of the headers of prepared scenes, which hold the checksums of all arrays, by which processes compare
        what they train on.

        Raises:
            InputError: a file is damaged.
        """
        digest = hashlib.sha256()
        for name in names:
            path = self.scene_path(name)
            if path.is_file():
                with open_archive(path) as file:
                    digest.update(f"{name} {file.value('digest', str) if 'digest' in file else ''}".encode())
        return digest.hexdigest()[:16]

    def load_kinds(self) -> tuple[str, ...]:
        """Loads the names of the things that the teacher tells apart; none for a teacher without names, and of datasets
        of earlier versions.

        Raises:
            InputError: the file is missing or damaged.
        """
        with advised("give another folder as prepared="), open_archive(self.folder / SPACE_FILE) as file:
            kinds = file.value("kinds", list) if "kinds" in file else []
            if not all(isinstance(kind, str) for kind in kinds):
                raise InputError("expected names as the kinds in the header")
        return tuple(kinds)

    def load_space(self) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None]:
        """Loads the output space, and for a coded teacher the vectors of its codes in standard units, else None.

        Raises:
            InputError: the file is missing or damaged.
        """
        with advised("give another folder as prepared="), open_archive(self.folder / SPACE_FILE) as file:
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

    def holds_scenes(self) -> bool:
        """Whether any scene is prepared."""
        return any((self.folder / "scenes").glob("*"))

    def has_scene(self, source: Path) -> bool:
        """Whether the scene at this path is prepared, from this path or from another one with the same files.

        Raises:
            InputError: another scene with the same name is, or its targets are not of the precision of this dataset.
        """
        path = self.scene_path(source.name)
        if not path.is_file():
            return False
        with advised("remove the file to prepare the scene again"), open_archive(path) as file:
            stored_source = file.value("source", str)
            files = file.value("source_files", str) if "source_files" in file else ""
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
        """Prepares one scene, and writes its file atomically.

        Args:
            scene: the scene, with Gaussians and views.
            teacher: a teacher of the dataset's space.
            config: settings of the preparation.
            source: the path that the scene was read from.
            device: where B is made and multiplied.

        Raises:
            InputError: the scene cannot be fused, or the disk is full.
        """
        outputs, _ = self.load_space()
        path = self.scene_path(scene.name)
        path.parent.mkdir(exist_ok=True)
        with self._maps() as maps:
            cached = CachedTeacher(teacher, maps)
            prepare_scene(path, scene, cached, outputs, config, source=source, device=device)

    def check_kinds(self, teacher: Teacher) -> None:
        """Checks that a scene to train on has no names that the dataset's classes lack, such as those of labels that
        were added since. Dense teachers have no classes before their targets are clustered.

        Raises:
            InputError: it has.
        """
        if teacher.table is None:
            return
        kinds = self.load_kinds()
        new = [kind for kind in getattr(teacher, "kinds", ()) if kind not in kinds]
        if kinds and new:
            raise InputError(
                f"{self.folder}: the classes of this dataset lack {listed(new, 3)}, since the scene has changed; give "
                "another folder as prepared="
            )

    @contextmanager
    def _maps(self) -> Iterator[Path]:
        """A folder for the teacher's maps of one scene while the block lasts. It is locked, so that others can tell it
        from that of a killed run."""
        with ExitStack() as held:
            with locked(self.folder, wait=True):
                maps = held.enter_context(tempfile.TemporaryDirectory(dir=self.folder, prefix=MAPS_PREFIX))
                held.enter_context(locked(maps))
            yield Path(maps)

    def remove_stale_maps(self) -> None:
        """Removes caches of teacher maps that killed runs left; where folders cannot be locked, none."""
        with locked(self.folder, wait=True):
            for path in self.folder.glob(f"{MAPS_PREFIX}*"):
                with suppress(OSError), locked(path) as is_stale:
                    if is_stale:
                        shutil.rmtree(path, ignore_errors=True)

    def count_classes(self, names: Sequence[str], track: Track, process: ProcessRank = ProcessRank()) -> None:
        """Counts the target classes of the training scenes and stores the counts, unless those of these scenes are
        stored already; scenes that are not prepared are left out.

        All processes of a training call this: the first one clusters the classes of a dense teacher from a sample of
        the targets and writes the file, and each counts the targets of its share of the scenes.

        Raises:
            InputError: in any process, a scene is damaged, or the disk is full.
        """
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
        scenes, counted = self.scenes(names), self._counted_scenes()
        if counted is None or (counted and {scene.name for scene in scenes} <= set(counted)):
            return None
        _, codebook = self.load_space()
        if codebook is None:
            scene_share = max(1, CLUSTERED_TARGETS // len(scenes))
            codebook = cluster_targets(np.concatenate([_seen_targets(scene, scene_share) for scene in scenes]))
        return codebook

    def _counted_scenes(self) -> list[str] | None:
        """The scenes whose targets were counted, none at first; None for a file of earlier versions."""
        path = self.folder / CLASS_BALANCE_FILE
        if not path.is_file():
            return []
        with advised("remove the file to count targets again"), open_archive(path) as file:
            return [str(name) for name in file.value("scenes", list)] if "scenes" in file else None

    def load_class_balance(self) -> ClassBalance:
        """Loads the target classes and their frequencies, as stored by `count_classes`.

        Raises:
            InputError: the file is missing or damaged.
        """
        channels = self.load_space()[0].channels
        path = self.folder / CLASS_BALANCE_FILE
        with advised("remove the file to count targets again"), open_archive(path) as file:
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
    """The targets of the seen Gaussians of a scene, or at most so many of them, evenly spaced; the scene is closed."""
    rows = np.flatnonzero(scene.weights)
    targets = scene.targets(rows[:: -(-len(rows) // max_targets)] if max_targets else rows)
    scene.close()
    return targets
