"""Sweeps: what is run in which order, what an interrupted one does again, what goes on, and what results say."""

import errno
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import linregress, sem, t

from gsencoder.core.errors import InputError
from gsencoder.core.process import Growth
from gsencoder.core.settings import Knob
from gsencoder.evaluate.tradeoff.measure import RECORDS_FILE, Record, Records, Timing, interleaved, measure
from gsencoder.evaluate.tradeoff.scaling import ScalingConfig, fit_exponent, geometric_sizes
from gsencoder.evaluate.tradeoff.stages import Opened, Score, Scores, Stage
from gsencoder.evaluate.tradeoff.sweep import (
    HalvingConfig,
    SweepConfig,
    best_first,
    check_sweep,
    crowding,
    draw_settings,
    effective_knobs,
    estimate,
    mark_front,
    non_dominated_ranks,
    scene_row,
    settings_of,
    successive_halving,
    summarize,
    sweep_stage,
)


@dataclass(frozen=True)
class ToySettings:
    effort: int = 4
    color: int = 0

    def __post_init__(self) -> None:
        if self.effort < 1:
            raise InputError(f"effort: expected 1 or more, got {self.effort}")


class Toy:
    """Runs and judgments of all scenes in order, as they were asked for; a run may be made to fail."""

    def __init__(self, *, colors_count: bool = False) -> None:
        self.runs: list[tuple[str, ToySettings]] = []
        self.judged: list[tuple[str, ToySettings]] = []
        self.fail_at: int | None = None
        self.colors_count = colors_count

    @contextmanager
    def opened(self, path: Path) -> Iterator[Opened]:
        def run(settings: ToySettings) -> ToySettings:
            if self.fail_at == len(self.runs):
                raise KeyboardInterrupt
            self.runs.append((path.name, settings))
            return settings

        def judge(product: ToySettings, settings: ToySettings) -> tuple[Scores, int]:
            assert product == settings
            self.judged.append((path.name, settings))
            hits = settings.color if self.colors_count else settings.effort
            scores = {"error": Score(1 / settings.effort), "acc_25": Score(hits, 8)}
            return scores, 100 * settings.effort + self.colors_count * settings.color

        yield run, judge

    def stage(self) -> Stage:
        knobs = (
            Knob(name="effort", key="effort", values=(1, 2, 8), exact=8),
            Knob(name="color", key="color", values=(1, 2)),
        )
        base = ToySettings()
        return Stage(name="fusion", knobs=knobs, base=base, open=self.opened, accuracy="error", cost="bytes")


def record(scene: str, cpu: list[float], scores: Scores | None = None, **knobs: int) -> Record:
    timings = tuple(Timing(seconds=2 * value, cpu_seconds=value, mib=10.0) for value in cpu)
    return Record(stage="fusion", scene=scene, knobs=knobs, timings=timings, scores=scores or {}, bytes=1)


SCENES = [Path("/rooms/a"), Path("/rooms/b"), Path("/rooms/c")]
CHANGES = [{}, {"effort": 1}, {"color": 2}]
TIMING = Timing(seconds=1.0, cpu_seconds=0.5, mib=1.0)
ALL = HalvingConfig(settings=50)


@pytest.fixture(autouse=True)
def _without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measuring memory collects garbage, which takes long after all that tests have imported."""
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
    rows = measure(toy.stage(), SCENES[:2], CHANGES, Records(), rounds=3)
    assert [[each.scene for each in row] for row in rows] == [["a", "b"]] * 3
    assert Counter(toy.runs) == {(scene, replace(ToySettings(), **each)): 4 for scene in "ab" for each in CHANGES}
    assert len(toy.judged) == len(set(toy.judged)) == 6
    assert toy.runs[:3] == toy.judged[:3]


@pytest.mark.parametrize("fail_at", range(1, 19, 6))
def test_an_interrupted_sweep_goes_on_where_it_was(tmp_path: Path, fail_at: int) -> None:
    whole, toy = Toy(), Toy()
    expected = measure(whole.stage(), SCENES[:2], CHANGES, Records(), rounds=2)
    toy.fail_at = fail_at
    with pytest.raises(KeyboardInterrupt):
        measure(toy.stage(), SCENES[:2], CHANGES, Records(tmp_path), rounds=2)
    toy.fail_at = None
    rows = measure(toy.stage(), SCENES[:2], CHANGES, Records(tmp_path), rounds=2)
    assert [[each.scores for each in row] for row in rows] == [[each.scores for each in row] for row in expected]
    assert {len(each.timings) for row in rows for each in row} == {2}
    # Nothing is judged twice, and no run is timed twice: warm-up runs alone are repeated.
    assert len(toy.judged) == len(set(toy.judged)) == 6
    assert len(toy.runs) <= len(whole.runs) + 3
    again = len(toy.runs)
    measure(toy.stage(), SCENES[:2], CHANGES, Records(tmp_path), rounds=2)
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
    file.write_bytes(b'{}\n{"stage": 3}\n')
    with pytest.raises(InputError, match="line 2 is damaged .*resume=false"):
        Records(tmp_path)


def test_measurements_of_another_sweep_are_not_mixed_in(tmp_path: Path) -> None:
    Records(tmp_path, {"scenes": 1})
    assert list(tmp_path.iterdir()) == []
    Records(tmp_path, {"scenes": 2}).add("fusion", "a", {}, TIMING)
    assert len(Records(tmp_path, {"scenes": 2})) == 1
    with pytest.raises(InputError, match="holds measurements of a sweep with other settings; give resume=false"):
        Records(tmp_path, {"scenes": 1})


def test_measurements_come_back_from_the_file_whatever_the_order_of_knobs(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.add("fusion", "a", {"x": 1, "y": 2}, replace(TIMING, mib=float("nan")))
    records.add("fusion", "a", {"x": 1, "y": 2}, ({"cosine": Score(float("nan"), 1)}, 7))
    read = Records(tmp_path).get("fusion", "a", {"y": 2, "x": 1})
    assert read.timings[0].seconds == 1.0
    assert np.isnan(read.timings[0].mib)
    assert np.isnan(read.scores["cosine"].total)  # type: ignore[index]
    assert read.bytes == 7


def test_a_measurement_that_cannot_be_written_ends_the_sweep(tmp_path, monkeypatch):
    def refused(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    records = Records(tmp_path)
    records.add("fusion", "a", {}, TIMING)
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=f"{RECORDS_FILE}: cannot write: Input/output error"):
        records.add("fusion", "a", {}, TIMING)


def test_one_knob_is_changed_at_a_time_and_the_base_comes_first() -> None:
    stage = Toy().stage()
    one_at_a_time = [{}, {"effort": 1}, {"effort": 2}, {"effort": 8}, {"color": 1}, {"color": 2}]
    assert settings_of(stage, SweepConfig()) == one_at_a_time
    assert settings_of(stage, SweepConfig(knobs=("color",), values=("color:0/7",))) == [{}, {"color": 7}]
    assert len(settings_of(stage, SweepConfig(grid=True))) == 4 * 3


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        (SweepConfig(knobs=("rays",)), "^sweep.knobs: 'rays' is no knob of fusion; expected some of effort, color"),
        (SweepConfig(values=("effort:1", "effort:2")), "^sweep.values: effort is given twice"),
        (SweepConfig(values=("effort:",)), "^sweep.values: expected KNOB:VALUE/VALUE, got 'effort:'"),
        (SweepConfig(knobs=("color",), values=("effort:1",)), "^sweep.values: effort is not among sweep.knobs=color;"),
        (SweepConfig(values=("effort:0",)), "^effort=0: effort: expected 1 or more"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused_at_once(sweep: SweepConfig, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_sweep([Toy().stage()], sweep)


def test_a_knob_without_effect_does_not_matter_and_is_not_changed_with_others() -> None:
    toy = Toy()
    result = sweep_stage(toy.stage(), SCENES, Records(), SweepConfig(rounds=1), ALL)
    assert result.matter == ("effort",)
    assert {knob for each in result.results if each.row["phase"] == "joint" for knob in each.knobs} <= {"effort"}
    assert [rung.scenes for rung in result.rungs] == [1, 3]
    # Cost and error of the toy trade against each other, so nothing that was tried with the knob is beaten.
    assert all(each.row["on_front"] for each in result.results if "color" not in each.knobs)
    assert result.results[0].row["phase"] == "base"
    # What was measured one at a time is not measured again.
    assert max(Counter(toy.runs).values()) == 2


def test_a_knob_that_needs_another_is_tried_with_it_and_judged_against_that() -> None:
    stage = Toy().stage()
    effort, color = stage.knobs
    # The color has no effect of its own; against the base it would seem to have that of the effort.
    stage = replace(stage, knobs=(effort, replace(color, needs={"effort": 8})))
    sweep = SweepConfig(rounds=1, knobs=("color",))
    assert settings_of(stage, sweep) == [{}, {"effort": 8}, {"effort": 8, "color": 1}, {"effort": 8, "color": 2}]
    assert sweep_stage(stage, SCENES, Records(), sweep).matter == ("effort",)


@dataclass(frozen=True)
class Picky(ToySettings):
    """Refuses a combination of values that it accepts alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.effort == 8 and self.color == 2:
            raise InputError("color=2: expected another effort than 8")


def test_combinations_that_a_stage_refuses_are_left_out_and_every_result_has_its_records() -> None:
    stage, sweep = replace(Toy(colors_count=True).stage(), base=Picky()), SweepConfig(rounds=1)
    result = sweep_stage(stage, SCENES, Records(), sweep, ALL)
    assert result.matter == ("effort", "color")
    assert len(result.rungs[0].settings) == 4 * 3 - 1
    # What others beat on the first scene is not measured on the rest.
    assert {each.row["scenes"] for each in result.results if each.row["phase"] == "joint"} == {1}
    measured = Counter(each.label for each in result.records)
    assert measured == {each.row["setting"]: each.row["scenes"] for each in result.results}


def test_the_cost_of_the_stage_is_the_one_that_decides() -> None:
    (effort, _), rows = Toy().stage().knobs, []
    for knobs, seconds in (({}, 2.0), ({"effort": 1}, 1.0)):
        timing = Timing(seconds=seconds, cpu_seconds=4.0, mib=1.0)
        rows.append([Record(stage="fusion", scene="a", knobs=knobs, timings=(timing,))])
    assert effective_knobs([effort], rows, rows[0], "seconds") == ["effort"]
    assert effective_knobs([effort], rows, rows[0], "cpu_seconds") == []


def test_what_scenes_do_not_agree_on_is_noise_and_a_scene_without_things_says_nothing() -> None:
    (effort, _) = Toy().stage().knobs

    def row(*hits: int, **knobs: int) -> list[Record]:
        scenes = [record(name, [1.0], {"acc_25": Score(n, 8)}, **knobs) for name, n in zip("abc", hits, strict=True)]
        return [*scenes, record("d", [1.0], {"acc_25": Score(0, 0)}, **knobs)]

    base = row(4, 4, 4)
    assert effective_knobs([effort], [base, row(7, 2, 4, effort=1)], base, "bytes") == []
    assert effective_knobs([effort], [base, row(6, 5, 6, effort=1)], base, "bytes") == ["effort"]


points = st.integers(1, 12).flatmap(
    lambda n: st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=n, max_size=n)
)


@given(points)
@settings(max_examples=40)
def test_a_rank_is_the_longest_chain_of_points_that_dominate_each_other(given: list[tuple[int, int]]) -> None:
    costs = np.array(given, np.float64)
    ranks = non_dominated_ranks(costs)

    def chain(index: int) -> int:
        better = [row for row, each in enumerate(given) if each != given[index] and np.all(costs[row] <= costs[index])]
        return 1 + max(map(chain, better)) if better else 0

    assert ranks.tolist() == [chain(index) for index in range(len(given))]
    order = best_first(costs)
    assert sorted(order) == list(range(len(given)))
    assert (np.diff(ranks[order]) >= 0).all()
    # Units do not change the order.
    assert best_first(costs * [1e-3, 64.0]).tolist() == order.tolist()


def test_what_was_not_measured_is_worse_than_anything_that_was() -> None:
    assert non_dominated_ranks(np.array([(1.0, np.nan), (1.0, 5.0)])).tolist() == [1, 0]
    assert non_dominated_ranks(np.array([(0.5, np.nan), (1.0, 5.0)])).tolist() == [0, 0]


def test_the_ends_of_a_front_stand_alone_and_a_crowd_does_not() -> None:
    line = np.array([(0, 10), (1, 9), (1.1, 8.9), (1.2, 8.8), (10, 0)], np.float64)
    alone = crowding(line)
    assert np.isinf(alone[[0, 4]]).all()
    assert alone[2] == min(alone)
    assert set(best_first(line)[:2].tolist()) == {0, 4}


VALUES = {"size": (4, 1, 2, 8), "steps": (10, 1, 100)}


@pytest.mark.parametrize("scenes", [1, 3, 10])
def test_the_best_in_each_column_reaches_the_last_rung_without_noise(scenes: int) -> None:
    def cost_and_error(knobs: dict[str, int]) -> tuple[float, float]:
        return knobs["size"] * knobs["steps"], 1 / knobs["size"] + 1 / knobs["steps"]

    drawn = draw_settings(VALUES, 100)
    rungs = successive_halving(drawn, scenes, lambda some, _: [cost_and_error(dict(each)) for each in some])
    costs = np.array([cost_and_error(each) for each in drawn])
    for column in range(2):
        assert drawn[int(costs[:, column].argmin())] in rungs[-1].settings


def test_rungs_grow_in_scenes_and_shrink_in_settings_and_the_best_is_left() -> None:
    losses, calls = np.random.default_rng(0).permutation(27), list[tuple[int, int]]()

    def evaluate(some, scenes):  # type: ignore[no-untyped-def]
        calls.append((len(some), scenes))
        return [(float(losses[each["n"]]),) for each in some]

    rungs = successive_halving([{"n": number} for number in range(27)], 12, evaluate)
    assert calls == [(27, 1), (9, 3), (4, 9), (4, 12)]
    assert [rung.scenes for rung in rungs] == [1, 3, 9, 12]
    assert rungs[-1].survivors == tuple({"n": number} for number in np.argsort(losses)[:4])


def test_settings_are_all_combinations_or_always_the_same_choice() -> None:
    everything = draw_settings(VALUES, 12)
    assert len(everything) == len({tuple(each.items()) for each in everything}) == 12
    some = draw_settings(VALUES, 5)
    assert some == draw_settings(VALUES, 5)
    assert len({tuple(each.items()) for each in some}) == 5
    assert all(each in everything for each in some)


def test_times_are_medians_over_rounds_and_means_over_scenes_and_ratios_are_of_the_same_round() -> None:
    base = [record(name, [1.0, 4.0, 16.0]) for name in "abc"]
    shares = (0.5, 0.25, 0.7)
    rows = [record(name, [share, 4 * share], views=1) for name, share in zip("abc", shares, strict=True)]
    row = summarize(rows, base, "one at a time").row
    middle = 2.5 * np.mean(shares)
    assert (row["cpu_seconds"], row["seconds"]) == pytest.approx((middle, 2 * middle))
    assert row["ratio"] == pytest.approx(np.prod(shares) ** (1 / 3))
    assert row["ratio_error"] == pytest.approx(sem(np.log(shares)))


def test_memory_is_that_of_the_largest_scene_bytes_a_mean_and_spread_a_median_over_scenes() -> None:
    timings = (("a", [1.0, 1.0, 1.0], 30.0, 1), ("b", [1.0, 2.0, 4.0], 50.0, 2), ("c", [1.0, 9.0, 17.0], 10.0, 6))
    rows = []
    for name, cpu, mib, size in timings:
        one = record(name, cpu)
        rows.append(replace(one, timings=tuple(replace(each, mib=mib) for each in one.timings), bytes=size))
    row = summarize(rows, rows, "base").row
    assert (row["mib"], row["bytes"]) == (50.0, 3.0)
    assert row["spread"] == pytest.approx(1.4826 * 0.5)


def test_the_row_of_a_scene_has_medians_over_rounds_and_shares_of_its_things() -> None:
    row = scene_row(record("a", [1.0, 2.0, 9.0], {"acc_25": Score(3, 4), "acc_50": Score(0, 0)}, views=1))
    assert (row["setting"], row["scene"], row["cpu_seconds"], row["seconds"]) == ("views=1", "a", 2.0, 4.0)
    assert (row["acc_25"], row["acc_25_things"], row["acc_50_things"]) == (0.75, 4, 0)
    assert np.isnan(row["acc_50"])


def test_a_score_counts_things_and_its_error_is_that_of_scenes() -> None:
    value, error, things = estimate([Score(3, 4), Score(1, 4)])
    assert (value, things) == (0.5, 8)
    # With as many things in each scene it is the standard error of the mean of the scenes' shares.
    assert error == pytest.approx(sem([0.75, 0.25]))
    assert np.isnan(estimate([Score(3, 4)])[1])
    assert np.isnan(estimate([Score(0, 0)])[0])
    # A scene without things changes nothing but the number of scenes.
    assert estimate([Score(3, 4), Score(1, 4), Score(0, 0)])[0] == 0.5


def test_a_difference_of_scores_has_the_error_of_differences_of_scenes() -> None:
    base = [Score(3, 4), Score(1, 4), Score(2, 4)]
    # Every scene gains one thing, so that nothing about the gain is uncertain, whatever the scenes' scores are.
    assert estimate([Score(4, 4), Score(2, 4), Score(3, 4)], base) == pytest.approx((0.25, 0.0, 12))
    value, error, _ = estimate([Score(4, 4), Score(0, 4), Score(3, 4)], base)
    assert (value, error) == pytest.approx((1 / 12, sem([0.25, -0.25, 0.25])))
    assert np.isnan(estimate([], [])[0])


def test_differences_are_of_the_scenes_that_both_have_scores_of() -> None:
    base = [record("a", [1.0], {"acc_25": Score(1, 2)}), record("b", [1.0])]
    other = [record("b", [1.0], {"acc_25": Score(2, 2)}, views=1), record("a", [1.0], {"acc_25": Score(2, 2)}, views=1)]
    row = summarize(other, base, "grid").row
    assert (row["acc_25_difference"], row["acc_25_things"]) == (0.5, 4)
    assert "acc_25_difference" not in summarize(base, base, "base").row


def test_the_front_is_drawn_among_settings_of_as_many_scenes() -> None:
    results = []
    for number, (cpu, error, scenes) in enumerate([(1.0, 0.3, 2), (2.0, 0.2, 2), (3.0, 0.25, 2), (0.1, 0.0, 1)]):
        rows = [record(name, [cpu], {"error": Score(error)}, n=number) for name in "ab"[:scenes]]
        results.append(summarize(rows, rows, "grid"))
    mark_front(results, replace(Toy().stage(), cost="cpu_seconds"))
    assert [each.row["on_front"] for each in results] == [True, True, False, False]


# Exponents of cost


@pytest.mark.parametrize("exponent", [-0.5, 0.0, 1.0, 2.3])
def test_a_power_law_without_noise_is_recovered_whatever_the_units(exponent: float) -> None:
    sizes = np.array([1e3, 4e3, 7e3, 5e5])
    for unit in (1e-6, 1.0, 1e6):
        fit = fit_exponent(sizes * unit, 3e-4 * sizes**exponent)
        assert fit.value == pytest.approx(exponent, abs=1e-9)
        assert fit.high - fit.low == pytest.approx(0, abs=1e-6)
        assert fit.constant * (sizes[0] * unit) ** fit.value == pytest.approx(3e-4 * sizes[0] ** exponent)


def test_the_interval_is_that_of_linear_regression() -> None:
    generator = np.random.default_rng(1)
    sizes = np.geomspace(10, 1000, 7)
    costs = sizes**0.8 * np.exp(0.1 * generator.normal(size=7))
    fit, oracle = fit_exponent(sizes, costs), linregress(np.log(sizes), np.log(costs))
    half = t.ppf(0.975, 5) * oracle.stderr
    assert (fit.value, fit.low, fit.high) == pytest.approx((oracle.slope, oracle.slope - half, oracle.slope + half))


def test_scenes_of_other_speeds_have_constants_of_their_own() -> None:
    sizes = np.array([1.0, 2.0, 4.0, 10.0, 20.0, 40.0])
    costs = np.array([1.0] * 3 + [100.0] * 3) * sizes
    assert fit_exponent(sizes, costs, np.array([0, 0, 0, 1, 1, 1])).value == pytest.approx(1)
    assert fit_exponent(sizes, costs).value > 1.5


@pytest.mark.parametrize(
    ("sizes", "costs"), [([1, 2], [1, 2]), ([2, 2, 2], [1, 2, 3]), ([1, 2, 3], [1, 0, 1]), ([0, 1, 2], [1, 1, 1])]
)
def test_what_no_line_fits_is_refused(sizes: list[float], costs: list[float]) -> None:
    with pytest.raises(InputError, match="^fit_exponent: expected"):
        fit_exponent(np.array(sizes, np.float64), np.array(costs, np.float64))


def test_sizes_are_whole_different_and_end_at_all() -> None:
    assert geometric_sizes(24, 5) == [3, 5, 8, 14, 24]
    assert geometric_sizes(2, 5) == [1, 2]
    with pytest.raises(InputError, match="^points: expected"):
        ScalingConfig(points=2)
