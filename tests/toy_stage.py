"""A stage whose costs and scores are known, for tests of sweeps."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.settings import Knob
from gsencoder.evaluate.tradeoff.measure import Record, Timing
from gsencoder.evaluate.tradeoff.stage import Judged, Score, Stage


@dataclass(frozen=True)
class ToySettings:
    effort: int = 4
    color: int = 0

    def __post_init__(self) -> None:
        if self.effort < 1:
            raise InputError(f"effort: expected 1 or more, got {self.effort}")


class Toy:
    """Runs and judgments of all scenes in order, as they were asked for; a run may be made to fail."""

    def __init__(self) -> None:
        self.runs: list[tuple[str, ToySettings]] = []
        self.judged: list[tuple[str, ToySettings]] = []
        self.fail_at: int | None = None

    def stage(self) -> Stage:
        @contextmanager
        def opened(path: Path) -> Iterator[ToyScene]:
            yield ToyScene(self, path.name)

        return Stage(
            name="fusion",
            knobs=(
                Knob(name="effort", key="effort", values=(1, 2, 8), exact=8),
                Knob(name="color", key="color", values=(1, 2)),
            ),
            base=ToySettings(),
            open=opened,
            accuracy="error",
            cost="bytes",
        )


class ToyScene:
    def __init__(self, toy: Toy, name: str) -> None:
        self._toy, self._name = toy, name

    def run(self, settings: ToySettings) -> ToySettings:
        if self._toy.fail_at == len(self._toy.runs):
            raise KeyboardInterrupt
        self._toy.runs.append((self._name, settings))
        return settings

    def judge(self, product: ToySettings, settings: ToySettings) -> Judged:
        assert product == settings
        self._toy.judged.append((self._name, settings))
        scores = {"error": Score(1 / settings.effort), "acc_25": Score(settings.effort, 8)}
        return Judged(scores=scores, bytes=100 * settings.effort)


def record(scene: str, cpu: list[float], scores: dict[str, Score] | None = None, **knobs: int) -> Record:
    timings = tuple(Timing(seconds=2 * value, cpu_seconds=value, mib=10.0) for value in cpu)
    return Record(
        stage="fusion", scene=scene, knobs=knobs, timings=timings, judged=Judged(scores=scores or {}, bytes=1)
    )
