"""The budgets of `encode`: what was promised, and what became of it, for people and for the summary."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from gsencoder.app.runs.progress import Progress
from gsencoder.app.runs.promises import report_choice, report_promises
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import settings
from gsencoder.core.settings import MEGABYTE
from gsencoder.infer.chunks import EncodeBudget, EncodeConfig, exact_encoding
from gsencoder.infer.encode_budget import BudgetEncoding, encode_within, realised_error
from gsencoder.infer.load import Encoder
from gsencoder.types import Scene


@runtime_checkable
class BudgetOptions(Protocol):
    """The options of a command that encodes within a budget."""

    @property
    def encode(self) -> EncodeConfig: ...
    @property
    def budget(self) -> EncodeBudget: ...
    @property
    def quiet(self) -> bool: ...


def encode_in_budget(
    scene: Scene,
    encoder: Encoder,
    teachers: Sequence[str],
    config: BudgetOptions,
    made_with: Mapping[str, str],
    summary: Summary,
    *,
    metres_per_unit: float,
) -> BudgetEncoding:
    """Chooses a setting and encodes; says which setting that is, and what is predicted of it."""
    assert scene.gaussians is not None
    # Of the settings, those that take the most bytes in the files.
    longest = replace(exact_encoding(config.encode), precision="bfloat16")
    encoding = encode_within(
        scene.gaussians,
        encoder,
        teachers,
        config.encode,
        config.budget,
        metres_per_unit=metres_per_unit,
        header={"encode": settings(longest), **made_with},
        track=Progress(quiet=config.quiet),
    )
    summary.add_seconds({"choose": encoding.choosing, "encode": encoding.seconds - encoding.choosing})
    ranks = {"rank" if len(encoding.ranks) == 1 else f"rank of {name}": rank for name, rank in encoding.ranks.items()}
    report_choice(
        summary,
        scene.name,
        {**encoding.setting.knobs, **ranks},
        predicted={
            "error": encoding.predicted,
            "seconds": encoding.choosing + encoding.setting.seconds if config.budget.seconds is not None else None,
        },
        notes=encoding.notes,
        quiet=config.quiet,
        gaussians_sampled=encoding.sampled,
    )
    return encoding


def check_promises(
    encoding: BudgetEncoding,
    scene: Scene,
    encoder: Encoder,
    files: Sequence[Path],
    config: BudgetOptions,
    summary: Summary,
    *,
    metres_per_unit: float,
) -> list[str]:
    """Measures what was promised; returns a line for each promise, and warns of those that are broken."""
    assert scene.gaussians is not None
    budget, realised = config.budget, dict[str, float]()
    if budget.error is not None and budget.check:
        with summary.step("check"):
            errors = realised_error(
                encoding,
                scene.gaussians,
                encoder,
                metres_per_unit=metres_per_unit,
                seed=budget.seed,
                track=Progress(quiet=config.quiet),
            )
        realised["error"] = max(error.total for error in errors.values())
    if budget.seconds is not None:
        realised["seconds"] = encoding.seconds
    if budget.megabytes is not None:
        realised["megabytes"] = sum(file.stat().st_size for file in files) / MEGABYTE
    return report_promises(summary, budget, realised)
