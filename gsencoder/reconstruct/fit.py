"""The steps of a reconstruction, with validations, a log and checkpoints."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, advised
from gsencoder.core.files.step_log import LOG_FILE, Log, read_log
from gsencoder.core.runtime.tracking import Track
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, State, save_state
from gsencoder.reconstruct.config import START_AGAIN, ReconstructConfig, Report
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.plan import Plan, extended, follow
from gsencoder.reconstruct.report import LogRow, describe
from gsencoder.reconstruct.score import covisible_pixels, score


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """An optimization that came to its end.

    Attributes:
        rows: of the log, oldest first.
        plan: as it was extended.
        seconds: from the first reading to the last step, of all runs that it took.
    """

    rows: list[LogRow]
    plan: Plan
    seconds: float


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
) -> Fitted:
    """All remaining steps of a plan, which is extended while a promised error is not reached. Whatever stops the run
    between two steps leaves a checkpoint."""
    with advised(START_AGAIN):
        log = Log(work, done=optimizer.step, events=False, begun=bool(held_out and optimizer.step))
        rows = read_rows(work / LOG_FILE)
    seen = covisible_pixels(optimizer.photographs, held_out, optimizer.training)
    start, saved_at, saved_step = time.monotonic() - state.seconds, time.monotonic(), optimizer.step

    def validate() -> None:
        due = config.validates_at(optimizer.step, plan.steps)
        # A continued run may begin at a step whose validation was cut off, or whose row is in the log already.
        if not held_out or not due or (rows and rows[-1]["step"] == optimizer.step):
            return
        scores = {
            name: value for name, value in score(optimizer, held_out, seen)._asdict().items() if value is not None
        }
        row: LogRow = {"seconds": time.monotonic() - start, "gaussians": len(optimizer.parameters["means"]), **scores}
        log.add(optimizer.step, row)
        rows.append({"step": optimizer.step, **row})
        report(
            f"step {optimizer.step} of {plan.steps}: {describe(row)}, {row['gaussians']:,} Gaussians, "
            f"{row['seconds']:.0f} s"
        )

    def save() -> None:
        now = State(
            adam=optimizer.adam,
            anchor=optimizer.anchor,
            exposures=None if optimizer.exposures is None else optimizer.exposures.maps,
            step=optimizer.step,
            seconds=time.monotonic() - start,
            facts={**state.facts, **plan.facts()},
        )
        save_state(work / CHECKPOINT_FILE, now, identity)

    try:
        validate()
        while True:
            for _ in track(range(optimizer.step, plan.steps), "optimising"):
                optimizer.advance()
                validate()
                if time.monotonic() - saved_at >= config.checkpoint_every:
                    save()
                    saved_at, saved_step = time.monotonic(), optimizer.step
            longer = extended(plan, config.budget, rows)
            if longer is None:
                break
            plan = longer
            follow(optimizer, plan)
    finally:
        # Also after the last step: writing the results may be interrupted as well.
        if optimizer.is_consistent and optimizer.step > saved_step:
            save()
    return Fitted(rows=rows, plan=plan, seconds=plan.spent + time.monotonic() - start)


def read_rows(path: Path) -> list[LogRow]:
    """The rows of a log as numbers.

    Raises:
        InputError: a cell that is not a number.
    """
    try:
        return [{name: float(cell) for name, cell in row.items()} for row in read_log(path)]
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}") from error
