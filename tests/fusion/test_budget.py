"""Budgets of fusion: limits are kept, looser ones never cost more, and choosing costs little."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fixed_teachers import SPACE, CodedTeacher, FixedTeacher, make_scene
from splats import one_gaussian

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import field_error, judge
from gsencoder.fusion.budget import BudgetFusion, FusionBudget, check_budget, exact_config, fuse_within
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import VisibilityConfig
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
