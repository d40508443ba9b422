"""What tests of commands share: the results of a run, and the line that a refused command prints."""

import json
from pathlib import Path
from typing import Any

import pytest

from gsencoder.app import main as cli


def results_of(folder: Path) -> dict[str, Any]:
    """The results in the summary of a run."""
    results: dict[str, Any] = json.loads((folder / "summary.json").read_text())["results"]
    return results


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that a refused command prints, beside warnings and a note on what it leaves behind."""
    capsys.readouterr()
    assert cli.main([*arguments, *(() if "quiet=true" in arguments else ("quiet=true",))]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith(("warning: ", "note: "))]
    assert len(lines) == 1
    return lines[0]


QUICK = (
    "quiet=true", "train.steps=6", "train.warmup=2", "train.log_every=2", "sampling.gaussians=600",
    "sampling.smallest=200", "model.transformer.encoder_depths=[1,1]",
    "model.transformer.encoder_channels=[32,32]", "model.transformer.decoder_depths=[1]",
    "model.transformer.decoder_channels=[32]", "seeds.voxel=0.06",
)  # fmt: skip
