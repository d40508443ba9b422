"""Preparation of all scenes of a training from disk: reading, seeding and fusing, shared among processes."""

import hashlib
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, SceneWarning, error_prefix, listed
from gsencoder.core.files import plain
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.core.settings import check_limits, option
from gsencoder.data.labels.files import read_split
from gsencoder.data.orbits import CamerasOfSplat
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import READABLE
from gsencoder.models.output_space import check_distinct
from gsencoder.teachers.base import Head, MissingInput, Teacher
from gsencoder.teachers.build import TeacherConfig, options_of_member, words_by_teacher
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.table import TEACHER_NAME
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words, closed_table
from gsencoder.train.distributed import check_agreement, fail_together
from gsencoder.train.prepare import (
    PrepareConfig,
    add_scene,
    fit_space,
    measure_dataset_heads,
    missing_heads,
    teacher_of_heads,
)
from gsencoder.train.prepared import SPACE_FILE, PreparedDataset
from gsencoder.train.samples import RoomsConfig
from gsencoder.types import Scene, SceneObject

TRAINED = "trained on"
"""What the settings of prepared scenes say of each scene that defines their space."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceConfig:
    """The source of a training's targets: settings of reading, seeding, the teacher and preparation."""

    splat: str = option(
        "",
        "file of the Gaussians of scenes with views, where {scene} stands for the name of its folder; "
        f"empty = make seeds. {READABLE}",
    )
    orbits: int = option(24, "largest number of cameras placed in a splat without views", ge=1, le=10_000)
    cameras: CamerasOfSplat = option(
        "auto", "where they stand: around it, inside it, or auto = inside if that shows most of it (a room)"
    )
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    teachers: Mapping[str, TeacherConfig] = field(
        default_factory=dict,
        metadata={
            "help": "several teachers instead of one, by the names that teacher= takes, or NAME:TEACHER; options of "
            "one of them are teachers.NAME.OPTION",
            "several": "teacher",
        },
    )
    text: TextConfig = field(default_factory=TableTextConfig)
    prepare: PrepareConfig = field(default_factory=PrepareConfig)
    rooms: RoomsConfig = field(default_factory=RoomsConfig)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.rooms.libraries and self.labels_teacher is None:
            raise InputError("rooms.libraries: made rooms have labels; expected teacher=labels, or labels in teachers=")
        wrong = [name for name in self.teachers if not re.fullmatch(TEACHER_NAME, name)]
        if wrong:
            raise InputError(f"teachers: expected names of letters, digits, _ and -, got {wrong[0]!r}")
        spelled: dict[str, str] = {}
        for name in self.teachers:
            other = spelled.setdefault(name.lower(), name)
            if other != name:
                raise InputError(
                    f"teachers: {other} and {name} differ only in case, and their files would overwrite each other "
                    f"where a file system ignores it; give another name, such as {name}_2"
                )

    @property
    def teachers_by_name(self) -> dict[str, TeacherConfig]:
        """The teachers of the training, one or several."""
        return dict(self.teachers) or {self.teacher.name: self.teacher}

    @property
    def labels_teacher(self) -> str | None:
        """The name of the teacher whose targets are labels, one for each Gaussian; None where there is none."""
        labels = [
            name for name, each in self.teachers_by_name.items() if isinstance(each, LabelsConfig) and each.cell == 1
        ]
        return labels[0] if labels else None

    def load_words(self) -> dict[str, Words]:
        """The words of the teachers that have any, by teacher."""
        return words_by_teacher(self.teachers_by_name, self.text, members=bool(self.teachers))

    def typed_options(self, name: str) -> AbstractContextManager[None]:
        """Names options of a teacher in errors by the keys that are typed: teachers.NAME.OPTION with `teachers`."""
        return options_of_member(name, self.teachers[name]) if name in self.teachers else nullcontext()


class SceneReader:
    """Reads scenes and builds teachers for them."""

    def __init__(self, config: SourceConfig, words: Mapping[str, Words]) -> None:
        self.config, self.words = config, words
        self._shared: dict[str, Teacher] = {}

    def teacher(self, name: str, scene: Scene) -> Teacher:
        """The teacher of a scene: its own, or one that is built once for all scenes; a `MissingInput` where the scene
        lacks what it needs."""
        config = self.config.teachers_by_name[name]
        teacher = None if config.per_scene else self._shared.get(name)
        if teacher is None:
            teacher = self._shared[name] = config.build(scene, self.words.get(name))
        # Known before Gaussians are made, which takes minutes where they come from photographs.
        if teacher.needs_images and scene.views is not None and scene.views.images is None:
            raise MissingInput(f"teacher {name}: the scene has no pictures")
        return teacher

    def with_views(self, name: str, path: Path) -> tuple[Scene, Teacher]:
        """A scene with views, which is enough for maps, and the teacher of this name."""
        with error_prefix(path):
            scene = self.load(path)
            return scene, self.teacher(name, scene)

    def weights_of_teachers(self, path: Path) -> dict[str, str]:
        """The digests of the weights of the teachers that a scene has, by their names."""
        with error_prefix(path):
            scene, weights = self.load(path), dict[str, str]()
            for name in self.config.teachers_by_name:
                try:
                    with self.config.typed_options(name):
                        weights[name] = self.teacher(name, scene).space.weights
                except MissingInput:
                    continue
        return weights

    def with_gaussians(self, scene: Scene, path: Path) -> Scene:
        """A scene that `load` read, with Gaussians, of known unit, named by its path."""
        scene = with_gaussians(scene, self.config.seeds)
        return replace(scene, name=path.name, metres_per_unit=unit_of(scene))

    def load(self, path: Path) -> Scene:
        """A scene with views, as it is on disk; cameras are placed in a splat without any."""
        config = self.config
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        if config.splat:
            from gsencoder.fusion.fit import with_fitting_splat

            scene = with_fitting_splat(scene, config.splat, config.data)
        if scene.views is None:
            from gsencoder.fusion.cameras import with_views

            scene = with_views(scene, config.orbits, config.prepare.fusion.blend, cameras=config.cameras)[0]
        return scene


def prepare_scenes(
    training: Sequence[Path],
    held_out: Sequence[Path],
    words: Mapping[str, Words],
    config: SourceConfig,
    folder: Path,
    *,
    heads: Sequence[str] = (),
    process: ProcessRank = ProcessRank(),
    device: torch.device = torch.device("cpu"),
    track: Track = untracked,
) -> dict[str, PreparedDataset]:
    """Prepares the scenes that are not in `folder` yet; the processes of a training share the work. A scene that lacks
    what one of several teachers needs, such as labels, is prepared for the others, with a warning.

    Args:
        training: scenes whose targets define the output spaces and their classes.
        words: the words of teachers that have any, by teacher.
        folder: of the prepared dataset, or of one for each of several teachers.
        heads: names of the teacher's adapter heads that are measured over the dataset.

    Returns:
        The prepared dataset of each teacher, by its name.
    """
    teachers = config.teachers_by_name
    several, every = len(teachers) > 1, [*training, *held_out]
    folders = teacher_folders(folder, list(teachers))
    settings = {
        name: _preparation_settings(training, words.get(name), teacher, config) for name, teacher in teachers.items()
    }
    reader, unmeasured = SceneReader(config, words), list[Head]()
    with_heads = teacher_of_heads(teachers, heads)
    with fail_together():
        datasets = {name: PreparedDataset(path, settings[name]) for name, path in folders.items()}
        if process.is_first:
            # Read first, since a head that is not there is an error before the teacher has made a map.
            with _about_teacher(config, with_heads):
                unmeasured = missing_heads(datasets[with_heads], heads, teachers[with_heads])
    for name, dataset in datasets.items():
        open_scene = partial(reader.with_views, name)
        with _about_teacher(config, name):
            with fail_together():
                made = _made_rooms(name, words.get(name), config)
            fit_space(
                dataset,
                training,
                open_scene,
                config.prepare,
                made=made,
                optional=several,
                process=process,
                track=track,
            )
            with fail_together():
                if unmeasured and name == with_heads:
                    views = config.prepare.basis_views
                    measure_dataset_heads(dataset, unmeasured, training, open_scene, views, optional=several)
    # Before hours of preparation, since the encoder could not have such columns.
    check_distinct({name: dataset.load_space()[0].space for name, dataset in datasets.items()})
    missing = {path: [name for name, dataset in datasets.items() if not dataset.has_scene(path)] for path in every}
    with fail_together():
        pass  # No process may start to prepare before all have listed the missing scenes.
    with fail_together():
        share = [path for path, names in missing.items() if names][process.rank :: process.world_size]
        weights = reader.weights_of_teachers(share[0]) if share and process.world_size > 1 else {}
    for name in teachers:
        check_agreement(f"the weights of teacher {name}" if several else "the teacher's weights", weights.get(name, ""))
    with fail_together():
        for path in track(share, "preparing scenes"):
            try:
                _prepare_scene(
                    path, missing[path], datasets, reader, config, device, trained=path in training, optional=several
                )
            except InputError as error:
                # The error is raised when all processes have ended their shares, which may take hours.
                if process.world_size > 1:
                    warnings.warn(f"process {process.rank} stops: {error}", SceneWarning, stacklevel=2)
                raise
    with fail_together():
        if process.is_first:
            _check_teachers(datasets, training, held_out)
            for dataset in datasets.values():
                dataset.cluster_classes([path.name for path in training])
    return datasets


def _made_rooms(name: str, words: Words | None, config: SourceConfig) -> list[Teacher]:
    """The teacher of the rooms that are made during the training, if the one of this name has their labels."""
    if not config.rooms.libraries or name != config.labels_teacher:
        return []
    from gsencoder.data.furnished.kinds import kinds

    box = np.zeros(3)
    # Kinds that are left out are no wrong answers either.
    known = [kind for kind in kinds() if kind not in config.rooms.without]
    objects = [SceneObject(id=1 + i, name=kind, aabb_min=box, aabb_max=box) for i, kind in enumerate(known)]
    return [config.teachers_by_name[name].build(Scene(name="rooms", objects=tuple(objects)), words)]


@contextmanager
def _about_teacher(config: SourceConfig, name: str) -> Iterator[None]:
    """Names a teacher, where there are several, and its options as they are typed in errors of the block."""
    with error_prefix(f"teacher {name}") if config.teachers else nullcontext(), config.typed_options(name):
        yield


def teacher_folders(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The folder of the prepared scenes of each teacher: the given one, or one in it for each of several teachers."""
    if len(names) == 1:
        prepared = sorted(path.parent.name for path in folder.glob(f"*/{SPACE_FILE}"))
        if prepared and not (folder / SPACE_FILE).is_file():
            teacher = names[0] if names[0] in prepared else prepared[0]
            raise InputError(
                f"{folder}: was prepared for several teachers ({listed(prepared, 3)}), and this run has one; give "
                f"another prepared=, or the folder of one of them ({folder / teacher})"
            )
        return {names[0]: folder}
    if (folder / SPACE_FILE).is_file():
        raise InputError(
            f"{folder}: was prepared for one teacher, and this run has several; give another prepared=, or move it to "
            f"the teacher's folder in one (FOLDER/{names[0]})"
        )
    return {name: folder / name for name in names}


def _preparation_settings(
    training: Sequence[Path], words: Words | None, teacher: TeacherConfig, config: SourceConfig
) -> dict[str, Any]:
    """Everything that the preparation for a teacher depends on, as JSON values."""
    settings = {
        "scenes": dict.fromkeys([path.name for path in training], TRAINED),
        "words": _words_digest(words),
        "data": plain(config.data),
        "seeds": plain(config.seeds),
        "teacher": plain(teacher),
        "prepare": plain(config.prepare),
        "rooms": list(config.rooms.without) if config.rooms.libraries else None,
        **{"splat": config.splat, "orbits": config.orbits, "cameras": config.cameras},
    }
    # Heads are measured and added when they are asked for; what is prepared besides does not depend on them.
    settings["teacher"].pop("heads", None)
    return settings


def _prepare_scene(
    path: Path,
    names: Sequence[str],
    datasets: Mapping[str, PreparedDataset],
    reader: "SceneReader",
    config: SourceConfig,
    device: torch.device,
    *,
    trained: bool,
    optional: bool,
) -> None:
    """Prepares a scene, which is trained on or held out, for some teachers; with `optional` those are left out for
    which it lacks something."""
    with error_prefix(path):
        scene, teachers = reader.load(path), dict[str, Teacher]()
        for name in names:
            try:
                with config.typed_options(name):
                    teachers[name] = reader.teacher(name, scene)
            except MissingInput:
                if not optional:
                    raise
        if not teachers:
            return
        scene = reader.with_gaussians(scene, path)
        for name, teacher in teachers.items():
            if trained:
                datasets[name].check_kinds(teacher)
            try:
                with config.typed_options(name):
                    add_scene(datasets[name], scene, teacher, config.prepare, source=path, device=device)
            except MissingInput:
                if not optional:
                    raise


def _check_teachers(
    datasets: Mapping[str, PreparedDataset], training: Sequence[Path], held_out: Sequence[Path]
) -> None:
    """Checks that each scene has a teacher and each teacher a scene, and warns of scenes that lack teachers."""
    every = [path.name for path in [*training, *held_out]]
    present = {
        name: [each for each in every if dataset.scene_path(each).is_file()] for name, dataset in datasets.items()
    }
    without = [name for name in every if not any(name in scenes for scenes in present.values())]
    if without:
        raise InputError(f"teachers: {len(without)} scenes have none of them, such as {without[0]!r}; leave these out")
    for name, scenes in present.items():
        lacking = [each for each in every if each not in scenes]
        if not any(path.name in scenes for path in training):
            raise InputError(f"teacher {name}: no scene to train on has it; leave it out")
        if lacking:
            warnings.warn(
                f"teacher {name}: {len(lacking)} of {len(every)} scenes lack what it needs ({listed(lacking, 3)}); "
                "there the other teachers are used alone",
                SceneWarning,
                stacklevel=3,
            )


def _words_digest(words: Words | None) -> str:
    if words is None:
        return ""
    table = closed_table(words)
    return hashlib.sha256(repr(table.names).encode() + table.embeddings.tobytes()).hexdigest()[:16]


def split_scenes(
    paths: Sequence[Path], patterns: Sequence[str], split: Path | None = None, holdout_split: Path | None = None
) -> tuple[list[Path], list[Path]]:
    """Splits scenes into those to train on and those held out for validation: by patterns of names to hold out, with *
    and ? as in file names, or by files of names to hold out and to train on."""
    names = [path.name for path in paths]
    if (repeated := first_repeated(names)) is not None:
        raise InputError(f"paths: two scenes are called {repeated[0]!r}; prepared scenes need distinct names")
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in names):
            raise InputError(
                f"holdout: no scene is called {pattern!r}; the scenes are {listed(names, 5)}; give names of these, or "
                "holdout=[] for none (experiments hold out scenes of the data that they are made for)"
            )
    trained = _names_of("split", split, names) or tuple(names)
    held_out = set(_names_of("holdout_split", holdout_split, names))
    if holdout_split is None:
        held_out = {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}
    elif patterns:
        raise InputError("holdout: expected holdout= or holdout_split=, got both; leave one out, or give holdout=[]")
    elif split is not None and (twice := sorted(held_out.intersection(trained))):
        raise InputError(
            f"holdout_split={holdout_split}: {len(twice)} of its scenes are in split= too, such as {twice[0]!r}; a "
            "scene is trained on or held out"
        )
    path_of = dict(zip(names, paths, strict=True))
    training = [path_of[name] for name in trained if name not in held_out]
    if not training:
        raise InputError("holdout: matches every scene; at least one must remain for training")
    return training, [path for path in paths if path.name in held_out]


def _names_of(option: str, file: Path | None, scenes: Sequence[str]) -> tuple[str, ...]:
    """The names in a split file, none without a file; all must be among those given."""
    if file is None:
        return ()
    chosen, possible = read_split(file), frozenset(scenes)
    missing = [name for name in chosen if name not in possible]
    if missing:
        raise InputError(
            f"{option}={file}: {len(missing)} of its {len(chosen)} scenes are not among those given, such as "
            f"{missing[0]!r}"
        )
    return chosen
