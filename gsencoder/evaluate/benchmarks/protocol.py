"""What the protocols of `evaluate` share: what they are given, how they answer, and the loop over scenes."""

import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from gsencoder.core.errors import InputError, SceneWarning, counted, error_hint
from gsencoder.core.settings import CheckedConfig
from gsencoder.data.labels.classes import ClassTable, ids_of_raw_names, is_scannetpp_map, load_classes
from gsencoder.data.labels.scans import find_labels
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.sources import FeatureSource, LabeledPoints, labeled_points, with_features
from gsencoder.evaluate.tables import ScoreReport
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.text.vocabulary import Words, check_known
from gsencoder.types import GaussianFeatures, QueryMemory, Scene

PREDICTIONS, LABELS = "predictions", "truth"
"""Names of the folders, or stems of the files, that a benchmark writes and scores."""
CLASS_IDS = "class_ids.csv"
"""The classes of a benchmark, as `score` takes them."""

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """What a protocol is given next to its own settings.

    Attributes:
        words: turn names and sentences into the features' space.
        scenes: loads all scenes one by one, for what must be known before the first is evaluated.
        folder: an existing one, for predictions and labels; None for protocols that write neither.
        method: name of the row of the features in tables.
        classes: see `load_classes`; empty = the names of the scenes' objects.
        label_map: file that gives raw names of objects a class; empty = they are names of classes.
        fusion: of the labels, where they are fused.
        memory_of: the memory that the features of a scene come from, whose queries are rendered and attend to its bank
            at each pixel; None where there is none.
    """

    words: Words
    scenes: Callable[[], Iterator[Scene]] = lambda: iter(())
    scene_names: tuple[str, ...] = ()
    folder: Path | None = None
    method: str = "features"
    classes: str = ""
    label_map: str = ""
    fusion: FuseConfig = field(default_factory=FuseConfig)
    localization: LocalizeConfig = field(default_factory=LocalizeConfig)
    memory_of: Callable[[Scene], QueryMemory | None] = lambda _: None

    def file(self, name: str) -> Path:
        """A file of the folder, which is there."""
        assert self.folder is not None
        return self.folder / name


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneResult(Generic[Result]):
    """What a protocol says of one scene; the value is its own."""

    scene: str
    gaussians: int
    seconds: dict[str, float]
    value: Result


class Benchmark(Generic[Result]):
    """A protocol at work. What cannot be evaluated is refused as it is made, before any scene is read.

    Several processes make one each, share the scenes, and the first reports the results of all.
    """

    def check(self, scene: Scene) -> Scene:
        """The scene with what the protocol needs of it, which is looked at before its features are made."""
        return scene

    def predict(self, scene: Scene, features: GaussianFeatures) -> Result:
        """The result of one scene with Gaussians, given their features."""
        raise NotImplementedError

    def report(self, results: Sequence[SceneResult[Result]]) -> ScoreReport:
        """The scores of all scenes, in their order."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol(CheckedConfig):
    """Settings of one protocol. Subclasses have a field `name: Literal["…"]`."""

    def start(self, evaluation: Evaluation) -> Benchmark[Any]:
        raise NotImplementedError


def predict_scenes(
    benchmark: Benchmark[Result],
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    seeds: SeedConfig = SeedConfig(),
) -> list[SceneResult[Result]]:
    """The results of scenes, one of which is in memory at a time; scenes come with the seconds of loading,
    and `seeds` makes Gaussians for those without."""
    results = []
    for loaded, load_seconds in scenes:
        scene, features, seconds = with_features(benchmark.check(loaded), source, seeds)
        start = time.perf_counter()
        value = benchmark.predict(scene, features)
        seconds = {"load": load_seconds, **seconds, "predict": time.perf_counter() - start}
        results.append(SceneResult(scene=scene.name, gaussians=len(features), seconds=seconds, value=value))
    return results


def warn_of_gaps(counts: Sequence[tuple[str, int]], what: str, advice: str) -> None:
    """Warns of scenes that have nothing to evaluate, and refuses them if there are no others.

    Args:
        counts: names of the scenes, and how much each has.
    """
    empty = [scene for scene, count in counts if not count]
    if len(empty) == len(counts):
        raise InputError(f"evaluate: no {what} in {counted(len(counts), 'scene')}{advice}")
    if empty:
        warnings.warn(
            f"no {what} in {len(empty)} of {len(counts)} scenes (first: {empty[0]!r})", SceneWarning, stacklevel=3
        )


def names_of(scenes: Iterable[Scene]) -> list[str]:
    """All names of the objects of scenes, in alphabetical order."""
    return sorted({each.name for scene in scenes for each in scene.objects if each.name})


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedClasses:
    """The classes of an evaluation, and what leads to them.

    Attributes:
        table: of those that can be predicted.
        class_of: class of each raw name; None where objects have names of classes.
        labeled: of ScanNet++, raw names of the objects that a vertex can belong to; None = all.
    """

    table: ClassTable
    class_of: Mapping[str, str] | None = None
    labeled: Collection[str] | None = None

    def points(self, scene: Scene) -> LabeledPoints:
        """The points of a scene, whose objects have classes."""
        mesh = None if scene.folder is None else find_labels(scene.folder, names=self.labeled)
        points = labeled_points(scene, mesh)
        return points if self.class_of is None else points.renamed(self.class_of)


def predicted_classes(evaluation: Evaluation, *, instances: bool = False) -> PredictedClasses:
    """The classes that an evaluation asks for, all of which its words know."""
    class_of, labeled = None, None
    if evaluation.classes:
        table = load_classes(evaluation.classes, instances=instances)
    elif evaluation.label_map:
        raise InputError("label_map: gives objects a class of classes=, such as scannet20, scannet200 or top100.txt")
    else:
        names = names_of(evaluation.scenes())
        table = ClassTable(names=tuple(names), ids=tuple(range(1, len(names) + 1)))
    if evaluation.label_map:
        name_of, ids = table.name_of, ids_of_raw_names(evaluation.label_map, evaluation.classes)
        class_of = {raw: name_of[number] for raw, number in ids.items() if number in name_of}
        labeled = list(ids) if is_scannetpp_map(evaluation.label_map) else None
    with error_hint("give words that know all classes, or the classes that they know as classes=FILE"):
        check_known(evaluation.words, table.names)
    return PredictedClasses(table=table, class_of=class_of, labeled=labeled)
