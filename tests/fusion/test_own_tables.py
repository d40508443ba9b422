"""Coded maps whose table differs from view to view, as regions with a vector each have it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixed_teachers import make_scene
from training_scenes import PREPARE, prepared
from training_scenes import SPACE as SIDES
from training_scenes import scene as side_scene

from gsencoder.fusion.basis import distinct_rows
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import VisibilityConfig
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

SPACE = FeatureSpace(name="s", channels=6)
IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])
SIZE = (24, 32)
REGIONS = (3, 0, 5, 1)
"""Number of regions of each view; one has none."""


class OwnTables:
    """Regions of each view with vectors of their own; as codes, or as the dense maps that they stand for."""

    table = None
    mean = None
    needs_images = False

    def __init__(self, rng: np.random.Generator, *, dense: bool, cheap: bool = True) -> None:
        self.dense, self.cheap, self.space, self.calls = dense, cheap, SPACE, 0
        self.maps = [
            FeatureMap(
                codes=rng.integers(-1, count, SIZE).astype(np.int32),
                table=rng.normal(size=(count, 6)).astype(np.float32),
                grid_from_image=IDENTITY,
                space=SPACE,
            )
            for count in REGIONS
        ]

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        made = self.maps[view]
        if not self.dense:
            return made
        return FeatureMap(features=made.rows().reshape(*SIZE, 6), grid_from_image=IDENTITY, space=SPACE)

    def settings(self) -> dict[str, Any]:
        return {"name": "own"}


def scene_of(masks: list[np.ndarray] | None = None) -> Scene:
    return make_scene(count=len(REGIONS), masks=masks)


@pytest.mark.parametrize("lift", ["blend", "center"])
@pytest.mark.parametrize("masked", [False, True])
def test_fusing_codes_with_tables_of_their_own_equals_fusing_their_vectors(rng, lift, masked):
    scene = scene_of([rng.random(SIZE) < 0.7 for _ in REGIONS] if masked else None)
    config = FuseConfig(lift=lift, basis=False, visibility=VisibilityConfig(against=()))
    seed = rng.integers(1000)
    coded, dense = (
        fuse(scene, OwnTables(np.random.default_rng(seed), dense=dense), config).features for dense in (False, True)
    )
    assert coded.seen.any()
    np.testing.assert_array_equal(coded.seen, dense.seen)
    np.testing.assert_allclose(coded.weights, dense.weights, rtol=1e-4)
    np.testing.assert_allclose(coded.features, dense.features, rtol=1e-3, atol=1e-5)


def test_each_region_counts_once_however_many_pixels_it_has(rng: np.random.Generator) -> None:
    teacher = OwnTables(rng, dense=False)
    rows = np.concatenate([each.table[np.unique(each.codes[each.codes >= 0])] for each in teacher.maps])  # type: ignore[index]
    np.testing.assert_array_equal(np.concatenate([distinct_rows(each) for each in teacher.maps]), rows)
    fused = fuse(scene_of(), teacher, FuseConfig(energy=1.0)).features
    np.testing.assert_allclose(fused.mean, rows.mean(axis=0), atol=1e-5)


def test_maps_with_tables_of_their_own_are_made_once_and_read_as_they_were(tmp_path, rng):
    teacher = OwnTables(rng, dense=False, cheap=False)
    cached = CachedTeacher(teacher, tmp_path)
    views = scene_of().views
    for _ in range(2):
        for view, made in enumerate(teacher.maps):
            read = cached.feature_map(views, view)
            for name in ("codes", "table", "grid_from_image"):
                np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert teacher.calls == len(REGIONS)


class SideRegions:
    """The halves of the picture as two regions, with vectors of each view's own; the second view has no region."""

    table = None
    mean = None
    needs_images = False
    cheap = True
    space = SIDES

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        shape = int(views.cameras.heights[view]), int(views.cameras.widths[view])
        codes, table = np.full(shape, -1, np.int32), np.zeros((0, 4), np.float32)
        if view == 0:
            codes[:] = np.arange(shape[1]) >= shape[1] // 2
            table = np.array([[1, 0, 0, 0], [0, 2, 0, 0]], np.float32)
        return FeatureMap(codes=codes, table=table, grid_from_image=IDENTITY, space=SIDES)

    def settings(self) -> dict[str, Any]:
        return {"name": "side regions"}


def test_scenes_are_prepared_for_training_from_tables_of_their_views(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1, teacher=SideRegions())
    outputs, codebook = dataset.load_space()
    assert codebook is None
    np.testing.assert_allclose(outputs.mean, [0.5, 1, 0, 0], atol=1e-6)
    one = dataset.scenes(names)[0]
    fused = fuse(side_scene(0), SideRegions(), replace(PREPARE.fusion, basis=False)).features
    rows = np.flatnonzero(fused.seen)
    np.testing.assert_allclose(outputs.restore(one.targets(rows)), fused.features[rows], atol=5e-3)
