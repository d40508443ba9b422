"""A stage whose knobs are swept: what a module of this folder says about one, and what is measured of it.

A new knob is a row in the list of its stage. A new stage is a module with a function from `Inputs` to a `Stage`.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

from gsencoder.core.settings import Knob
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.localization import LocalizationProtocol
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.teachers.build import TeacherConfig
from gsencoder.teachers.labels import LabelsConfig

StageName = Literal["reconstruction", "fusion", "encoder", "packages", "localization", "views"]
Cost = Literal["cpu_seconds", "seconds", "mib", "bytes"]
"""What a run costs: CPU seconds of all threads, wall-clock seconds, growth of peak memory, bytes written."""

HIGHER_IS_BETTER = {
    "acc_25": True,
    "acc_50": True,
    "error": False,
    "covered": True,
    "rank": False,
    "psnr": True,
    "ssim": True,
    "names": True,
    "cosine": True,
    "object_share": True,
    "visible": True,
    "views": False,
    "gaussians": False,
    "row_bytes": False,
}
"""The scores that stages give, and whether more of one is better."""


class Score(NamedTuple):
    """A score of one scene, as a sum over things that count alike (objects, names, or the scene itself).

    Attributes:
        total: of the scores of the things.
        things: how many they are; 0 = the scene has none.
    """

    total: float
    things: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What a run's product is worth.

    Attributes:
        scores: by name, see `HIGHER_IS_BETTER`.
        bytes: that the product takes as files.
    """

    scores: Mapping[str, Score]
    bytes: int


@runtime_checkable
class StageScene(Protocol):
    """A scene with all that a stage needs and no knob changes."""

    def run(self, settings: Any) -> Any:
        """The stage itself, which is timed."""

    def judge(self, product: Any, settings: Any) -> Judged:
        """The product against labels or the exact reference, which is not timed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage and its knobs.

    Attributes:
        name: of the stage.
        knobs: what is swept.
        base: the settings that a sweep starts from, the "defaults" of its tables.
        open: prepares a scene; entered once for all runs on it.
        accuracy: the score that the front is drawn with.
        cost: what the front is drawn with where the sweep does not say.
    """

    name: StageName
    knobs: tuple[Knob, ...]
    base: Any
    open: Callable[[Path], AbstractContextManager[StageScene]]
    accuracy: str
    cost: Cost = "cpu_seconds"


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What stages start from, which no knob changes."""

    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    protocol: LocalizationProtocol = field(default_factory=LocalizationProtocol)
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
