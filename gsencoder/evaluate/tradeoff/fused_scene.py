"""Scenes with Gaussians, a teacher and fused features, on which stages are measured."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.boxes import Hit
from gsencoder.evaluate.protocols.localization import score_queries
from gsencoder.evaluate.tradeoff.stage import Inputs, Score
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.fusion.folder import save_features
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.teachers.build import build_teacher, text_table_of
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class TaughtScene:
    """A scene with Gaussians and a teacher, whose maps are computed once.

    Attributes:
        scene: with Gaussians.
        teacher: cached.
        words: the teacher's; None where it has none.
        inputs: what it was made with.
    """

    scene: Scene
    teacher: CachedTeacher
    words: TextTable | None
    inputs: Inputs

    def fused(self) -> GaussianFeatures:
        """Features by the settings of fusion that no knob changes."""
        return fuse(self.scene, self.teacher, self.inputs.fusion).features

    def hits(self, features: GaussianFeatures, localize: LocalizeConfig | None = None) -> list[Hit]:
        """One for each object that is queried; none where the teacher has no words."""
        if self.words is None:
            return []
        config = self.inputs.localize if localize is None else localize
        return score_queries(self.scene, features, self.words, self.inputs.protocol, config)[0]

    def with_fused(self) -> Scene:
        """The scene with its fused features."""
        features = self.fused()
        return replace(self.scene, features={features.space.name: features})

    def need_words(self, stage: str) -> TextTable:
        """The words.

        Raises:
            InputError: there are none.
        """
        if self.words is None:
            raise InputError(
                f"tradeoff: the stage {stage} asks for words, and the teacher has none; give teacher=labels"
            )
        return self.words


@contextmanager
def taught_scene(path: Path, inputs: Inputs) -> Iterator[TaughtScene]:
    """Reads a scene, seeds it where it has no Gaussians, and builds its teacher."""
    words = text_table_of(inputs.teacher)
    scene = load_scene(path, options=inputs.data)
    scene = with_gaussians(with_counted_views(scene) if words is not None else scene, inputs.seeds)
    with tempfile.TemporaryDirectory(prefix="gsencoder_maps_") as maps:
        teacher = CachedTeacher(build_teacher(inputs.teacher, scene, words), Path(maps))
        yield TaughtScene(scene=scene, teacher=teacher, words=words, inputs=inputs)


def hit_scores(hits: list[Hit]) -> Mapping[str, Score]:
    """Acc@0.25 and Acc@0.5 as sums over objects; nothing where none is queried."""
    if not hits:
        return {}
    return {
        f"acc_{round(100 * threshold)}": Score(float(sum(hit.iou >= threshold for hit in hits)), len(hits))
        for threshold in (0.25, 0.5)
    }


def stored_bytes(scene: Scene, features: GaussianFeatures) -> int:
    """Bytes of the file of features alone, as every command writes it."""
    from gsencoder.fusion.folder import FEATURES_FILE

    with tempfile.TemporaryDirectory(prefix="gsencoder_stored_") as folder:
        save_features(folder, scene, features)
        return (Path(folder) / FEATURES_FILE).stat().st_size
