"""Sweeps: what is run in which order, what an interrupted one does again, and what results say of scenes."""

import errno
import os
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import sem
from toy_stage import Toy, ToyScene, ToySettings

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.peak_memory import Growth
from gsencoder.evaluate.tradeoff.halving import HalvingConfig
from gsencoder.evaluate.tradeoff.measure import interleaved, measure
from gsencoder.evaluate.tradeoff.records import RECORDS_FILE, Record, Records, Timing
from gsencoder.evaluate.tradeoff.results import (
    estimate,
    estimate_difference,
    mark_front,
    pick_within,
    scene_row,
    summarize,
)
from gsencoder.evaluate.tradeoff.stage import Judged, Score
from gsencoder.evaluate.tradeoff.sweep import (
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
    ("number", "said"), [(errno.ENOSPC, "no space left on the device"), (errno.EIO, "Input/output error")]
)
def test_a_measurement_that_cannot_be_written_ends_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    def refused(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    timing = Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0)
    records = Records(tmp_path)
    records.add_timing("fusion", "a", {}, timing)
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=f"{RECORDS_FILE}: cannot write: {said}"):
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
    stage, sweep = replace(Toy().stage(), base=Picky()), SweepConfig(rounds=1, cost="bytes")
    result = sweep_stage(stage, SCENES, Records(), sweep, HalvingConfig(settings=50))
    assert result.matter == ("effort", "color")
    assert len(result.rungs[0].settings) == 4 * 3 - 1
    # What others beat on the first scene is not measured on the rest.
    assert {each.scenes for each in result.results if each.phase == "joint"} == {1}
    measured = Counter(each.label for each in result.records)
    assert measured == {each.label: each.scenes for each in result.results}


def test_the_cost_that_is_asked_for_is_the_one_that_decides() -> None:
    result = sweep_stage(Toy().stage(), SCENES[:1], Records(), SweepConfig(rounds=1, knobs=("color",), cost="seconds"))
    assert result.cost == "seconds"
    (effort, _), rows = Toy().stage().knobs, []
    for knobs, seconds in (({}, 2.0), ({"effort": 1}, 1.0)):
        timing = Timing(seconds=seconds, cpu_seconds=4.0, mib=1.0)
        rows.append([Record(stage="fusion", scene="a", knobs=knobs, timings=(timing,))])
    assert knobs_that_matter([effort], rows, rows[0], "seconds") == ["effort"]
    assert knobs_that_matter([effort], rows, rows[0], "cpu_seconds") == []


def test_what_scenes_do_not_agree_on_is_noise_and_a_scene_without_things_says_nothing() -> None:
    (effort, _) = Toy().stage().knobs

    def row(*hits: int, **knobs: int) -> list[Record]:
        scenes = [record(name, [1.0], {"acc_25": Score(n, 8)}, **knobs) for name, n in zip("abc", hits, strict=True)]
        return [*scenes, record("d", [1.0], {"acc_25": Score(0, 0)}, **knobs)]

    base = row(4, 4, 4)
    assert knobs_that_matter([effort], [base, row(7, 2, 4, effort=1)], base, "bytes") == []
    assert knobs_that_matter([effort], [base, row(6, 5, 6, effort=1)], base, "bytes") == ["effort"]


def record(scene: str, cpu: list[float], scores: dict[str, Score] | None = None, **knobs: int) -> Record:
    timings = tuple(Timing(seconds=2 * value, cpu_seconds=value, mib=10.0) for value in cpu)
    return Record(
        stage="fusion", scene=scene, knobs=knobs, timings=timings, judged=Judged(scores=scores or {}, bytes=1)
    )


def test_times_are_medians_over_rounds_and_means_over_scenes_and_ratios_are_of_the_same_round() -> None:
    base = [record("a", [1.0, 2.0, 3.0]), record("b", [10.0, 20.0, 30.0])]
    half = [record("a", [0.5, 1.0, 1.5], views=1), record("b", [5.0, 10.0, 15.0], views=1)]
    result = summarize(half, base, "one at a time")
    assert (result.cpu_seconds, result.seconds) == (5.5, 11.0)
    assert result.ratio == pytest.approx(0.5)
    assert result.ratio_error == pytest.approx(0)
    assert result.spread == pytest.approx(1.4826 * 0.5)


def test_memory_is_that_of_the_largest_scene_bytes_a_mean_and_spread_a_median_over_scenes() -> None:
    rows = [
        record(name, cpu) for name, cpu in (("a", [1.0, 1.0, 1.0]), ("b", [1.0, 2.0, 4.0]), ("c", [1.0, 9.0, 17.0]))
    ]
    rows = [
        replace(
            row,
            timings=tuple(replace(timing, mib=mib) for timing in row.timings),
            judged=Judged(scores={}, bytes=size),
        )
        for row, mib, size in zip(rows, (30.0, 50.0, 10.0), (1, 2, 6), strict=True)
    ]
    result = summarize(rows, rows, "base")
    assert (result.mib, result.bytes) == (50.0, 3.0)
    assert result.spread == pytest.approx(1.4826 * 0.5)


def test_ratios_are_of_the_rounds_that_both_have_and_their_error_is_that_of_the_mean_logarithm() -> None:
    base = [record(name, [1.0, 4.0, 16.0]) for name in "abc"]
    shares = (0.5, 0.25, 0.7)
    rows = [record(name, [share, 4 * share], views=1) for name, share in zip("abc", shares, strict=True)]
    result = summarize(rows, base, "one at a time")
    assert result.ratio == pytest.approx(np.prod(shares) ** (1 / 3))
    assert result.ratio_error == pytest.approx(sem(np.log(shares)))


def test_the_row_of_a_scene_has_medians_over_rounds_and_shares_of_its_things() -> None:
    row = scene_row(record("a", [1.0, 2.0, 9.0], {"acc_25": Score(3, 4), "acc_50": Score(0, 0)}, views=1))
    assert (row["setting"], row["scene"], row["cpu_seconds"], row["seconds"]) == ("views=1", "a", 2.0, 4.0)
    assert (row["acc_25"], row["acc_25_things"], row["acc_50_things"]) == (0.75, 4, 0)
    assert np.isnan(row["acc_50"])


def test_a_score_counts_things_and_its_error_is_that_of_scenes() -> None:
    value, error, things = estimate([Score(3, 4), Score(1, 4)])
    assert (value, things) == (0.5, 8)
    # With as many things in each scene it is the standard error of the mean of the scenes' shares.
    assert error == pytest.approx(np.std([0.75, 0.25], ddof=1) / np.sqrt(2))
    assert np.isnan(estimate([Score(3, 4)]).error)
    assert np.isnan(estimate([Score(0, 0)]).value)
    # A scene without things says nothing, and changes nothing but the number of scenes.
    assert estimate([Score(3, 4), Score(1, 4), Score(0, 0)]).value == 0.5


def test_standard_errors_hold_the_truth_as_often_as_they_say() -> None:
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(1000):
        chance = generator.beta(8, 2, size=40)
        things = generator.integers(4, 15, size=40)
        hits = generator.binomial(things, chance)
        value, error, _ = estimate([Score(float(h), float(n)) for h, n in zip(hits, things, strict=True)])
        inside += abs(value - 0.8) <= 1.96 * error
    assert 0.92 < inside / 1000 < 0.98


def test_a_difference_of_scores_has_the_error_of_differences_of_scenes() -> None:
    base = [Score(3, 4), Score(1, 4), Score(2, 4)]
    # Every scene gains one thing, so that nothing about the gain is uncertain, whatever the scenes' scores are.
    assert estimate_difference([Score(4, 4), Score(2, 4), Score(3, 4)], base) == pytest.approx((0.25, 0.0, 12))
    value, error, _ = estimate_difference([Score(4, 4), Score(0, 4), Score(3, 4)], base)
    assert value == pytest.approx(1 / 12)
    assert error == pytest.approx(np.std([0.25, -0.25, 0.25], ddof=1) / np.sqrt(3))
    assert np.isnan(estimate_difference([Score(3, 4)], [Score(1, 4)]).error)
    assert np.isnan(estimate_difference([], []).value)


def test_differences_are_of_the_scenes_that_both_have_scores_of() -> None:
    base = [record("a", [1.0], {"acc_25": Score(1, 2)}), record("b", [1.0])]
    other = [record("b", [1.0], {"acc_25": Score(2, 2)}, views=1), record("a", [1.0], {"acc_25": Score(2, 2)}, views=1)]
    row = summarize(other, base, "grid").row()
    assert (row["acc_25_difference"], row["acc_25_things"]) == (0.5, 4)
    assert "acc_25_difference" not in summarize(base, base, "base").row()


def test_the_front_is_drawn_among_settings_of_as_many_scenes() -> None:
    def result(cpu: float, error: float, scenes: int = 2, **knobs: int):  # type: ignore[no-untyped-def]
        rows = [record(name, [cpu], {"error": Score(error)}, **knobs) for name in "ab"[:scenes]]
        return summarize(rows, rows, "grid")

    marked = mark_front(
        [result(1.0, 0.3), result(2.0, 0.2, n=1), result(3.0, 0.25, n=2), result(0.1, 0.0, scenes=1, n=3)],
        "error",
        "cpu_seconds",
    )
    assert [each.on_front for each in marked] == [True, True, False, False]


def test_a_limit_of_error_takes_the_cheapest_and_one_of_seconds_the_most_exact() -> None:
    def result(seconds: float, error: float, **knobs: int):  # type: ignore[no-untyped-def]
        rows = [record("a", [seconds / 2], {"error": Score(error)}, **knobs)]
        return summarize(rows, rows, "grid")

    trades = [result(3.0, 0.1), result(2.0, 0.2, n=1), result(1.0, 0.3, n=2)]
    assert pick_within(trades, None, 0.25).knobs == {"n": 1}
    assert pick_within(trades, 2.5, None).knobs == {"n": 1}
    assert pick_within(trades, 5.0, 0.3).knobs == {"n": 2}
    with pytest.raises(InputError, match=r"fastest \(n=2\).*most exact \(defaults\)"):
        pick_within(trades, 0.5, None)
