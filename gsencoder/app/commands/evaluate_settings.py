"""Settings of `gsencoder evaluate`."""

from dataclasses import dataclass, field

from gsencoder.app.settings.config import CommonConfig
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats.files import READABLE
from gsencoder.evaluate.protocols.absent import (
    AbsentProtocol,
)
from gsencoder.evaluate.protocols.grounding import (
    GroundingProtocol,
)
from gsencoder.evaluate.protocols.instances import InstancesProtocol
from gsencoder.evaluate.protocols.localization import (
    LocalizationProtocol,
)
from gsencoder.evaluate.protocols.naming import NamingProtocol
from gsencoder.evaluate.protocols.recognition import RecognitionProtocol
from gsencoder.evaluate.protocols.referring import ReferringProtocol
from gsencoder.evaluate.protocols.retrieval import RetrievalProtocol
from gsencoder.evaluate.protocols.semantics import SemanticsProtocol
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.teachers.build import TeacherConfig
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig(CommonConfig):
    """Settings of `evaluate`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "labeled scenes, or folders of scenes", "metavar": "SCENE", "required": True},
    )
    weights: str = field(
        default="",
        metadata={
            "help": "encoder whose features are evaluated (see encode); empty = the fused features of the teacher"
        },
    )
    features: str = field(
        default="",
        metadata={
            "help": "features that are evaluated in place of those: a folder written by fuse, encode, pack or memory, "
            "or one with such a folder for each scene"
        },
    )
    space: str = field(
        default="",
        metadata={
            "help": "of an encoder or features of several teachers, the one that is evaluated; empty = that of the "
            "words"
        },
    )
    head: str = field(
        default="",
        metadata={
            "help": "adapter head whose outputs are evaluated, such as siglip, with the words of text=; empty = the "
            "features themselves"
        },
    )
    protocol: (
        LocalizationProtocol
        | NamingProtocol
        | AbsentProtocol
        | GroundingProtocol
        | RecognitionProtocol
        | InstancesProtocol
        | SemanticsProtocol
        | ReferringProtocol
        | RetrievalProtocol
    ) = field(default_factory=LocalizationProtocol)
    classes: str = field(
        default="",
        metadata={
            "help": "of recognition, instances and semantics: scannet20, scannet200, a CSV file with the columns id, "
            "name and group, or ScanNet++'s top100.txt; empty = the names of the scenes' objects"
        },
    )
    label_map: str = field(
        default="",
        metadata={
            "help": "scannetv2-labels.combined.tsv, or ScanNet++'s map_benchmark.csv, which gives the raw names of "
            "objects a class of classes=, and of referring tells unique from multiple"
        },
    )
    splat: str = field(default="", metadata={"help": f"Gaussians of the scenes; empty = seeds. {READABLE}"})
    report: bool = field(default=False, metadata={"help": "write report.html, a page with pictures and figures"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    text: TextConfig = field(default_factory=TableTextConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
