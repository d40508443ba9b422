"""The loop: it learns, micro batches add up, and it stops before a value that is not finite does harm."""

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from archives import header_of
from safetensors.numpy import load_file
from training_scenes import (
    LOSSES,
    SHORT,
    Prepared,
    assert_same_weights,
    losses,
    made,
    rows,
    samples,
    small_encoder,
    steps_in,
    stop_at,
    trainer,
    weights_in,
)

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.core.process import ProcessRank, Stopped
from gsencoder.train import loop as data_workers
from gsencoder.train.loop import (
    TRAINING_CHECKPOINT_FILE,
    TrainerConfig,
    ValidationResult,
    _parameter_groups,
    automatic_workers,
    silence_connection_errors,
)
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepared import PreparedScene
from gsencoder.train.run import encoder_trainer

pytestmark = pytest.mark.slow


def test_training_brings_the_loss_down(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path, replace(SHORT, steps=20)).run()
    curve = losses(tmp_path)
    assert len(curve) == 20
    assert np.mean(curve[-5:]) < 0.8 * np.mean(curve[:5])


def test_a_sample_that_cannot_be_made_stops_the_run_in_its_own_words(dataset, tmp_path, monkeypatch):
    one = trainer(dataset, tmp_path)
    refused = InputError("scene wall_1: its file is gone")
    monkeypatch.setattr("gsencoder.train.samples.make_sample", lambda *_: (_ for _ in ()).throw(refused))
    with pytest.raises(InputError, match="wall_1: its file is gone"):
        one.run()


def test_a_training_that_compares_nothing_is_refused(dataset: Prepared, tmp_path: Path) -> None:
    strict = LossConfig(field_weight=0.0, render_weight=1.0, min_alpha=1.0, min_kept=1.0)
    nothing = samples(*dataset, losses=strict)
    with pytest.raises(InputError, match=r"there is nothing to compare in wall_\d"):
        encoder_trainer(small_encoder(), nothing, strict, SHORT, folder=tmp_path, settings={}).run()


def test_micro_batches_add_up_to_the_batch(dataset: Prepared, tmp_path: Path) -> None:
    """Two samples at once, or one after the other: the same sums, divided by the same counts."""
    config = replace(SHORT, steps=4)
    for name, batch, accumulate in (("at_once", 2, 1), ("in_turn", 1, 2)):
        encoder = small_encoder()
        # Orders as in evaluation, and nothing dropped: both are drawn at random once a micro-batch.
        encoder.train = encoder.eval = lambda mode=True, encoder=encoder: encoder  # type: ignore[method-assign]
        for module in encoder.modules():
            module.training = False
            if hasattr(module, "share"):
                module.share = 0.0
        changed = replace(config, batch=batch, accumulate=accumulate)
        encoder_trainer(encoder, samples(*dataset), LOSSES, changed, folder=made(tmp_path / name), settings={}).run()
    for column in ("loss", "field", "render", "contrast", "gradient"):
        one, two = (losses(tmp_path / name, column) for name in ("at_once", "in_turn"))
        np.testing.assert_allclose(one, two, rtol=1e-4 if column != "gradient" else 1e-3)


def test_a_target_that_is_not_finite_stops_the_run_before_the_step_and_names_the_scene(dataset, tmp_path, monkeypatch):
    data = samples(*dataset)
    for number in range(len(data.scenes)):
        data[number]  # Kinds of targets are looked up once, and here before they are spoiled.
    one = encoder_trainer(small_encoder(), data, LOSSES, SHORT, folder=tmp_path, settings={})
    before = {name: value.clone() for name, value in one.network.state_dict().items()}
    spoiled = lambda scene, rows: np.full(scene.targets(rows).shape, np.inf, np.float16)  # noqa: E731
    monkeypatch.setattr(PreparedScene, "float16_targets", spoiled)
    with pytest.raises(
        InputError, match=r"the field loss of wall_\d \((near, far|far, near)\) is not finite at step 0"
    ):
        one.run()
    assert all(torch.equal(value, before[name]) for name, value in one.network.state_dict().items())
    assert not (tmp_path / TRAINING_CHECKPOINT_FILE).exists()


def test_what_was_done_before_a_step_that_is_not_finite_is_kept(dataset: Prepared, tmp_path: Path) -> None:
    one = trainer(dataset, tmp_path, replace(SHORT, checkpoint_every=1e9))
    calls: list[int] = []

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return gradient * (float("nan") if len(calls) == 4 else 1.0)

    one.network.head_norm.weight.register_hook(spoil)
    with pytest.raises(InputError, match="the gradient of wall_.* not finite at step 3; parameters were not changed"):
        one.run()
    assert steps_in(tmp_path) == 3
    trainer(dataset, tmp_path).run()
    assert len(losses(tmp_path)) == 8


def test_the_learning_rate_rises_and_falls() -> None:
    config = TrainerConfig(steps=100, warmup=10, learning_rate=1.0)
    rates = [config.rate_at(step, 0.1) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == pytest.approx(1.0, abs=1e-2)
    assert rates[99] == pytest.approx(0.1, abs=1e-2)
    assert all(np.diff(rates[10:]) < 0)


def test_validation_is_asked_for_and_logged(dataset: Prepared, tmp_path: Path) -> None:
    config, grey = replace(SHORT, validate_every=4), np.full((4, 6, 3), 128, np.uint8)
    scores = iter((0.5, 1.0))
    validate = lambda encoder: ValidationResult({"score": next(scores)}, {"sheet": grey})  # noqa: E731
    trainer(dataset, tmp_path, config, validate=validate).run()
    assert sorted(path.name for path in (tmp_path / "validation").iterdir()) == ["sheet_000004.png", "sheet_000008.png"]
    rows = read_log(tmp_path / LOG_FILE)
    assert [row.get("validation/score") for row in rows] == [None] * 3 + ["0.5"] + [None] * 3 + ["1.0"]


@pytest.mark.alone
def test_workers_are_spawned_and_make_the_same_samples(dataset: Prepared, tmp_path: Path) -> None:
    trainer(dataset, tmp_path / "alone", replace(SHORT, steps=3)).run()
    trainer(dataset, tmp_path / "helped", replace(SHORT, steps=3, workers=1)).run()
    np.testing.assert_allclose(losses(tmp_path / "alone"), losses(tmp_path / "helped"), rtol=1e-5)


def test_matrices_decay_and_norms_and_biases_do_not() -> None:
    encoder = small_encoder([4, 4])
    groups = _parameter_groups(encoder, 0.3)
    decay = {id(value): group["weight_decay"] for group in groups for value in group["params"]}
    assert len(decay) == sum(len(group["params"]) for group in groups) == len(list(encoder.parameters()))
    for name, value in encoder.named_parameters():
        assert decay[id(value)] == (0.0 if name.endswith("bias") or "norm" in name else 0.3), name


@pytest.mark.parametrize(
    ("cores", "processes", "gigabytes", "expected"),
    [(16, 1, 64, 8), (16, 4, 64, 3), (4, 1, 64, 3), (2, 4, 64, 0), (16, 1, 2.5, 2), (16, 8, 4, 0), (1, 1, 64, 0)],
)
def test_beside_a_gpu_samples_are_made_by_the_cores_that_are_left_as_far_as_shared_memory_reaches(
    monkeypatch: pytest.MonkeyPatch, cores: int, processes: int, gigabytes: float, expected: int
) -> None:
    usage = shutil.disk_usage(".")._replace(free=int(gigabytes * 2**30))
    monkeypatch.setattr(data_workers, "available_cores", lambda: cores)
    monkeypatch.setattr(data_workers.shutil, "disk_usage", lambda folder: usage)
    process = ProcessRank(rank=0, world_size=processes, local_rank=0, local_world_size=processes)
    assert automatic_workers(torch.device("cuda"), process) == expected
    assert automatic_workers(torch.device("cpu"), process) == 0


@pytest.fixture(scope="module")
def whole(dataset: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    trainer(dataset, folder).run()
    return folder


def test_a_run_that_was_cut_off_goes_on_as_if_nothing_had_happened(dataset, whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        trainer(dataset, tmp_path / "cut").run(stop_at(5))
    assert len(losses(tmp_path / "cut")) == 5
    again = trainer(dataset, tmp_path / "cut")
    assert again.state.step == 5
    again.run()
    assert rows(tmp_path / "cut") == rows(whole)
    assert_same_weights(tmp_path / "cut", whole)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.usefixtures("interrupts")
def test_a_signal_within_a_step_ends_the_run_after_it(dataset: Prepared, whole: Path, tmp_path: Path) -> None:
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
    assert rows(tmp_path / "cut") == rows(whole)
    assert_same_weights(tmp_path / "cut", whole)


@pytest.mark.parametrize(("cause", "saved"), [(Stopped(15), True), (KeyboardInterrupt(), True), (None, False)])
def test_a_stop_that_compiled_code_wraps_is_a_stop(dataset, tmp_path, cause, saved):
    error = SystemError("returned a result with an exception set")
    error.__cause__ = cause
    with pytest.raises(SystemError):
        trainer(dataset, tmp_path, replace(SHORT, checkpoint_every=1e9)).run(stop_at(3, error))
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
                shutil.copy(tmp_path / TRAINING_CHECKPOINT_FILE, tmp_path / "third")
            yield step

    with pytest.raises(KeyboardInterrupt):
        first.run(stop_at_five)
    # As a process leaves it that is killed: two rows more than the checkpoint has steps.
    (tmp_path / "third").replace(tmp_path / TRAINING_CHECKPOINT_FILE)
    assert (len(losses(tmp_path)), steps_in(tmp_path)) == (5, 3)
    trainer(dataset, tmp_path).run()
    assert [int(row["step"]) for row in read_log(tmp_path / LOG_FILE)] == list(range(1, 9))


def test_a_checkpoint_of_other_settings_is_refused_and_named(dataset: Prepared, whole: Path) -> None:
    with pytest.raises(InputError, match=r"was made with run=1, and this run asks run=2"):
        encoder_trainer(small_encoder(), samples(*dataset), LOSSES, SHORT, folder=whole, settings={"run": 2})
    for key, message in (("samples_per_step", "a step had 1 samples, and this run has 4"), ("spaces", "changed")):
        settings = {"run": 1, key: 4}
        with pytest.raises(InputError, match=message):
            encoder_trainer(small_encoder(), samples(*dataset), LOSSES, SHORT, folder=whole, settings=settings)


@pytest.mark.parametrize(
    ("key", "value"), [("step", -5), ("step", 1000), ("unlogged", [{"loss": "x"}]), ("closed", False)]
)
def test_a_state_that_no_run_was_in_is_refused(dataset, whole, tmp_path, key, value):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path = tmp_path / TRAINING_CHECKPOINT_FILE
    write_archive(path, load_file(path), {**header_of(path), key: value})
    with pytest.raises(InputError, match="give resume=false"):
        trainer(dataset, tmp_path)


EIGHT_GPUS = """
import torch

def refuse() -> None:
    raise AssertionError("the GPU was used")

torch.cuda.is_available, torch.cuda.device_count, torch.cuda._lazy_init = lambda: True, lambda: 8, refuse
"""
"""Lets torch say that the machine has GPUs, and lets every use of one fail."""
SCRIPT = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, {tests!r})
from training_scenes import LOSSES, SHORT, samples, small_encoder
from gsencoder.train.distributed import join_processes
from gsencoder.train.prepared import PreparedDataset, PreparedScene
from gsencoder.train.run import encoder_trainer

if __name__ == "__main__":
    dataset = PreparedDataset(Path({prepared!r}), {{"made": "for a test"}})
    names = {names!r}
    with join_processes("cpu") as (process, device):
        config = replace(SHORT, steps={steps}, accumulate={accumulate})
        trainer = encoder_trainer(small_encoder(), samples(dataset, names), LOSSES, config, folder=Path({folder!r}),
                          settings={{}}, process=process, device=device)
        trainer.run()
    threads = [(task / "comm").read_text() for task in Path("/proc/self/task").glob("*")]
    sys.exit(any("gloo" in name for name in threads) and "threads of the process group are left: " + str(threads))
"""


def script(dataset: Prepared, folder: Path, *, steps: int, accumulate: int, before: str = "") -> Path:
    places = {"tests": str(Path(__file__).resolve().parent.parent), "prepared": str(dataset[0].folder)}
    numbers = {"names": dataset[1], "steps": steps, "accumulate": accumulate}
    path = made(folder) / "run.py"
    path.write_text(before + SCRIPT.format(folder=str(folder), **places, **numbers))
    return path


@pytest.mark.alone
def test_two_processes_on_the_cpu_of_a_machine_with_gpus_follow_the_losses_of_one(dataset, tmp_path, ranks):
    alone = script(dataset, tmp_path / "one", steps=4, accumulate=2)
    pair = script(dataset, tmp_path / "two", steps=4, accumulate=1, before=EIGHT_GPUS)
    ranks.started(alone, count=1).end_well()
    launcher = [sys.executable, "-W", "ignore", "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*launcher, str(pair)], check=False, timeout=300, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    # AdamW does not see the scale of a gradient, and clipping hides it: the norm is what tells.
    for column in ("loss", "field", "render", "contrast", "gradient"):
        two, one = (losses(tmp_path / name, column) for name in ("two", "one"))
        np.testing.assert_allclose(two, one, rtol=1e-4 if column != "gradient" else 1e-3)
    two, one = weights_in(tmp_path / "two"), weights_in(tmp_path / "one")
    assert two.keys() == one.keys()
    for name, value in two.items():
        np.testing.assert_allclose(value, one[name], atol=2e-3)
