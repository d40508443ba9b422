"""The training loop, resumable, with equal results on one process or several.

Checkpoints of training: parameters, optimizer state and step in one safetensors file, written atomically.

The learning rate schedule, the order of samples and all random numbers are functions of the seed and the step, so of
these only the step is stored.
"""

import math
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from gsencoder.core.archive import Archive, open_archive, write_archive
from gsencoder.core.device import autocast_dtype
from gsencoder.core.errors import InputError, advised
from gsencoder.core.logs import Log
from gsencoder.core.process import Precision, ProcessRank, Track, defer_signals, stop_of, untracked
from gsencoder.core.settings import first_difference
from gsencoder.core.threads import available_cores, threads_of_torch
from gsencoder.train import distributed
from gsencoder.train.distributed import (
    check_agreement,
    digest_of,
    digest_of_weights,
    fail_together,
    lost_processes,
)
from gsencoder.train.losses import NO_WEIGHT, Objective, TrainingBatch, finite_terms, sum_divisors
from gsencoder.train.samples import StepSampler

CHANGEABLE_ON_RESUME = (
    "workers",
    "prefetch",
    "log_every",
    "validate_every",
    "checkpoint_every",
    "compile",
    "accumulate",
)
"""Settings of the loop that a resumed run may change, since they do not change the result of a step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerConfig:
    """Settings of the training loop."""

    steps: int = field(default=2000, metadata={"help": "optimizer steps"})
    batch: int = field(default=1, metadata={"help": "samples per micro-batch"})
    accumulate: int = field(
        default=1, metadata={"help": "micro-batches per process and step, whose gradients are accumulated"}
    )
    learning_rate: float = field(default=2e-3, metadata={"help": "highest learning rate"})
    final_rate: float = field(default=0.01, metadata={"help": "learning rate at the end, as a fraction of the highest"})
    warmup: int = field(default=100, metadata={"help": "steps of linear warm-up of the learning rate"})
    weight_decay: float = field(default=0.05, metadata={"help": "weight decay of matrices; norms and biases have none"})
    clip: float = field(default=1.0, metadata={"help": "norm to which the gradient is clipped; 0 = no clipping"})
    precision: Precision = field(
        default="auto",
        metadata={
            "help": "floating-point type of the network; auto = bfloat16 on a CPU with AMX, else float32 (on a GPU "
            "bfloat16 suits model=base)"
        },
    )
    workers: int | None = field(
        default=None,
        metadata={
            "help": "number of processes that make samples; 0 = make them in the training process, null = that "
            "without a GPU, else one a core, at most 8, as far as /dev/shm has 1 GiB for each"
        },
    )
    prefetch: int = field(
        default=2,
        metadata={"help": "batches that each of these processes makes ahead; each is held in shared memory (/dev/shm)"},
    )
    seed: int = field(default=0, metadata={"help": "seed of all random numbers"})
    log_every: int = field(default=10, metadata={"help": "steps per row of the log, over which losses are averaged"})
    validate_every: int = field(default=500, metadata={"help": "steps between validations; 0 = only at the end"})
    checkpoint_every: float = field(default=300.0, metadata={"help": "seconds between checkpoints"})
    compile: bool = field(default=False, metadata={"help": "compile the network with torch.compile"})

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "accumulate", "log_every", "prefetch"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        for name in ("warmup", "weight_decay", "clip", "workers", "seed", "validate_every", "checkpoint_every"):
            if not 0 <= (getattr(self, name) or 0) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.seed >= 1 << 63:
            raise InputError(f"seed: expected a number below 2⁶³, got {self.seed}")
        if not 0 < self.learning_rate < math.inf:
            raise InputError(f"learning_rate: expected a positive number, got {self.learning_rate}")
        if not 0 <= self.final_rate <= 1:
            raise InputError(f"final_rate: expected a number in [0, 1], got {self.final_rate}")

    def samples_per_step(self, processes: int) -> int:
        """The number of samples of one optimizer step over all processes."""
        return self.batch * self.accumulate * processes

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: linear warm-up, then a half cosine down to `final_rate`."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        progress = (step - self.warmup) / max(self.steps - self.warmup, 1)
        final = self.final_rate
        return self.learning_rate * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))


TRAINING_CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingState:
    """The state of a training run that is not in tensors.

    Attributes:
        step: number of completed steps.
        seconds: their duration.
        unlogged: losses of the steps since the last row of the log, to be averaged in the next row.
        closed: whether logging and validation after the last step are completed.
    """

    step: int = 0
    seconds: float = 0.0
    unlogged: tuple[dict[str, float], ...] = ()
    closed: bool = True


def save_checkpoint(
    path: Path,
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    state: TrainingState,
    settings: dict[str, Any],
) -> None:
    """Writes a checkpoint; an existing one is replaced only by a complete new one.

    Args:
        model: the model in training.
        optimizer: AdamW over parameters of `model`.
        state: step, seconds and losses that are not logged yet.
        settings: the settings that a run must share to resume from here, as JSON values.
    """
    arrays = {f"model.{name}": value.detach().cpu().numpy() for name, value in trained_state(model).items()}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            arrays[f"optimizer.{key}.{name}"] = value.detach().float().cpu().numpy()
    with_moments = [name for name, parameter in model.named_parameters() if optimizer.state.get(parameter)]
    header = {**asdict(state), "settings": settings, "moved": with_moments}
    write_archive(path, arrays, header)


def trained_state(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """What a training changes of a network: its state, or, where parameters are frozen, the others alone.

    Frozen parameters, and buffers beside them, are those of a model that adapters are trained on; they are read from
    its own files, which are many times larger than the adapters.
    """
    state = model.state_dict()
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    if all(parameter.requires_grad for parameter in model.parameters()):
        return state
    return {name: value for name, value in state.items() if name in trained}


def load_checkpoint(
    path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer, settings: dict[str, Any]
) -> TrainingState:
    """Restores model and optimizer from a checkpoint."""
    with advised(_begin_anew(path)), open_archive(path) as file:
        stored_settings = file.value("settings", dict)
        if stored_settings != settings:
            raise InputError(f"{path}: {_describe_difference(stored_settings, settings)}")
        parameters = {
            name: torch.from_numpy(file.array(f"model.{name}", "float32", tuple(value.shape)))
            for name, value in trained_state(model).items()
        }
        moments: dict[torch.nn.Parameter, dict[str, torch.Tensor]] = {}
        with_moments = file.value("moved", list)
        for name, parameter in model.named_parameters():
            if name not in with_moments:
                continue
            shape = tuple(parameter.shape)
            keys = (("step", ()), ("exp_avg", shape), ("exp_avg_sq", shape))
            moments[parameter] = {
                key: torch.from_numpy(file.array(f"optimizer.{key}.{name}", "float32", size).copy())
                for key, size in keys
            }
        state = _read_state(file)
    # Of a network with frozen parameters these are a part, which is complete, since it was asked for by name.
    model.load_state_dict(parameters, strict=parameters.keys() == model.state_dict().keys())
    for parameter, values in moments.items():
        optimizer.state[parameter] = {key: value.to(parameter.device) for key, value in values.items()}
    return state


def check_same_teachers(path: Path, teachers: Sequence[str]) -> None:
    """Checks that a checkpoint, if there is one, is of a run with these teachers, which is known before anything is
    prepared for them.
    """
    if not path.is_file():
        return
    with advised(_begin_anew(path)), open_archive(path) as file:
        stored, requested = file.value("settings", dict), {"teachers": list(teachers)} if len(teachers) > 1 else {}
        if stored.get("teachers") != requested.get("teachers"):
            raise InputError(f"{path}: {_describe_difference(stored, requested)}")


def _begin_anew(path: Path) -> str:
    return f"give resume=false to begin anew, or remove {path}"


def _describe_difference(stored: dict[str, Any], settings: dict[str, Any]) -> str:
    """The first difference between the settings of a checkpoint and of this run, and what to do about it."""
    # Stated by runs with several teachers alone.
    saved, requested = stored.get("teachers"), settings.get("teachers")
    if saved != requested:
        single = "one teacher"
        saved, requested = (single if each is None else f"teachers={each}" for each in (saved, requested))
        return f"was made with {saved}, and this run asks {requested}; give the same settings or another out="
    if any(stored.get(name) != settings.get(name) for name in ("space", "spaces", "scenes")):
        return "the prepared scenes have changed since; give the former prepared=, or another out="
    before, now = stored.get("samples_per_step"), settings.get("samples_per_step")
    if before != now:
        return (
            f"a step had {before} samples, and this run has {now} (train.batch × train.accumulate × processes); change "
            "train.accumulate= or the number of processes, or give another out="
        )
    return f"was made with {first_difference(stored, settings)}; give the same settings or another out="


def _read_state(file: Archive) -> TrainingState:
    step, seconds, unlogged = file.value("step", int), file.value("seconds", float, int), file.value("unlogged", list)
    closed: bool = file.value("closed", bool)
    all_numeric = all(
        isinstance(row, dict) and all(isinstance(value, (int, float)) for value in row.values()) for row in unlogged
    )
    if step < 1 or not 0 <= seconds < math.inf or not all_numeric or not (unlogged or closed):
        raise InputError(
            f"the state is not one that training writes (step {step}, {len(unlogged)} steps without a row in the log)"
        )
    return TrainingState(step=step, seconds=float(seconds), unlogged=tuple(unlogged), closed=closed)


MOST_WORKERS = 8
"""Four of them made a sample of 32,000 Gaussians each 21 ms beside steps of 36 ms; larger samples take more."""
SHARED_MEMORY = Path("/dev/shm")
WORKER_BYTES = 1 << 30
"""Shared memory that is left for the samples that a worker makes ahead; two of 250,000 Gaussians are 0.3 GB."""


def automatic_workers(device: torch.device, process: ProcessRank) -> int:
    """How many processes make samples for a training process.

    Without a GPU none, since the network has all cores. Beside a GPU one for each core of this process's share of the
    machine but one, at most `MOST_WORKERS`, and as many as /dev/shm has room for, which is small in containers.
    """
    if device.type == "cpu":
        return 0
    cores = available_cores() // process.local_world_size - 1
    room = MOST_WORKERS
    if SHARED_MEMORY.is_dir():
        room = shutil.disk_usage(SHARED_MEMORY).free // process.local_world_size // WORKER_BYTES
    return max(0, min(MOST_WORKERS, cores, room))


def start_worker(worker: int) -> None:  # noqa: ARG001
    """Sets a data worker to one thread, and makes it ignore signals that are sent to the process group: the training
    process ends its workers after it has saved, and a worker that dies earlier would be an error while it saves."""
    torch.set_num_threads(1)
    for name in ("SIGTERM", "SIGHUP", "SIGINT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    sys.excepthook = silence_connection_errors


@contextmanager
def lost_workers() -> Iterator[None]:
    """Turns the error of torch about a data worker that the system ended into one that says what may be behind it.

    It may be raised anywhere in the block, also between a step and the record of it, so that nothing is to be saved
    on its account.
    """
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker (pid"):
            raise
        message = " ".join(str(error).split()).partition(". ")[0]
        raise InputError(
            f"training: a process that makes samples was ended by the system ({message}): memory or {SHARED_MEMORY} is "
            "full, or a prepared scene was cut off; make room and give the same command again, which continues from "
            "the last checkpoint, with fewer train.workers if it happens again"
        ) from error


def silence_connection_errors(
    error_type: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """An excepthook of data workers that does not print errors of connections.

    If the training process stops while it receives a sample, it reports the reason itself; the worker's thread that
    sends the sample would print that its connection was reset or closed.
    """
    if not issubclass(error_type, ConnectionError | EOFError):
        sys.__excepthook__(error_type, error, trace)


SAMPLE_THREADS = 4
"""Threads while a sample is made in the training process: its arrays are small, and sixteen take 3 times as long."""


class ValidationResult(NamedTuple):
    """The result of a validation.

    Attributes:
        scores: numbers by name.
        pictures: images uint8 [H, W, 3] by name.
    """

    scores: Mapping[str, float]
    pictures: Mapping[str, np.ndarray] = {}


class Trainer:
    """Trains a network on samples; its checkpoint and log, from which a killed run is resumed, are in one folder."""

    def __init__(
        self,
        network: nn.Module,
        dataset: Dataset[Any],
        objective: Callable[[nn.Module], Objective],
        config: TrainerConfig,
        *,
        collate: Callable[[Any], TrainingBatch | InputError],
        folder: Path,
        settings: Mapping[str, Any],
        process: ProcessRank = ProcessRank(),
        device: torch.device = torch.device("cpu"),
        tensorboard: bool = False,
        validate: Callable[[Any], ValidationResult] = lambda network: ValidationResult({}),  # noqa: ARG005
    ) -> None:
        """Sets up training, and resumes from the checkpoint in `folder` if there is one.

        Args:
            network: the network, trained in place and moved to `device`.
            dataset: the training samples, by number; an error of a sample is a value.
            objective: gives the loss of the network once it is compiled or wrapped for several processes.
            collate: joins samples to a batch, or returns the error of one of them.
            folder: existing folder for checkpoint and log.
            settings: the settings that a run must share with the one that it resumes, as JSON values.
            tensorboard: whether to write TensorBoard events.
            validate: validates the network, which is given in evaluation mode; called in all processes, which may
                share the work, and the result of the first one is logged.
        """
        self.config, self.dataset, self.process, self.device = config, dataset, process, device
        self.folder, self.settings, self.validate = folder, dict(settings), validate
        self.network, self._collate = network.to(device), collate
        self.optimizer = torch.optim.AdamW(
            _parameter_groups(network, config), lr=config.learning_rate, betas=(0.9, 0.98), fused=True
        )
        self.state = TrainingState()
        self.last_validation: ValidationResult | None = None
        if (folder / TRAINING_CHECKPOINT_FILE).is_file():
            self.state = load_checkpoint(folder / TRAINING_CHECKPOINT_FILE, network, self.optimizer, self.settings)
            if self.state.step > config.steps:
                raise InputError(
                    f"{folder / TRAINING_CHECKPOINT_FILE}: is at step {self.state.step}, beyond the last step "
                    f"{config.steps}; give resume=false to begin anew"
                )
        if process.world_size > 1:
            check_agreement("the settings of training", digest_of(self.settings))
            state = f"{self.state.step} {digest_of_weights(network)}"
            check_agreement("the step and the weights that training begins with", state)
        # If the run was interrupted before the last step was closed, the step's row of the log is written again.
        closed_steps = self.state.step - (not self.state.closed)
        has_log = self.state.step > len(self.state.unlogged)
        self._log = Log(folder, done=closed_steps, events=tensorboard, begun=has_log) if process.is_first else None
        called: nn.Module = torch.compile(network, dynamic=True) if config.compile else network  # type: ignore[assignment]
        self._parallel: nn.parallel.DistributedDataParallel | None = None
        if process.world_size > 1:
            device_ids = [device.index] if device.type == "cuda" else None
            called = self._parallel = nn.parallel.DistributedDataParallel(called, device_ids=device_ids)
        self.objective = objective(called)
        self._autocast = autocast_dtype(config.precision, device, training=True)

    def run(self, track: Track = untracked) -> TrainingState:
        """Runs the remaining steps.

        If the run is stopped by an interrupt, a signal or an InputError, it saves a checkpoint of the last completed
        step first.

        Returns:
            Steps and seconds of the training.
        """
        with lost_workers():
            try:
                self._run(track)
            except BaseException as stop:
                can_resume = (
                    isinstance(stop, InputError) or not isinstance(stop, Exception) or stop_of(stop) is not None
                )
                if can_resume and self.state.step:
                    with suppress(InputError):
                        self.save()
                raise
        # DistributedDataParallel holds the process group, whose threads must end before the interpreter exits.
        self.objective.network, self._parallel = self.network, None
        return self.state

    def _run(self, track: Track) -> None:
        config, start = self.config, time.monotonic() - self.state.seconds
        first, saved = self.state.step, time.monotonic()
        if not self.state.closed:
            self._close_step()
        loader = self._loader(first)
        batches, threads = iter(loader), torch.get_num_threads()
        sample_threads = threads if loader.num_workers else min(SAMPLE_THREADS, threads)
        for step in track(range(first, config.steps), "training"):
            with threads_of_torch(sample_threads):
                items = [next(batches) for _ in range(config.accumulate)]
            with lost_processes(self.process, distributed.STEP_MINUTES):
                losses = self._gradients(step, items)
            unlogged = (*self.state.unlogged, losses)
            # A signal between these lines would save a checkpoint of parameters and state of different steps.
            with defer_signals():
                self.optimizer.step()
                seconds = time.monotonic() - start
                self.state = TrainingState(step=step + 1, seconds=seconds, unlogged=unlogged, closed=False)
            self._close_step()
            if time.monotonic() - saved >= config.checkpoint_every or self.state.step == config.steps:
                self.save()
                saved = time.monotonic()

    def _close_step(self) -> None:
        """Closes a step: validates if it is due, and writes a row of the log if it is due."""
        config, step, recent = self.config, self.state.step, self.state.unlogged
        is_last = step == config.steps
        row: dict[str, float] = {}
        if log_due := is_last or step % config.log_every == 0:
            # A term of a teacher that no scene of a step has is not among the losses of that step.
            names = dict.fromkeys(name for losses in recent for name in losses)
            row = {name: float(np.mean([losses[name] for losses in recent if name in losses])) for name in names}
        if is_last or (config.validate_every and step % config.validate_every == 0):
            with fail_together():
                row |= self._run_validation(step)
        if row and self._log is not None:
            self._log.add(step, row | {"seconds": self.state.seconds})
        self.state = replace(self.state, unlogged=() if log_due else recent, closed=True)

    def save(self) -> None:
        """Writes the checkpoint, on the first process only."""
        if self.process.is_first:
            save_checkpoint(
                self.folder / TRAINING_CHECKPOINT_FILE, self.network, self.optimizer, self.state, self.settings
            )

    def _loader(self, first: int) -> "DataLoader[Any]":
        config = self.config
        sampler = StepSampler(
            first,
            config.steps,
            batch=config.batch,
            accumulate=config.accumulate,
            rank=self.process.rank,
            world=self.process.world_size,
        )
        workers = automatic_workers(self.device, self.process) if config.workers is None else config.workers
        # Workers are spawned: a forked child would inherit the state of threads that do not exist in it.
        return DataLoader(
            self.dataset,
            batch_sampler=sampler,
            collate_fn=self._collate,
            num_workers=workers,
            multiprocessing_context="spawn" if workers else None,
            worker_init_fn=start_worker if workers else None,
            prefetch_factor=config.prefetch if workers else None,
        )

    def _gradients(self, step: int, items: list[Any]) -> dict[str, float]:
        """Computes the gradients of one optimizer step; returns the losses over all processes.

        Args:
            items: micro-batches of this process, or the errors of their samples.
        """
        self.optimizer.zero_grad(set_to_none=True)
        rate = self.config.rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.network.train()
        batches, divisors = sum_divisors(self.objective, items, self.device)
        lambdas = self.objective.lambdas
        micro_terms = []
        for micro, batch in enumerate(batches):
            self._seed((step * len(batches) + micro) * self.process.world_size + self.process.rank)
            if self._parallel is not None:
                self._parallel.require_backward_grad_sync = micro + 1 == len(batches)
            with torch.autocast(self.device.type, self._autocast, enabled=self._autocast is not None):
                terms = self.objective(batch.to(self.device))
            shares = torch.stack([terms[name] / divisors[name] for name in lambdas])
            loss = (shares * shares.new_tensor(list(lambdas.values()))).sum()
            # DistributedDataParallel averages gradients over processes; the step needs their sum.
            (loss * self.process.world_size).backward()
            micro_terms.append(shares.detach().double())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip or math.inf).item()
        losses = finite_terms(
            step, batches, list(lambdas), torch.stack(micro_terms), norm, processes=self.process.world_size
        )
        total = sum(lambdas[name] * loss for name, loss in losses.items())
        losses = {name: loss for name, loss in losses.items() if divisors[name] > NO_WEIGHT}
        return {"loss": total, **losses, "gradient": norm, "learning_rate": rate}

    def _seed(self, number: int) -> None:
        """Seeds the network's random numbers by the number of the micro-batch in the run, so that a resumed run repeats
        them."""
        state = np.random.SeedSequence([self.config.seed, number]).generate_state(1, np.uint64)
        seed = int(state[0] >> np.uint64(1))
        if self.device.type == "cpu":
            # torch.manual_seed would queue the call, with its stack, for a GPU that a run on a CPU never starts.
            torch.default_generator.manual_seed(seed)
        else:
            torch.manual_seed(seed)

    def _run_validation(self, step: int) -> dict[str, float]:
        """Validates in all processes; returns the columns of the log, which are empty on all but the first."""
        self.network.eval()
        self.last_validation = result = self.validate(self.network)
        if self._log is None:
            return {}
        for name, pixels in result.pictures.items():
            self._log.picture(step, f"validation/{name}", pixels)
        return {f"validation/{name}": float(value) for name, value in result.scores.items()}


def _parameter_groups(network: nn.Module, config: TrainerConfig) -> list[dict[str, Any]]:
    """Parameters with weight decay (matrices) and without (norms and biases); frozen ones are in neither group."""
    trained = [value for value in network.parameters() if value.requires_grad]
    matrices = [value for value in trained if value.ndim > 1]
    vectors = [value for value in trained if value.ndim <= 1]
    return [{"params": matrices, "weight_decay": config.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
