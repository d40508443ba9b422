"""Preparation of all scenes of a training from disk: reading, seeding and fusing, shared among processes."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, about
from gsencoder.core.files.json_values import plain
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.seeding.spacing import unit_of
from gsencoder.data.splats import READABLE
from gsencoder.fusion.orbit_views import CamerasOfSplat, check_orbits, with_views
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.fusion.teachers.regions.config import RegionsConfig
from gsencoder.text.table import TextTable
from gsencoder.train.distributed import ProcessRank, fail_together
from gsencoder.train.prepare import PrepareConfig, PreparedDataset
from gsencoder.types import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceConfig:
    """The source of a training's targets: settings of reading, seeding, the teacher and preparation."""

    splat: str = field(
        default="", metadata={"help": f"file of the Gaussians of scenes with views; empty = make seeds. {READABLE}"}
    )
    orbits: int = field(default=24, metadata={"help": "largest number of cameras placed in a splat without views"})
    cameras: CamerasOfSplat = field(
        default="auto",
        metadata={"help": "where they stand: around it, inside it, or auto = inside if that shows most of it (a room)"},
    )
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    prepare: PrepareConfig = field(default_factory=PrepareConfig)

    def __post_init__(self) -> None:
        check_orbits(self.orbits)


def split_scenes(paths: Sequence[Path], patterns: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """Splits scenes into those to train on and those held out for validation.

    Args:
        paths: all scenes.
        patterns: names of scenes to hold out, with * and ? as in file names.

    Raises:
        InputError: a pattern matches no scene, all scenes are held out, or two scenes have the same name.
    """
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise InputError(f"paths: two scenes are called {duplicate!r}; prepared scenes need distinct names")
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in names):
            raise InputError(f"holdout: no scene is called {pattern!r}; the scenes are {', '.join(names[:5])}, …")
    held_out = [path for path in paths if any(fnmatch(path.name, pattern) for pattern in patterns)]
    training = [path for path in paths if path not in held_out]
    if not training:
        raise InputError("holdout: matches every scene; at least one must remain for training")
    return training, held_out


def prepare_scenes(
    training: Sequence[Path],
    held_out: Sequence[Path],
    words: TextTable | None,
    config: SourceConfig,
    folder: Path,
    *,
    voxel: float,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> PreparedDataset:
    """Prepares the scenes that are not in `folder` yet; the processes of a training share the work.

    Args:
        training: scenes whose targets define the output space and the class balance.
        held_out: scenes for validation.
        words: text table of the teacher; None if it has none.
        config: settings of reading, seeding, the teacher and preparation.
        folder: folder of the prepared dataset; created if it does not exist.
        voxel: edge length of the encoder's grid cells in metres, from which the unit of a splat is estimated if it is
            unknown.
        process: rank of this process.
        track: wraps loops to show progress.

    Raises:
        InputError: in any process, a scene cannot be used, or the folder cannot.
    """
    sections = {name: plain(getattr(config, name)) for name in ("data", "seeds", "teacher", "prepare")}
    made_with: dict[str, Any] = {
        "scenes": {path.name: str(path.resolve()) for path in training},
        "words": _text_table_digest(words),
        **sections,
        **{"splat": config.splat, "orbits": config.orbits, "cameras": config.cameras, "voxel": voxel},
    }
    read_views, read_scene = _scene_readers(config, words, voxel)
    with fail_together():
        if process.is_first:
            dataset = PreparedDataset(folder, made_with)
            dataset.remove_stale_maps()
            dataset.fit_space(training, read_views, config.prepare)
    dataset = PreparedDataset(folder, made_with)
    missing = [path for path in [*training, *held_out] if not dataset.has_scene(path)]
    with fail_together():
        pass  # No process may start to prepare before all have listed the missing scenes.
    with fail_together():
        assigned: Iterable[Path] = track(missing[process.rank :: process.world_size], "preparing scenes")
        for path in assigned:
            scene, teacher = read_scene(path)
            with about(path):
                dataset.prepare(scene, teacher, config.prepare, source=path)
    with fail_together():
        if process.is_first:
            dataset.count_classes([path.name for path in training], track)
    return dataset


ReadScene = Callable[[Path], tuple[Scene, Teacher]]


def _scene_readers(config: SourceConfig, words: TextTable | None, voxel: float) -> tuple[ReadScene, ReadScene]:
    """Two functions from a path to a scene and its teacher. The first ensures only that the scene has views, which is
    enough for teacher maps; the second also makes Gaussians, estimates the unit, and names the scene by its path."""
    shared: list[Teacher] = []

    def teacher_of(scene: Scene) -> Teacher:
        # Objects and masks belong to a scene; any other teacher is built once for all scenes.
        if isinstance(config.teacher, (LabelsConfig, RegionsConfig)):
            return build_teacher(config.teacher, scene, words)
        if not shared:
            shared.append(build_teacher(config.teacher, scene, words))
        return shared[0]

    def read_views(path: Path) -> tuple[Scene, Teacher]:
        with about(path):
            scene = load_scene(path, splat=config.splat or None, options=config.data)
            if scene.views is None:
                scene = with_views(scene, config.orbits, config.prepare.fusion.blend, cameras=config.cameras)
            return scene, teacher_of(scene)

    def read_scene(path: Path) -> tuple[Scene, Teacher]:
        scene, teacher = read_views(path)
        with about(path):
            scene = with_gaussians(scene, config.seeds)
            return replace(scene, name=path.name, metres_per_unit=unit_of(scene, voxel)), teacher

    return read_views, read_scene


def _text_table_digest(words: TextTable | None) -> str:
    if words is None:
        return ""
    return hashlib.sha256(repr(words.names).encode() + words.embeddings.tobytes()).hexdigest()[:16]
