"""A training that was stopped goes on as if nothing had happened, or says why it cannot."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from archives import header_of
from safetensors.numpy import load_file
from trainer_runs import Prepared, assert_same_weights, losses, rows, steps_in, trainer
from training_scenes import LOSSES, SHORT, samples, small_encoder

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.core.process import Stopped
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE, ValidationResult, silence_connection_errors
from gsencoder.train.run import encoder_trainer

pytestmark = pytest.mark.slow


def test_a_run_that_was_cut_off_goes_on_as_if_nothing_had_happened(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path / "whole").run()

    def stop_at_five(steps: range, label: str):
        for step in steps:
            if step == 5:
                raise KeyboardInterrupt
            yield step

    with pytest.raises(KeyboardInterrupt):
        trainer(dataset, tmp_path / "cut").run(stop_at_five)
    assert len(losses(tmp_path / "cut")) == 5
    again = trainer(dataset, tmp_path / "cut")
    assert again.state.step == 5
    again.run()
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert_same_weights(tmp_path / "cut", tmp_path / "whole")


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.usefixtures("interrupts")
def test_a_signal_within_a_step_ends_the_run_after_it(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path / "whole").run()
    cut = trainer(dataset, tmp_path / "cut")
    step = cut.optimizer.step

    def half() -> None:
        if cut.state.step == 4:
            os.kill(os.getpid(), signal.SIGINT)
        step()

    cut.optimizer.step = half  # type: ignore[method-assign,assignment]
    with pytest.raises(KeyboardInterrupt):
        cut.run()
    assert steps_in(tmp_path / "cut") == 5
    trainer(dataset, tmp_path / "cut").run()
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert_same_weights(tmp_path / "cut", tmp_path / "whole")


@pytest.mark.parametrize(("cause", "saved"), [(Stopped(15), True), (KeyboardInterrupt(), True), (None, False)])
def test_a_stop_that_compiled_code_wraps_is_a_stop(
    dataset: Prepared, tmp_path: Path, cause: BaseException | None, saved: bool
) -> None:
    def stop_at_three(steps: range, label: str):
        for step in steps:
            if step == 3:
                raise SystemError("returned a result with an exception set") from cause
            yield step

    with pytest.raises(SystemError):
        trainer(dataset, tmp_path, replace(SHORT, checkpoint_every=1e9)).run(stop_at_three)
    assert (tmp_path / TRAINING_CHECKPOINT_FILE).is_file() == saved


def test_a_worker_whose_training_process_is_gone_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    for error in (ConnectionResetError(), BrokenPipeError(), EOFError()):
        silence_connection_errors(type(error), error, None)
    assert capsys.readouterr().err == ""
    silence_connection_errors(ValueError, ValueError("wrong"), None)
    assert "ValueError: wrong" in capsys.readouterr().err


@pytest.mark.parametrize("at", [4, 8])
def test_an_interrupted_validation_is_done_again(dataset: Prepared, tmp_path: Path, at: int) -> None:
    config = replace(SHORT, validate_every=4, log_every=4, checkpoint_every=1e9)
    scores: list[float] = []

    def validate(encoder: torch.nn.Module) -> ValidationResult:
        scores.append(float(sum(value.double().sum() for value in encoder.state_dict().values())))
        if len(scores) == at // 4:
            raise KeyboardInterrupt
        return ValidationResult({"score": scores[-1]})

    with pytest.raises(KeyboardInterrupt):
        trainer(dataset, tmp_path / "cut", config, validate=validate).run()
    assert steps_in(tmp_path / "cut") == at
    trainer(dataset, tmp_path / "cut", config, validate=validate).run()
    scores += [0.0] * 10
    trainer(dataset, tmp_path / "whole", config, validate=validate).run()
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert len([row for row in rows(tmp_path / "cut") if "validation/score" in row]) == 2


def test_rows_of_steps_that_are_done_again_are_taken_out_of_the_log(dataset: Prepared, tmp_path: Path) -> None:
    first = trainer(dataset, tmp_path, replace(SHORT, checkpoint_every=1e9, steps=8))

    def stop_at_five(steps: range, label: str):
        for step in steps:
            if step == 5:
                raise KeyboardInterrupt
            if step == 3:
                first.save()
            yield step

    with pytest.raises(KeyboardInterrupt):
        first.run(stop_at_five)
    assert len(losses(tmp_path)) == 5  # Two rows more than the checkpoint has steps.
    trainer(dataset, tmp_path).run()
    assert [int(row["step"]) for row in read_log(tmp_path / LOG_FILE)] == list(range(1, 9))


def test_a_checkpoint_of_other_settings_is_refused_and_named(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path).run()
    with pytest.raises(InputError, match=r"was made with run=1, and this run asks run=2"):
        encoder_trainer(small_encoder(), samples(*dataset), LOSSES, SHORT, folder=tmp_path, settings={"run": 2})
    for key, message in (("samples_per_step", "a step had 1 samples, and this run has 4"), ("spaces", "changed")):
        with pytest.raises(InputError, match=message):
            encoder_trainer(
                small_encoder(), samples(*dataset), LOSSES, SHORT, folder=tmp_path, settings={"run": 1, key: 4}
            )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("step", -5),
        ("step", 0),
        ("step", 1000),
        ("seconds", -1.0),
        ("unlogged", [3]),
        ("unlogged", [{"loss": "x"}]),
        ("closed", False),
        ("moved", "all"),
    ],
)
def test_a_state_that_no_run_was_in_is_refused(dataset: Prepared, tmp_path: Path, key: str, value: object) -> None:
    trainer(dataset, tmp_path).run()
    path = tmp_path / TRAINING_CHECKPOINT_FILE
    header = header_of(path)
    assert header["unlogged"] == []
    write_archive(path, load_file(path), {**header, key: value})
    with pytest.raises(InputError, match="give resume=false"):
        trainer(dataset, tmp_path)


def test_a_checkpoint_without_moments_is_refused(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path).run()
    path = tmp_path / TRAINING_CHECKPOINT_FILE
    arrays = {name: array for name, array in load_file(path).items() if not name.startswith("optimizer.step")}
    write_archive(path, arrays, header_of(path))
    with pytest.raises(InputError, match=r"'optimizer\.step\..*' is missing"):
        trainer(dataset, tmp_path)


def test_a_log_that_is_gone_is_told(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path).run()
    (tmp_path / LOG_FILE).unlink()
    with pytest.warns(SceneWarning, match=r"log\.csv: is missing; the log starts at step 8"):
        trainer(dataset, tmp_path)
