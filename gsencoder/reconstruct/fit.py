"""The steps of a reconstruction, with validations, a log and checkpoints."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, advised
from gsencoder.core.logs import LOG_FILE, Log, read_log
from gsencoder.core.process import Track
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, State, save_state
from gsencoder.reconstruct.config import START_AGAIN, ReconstructConfig, Report
from gsencoder.reconstruct.expected_time import Pace
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.plan import STEPS, Plan, extended, follow
from gsencoder.reconstruct.report import LogRow, describe
from gsencoder.reconstruct.score import covisible_pixels, score


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """An optimization that came to its end.

    Attributes:
        rows: of the log, oldest first.
        plan: as it was extended, or changed by the clock.
    """

    rows: list[LogRow]
    plan: Plan


def fit(
    optimizer: Optimizer,
    state: State,
    plan: Plan,
    held_out: Sequence[int],
    config: ReconstructConfig,
    work: Path,
    identity: Mapping[str, Any],
    track: Track,
    report: Report,
    *,
    pace: Pace | None = None,
    now: Callable[[], float] = time.monotonic,
) -> Fitted:
    """All remaining steps of a plan, which is extended while a promised error is not reached, and changed where a clock
    sets the pace. Whatever stops the run between two steps leaves a checkpoint."""
    with advised(START_AGAIN):
        log = Log(work, done=optimizer.step, events=False, begun=bool(held_out and optimizer.step))
        rows = read_rows(work / LOG_FILE)
    seen = covisible_pixels(optimizer.photographs, held_out, optimizer.training)
    start, saved_at, saved_step = now() - state.seconds, now(), optimizer.step

    def validate() -> None:
        due = config.validates_at(optimizer.step, plan.steps)
        # A continued run may begin at a step whose validation was cut off, or whose row is in the log already.
        if not held_out or not due or (rows and rows[-1]["step"] == optimizer.step):
            return
        scores = {
            name: value for name, value in score(optimizer, held_out, seen)._asdict().items() if value is not None
        }
        row: LogRow = {"seconds": now() - start, "gaussians": len(optimizer.parameters["means"]), **scores}
        log.add(optimizer.step, row)
        rows.append({"step": optimizer.step, **row})
        report(
            f"step {optimizer.step} of {plan.steps}: {describe(row)}, {row['gaussians']:,} Gaussians, "
            f"{row['seconds']:.0f} s"
        )

    def save() -> None:
        between = State(
            adam=optimizer.adam,
            anchor=optimizer.anchor,
            exposures=None if optimizer.exposures is None else optimizer.exposures.maps,
            step=optimizer.step,
            seconds=now() - start,
            facts={**state.facts, **plan.facts()},
        )
        save_state(work / CHECKPOINT_FILE, between, identity)

    try:
        validate()
        while True:
            for _ in track(range(optimizer.step, plan.steps), "optimising"):
                optimizer.advance()
                validate()
                if pace is not None and optimizer.step < plan.steps:
                    steps = pace.steps(optimizer, config.validates_at, STEPS[-1])
                    if steps != plan.steps:
                        plan = replace(plan, steps=steps, earlier=(*plan.earlier, plan.steps, optimizer.step))
                        break
                if now() - saved_at >= config.checkpoint_every:
                    save()
                    saved_at, saved_step = now(), optimizer.step
            else:
                plan = extended(plan, config.budget, rows)
            if plan.steps == optimizer.step:
                break
            follow(optimizer, plan)
    finally:
        # Also after the last step: writing the results may be interrupted as well.
        if optimizer.is_consistent and optimizer.step > saved_step:
            save()
    return Fitted(rows=rows, plan=plan)


def read_rows(path: Path) -> list[LogRow]:
    """The rows of a log as numbers.

    Raises:
        InputError: a cell that is not a number.
    """
    try:
        return [{name: float(cell) for name, cell in row.items()} for row in read_log(path)]
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}") from error
