"""Knobs: values go into nested frozen settings, and only there; every stage's list fits its settings."""

import re
from dataclasses import dataclass, field

import pytest

from gsencoder.core.errors import InputError
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
    assert (read_value(Outer(), low, "3"), read_value(Outer(), rate, "3"), read_value(Outer(), on, "true")) == (
        3,
        3.0,
        True,
    )
    for knob, text in ((low, "3.5"), (rate, "much"), (on, "yes")):
        with pytest.raises(InputError, match=f"^{knob.name}: expected .*, got '{text}'"):
            read_value(Outer(), knob, text)
    graph = next(knob for knob in ENCODER_KNOBS if knob.name == "graph")
    with pytest.raises(InputError, match="^graph: expected one of none, float32, .*got 'int4'"):
        read_value(EncoderSettings(), graph, "int4")
