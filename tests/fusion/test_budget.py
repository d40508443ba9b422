"""Budgets of fusion: limits are kept, looser ones never cost more, and choosing costs little."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fixed_teachers import EXACT, SPACE, CodedTeacher, FixedTeacher, make_scene
from scipy.sparse import csr_array
from splats import one_gaussian

from gsencoder.core.errors import InputError
from gsencoder.fusion import lift
from gsencoder.fusion.basis import field_error, judge
from gsencoder.fusion.budget import (
    BudgetFusion,
    FusionBudget,
    bisection_order,
    check_budget,
    exact_config,
    fuse_within,
    map_at_rays,
    mean_turn,
)
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import VisibilityConfig, coverage_order, covering_views, keep_visible, sample_view
from gsencoder.render import BlendConfig, blend
from gsencoder.render.blend_cpu import strided_lattice
from gsencoder.types import Cameras, FeatureMap, Scene, Views

BASE = FuseConfig(visibility=VisibilityConfig(against=()))


@pytest.fixture(autouse=True)
def _narrow() -> None:
    """Teachers of few channels need no basis here."""


def alike(count: int, noise: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Maps that show much the same everywhere, and differ from view to view."""
    common = rng.normal(size=(6, 8, 6)).astype(np.float32)
    return [(common + noise * rng.normal(size=common.shape)).astype(np.float32) for _ in range(count)]


def coded(count: int, rng: np.random.Generator, *, empty: bool = False) -> CodedTeacher:
    columns = np.repeat(np.arange(32)[None] // 8, 24, axis=0).astype(np.int32)
    codes = [np.full_like(columns, -1) if empty else columns for _ in range(count)]
    return CodedTeacher(codes, rng.normal(size=(4, 6)).astype(np.float32))


def turned(cameras: Cameras, rows: list[int]) -> Cameras:
    """The cameras, some of them turned around, away from everything."""
    poses = cameras.cam_from_world.copy()
    poses[rows] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ poses[rows]
    return replace(cameras, cam_from_world=poses)


def with_turned(scene: Scene, rows: list[int]) -> Scene:
    return replace(scene, views=replace(scene.views, cameras=turned(scene.views.cameras, rows)))


def kept_error(scene: Scene, teacher: FixedTeacher, made: BudgetFusion) -> float:
    exact = fuse(scene, teacher, exact_config(BASE)).features
    return field_error(made.fusion.features, exact, sample=0).total


def kinds() -> dict[str, Callable[[np.random.Generator], tuple[Scene, FixedTeacher]]]:
    return {
        "many views": lambda rng: (make_scene(count=12), FixedTeacher(alike(12, 0.3, rng))),
        "codes": lambda rng: (make_scene(count=30), coded(30, rng)),
        "one view": lambda rng: (make_scene(count=1), FixedTeacher(alike(1, 0.3, rng))),
        "some look away": lambda rng: (with_turned(make_scene(count=30), [0, 3, 4]), coded(30, rng)),
        "one Gaussian": lambda rng: (make_scene(gaussians=one_gaussian(), count=6), FixedTeacher(alike(6, 0.3, rng))),
    }


@pytest.mark.parametrize("kind", kinds())
def test_a_limit_of_error_is_kept_and_a_looser_one_never_costs_more(kind: str, rng: np.random.Generator) -> None:
    scene, teacher = kinds()[kind](rng)
    costs = []
    for error in (0.002, 0.02, 0.2):
        made = fuse_within(scene, teacher, BASE, FusionBudget(error=error))
        assert kept_error(scene, teacher, made) <= error
        costs.append(made.choice.setting)
    assert costs == sorted(costs, reverse=True)


@pytest.mark.parametrize("costly", [False, True])
def test_a_loose_limit_takes_fewer_views_and_each_of_their_maps_is_used(costly: bool, rng: np.random.Generator) -> None:
    scene, teacher = make_scene(count=30), FixedTeacher(alike(30, 0.1, rng))
    teacher.cheap = not costly
    made = fuse_within(scene, teacher, BASE, FusionBudget(error=0.3))
    assert len(made.fusion.views) < 30
    if costly:
        assert made.teacher.maps.keys() <= set(made.fusion.views)
        assert teacher.calls == len(made.fusion.views)


def test_few_views_of_a_cheap_teacher_are_fused_exactly_and_none_is_looked_at(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(count=24), FixedTeacher(alike(24, 0.1, rng))
    teacher.cheap = True
    made = fuse_within(scene, teacher, BASE, FusionBudget(error=0.3))
    assert (made.choice.setting, made.predicted["error"], teacher.calls) == (24, 0.0, 24)
    assert kept_error(scene, teacher, made) == 0


def test_views_that_see_nothing_are_not_used(rng: np.random.Generator) -> None:
    # These are looked at.
    scene, teacher = with_turned(make_scene(count=30), [7, 15, 22]), coded(30, rng)
    made = fuse_within(scene, teacher, BASE, FusionBudget(error=0.1))
    assert not {7, 15, 22} & set(made.fusion.views)


@pytest.mark.parametrize("nothing", ["no view sees anything", "no features"])
def test_what_cannot_be_fused_is_refused_as_without_a_budget(nothing: str, rng: np.random.Generator) -> None:
    teacher = coded(5, rng, empty=nothing == "no features")
    scene = with_turned(make_scene(), [] if nothing == "no features" else [0, 1, 2, 3, 4])
    with pytest.raises(InputError, match="none of"):
        fuse_within(scene, teacher, BASE, FusionBudget(error=0.01))


def test_the_same_scene_makes_the_same_choice(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(count=12), FixedTeacher(alike(12, 0.3, rng))
    one, other = (fuse_within(scene, teacher, BASE, FusionBudget(error=0.05)) for _ in range(2))
    assert one.fusion.views == other.fusion.views
    assert one.fusion.config == other.fusion.config
    np.testing.assert_array_equal(one.fusion.features.features, other.fusion.features.features)


class SlowTeacher(FixedTeacher):
    """Takes ten seconds of a clock for each map."""

    cheap = True

    def __init__(self, maps: list[np.ndarray]) -> None:
        super().__init__(maps)
        self.now = 0.0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.now += 10
        return super().feature_map(views, view)


def test_more_seconds_are_more_views(rng: np.random.Generator) -> None:
    scene, maps = make_scene(count=16), alike(16, 0.5, rng)
    numbers = []
    for seconds in (60.0, 120.0, 1000.0):
        teacher = SlowTeacher(maps)
        made = fuse_within(
            scene, teacher, BASE, FusionBudget(seconds=seconds), clock=lambda teacher=teacher: teacher.now
        )
        assert made.seconds <= seconds
        numbers.append(len(made.fusion.views))
    assert numbers == sorted(numbers)
    assert numbers[0] < numbers[-1] == 16


def test_where_error_and_other_budgets_conflict_the_error_is_kept_and_each_conflict_named(rng):
    scene, teacher = make_scene(count=6), FixedTeacher(alike(6, 0.3, rng))
    made = fuse_within(scene, teacher, BASE, FusionBudget(error=0.01, seconds=1e-9, megabytes=1e-6))
    assert kept_error(scene, teacher, made) <= 0.01
    assert [note.split("=")[0] for note in made.notes] == ["budget.error", "budget.error"]


def test_fewer_megabytes_are_a_lower_rank(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(n=2000, count=4), FixedTeacher(alike(4, 0.3, rng))
    ranks = [
        fuse_within(scene, teacher, BASE, FusionBudget(megabytes=size)).fusion.features.features.shape[1]
        for size in (0.028, 0.032, 1.0)
    ]
    assert ranks == sorted(ranks)
    assert 1 <= ranks[0] < ranks[-1] == SPACE.channels


def test_megabytes_that_no_coordinate_fits_into_are_refused_with_those_that_one_takes(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(n=2000, count=4), FixedTeacher(alike(4, 0.3, rng))
    with pytest.raises(InputError, match=r"^budget\.megabytes=0\.001: the smallest result takes .* MB") as refused:
        fuse_within(scene, teacher, BASE, FusionBudget(megabytes=0.001))
    needed = float(str(refused.value).split("takes ")[1].split()[0])
    made = fuse_within(scene, teacher, BASE, FusionBudget(megabytes=needed))
    assert made.fusion.features.features.shape[1] == 1
    assert not made.notes


@pytest.mark.parametrize(
    ("fusion", "named"),
    [
        ({"views": 3}, "fusion.views=3"),
        ({"view_choice": "coverage"}, "fusion.view_choice=coverage"),
        ({"lift": "center"}, "fusion.lift=center"),
        ({"visibility": VisibilityConfig(against=("rendered",))}, "against=rendered"),
    ],
)
def test_options_that_a_budget_chooses_or_does_not_know_are_refused(fusion: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        check_budget(FusionBudget(seconds=3.0), FuseConfig(**fusion))
    check_budget(FusionBudget(), FuseConfig(**fusion))


def test_an_error_is_measured_on_a_tenth_of_what_the_exact_features_see(rng: np.random.Generator) -> None:
    scene, teacher = make_scene(count=3), coded(3, rng)
    exact = fuse(scene, teacher, exact_config(BASE)).features
    unseen = replace(exact, weights=np.zeros_like(exact.weights), features=np.zeros_like(exact.features))
    assert judge(exact, exact).total == pytest.approx(0, abs=1e-9)
    assert judge(unseen, exact).total == 1


OPEN = VisibilityConfig(against=())


@pytest.mark.parametrize("depth", [False, True])
def test_sampled_rays_have_the_weights_of_b_at_their_pixels(depth, rng, monkeypatch):
    monkeypatch.setattr(lift, "RAYS", 100)
    depths = [rng.uniform(1.5, 3.0, (24, 33)).astype(np.float32) for _ in range(5)]
    masks = [rng.uniform(size=(24, 33)) > 0.3 for _ in range(5)]
    scene = make_scene(n=400, masks=masks, **({"depths": depths} if depth else {}))
    config = BlendConfig(stop_transmittance=1e-6)
    visibility = VisibilityConfig(against=("sensor",), relative=0.2) if depth else OPEN
    sampled = sample_view(scene.gaussians, scene.views, 2, visibility, config)
    b = blend(scene.gaussians, scene.views.cameras, 2, config=config)
    b = keep_visible(b, depths[2][:, :32], visibility) if depth else b
    assert sampled.shape == (8, 10)
    assert len(sampled.col) > 50
    full, part = (
        csr_array((each.weight.numpy(), each.col.numpy(), each.crow.numpy()), (each.rows, each.gaussians)).toarray()
        for each in (b, sampled)
    )
    pixels = full.reshape(24, 32, -1)[1:24:3, 1:30:3].reshape(80, -1)
    share = masks[2][1:24:3, 1:30:3].reshape(80, 1)
    np.testing.assert_allclose(part, pixels * share, rtol=1e-4, atol=1e-6)


def test_the_first_views_cover_most_and_one_that_adds_nothing_comes_last() -> None:
    seen = np.array([[1, 1, 0, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 1]], bool)
    # Once all are seen, the first view shows two of them a second time.
    assert coverage_order(seen).tolist() == [2, 3, 0, 1]
    assert coverage_order(seen, first=(1,)).tolist() == [1, 2, 3, 0]
    assert coverage_order(np.zeros((3, 4), bool)).tolist() == [0, 1, 2]


def test_a_view_of_the_same_gaussians_comes_after_one_that_shows_another() -> None:
    seen = np.array([[1, 1, 1, 0], [1, 1, 1, 0], [0, 0, 0, 1]], bool)
    assert coverage_order(seen).tolist() == [0, 2, 1]


def test_views_by_coverage_see_more_than_evenly_spaced_ones() -> None:
    """All but two cameras stand together and look at one end; evenly spaced ones are of these."""
    scene = make_scene(n=600, count=9)
    poses = scene.views.cameras.cam_from_world.copy()
    poses[:, 0, 3] = 2.0
    poses[[3, 5], 0, 3] = [0.0, -2.0]
    scene = replace(scene, views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=poses)))
    teacher = FixedTeacher([np.ones((6, 8, 6), np.float32)] * 9)
    even, covering = (
        fuse(scene, teacher, replace(EXACT, views=3, view_choice=choice)) for choice in ("even", "coverage")
    )
    assert covering.features.seen.sum() > even.features.seen.sum()
    assert {3, 5} <= set(covering.views)


def test_all_views_need_no_choice_and_rows_are_those_that_are_given() -> None:
    scene, teacher = make_scene(), FixedTeacher([np.ones((6, 8, 6), np.float32)] * 5)
    assert covering_views(scene.gaussians, scene.views, OPEN, BlendConfig(), 9) == (0, 1, 2, 3, 4)
    of_rows, even = fuse(scene, teacher, EXACT, rows=(0, 2, 4)), fuse(scene, teacher, replace(EXACT, views=3))
    assert of_rows.views == even.views == (0, 2, 4)
    np.testing.assert_array_equal(of_rows.features.features, even.features.features)


def test_views_in_the_order_of_bisection_are_spread_however_many_are_taken() -> None:
    for count in (1, 2, 7, 24, 97):
        order = bisection_order(count)
        assert sorted(order) == list(range(count))
        for taken in range(1, count + 1):
            gaps = np.diff([-1, *sorted(order[:taken]), count])
            assert gaps.max() <= 2 * count / taken + 2


def test_what_a_map_shows_at_rays_is_the_cell_that_each_ray_meets_and_nothing_outside() -> None:
    teacher = FixedTeacher([np.arange(6 * 8 * 6, dtype=np.float32).reshape(6, 8, 6)], stride=4)
    scene = make_scene()
    feature_map = teacher.feature_map(scene.views, 0)
    lattice = strided_lattice(40, 24, 3)  # The map ends after 32 pixels.
    at_rays = map_at_rays(feature_map, lattice)
    assert (at_rays.height, at_rays.width) == (lattice.height, lattice.width)
    for line in range(lattice.height):
        for column in range(lattice.width):
            x, y = int(lattice.x0 + 3 * column) // 4, int(lattice.y0 + 3 * line) // 4
            assert at_rays.has_vector[line, column] == (x < 8)
            if x < 8:
                np.testing.assert_array_equal(at_rays.features[line, column], feature_map.features[y, x])


def test_the_turn_of_means_is_that_of_independent_vectors(rng: np.random.Generator) -> None:
    """Vectors of length 1 with noise of variance s² in D dimensions: 1 − cosine is about D s² / 2 (1/k − 1/K)."""
    maps, count, channels, noise = 8, 4000, 12, 0.05
    common = rng.normal(size=(count, channels))
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    sums = common + noise * rng.normal(size=(maps, count, channels))
    weights, means = np.ones((maps, count)), np.zeros((maps, channels))
    # Perpendicular to the vector, the noise has one dimension less.
    expected = (channels - 1) * noise**2 / 2
    assert mean_turn(sums, weights, means, range(maps)) == pytest.approx(expected, rel=0.05)
    # Halves of a recording that differ count, though neighbors are alike.
    drifting = sums + np.linspace(-0.4, 0.4, maps)[:, None, None] * rng.normal(size=(count, channels))
    assert mean_turn(drifting, weights, means, range(maps)) > 10 * expected
    assert mean_turn(sums[:1], weights[:1], means[:1], [0]) == 1
