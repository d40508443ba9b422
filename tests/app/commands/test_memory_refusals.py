"""`gsencoder memory`, and commands that read memories: what would be lost, ignored or trained on nothing is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from memory_samples import make_memory
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.app.commands.memory import MemoryCommandConfig
from gsencoder.app.options import options_by_key
from gsencoder.core.logs import read_log
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import save_memories
from gsencoder.train import memory as training
from gsencoder.train.memory import fingerprint_of, memory_training
from gsencoder.types import Scene

QUICK = ("train.steps=12", "train.warmup=2", "memory.channels=3", "pictures=0", "teacher=palette")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    write_room(make_room(0, objects=2, views=2, width=60, height=45), folder)
    return folder


def test_the_defaults_that_help_shows_are_those_of_the_command() -> None:
    options, training = options_by_key(MemoryCommandConfig), memory_training()
    for name in ("steps", "learning_rate", "warmup", "validate_every"):
        assert options[f"train.{name}"].default == getattr(training, name)


def test_rows_that_nothing_covers_and_queries_of_any_width_are_refused(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["memory", str(room), f"out={tmp_path / 'out'}", "teacher=palette", "train.steps=2", "pictures=0"]
    assert "memory.min_alpha: no cell of 2 views of teacher palette is covered to 1" in refusal(
        capsys, *words, "memory.min_alpha=1"
    )
    assert "memory.channels: expected 1 to 1,024, got 100000" in refusal(capsys, *words, "memory.channels=100000")
    assert not (tmp_path / "out").exists()


def test_an_unfinished_optimization_is_not_thrown_away_by_a_run_without_one(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["memory", str(room), f"out={tmp_path / 'out'}", *QUICK]

    def interrupted(self: training.Trainer, track: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training.Trainer, "run", interrupted)
        assert cli.main(words) == 130
    assert "holds what was computed; a run with the same out= and settings continues it" in capsys.readouterr().err
    assert "an optimization that is not finished and would be lost" in refusal(capsys, *words, "optimize=false")
    assert cli.main([*words, "optimize=false", "resume=false"]) == 0
    assert cli.main([*words, "overwrite=true"]) == 0
    assert len(read_log(tmp_path / "out" / "log.csv")) > 0
    assert "steps" in results_of(tmp_path / "out")


def test_more_components_than_there_are_features_are_no_limit(room: Path, tmp_path: Path) -> None:
    for components in (10_000, 10**12):
        out = tmp_path / str(components)
        words = ["memory", str(room), f"out={out}", *QUICK, "optimize=false", f"bank.components={components}"]
        assert cli.main(words) == 0
    first, second = (results_of(tmp_path / str(each))["teachers"]["palette"] for each in (10_000, 10**12))
    assert first["components"] == second["components"]


def test_banks_of_as_many_components_have_fingerprints_of_their_own() -> None:
    bank = make_memory().bank
    other = replace(bank, components=bank.components + np.float32(1e-3))
    assert fingerprint_of(bank) == fingerprint_of(replace(bank)) != fingerprint_of(other)


def test_settings_that_a_form_or_a_memory_does_not_take_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = make_memory(gaussians=20)
    scene = Scene(name="s", gaussians=random_gaussians(20), origin=np.zeros(3))
    save_memories(tmp_path, scene, {"a": memory})
    folder, out = str(tmp_path), f"out={tmp_path / 'm.onnx'}"
    export = ["export", f"memory={folder}", out]
    assert "expected one of them, got 'foo'" in refusal(capsys, *export, "space=foo")
    assert "splats are compared with encoders alone" in refusal(capsys, "export", "/nowhere", *export[1:])
    assert "space: names a teacher of memory=" in refusal(capsys, "export", "space=foo", out)
    packed = ["pack", folder, f"out={tmp_path / 'p'}"]
    assert "budget.error: form=npz writes features as they are" in refusal(capsys, *packed, "form=npz", "error=0.5")
    assert "form=compact takes none" in refusal(capsys, *packed, "index.threshold=0.4")
