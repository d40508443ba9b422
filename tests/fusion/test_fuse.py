"""Fusion against its definition, and what happens when it is interrupted."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixed_teachers import EXACT, SPACE, CodedTeacher, FixedTeacher, make_scene
from rooms import merged
from splats import one_gaussian, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse, select_views
from gsencoder.fusion.lift import VisibilityConfig
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Gaussians, Scene


def random_maps(rng: np.random.Generator, count: int = 5) -> list[np.ndarray]:
    return [rng.normal(size=(6, 8, 6)).astype(np.float32) for _ in range(count)]


def by_definition(scene: Scene, maps: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    n = len(scene.gaussians)
    sums, weights = np.zeros((n, 6)), np.zeros(n)
    for view, features in enumerate(maps):
        b = blend(scene.gaussians, scene.views.cameras, view, patch=4, config=BlendConfig(rays_per_patch=16))
        row = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
        np.add.at(sums, b.col.numpy(), b.weight.numpy()[:, None] * features.reshape(-1, 6)[row])
        np.add.at(weights, b.col.numpy(), b.weight.numpy())
    return np.divide(sums, weights[:, None], where=weights[:, None] > 0, out=sums), weights


def decoded(fusion: Fusion) -> np.ndarray:
    return np.where(fusion.features.seen[:, None], fusion.features.decode(), 0)


def test_fused_features_are_the_weighted_mean_of_what_each_gaussian_shows(rng: np.random.Generator) -> None:
    scene, maps = make_scene(), random_maps(rng)
    expected, weights = by_definition(scene, maps)
    for config in (EXACT, replace(EXACT, basis=False)):
        fusion = fuse(scene, FixedTeacher(maps), config)
        np.testing.assert_allclose(fusion.features.weights, weights, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(decoded(fusion), expected, atol=1e-4)


def test_a_constant_map_gives_a_constant_feature() -> None:
    maps = [np.full((6, 8, 6), 3.5, np.float32)] * 5
    fusion = fuse(make_scene(), FixedTeacher(maps))
    np.testing.assert_allclose(decoded(fusion)[fusion.features.seen], 3.5, rtol=1e-5)


@pytest.mark.parametrize("teacher", ["coded", "cheap", "costly"])
def test_the_number_of_threads_does_not_change_a_bit(teacher, rng, monkeypatch):
    """Nor does sensor depth, which hides some Gaussians; views of a cheap teacher are prepared side by side."""
    depths = [rng.uniform(1.5, 3.0, (24, 32)).astype(np.float32) for _ in range(9)]
    scene, maps = make_scene(count=9, depths=depths), random_maps(rng, 9)
    made: FixedTeacher = FixedTeacher(maps)
    if teacher == "coded":
        codes = [rng.integers(-1, 4, (24, 32), dtype=np.int32) for _ in range(9)]
        made = CodedTeacher(codes, rng.normal(size=(4, 6)).astype(np.float32))
    made.cheap = teacher != "costly"
    config = replace(EXACT, visibility=VisibilityConfig(relative=0.2))
    results = []
    for threads in (1, 3, 9):
        # Wherever the machine has fewer cores.
        monkeypatch.setattr("gsencoder.core.threads.thread_count", lambda threads=threads: threads)
        results.append(fuse(scene, made, config))
    assert 0 < results[0].features.seen.sum() < len(results[0].features)
    for other in results[1:]:
        assert (other.features.features == results[0].features.features).all()
        assert (other.features.weights == results[0].features.weights).all()
        assert (other.features.mean == results[0].features.mean).all()


def test_a_narrow_teacher_keeps_all_channels_and_a_wide_one_a_basis(rng, monkeypatch):
    for narrow in (SPACE.channels, SPACE.channels - 1):
        monkeypatch.setattr(sys.modules["gsencoder.fusion.fuse"], "NARROW", narrow)
        features = fuse(make_scene(), FixedTeacher(random_maps(rng))).features
        assert (features.basis is None) == (narrow == SPACE.channels)
        assert features.basis is not None or features.features.shape[1] == SPACE.channels


def test_coded_maps_are_the_same_as_their_vectors(rng: np.random.Generator) -> None:
    scene = make_scene()
    table = rng.normal(size=(4, 6)).astype(np.float32)
    codes = [rng.integers(0, 4, size=(24, 32)).astype(np.int32) for _ in range(5)]
    coded = fuse(scene, CodedTeacher(codes, table), FuseConfig(energy=1.0))
    dense = fuse(scene, FixedTeacher([table[c] for c in codes], stride=1), EXACT)
    np.testing.assert_allclose(decoded(coded), decoded(dense), atol=1e-4)
    np.testing.assert_allclose(coded.features.weights, dense.features.weights, rtol=1e-4)


def two_walls() -> Gaussians:
    near, far = one_gaussian((0, 0, 2), (3.0, 3.0, 0.01), 1.0), one_gaussian((0, 0, 4), (6.0, 6.0, 0.01), 1.0)
    return merged(near, far)


@pytest.mark.parametrize("against", ["rendered", "sensor"])
def test_the_center_lift_sees_a_hidden_wall_unless_an_occlusion_test_hides_it(against: str) -> None:
    maps = [np.ones((6, 8, 6), np.float32)]
    depth = np.full((24, 32), 2.0, np.float32)
    scene = make_scene(count=1, gaussians=two_walls(), depths=[depth])
    seen = fuse(scene, FixedTeacher(maps), replace(EXACT, lift="center")).features.weights
    assert seen.tolist() == [1, 1]
    tested = replace(EXACT, lift="center", visibility=VisibilityConfig(against=(against,)))  # type: ignore[arg-type]
    assert fuse(scene, FixedTeacher(maps), tested).features.weights.tolist() == [1, 0]


TESTS = [(lift, True, ("sensor",)) for lift in ("blend", "center")]
TESTS += [("blend", False, ()), ("center", False, ("rendered",))]


@pytest.mark.parametrize(("lift", "sensor", "tested"), TESTS)
def test_the_automatic_test_takes_the_depth_that_there_is(lift, sensor, tested, rng):
    depths = {"depths": [np.full((24, 32), 2.0, np.float32)]} if sensor else {}
    scene, teacher = make_scene(count=1, gaussians=two_walls(), **depths), FixedTeacher(random_maps(rng)[:1])
    config = FuseConfig(lift=lift, energy=1.0)  # type: ignore[arg-type]
    fusion = fuse(scene, teacher, config)
    assert fusion.depth_sources == tested
    named = fuse(scene, teacher, replace(config, visibility=VisibilityConfig(against=tested)))
    assert (fusion.features.weights == named.features.weights).all()


@pytest.mark.parametrize(
    ("relative", "absolute", "passes"), [(0.1, 0.0, True), (0.01, 0.0, False), (0.0, 0.2, True), (0.1, 0.05, False)]
)
def test_tolerances_combine(relative: float, absolute: float, passes: bool) -> None:
    """The wall is at 2, the sensor says 2.1."""
    depth = np.full((24, 32), 2.1, np.float32)
    scene = make_scene(count=1, gaussians=one_gaussian((0, 0, 2), (3.0, 3.0, 0.01), 1.0), depths=[depth])
    visibility = VisibilityConfig(against=("sensor",), relative=relative, absolute=absolute)
    teacher = FixedTeacher([np.ones((6, 8, 6), np.float32)])
    for lift in ("center", "blend"):
        config = replace(EXACT, lift=lift, visibility=visibility)  # type: ignore[arg-type]
        if passes:
            assert fuse(scene, teacher, config).features.weights[0] > 0
        else:
            with pytest.raises(InputError, match="none of 1 views"):
                fuse(scene, teacher, config)


def test_an_interrupted_run_goes_on_and_ends_with_the_same_bits(tmp_path: Path, rng: np.random.Generator) -> None:
    scene, maps = make_scene(), random_maps(rng)
    whole = fuse(scene, FixedTeacher(maps), EXACT, work=tmp_path / "whole")
    teacher = FixedTeacher(maps)
    teacher.fail_at = 3
    with pytest.raises(KeyboardInterrupt):
        fuse(scene, teacher, EXACT, work=tmp_path / "cut")
    teacher.fail_at, teacher.calls = None, 0
    resumed = fuse(scene, teacher, EXACT, work=tmp_path / "cut")
    assert teacher.calls == 2
    assert (resumed.features.features == whole.features.features).all()
    assert (resumed.features.weights == whole.features.weights).all()


def test_a_folder_of_another_run_is_refused_with_both_settings_named(tmp_path: Path, rng: np.random.Generator) -> None:
    scene, maps = make_scene(), random_maps(rng)
    fuse(scene, FixedTeacher(maps), EXACT, work=tmp_path)
    with pytest.raises(InputError, match=r"fuse\.lift=blend, and this run asks fuse\.lift=center"):
        fuse(scene, FixedTeacher(maps), replace(EXACT, lift="center"), work=tmp_path)
    with pytest.raises(InputError, match=r"begun with scene\.gaussians="):
        fuse(make_scene(gaussians=random_gaussians(20, 3)), FixedTeacher(maps), EXACT, work=tmp_path)
    renamed = replace(scene, views=replace(scene.views, names=tuple(f"other {name}" for name in scene.views.names)))
    with pytest.raises(InputError, match=r"begun with scene\.views="):
        fuse(renamed, FixedTeacher(maps), EXACT, work=tmp_path)


def test_a_share_of_the_views_is_rounded_up_and_never_none() -> None:
    def chosen(count: int, share: float, views: int = 0) -> tuple[int, ...]:
        scene, config = make_scene(count=count), replace(EXACT, view_share=share, views=views)
        return select_views(scene.gaussians, scene.views, config)

    assert chosen(5, 1.0) == (0, 1, 2, 3, 4)
    assert chosen(5, 0.6) == (0, 2, 4)
    assert chosen(5, 0.601) == chosen(5, 0.8) == (0, 1, 3, 4)
    assert chosen(5, 1e-6) == (0,)
    # With a number as well, the fewer of both.
    assert chosen(5, 0.6, views=2) == (0, 4)
    assert chosen(5, 0.4, views=4) == (0, 4)


def test_scenes_that_cannot_be_fused_say_why(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(), FixedTeacher(random_maps(rng))
    with pytest.raises(InputError, match="no Gaussians"):
        fuse(replace(scene, gaussians=None), teacher)
    with pytest.raises(InputError, match="no views"):
        fuse(replace(scene, views=None), teacher)
    away = make_scene(gaussians=random_gaussians(20, center=(0, 0, -50)))
    with pytest.raises(InputError, match="none of 5 views of test sees any Gaussian"):
        fuse(away, teacher)
    with pytest.raises(InputError, match="no sensor depth"):
        fuse(scene, teacher, replace(EXACT, visibility=VisibilityConfig(against=("sensor",))))
