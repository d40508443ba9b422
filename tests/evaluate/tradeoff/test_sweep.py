"""Sweeps: what is run in which order, and what an interrupted one does again."""

import errno
import os
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from toy_stage import Toy, ToyScene, ToySettings

from gsencoder.core.errors import InputError
from gsencoder.core.process import Growth
from gsencoder.evaluate.tradeoff.measure import RECORDS_FILE, Record, Records, Timing, interleaved, measure
from gsencoder.evaluate.tradeoff.stage import Judged, Score
from gsencoder.evaluate.tradeoff.sweep import (
    HalvingConfig,
    SweepConfig,
    check_sweep,
    knobs_that_matter,
    settings_of,
    sweep_stage,
)

SCENES = [Path("/rooms/a"), Path("/rooms/b"), Path("/rooms/c")]


@pytest.fixture(autouse=True)
def _without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measuring memory collects garbage, which takes long beside all that tests have imported."""
    monkeypatch.setattr("gsencoder.evaluate.tradeoff.measure.memory_growth", lambda: nullcontext(Growth()))


def test_every_round_takes_every_setting_once_in_an_order_of_its_own() -> None:
    order = list(interleaved(20, 4, seed=3))
    assert [number for number, _ in order] == sorted(number for number, _ in order)
    rounds = [[setting for number, setting in order if number == chosen] for chosen in range(4)]
    assert all(sorted(each) == list(range(20)) for each in rounds)
    assert len({tuple(each) for each in rounds}) == 4
    assert order == list(interleaved(20, 4, seed=3)) != list(interleaved(20, 4, seed=4))


def test_each_setting_is_warmed_up_and_judged_once_and_then_timed_in_each_round() -> None:
    toy = Toy()
    settings = [{}, {"effort": 1}, {"color": 2}]
    rows = measure(toy.stage(), SCENES[:2], settings, Records(), rounds=3)
    assert [[record.scene for record in row] for row in rows] == [["a", "b"]] * 3
    assert Counter(toy.runs) == {(scene, replace(ToySettings(), **each)): 4 for scene in "ab" for each in settings}
    assert len(toy.judged) == len(set(toy.judged)) == 6
    # Judged ones come before timed ones.
    assert toy.runs[:3] == toy.judged[:3]


@pytest.mark.parametrize("fail_at", range(1, 19, 3))
def test_an_interrupted_sweep_goes_on_where_it_was(tmp_path: Path, fail_at: int) -> None:
    settings = [{}, {"effort": 1}, {"color": 2}]
    whole = Toy()
    expected = measure(whole.stage(), SCENES[:2], settings, Records(), rounds=2)
    toy = Toy()
    toy.fail_at = fail_at
    with pytest.raises(KeyboardInterrupt):
        measure(toy.stage(), SCENES[:2], settings, Records(tmp_path), rounds=2)
    before = len(toy.judged)
    toy.fail_at = None
    rows = measure(toy.stage(), SCENES[:2], settings, Records(tmp_path), rounds=2)
    assert [[record.scores for record in row] for row in rows] == [
        [record.scores for record in row] for row in expected
    ]
    assert {len(record.timings) for row in rows for record in row} == {2}
    # Nothing is judged twice, and no run is timed twice: warm-up runs alone are repeated.
    assert len(toy.judged) == len(set(toy.judged)) == 6
    assert before < 6 or fail_at > 12
    assert len(toy.runs) <= len(whole.runs) + 3
    again = len(toy.runs)
    measure(toy.stage(), SCENES[:2], settings, Records(tmp_path), rounds=2)
    assert len(toy.runs) == again


def test_a_line_that_a_kill_cut_off_is_measured_again_and_a_damaged_one_refused(tmp_path: Path) -> None:
    toy = Toy()
    measure(toy.stage(), SCENES[:1], [{}], Records(tmp_path), rounds=2)
    file = tmp_path / RECORDS_FILE
    whole = file.read_bytes()
    file.write_bytes(whole[:-5])
    (row,) = measure(toy.stage(), SCENES[:1], [{}], Records(tmp_path), rounds=2)
    assert len(row[0].timings) == 2
    assert len(file.read_bytes().splitlines()) == len(whole.splitlines())
    file.write_bytes(b'{"stage": 3}\n')
    with pytest.raises(InputError, match="line 1 is damaged .*resume=false"):
        Records(tmp_path)


def test_measurements_of_another_sweep_are_not_mixed_in(tmp_path: Path) -> None:
    timing = Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0)
    Records(tmp_path, {"scenes": 1}).add_timing("fusion", "a", {}, timing)
    assert len(Records(tmp_path, {"scenes": 1})) == 1
    with pytest.raises(InputError, match="holds measurements of a sweep with other settings; give resume=false"):
        Records(tmp_path, {"scenes": 2})


def test_a_sweep_that_measured_nothing_leaves_nothing_and_does_not_stand_in_the_way_of_another(tmp_path: Path) -> None:
    Records(tmp_path, {"scenes": 1})
    assert list(tmp_path.iterdir()) == []
    Records(tmp_path, {"scenes": 2}).add_timing("fusion", "a", {}, Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0))
    assert len(Records(tmp_path, {"scenes": 2})) == 1


def test_numbers_that_are_not_finite_survive_the_file(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.add_timing("fusion", "a", {"x": 1}, Timing(seconds=1.0, cpu_seconds=0.5, mib=float("nan")))
    records.add_judged("fusion", "a", {"x": 1}, Judged(scores={"cosine": Score(float("nan"), 1)}, bytes=7))
    read = Records(tmp_path).get("fusion", "a", {"x": 1})
    assert read.timings[0].seconds == 1.0
    assert np.isnan(read.timings[0].mib)
    assert np.isnan(read.scores["cosine"].total)
    assert read.bytes == 7


def test_the_order_of_knobs_tells_no_records_apart(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.add_timing("fusion", "a", {"x": 1, "y": 2}, Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0))
    assert len(Records(tmp_path).get("fusion", "a", {"y": 2, "x": 1}).timings) == 1


@pytest.mark.parametrize(
    ("number", "problem"), [(errno.ENOSPC, "no space left on the device"), (errno.EIO, "Input/output error")]
)
def test_a_measurement_that_cannot_be_written_ends_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, problem: str
) -> None:
    def refused(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    timing = Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0)
    records = Records(tmp_path)
    records.add_timing("fusion", "a", {}, timing)
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=f"{RECORDS_FILE}: cannot write: {problem}"):
        records.add_timing("fusion", "a", {}, timing)


def test_one_knob_is_changed_at_a_time_and_the_base_comes_first() -> None:
    stage = Toy().stage()
    assert settings_of(stage, SweepConfig()) == [
        {},
        {"effort": 1},
        {"effort": 2},
        {"effort": 8},
        {"color": 1},
        {"color": 2},
    ]
    assert settings_of(stage, SweepConfig(knobs=("color",), values=("color:0/7",))) == [{}, {"color": 7}]
    assert len(settings_of(stage, SweepConfig(grid=True))) == 4 * 3


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        (SweepConfig(knobs=("rays",)), "^sweep.knobs: 'rays' is no knob of fusion; expected some of effort, color"),
        (SweepConfig(values=("rays:1",)), "^sweep.values: 'rays' is no knob"),
        (SweepConfig(values=("effort:1", "effort:2")), "^sweep.values: effort is given twice"),
        (SweepConfig(values=("effort",)), "^sweep.values: expected KNOB:VALUE/VALUE, got 'effort'"),
        (SweepConfig(values=("effort:",)), "^sweep.values: expected KNOB:VALUE/VALUE, got 'effort:'"),
        (SweepConfig(knobs=("color",), values=("effort:1",)), "^sweep.values: effort is not among sweep.knobs=color;"),
        (SweepConfig(values=("effort:much",)), "^effort: expected a whole number, got 'much'"),
        (SweepConfig(values=("effort:0",)), "^effort=0: effort: expected 1 or more"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused_at_once(sweep: SweepConfig, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_sweep([Toy().stage()], sweep)


def test_a_knob_without_effect_does_not_matter_and_is_not_changed_with_others() -> None:
    toy = Toy()
    result = sweep_stage(toy.stage(), SCENES, Records(), SweepConfig(rounds=1), HalvingConfig(settings=50))
    assert result.matter == ("effort",)
    assert {knob for each in result.results if each.phase == "joint" for knob in each.knobs} <= {"effort"}
    assert [rung.scenes for rung in result.rungs] == [1, 3]
    # Cost and error of the toy trade against each other, so nothing that was tried with the knob is beaten.
    assert all(each.on_front for each in result.results if "color" not in each.knobs)
    assert result.results[0].phase == "base"


def test_a_knob_that_needs_another_is_tried_beside_it_and_judged_against_that() -> None:
    stage = Toy().stage()
    effort, color = stage.knobs
    # The color has no effect of its own; against the base it would seem to have that of the effort.
    stage = replace(stage, knobs=(effort, replace(color, needs={"effort": 8})))
    sweep = SweepConfig(rounds=1, knobs=("color",))
    assert settings_of(stage, sweep) == [{}, {"effort": 8}, {"effort": 8, "color": 1}, {"effort": 8, "color": 2}]
    assert sweep_stage(stage, SCENES, Records(), sweep).matter == ("effort",)


def test_settings_of_the_joint_part_that_were_measured_before_are_not_measured_again() -> None:
    toy = Toy()
    sweep_stage(toy.stage(), SCENES, Records(), SweepConfig(rounds=1), HalvingConfig(settings=50))
    assert max(Counter(toy.runs).values()) == 2


@dataclass(frozen=True)
class Picky(ToySettings):
    """Refuses a combination of values that it accepts alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.effort == 8 and self.color == 2:
            raise InputError("color=2: expected another effort than 8")


def test_combinations_that_a_stage_refuses_are_left_out_and_every_result_has_its_records(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def judge(self: ToyScene, product: ToySettings, settings: ToySettings) -> Judged:
        scores = {"error": Score(1 / settings.effort), "acc_25": Score(settings.color, 8)}
        return Judged(scores=scores, bytes=100 * settings.effort + settings.color)

    monkeypatch.setattr(ToyScene, "judge", judge)
    stage, sweep = replace(Toy().stage(), base=Picky(), cost="bytes"), SweepConfig(rounds=1)
    result = sweep_stage(stage, SCENES, Records(), sweep, HalvingConfig(settings=50))
    assert result.matter == ("effort", "color")
    assert len(result.rungs[0].settings) == 4 * 3 - 1
    # What others beat on the first scene is not measured on the rest.
    assert {each.scenes for each in result.results if each.phase == "joint"} == {1}
    measured = Counter(each.label for each in result.records)
    assert measured == {each.label: each.scenes for each in result.results}


def test_the_cost_of_the_stage_is_the_one_that_decides() -> None:
    stage = replace(Toy().stage(), cost="seconds")
    result = sweep_stage(stage, SCENES[:1], Records(), SweepConfig(rounds=1, knobs=("color",)))
    assert result.cost == "seconds"
    (effort, _), rows = Toy().stage().knobs, []
    for knobs, seconds in (({}, 2.0), ({"effort": 1}, 1.0)):
        timing = Timing(seconds=seconds, cpu_seconds=4.0, mib=1.0)
        rows.append([Record(stage="fusion", scene="a", knobs=knobs, timings=(timing,))])
    assert knobs_that_matter([effort], rows, rows[0], "seconds") == ["effort"]
    assert knobs_that_matter([effort], rows, rows[0], "cpu_seconds") == []
