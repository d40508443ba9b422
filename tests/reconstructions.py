"""Short reconstructions, as a user runs them, and what they say when they refuse."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gsencoder.app import main as cli
from gsencoder.reconstruct.optimize import Optimizer

QUICK = ("quiet=true", "optimize.steps=12", "holdout=4", "seeds.voxel=0.08", "optimize.sh_degree=1")


def summary_of(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that a refused command prints, beside warnings and a note on what it leaves behind."""
    capsys.readouterr()
    assert cli.main(["reconstruct", *arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith(("warning: ", "note: "))]
    assert len(lines) == 1
    return lines[0]


@contextmanager
def cut_at(step: int) -> Iterator[None]:
    """Interrupts the reconstruction in the block at a step."""
    advance = Optimizer.advance

    def stop(self: Optimizer) -> dict[str, float]:
        if self.step == step:
            raise KeyboardInterrupt
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Optimizer, "advance", stop)
        with pytest.raises(KeyboardInterrupt):
            yield


def never(*_: object, **__: object) -> None:
    raise AssertionError("was called again")


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt
