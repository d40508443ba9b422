"""Fusion where B is made and multiplied by torch, as on a GPU, against the numba kernels of a CPU."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from fixed_teachers import EXACT, SPACE, CodedTeacher, FixedTeacher, make_scene
from pretend_device import pretended_device

from gsencoder.core.errors import InputError
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse
from gsencoder.fusion.lift import VisibilityConfig
from gsencoder.render import BlendConfig
from gsencoder.types import FeatureMap, Scene, Views

TORCH = BlendConfig(backend="torch")
VIEWS = 2
DEPTHS = tuple(np.full((24, 32), 2.0 + 0.3 * view, np.float32) for view in range(VIEWS))
MASKS = tuple(np.random.default_rng(view).random((24, 32)) < 0.7 for view in range(VIEWS))
TABLE = np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32)


class OwnTables(CodedTeacher):
    """Coded maps with a table each."""

    table = None

    def __init__(self, codes: list[np.ndarray], table: np.ndarray) -> None:
        super().__init__(codes, table)
        self.own, self.table = table, None  # type: ignore[assignment]

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        grid = np.array([[1.0, 0, 0], [0, 1.0, 0]])
        return FeatureMap(codes=self.maps[view], table=self.own + view, grid_from_image=grid, space=SPACE)


def teacher_of(kind: str) -> Any:
    rng = np.random.default_rng(1)
    if kind == "dense":
        maps = [rng.normal(size=(6, 8, 6)).astype(np.float32) for _ in range(VIEWS)]
        maps[1][1, 3] = np.nan
        return FixedTeacher(maps)
    codes = [rng.integers(-1, 7, (24, 32)).astype(np.int32) for _ in range(VIEWS)]
    return CodedTeacher(codes, TABLE) if kind == "coded" else OwnTables(codes, TABLE)


def hidden_scene(**views: Any) -> Scene:
    return make_scene(150, VIEWS, **views)


CASES = {
    "plain": (EXACT, {}),
    "basis": (replace(EXACT, energy=0.9), {}),
    "all channels": (replace(EXACT, basis=False), {}),
    "sensor depth": (
        replace(EXACT, visibility=VisibilityConfig(against=("sensor",), relative=0.5)),
        {"depths": DEPTHS},
    ),
    "rendered depth": (replace(EXACT, visibility=VisibilityConfig(against=("rendered",), relative=0.1)), {}),
    "masks": (EXACT, {"masks": MASKS}),
    "centers": (replace(EXACT, lift="center", visibility=VisibilityConfig(against=("rendered",), relative=0.1)), {}),
}


PAIRS = [*(("dense", case) for case in CASES), ("coded", "masks"), ("own tables", "masks"), ("own tables", "centers")]


@cache
def by_torch(case: str, kind: str) -> Fusion:
    """What both tests hold against another fusion."""
    config, views = CASES[case]
    return fuse(hidden_scene(**views), teacher_of(kind), replace(config, blend=TORCH), device="cpu")


def assert_same(one: Fusion, other: Fusion, *, atol: float) -> None:
    np.testing.assert_allclose(one.features.weights, other.features.weights, rtol=1e-4, atol=atol)
    # Of a Gaussian that hardly anything sees, the weights are rounding.
    seen = other.features.weights > 1e-3
    assert seen.any()
    np.testing.assert_allclose(one.features.features[seen], other.features.features[seen], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("kind", "case"), PAIRS)
def test_a_fusion_by_torch_equals_that_by_numba(case: str, kind: str) -> None:
    config, views = CASES[case]
    scene = hidden_scene(**views)
    expected = fuse(scene, teacher_of(kind), config, device="cpu")
    assert_same(by_torch(case, kind), expected, atol=1e-4)


@pytest.mark.parametrize(("kind", "case"), PAIRS)
def test_a_fusion_on_another_device_leaves_no_tensor_behind_and_gives_the_same(case: str, kind: str) -> None:
    config, views = CASES[case]
    scene = hidden_scene(**views)
    expected = by_torch(case, kind)
    with pretended_device() as device:
        assert_same(fuse(scene, teacher_of(kind), config, device=device), expected, atol=1e-5)


def test_the_numba_kernels_are_refused_on_another_device() -> None:
    config = replace(EXACT, blend=BlendConfig(backend="cpu"))
    refusal = pytest.raises(InputError, match="blend.backend: cpu computes on a CPU alone, got device meta")
    with pretended_device() as device, refusal:
        fuse(hidden_scene(), teacher_of("dense"), config, device=device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
def test_a_device_that_is_not_there_is_an_error() -> None:
    with pytest.raises(InputError, match="torch sees no GPU"):
        fuse(hidden_scene(), teacher_of("dense"), FuseConfig(), device="cuda")
