"""The seconds of a stage's steps."""

import pytest

from gsencoder.core.runtime.clock import Clock


def test_a_clock_adds_up_the_seconds_of_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 11.0, 20.0, 22.5, 30.0, 34.0])
    monkeypatch.setattr("gsencoder.core.runtime.clock.time.perf_counter", lambda: next(times))
    clock = Clock()
    for step in ("blend", "lift", "blend"):
        with clock(step):
            pass
    assert clock.seconds == {"blend": 5.0, "lift": 2.5}
