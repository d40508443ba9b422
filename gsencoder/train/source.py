"""The source of a training's targets: its settings, and the scenes with their teachers as they are read from disk."""

import re
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsencoder.core.errors import InputError, about
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import READABLE
from gsencoder.fusion.cameras import CamerasOfSplat, check_orbits, with_views
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.fusion.folder import TEACHER_NAME
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.teachers.build import TeacherConfig, build_teacher, options_of_member
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.teachers.masks import RegionsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.train.prepare import PrepareConfig
from gsencoder.types import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceConfig:
    """The source of a training's targets: settings of reading, seeding, the teacher and preparation."""

    splat: str = field(
        default="",
        metadata={
            "help": "file of the Gaussians of scenes with views, where {scene} stands for the name of its folder; "
            f"empty = make seeds. {READABLE}"
        },
    )
    orbits: int = field(default=24, metadata={"help": "largest number of cameras placed in a splat without views"})
    cameras: CamerasOfSplat = field(
        default="auto",
        metadata={"help": "where they stand: around it, inside it, or auto = inside if that shows most of it (a room)"},
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

    def __post_init__(self) -> None:
        check_orbits(self.orbits)
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

    def typed_options(self, name: str) -> AbstractContextManager[None]:
        """Names options of a teacher in errors by the keys that are typed: teachers.NAME.OPTION with `teachers`."""
        return options_of_member(name, self.teachers[name]) if name in self.teachers else nullcontext()


class SceneReader:
    """Reads scenes and builds teachers for them."""

    def __init__(self, config: SourceConfig, words: Mapping[str, Words], voxel: float) -> None:
        """Args:
        config: settings of reading, seeding and the teachers.
        words: the words of teachers that have any, by teacher.
        voxel: see `prepare_scenes`.
        """
        self.config, self.words, self.voxel = config, words, voxel
        self._shared: dict[str, Teacher] = {}

    def teacher(self, name: str, scene: Scene) -> Teacher:
        """The teacher of a scene. Objects and masks belong to a scene; any other teacher is built once for all."""
        config = self.config.teachers_by_name[name]
        if isinstance(config, (LabelsConfig, RegionsConfig)):
            return build_teacher(config, scene, self.words.get(name))
        if name not in self._shared:
            self._shared[name] = build_teacher(config, scene, self.words.get(name))
        return self._shared[name]

    def with_views(self, name: str, path: Path) -> tuple[Scene, Teacher]:
        """A scene with views, which is enough for maps, and the teacher of this name."""
        with about(path):
            scene = self.load(path)
            return scene, self.teacher(name, scene)

    def weights_of_teachers(self, path: Path) -> dict[str, str]:
        """The digests of the weights of the teachers that a scene has, by their names."""
        with about(path):
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
        return replace(scene, name=path.name, metres_per_unit=unit_of(scene, self.voxel))

    def load(self, path: Path) -> Scene:
        """A scene with views, as it is on disk; cameras are placed in a splat without any."""
        config = self.config
        scene = load_scene(path, splat=config.splat or None, options=config.data)
        scene = with_fitting_splat(scene, config.splat, config.data)
        if scene.views is None:
            scene = with_views(scene, config.orbits, config.prepare.fusion.blend, cameras=config.cameras)
        return scene
