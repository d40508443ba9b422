"""The seconds of a stage's steps."""

import time

import pytest

from gsencoder.core.process import Clock, timed
from gsencoder.core.threads import ahead


def test_a_clock_adds_up_the_seconds_of_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 11.0, 20.0, 22.5, 30.0, 34.0])
    monkeypatch.setattr("gsencoder.core.process.time.perf_counter", lambda: next(times))
    clock = Clock()
    for step in ("blend", "lift", "blend"):
        with clock(step):
            pass
    assert clock.seconds == {"blend": 5.0, "lift": 2.5}


def test_marked_functions_count_on_the_clock_that_runs_and_on_none_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([0.0, 0.0, 1.0, 1.0, 10.0, 12.0, 15.0, 20.0, 24.0, 30.0, 31.0, 40.0])
    monkeypatch.setattr("gsencoder.core.process.time.perf_counter", lambda: next(times))
    double = timed("lift")(lambda number: 2 * number)
    assert double(1) == 2
    with Clock().running() as outer:
        assert double(2) == 4
        with Clock().running() as inner:
            assert double(3) == 6
        assert double(4) == 8
        with pytest.raises(TypeError, match="missing"):
            double()
    assert double(5) == 10
    assert outer.seconds == {"lift": 5.0}
    assert inner.seconds == {"lift": 2.0}


def test_steps_of_several_threads_share_the_seconds_of_the_wall_clock() -> None:
    def work(item: int) -> int:
        time.sleep(0.02)
        return item

    clock = Clock()
    clock.seconds = {"teacher": 2.0}
    start = time.perf_counter()
    with clock.running():
        assert list(ahead(timed("blend")(work), range(6), 3)) == [*range(6)]
    wall = time.perf_counter() - start
    assert clock.seconds["teacher"] == 2.0
    assert 0.8 * wall < clock.seconds["blend"] <= wall
