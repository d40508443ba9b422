"""A stage whose costs and scores are known, for tests of sweeps."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.settings import Knob
from gsencoder.evaluate.tradeoff.measure import Record, Timing
from gsencoder.evaluate.tradeoff.stages import Opened, Score, Scores, Stage


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
        return Stage(
            name="fusion",
            knobs=(
                Knob(name="effort", key="effort", values=(1, 2, 8), exact=8),
                Knob(name="color", key="color", values=(1, 2)),
            ),
            base=ToySettings(),
            open=self.opened,
            accuracy="error",
            cost="bytes",
        )


def record(scene: str, cpu: list[float], scores: Scores | None = None, **knobs: int) -> Record:
    timings = tuple(Timing(seconds=2 * value, cpu_seconds=value, mib=10.0) for value in cpu)
    return Record(stage="fusion", scene=scene, knobs=knobs, timings=timings, scores=scores or {}, bytes=1)
