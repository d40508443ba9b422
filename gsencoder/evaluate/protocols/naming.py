"""The naming protocol on labeled scenes: is the nearest word of a Gaussian's feature the one that it was fused from?

For every scene the choices are the names of its objects and "other", the normalized mean of the whole table. The truth
is the nearest of them to the feature that the labels teacher's maps are fused into. Only Gaussians that were seen
count, and every name counts the same, however many Gaussians it has.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.sources import Source, with_features
from gsencoder.fusion.feature_error import field_error
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.teachers.build import build_teacher
from gsencoder.fusion.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

CHUNK = 16_384


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingProtocol:
    """Which names count."""

    name: Literal["naming"] = "naming"
    min_gaussians: int = field(default=1, metadata={"help": "names with fewer Gaussians in all scenes are left out"})

    def __post_init__(self) -> None:
        if self.min_gaussians < 1:
            raise InputError(f"min_gaussians: expected 1 or more, got {self.min_gaussians}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneNames:
    """One scene: for each name the Gaussians that have it, and those among them that were told right.

    Attributes:
        scene: its name.
        total: Gaussians by name, as fused.
        right: of these, those whose feature is nearest to the same name.
        cosine: mean cosine of the features with the fused ones, each about its mean.
        seconds: by step.
    """

    scene: str
    total: dict[str, int]
    right: dict[str, int]
    cosine: float
    seconds: dict[str, float]


def evaluate_naming(
    scenes: Iterable[tuple[Scene, float]],
    source: Source,
    words: TextTable,
    *,
    seeds: SeedConfig = SeedConfig(),
    fusion: FuseConfig = FuseConfig(),
) -> list[SceneNames]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: labeled, with instance maps, as `opened` gives them.
        source: what gives a scene the features that are judged.
        words: of the labels teacher.
        seeds: how Gaussians are made for scenes without.
        fusion: how the truth is fused.

    Raises:
        InputError: whatever is wrong with a scene, or features of a space that the words do not lead into.
    """
    found = []
    for bare, loaded in scenes:
        scene, features, spent = with_features(bare, source, seeds)
        teacher = build_teacher(LabelsConfig(), scene, words)
        assert isinstance(teacher, LabelsTeacher)
        truth = fuse(scene, teacher, fusion).features
        if features.space.text_encoder != words.space.text_encoder:
            raise InputError(
                f"naming: the features are of ({features.space.describe()}), the words of ({words.space.describe()})"
            )
        found.append(compare_names(scene.name, truth, features, teacher, {"load": loaded, **spent}))
    return found


def compare_names(
    name: str,
    truth: GaussianFeatures,
    features: GaussianFeatures,
    teacher: LabelsTeacher,
    seconds: dict[str, float],
) -> SceneNames:
    """Counts the nearest words of a scene's features against those of the fused ones.

    Args:
        name: of the scene.
        truth: fused from the teacher's maps; Gaussians that it has not seen do not count.
        features: of the same Gaussians.
        teacher: of the scene.
        seconds: by step, to be kept with the result.
    """
    rows = np.flatnonzero(truth.seen)
    wanted, told = (nearest_words(one, rows, teacher.vectors) for one in (truth, features))
    total = np.bincount(wanted, minlength=len(teacher.names))
    right = np.bincount(wanted[told == wanted], minlength=len(teacher.names))
    there = np.flatnonzero(total)
    return SceneNames(
        scene=name,
        total={teacher.names[code]: int(total[code]) for code in there},
        right={teacher.names[code]: int(right[code]) for code in there},
        cosine=1 - field_error(features, truth).centered if features.space == truth.space else float("nan"),
        seconds=seconds,
    )


def nearest_words(
    features: GaussianFeatures, rows: Int64[np.ndarray, " n"], vectors: Float32[np.ndarray, "C D"]
) -> Int64[np.ndarray, " n"]:
    """For each row the vector with which its feature has the largest cosine."""
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    parts = [
        (features.decode(rows[start : start + CHUNK]) @ directions.T).argmax(axis=1)
        for start in range(0, len(rows), CHUNK)
    ]
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def naming_scores(scenes: Sequence[SceneNames], protocol: NamingProtocol = NamingProtocol()) -> dict[str, Any]:
    """The figures of the protocol: accuracy averaged over names ("other" is one), over objects' names alone, over
    Gaussians, and of each name, worst first."""
    total: dict[str, int] = {}
    right: dict[str, int] = {}
    for scene in scenes:
        for name, count in scene.total.items():
            total[name] = total.get(name, 0) + count
            right[name] = right.get(name, 0) + scene.right[name]
    each = {name: right[name] / count for name, count in total.items() if count >= protocol.min_gaussians}
    if not each:
        raise InputError(f"naming: no name has {protocol.min_gaussians} Gaussians")
    named = [score for name, score in each.items() if name != "other"]
    gaussians = sum(total[name] for name in each)
    order = sorted(each, key=lambda name: (each[name], name))
    return {
        "accuracy": float(np.mean(list(each.values()))),
        "accuracy_named": float(np.mean(named)) if named else float("nan"),
        "accuracy_gaussians": sum(right[name] for name in each) / gaussians,
        "cosine": float(np.mean([scene.cosine for scene in scenes])),
        "names": {name: {"gaussians": total[name], "accuracy": each[name]} for name in order},
    }
