"""Walls prepared for two teachers, and samples with the targets of both."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from training_scenes import SMALL, DenseSideTeacher, SideTeacher, prepared, samples

from gsencoder.train.losses import Batch, TeacherRecipe
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.samples import SampleDataset, SampleRecipe, TrainingScene, join_samples
from gsencoder.types import FeatureMap, FeatureSpace, Views

TALL = FeatureSpace(name="heights", channels=4)


class HeightTeacher(DenseSideTeacher):
    """Says of cells of two pixels how high in the picture they are."""

    space = TALL

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        seen = super().feature_map(views, view)
        rows = np.linspace(-1, 1, len(seen.features), dtype=np.float32)[:, None]
        features = np.stack(np.broadcast_arrays(rows, rows**2, np.sin(3 * rows), np.float32(0)), axis=-1)
        features = np.broadcast_to(features, seen.features.shape).astype(np.float32)
        return FeatureMap(features=features.copy(), grid_from_image=seen.grid_from_image, space=TALL)


class DenseTeacher(DenseSideTeacher):
    """A dense teacher of a space of its own."""

    space = FeatureSpace(name="dense sides", channels=4)

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        return replace(super().feature_map(views, view), space=self.space)


Datasets = Mapping[str, tuple[PreparedDataset, list[str]]]


def prepared_by_both(folder: Path) -> Datasets:
    """The same walls, prepared for two teachers; the second one lacks the last wall."""
    sides, names = prepared(folder / "sides", teacher=SideTeacher())
    heights, _ = prepared(folder / "heights", count=2, teacher=HeightTeacher())
    return {"sides": (sides, names), "heights": (heights, names)}


def joint(datasets: Datasets, weights: Mapping[str, float] = {}, **changes: object) -> SampleDataset:
    """Samples of all walls with the targets of both teachers."""
    recipe: SampleRecipe = samples(*datasets["sides"], **changes).recipe
    teachers = tuple(
        TeacherRecipe(name=name, codebook=dataset.load_codebook(), weight=weights.get(name, 1.0))
        for name, (dataset, _) in datasets.items()
    )
    names = datasets["sides"][1]
    scenes = [TrainingScene([dataset.find_scene(name) for dataset, _ in datasets.values()]) for name in names]
    return SampleDataset(scenes, replace(recipe, teachers=teachers))


def batch_of(data: SampleDataset, numbers: range) -> Batch:
    batch = join_samples([data[number] for number in numbers], SMALL.transformer.patch)
    assert isinstance(batch, Batch)
    return batch
