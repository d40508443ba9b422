"""The engine of budgets on a fake stage with known costs, the knobs that it turns, and what a run reports."""

import re
from dataclasses import dataclass, field

import numpy as np
import pytest

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.budget import (
    PLANNED,
    Budget,
    Estimate,
    check_any_limit,
    choose,
    error_bound,
    reject_options_set_by_budget,
)
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import (
    Knob,
    changed_knobs,
    describe_values,
    exact_settings,
    read_value,
    value_at,
    with_knobs,
    with_values,
)
from gsencoder.evaluate.tradeoff.stages import (
    ENCODER_KNOBS,
    LOCALIZATION_KNOBS,
    RECONSTRUCTION_KNOBS,
    VIEWS_KNOBS,
    EncoderSettings,
    ReconstructionSettings,
)
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.package import FUSION_KNOBS, PACKAGE_KNOBS, PackageSettings
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.views.targets import ViewsConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class FullBudget(Budget):
    megabytes: float | None = None
    seconds: float | None = None
    error: float | None = None


class Stage:
    """A setting is a number of views of ten: each takes a second and two megabytes and shows a tenth."""

    def __init__(self) -> None:
        self.measured: list[int] = []

    def __call__(self, views: int) -> Estimate:
        self.measured.append(views)
        error = 1 - views / 10
        return Estimate(error=error, bound=min(1.1 * error, 1), seconds=float(views), megabytes=2.0 * views)

    def chosen(self, **limits: float) -> int:
        return choose(range(1, 11), self, FullBudget(**limits)).setting


def test_the_cheapest_setting_whose_bound_keeps_the_error_is_chosen_and_few_are_measured() -> None:
    stage = Stage()
    # Of 8 views the error is 0.2 and may be 0.22.
    assert [stage.chosen(error=error) for error in (1e-9, 0.2, 0.22 + 1e-9, 0.999)] == [10, 9, 8, 1]
    assert len(stage.measured) <= 4 * 5
    limits = np.linspace(0.01, 0.99, 40)
    chosen = [stage.chosen(error=float(limit)) for limit in limits]
    assert chosen == sorted(chosen, reverse=True)


def test_the_most_exact_setting_within_seconds_and_megabytes_is_chosen() -> None:
    stage = Stage()
    assert stage.chosen(seconds=6 / PLANNED + 1e-9) == 6
    assert stage.chosen(seconds=100) == 10
    assert stage.chosen(megabytes=7.9) == 3
    assert stage.chosen(seconds=100, megabytes=7.9) == stage.chosen(seconds=3.9, megabytes=100) == 3
    fastest = choose(range(2, 11), stage, FullBudget(seconds=1))
    assert (fastest.setting, fastest.estimate.seconds) == (2, 2)
    assert fastest.notes == ("budget.seconds=1: the fastest setting takes about 2 s; it is used",)
    with pytest.raises(InputError, match=r"^budget.megabytes=1.5: the smallest result takes 2 MB; give more$"):
        stage.chosen(megabytes=1.5)


def test_an_error_comes_before_seconds_and_megabytes_which_are_named() -> None:
    choice = choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=5, megabytes=100))
    assert choice.setting == 6
    assert choice.notes == ("budget.error=0.5 takes about 6 s, more than budget.seconds=5; budget.error comes first",)
    both = choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=1, megabytes=3))
    assert ["budget.seconds" in both.notes[0], "12 MB" in both.notes[1]] == [True, True]
    assert choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=6)).notes == ()


def test_an_error_is_bounded_by_the_scatter_of_the_sample() -> None:
    assert error_bound([0.1, 0.1, 0.1], 2.0) == pytest.approx(0.2)
    parts = np.array([0.1, 0.3, 0.2, 0.4])
    assert error_bound(parts, 1.0) == pytest.approx(0.25 + 2 * parts.std(ddof=1) / 2)
    assert error_bound([0.9, 0.1], 1.0) == 1


@pytest.mark.parametrize(("name", "value"), [("error", 1.0), ("seconds", 0.0), ("megabytes", float("inf"))])
def test_a_limit_that_means_nothing_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"^{name}: expected a number"):
        FullBudget(**{name: value})
    with pytest.raises(InputError, match="^budget: expected budget.error="):
        check_any_limit(FullBudget())


def test_options_that_a_budget_chooses_are_refused_where_they_are_set_and_only_with_a_budget() -> None:
    keys = ("rate", "inner.high")
    for settings, named in ((Outer(rate=0.5), "s.rate=0.5"), (Outer(inner=Inner(high=8)), "s.inner.high=8")):
        with pytest.raises(InputError, match=f"^{named}: is chosen by budget.error and budget.megabytes"):
            reject_options_set_by_budget(FullBudget(error=0.1, megabytes=1), settings, Outer(), keys, "s")
        reject_options_set_by_budget(FullBudget(), settings, Outer(), keys, "s")
    reject_options_set_by_budget(FullBudget(error=0.1), Outer(), Outer(), keys, "s")


def test_a_limit_that_is_kept_has_a_line_one_that_is_broken_a_warning_and_one_that_is_not_measured_says_so() -> None:
    summary = Run("encode", CommonConfig())
    predicted = {"error": float("nan"), "seconds": 1.9}
    with pytest.warns(SceneWarning, match="^error first$"):
        summary.report_choice("room", {"rank": 4}, predicted=predicted, notes=["error first"])
    assert summary.results["budget"] == {"chosen": {"rank": 4}, "predicted": {"seconds": 1.9}, "notes": ["error first"]}
    budget = FullBudget(error=0.25, seconds=2.0, megabytes=1.0)
    with pytest.warns(SceneWarning, match="^budget.seconds: the limit is 2, and it became 2.001$") as caught:
        lines = summary.report_budget(budget, {"seconds": 2.001, "megabytes": 1.0})
    assert len(caught) == 1
    unmeasured = "budget.error: limit 0.25, not measured (budget.check=false)"
    assert lines == [unmeasured, "budget.megabytes: limit 1, measured 1"]
    assert summary.results["budget"]["limits"] == {"error": 0.25, "seconds": 2.0, "megabytes": 1.0}
    assert summary.results["budget"]["measured"] == {"seconds": 2.001, "megabytes": 1.0}


STAGES = {
    "fusion": (FuseConfig(), FUSION_KNOBS),
    "packages": (PackageSettings(), PACKAGE_KNOBS),
    "encoder": (EncoderSettings(), ENCODER_KNOBS),
    "localization": (LocalizeConfig(), LOCALIZATION_KNOBS),
    "views": (ViewsConfig(), VIEWS_KNOBS),
    "reconstruction": (ReconstructionSettings(), RECONSTRUCTION_KNOBS),
}


@dataclass(frozen=True)
class Inner:
    low: int = 1
    high: int = 2

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise InputError(f"low: expected less than high={self.high}, got {self.low}")


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    rate: float | None = None
    on: bool = False


KNOBS = (
    Knob(name="low", key="inner.low", values=(0,), exact=1),
    Knob(name="high", key="inner.high", values=(5,)),
    Knob(name="rate", key="rate", values=(0.5,), exact=0.0),
    Knob(name="on", key="on", values=(True,)),
)


@pytest.mark.parametrize("stage", STAGES)
def test_every_value_of_every_knob_fits_the_settings_of_its_stage(stage: str) -> None:
    settings, knobs = STAGES[stage]
    assert len({knob.name for knob in knobs}) == len(knobs)
    for knob in knobs:
        for value in knob.values if knob.exact is None else (*knob.values, knob.exact):
            changed = with_knobs(settings, knobs, {knob.name: value})
            assert value_at(changed, knob.key) == value
            assert with_values(changed, {knob.key: value_at(settings, knob.key)}) == settings
    exact = exact_settings(settings, knobs)
    assert all(value_at(exact, knob.key) == knob.exact for knob in knobs if knob.exact is not None)


def test_values_of_one_section_change_together() -> None:
    assert with_knobs(Outer(), KNOBS, {"low": 4, "high": 5}) == Outer(inner=Inner(4, 5))
    with pytest.raises(InputError, match="^low=4: low: expected less than high=2"):
        with_knobs(Outer(), KNOBS, {"low": 4})


@pytest.mark.parametrize("key", ["nope", "inner.nope", "nope.low"])
def test_a_key_that_the_settings_lack_is_refused(key: str) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(key.removeprefix('inner.'))}: no such setting"):
        with_values(Outer(), {key: 1})
    with pytest.raises(InputError, match="^nope: no such knob; expected one of low, high, rate, on"):
        with_knobs(Outer(), KNOBS, {"nope": 1})


def test_changes_are_those_from_the_base_in_the_order_of_the_knobs() -> None:
    assert changed_knobs(Outer(), KNOBS, {"on": True, "high": 5, "low": 1}) == {"high": 5, "on": True}
    assert describe_values({"high": 5, "on": True, "rate": 1e-6}) == "high=5, on=true, rate=1e-06"
    assert describe_values({}) == "defaults"


def test_text_becomes_a_value_of_the_declared_type() -> None:
    low, _, rate, on = KNOBS
    assert (read_value(Outer(), low, "3"), read_value(Outer(), on, "true")) == (3, True)
    assert read_value(Outer(), rate, "3") == 3.0
    for knob, text in ((low, "3.5"), (rate, "much"), (on, "yes")):
        with pytest.raises(InputError, match=f"^{knob.name}: expected .*, got '{text}'"):
            read_value(Outer(), knob, text)
    graph = next(knob for knob in ENCODER_KNOBS if knob.name == "graph")
    with pytest.raises(InputError, match="^graph: expected one of none, float32, .*got 'int4'"):
        read_value(EncoderSettings(), graph, "int4")
