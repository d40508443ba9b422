"""The training loop, resumable, with equal results on one process or several, and its checkpoints.

The learning rate schedule, the order of samples and all random numbers are functions of the seed and the step, so of
these only the step is stored.
"""

import math
import shutil
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.device import autocast_dtype, to_device
from gsencoder.core.errors import InputError, error_hint
from gsencoder.core.files import plain
from gsencoder.core.logs import Log
from gsencoder.core.process import Precision, ProcessRank, Track, available_cores, defer_signals, stop_of, untracked
from gsencoder.core.settings import CheckedConfig, first_difference, option
from gsencoder.core.threads import threads_of_torch
from gsencoder.train import distributed
from gsencoder.train.distributed import (
    STOPPED_ELSEWHERE,
    check_agreement,
    digest_of,
    digest_of_weights,
    fail_together,
    lost_processes,
    sum_over_processes,
)

CHANGEABLE_ON_RESUME = ("workers", "prefetch", "log_every", "validate_every", "checkpoint_every", "accumulate")
"""Settings of the loop that a resumed run may change, since they do not change the result of a step."""
CLIP = 1.0
"""Norm to which gradients are clipped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerConfig(CheckedConfig):
    """Settings of the training loop."""

    steps: int = option(2000, "optimizer steps", ge=1)
    batch: int = option(1, "samples per micro-batch", ge=1)
    accumulate: int = option(1, "micro-batches per process and step, whose gradients are accumulated", ge=1)
    learning_rate: float = option(2e-3, "highest learning rate", gt=0)
    warmup: int = option(100, "steps of linear warm-up of the learning rate", ge=0)
    precision: Precision = option(
        "auto",
        "floating-point type of the network; auto = bfloat16 on a CPU with AMX, else float32 (on a GPU "
        "bfloat16 suits model=base)",
    )
    workers: int | None = option(
        None,
        "number of processes that make samples; 0 = make them in the training process, null = that "
        "without a GPU, else one a core, at most 8, as far as /dev/shm has 1 GiB for each",
        ge=0,
    )
    prefetch: int = option(
        2, "batches that each of these processes makes ahead; each is held in shared memory (/dev/shm)", ge=1
    )
    seed: int = option(0, "seed of all random numbers", ge=0, lt=1 << 63)
    log_every: int = option(10, "steps per row of the log, over which losses are averaged", ge=1)
    validate_every: int = option(500, "steps between validations; 0 = only at the end", ge=0)
    checkpoint_every: float = option(300.0, "seconds between checkpoints", ge=0)

    def samples_per_step(self, processes: int) -> int:
        """The number of samples of one optimizer step over all processes."""
        return self.batch * self.accumulate * processes

    def rate_at(self, step: int, final: float) -> float:
        """The learning rate of a step: linear warm-up, then a half cosine down to `final`, a share of the highest."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        progress = (step - self.warmup) / max(self.steps - self.warmup, 1)
        return self.learning_rate * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))


@runtime_checkable
class Objective(Protocol):
    """The loss of a network, possibly wrapped for several processes, as weighted terms. In a step each term is Σ total
    / Σ divisor, summed over all micro-batches of all processes. `lambdas` are the weights of the terms that are not 0,
    and `advice` is what the user should check where no term has a divisor above 0."""

    network: nn.Module

    @property
    def lambdas(self) -> dict[str, float]: ...

    @property
    def advice(self) -> str: ...

    def divisors(self, batch: Any) -> dict[str, float]:
        """The sum of the weights of a batch's rows, for each term."""
        ...

    def __call__(self, batch: Any) -> dict[str, Tensor]:
        """The totals of the terms whose weight is not 0."""
        ...


class ErrorsAsValues(Dataset[Any]):
    """A dataset that gives the error of a sample as a value: raised in a data worker it would arrive as a long
    traceback."""

    def __init__(self, dataset: Dataset[Any]) -> None:
        self.dataset = dataset

    def __getitem__(self, number: int) -> Any:
        try:
            return self.dataset[number]
        except InputError as error:
            return error


def join_unless_error(samples: Sequence[Any], collate: Callable[[Any], Any]) -> Any:
    """The batch of some samples, or the first error among them."""
    errors = [each for each in samples if isinstance(each, InputError)]
    return errors[0] if errors else collate(samples)


NO_WEIGHT = 1e-12
"""Divisor of a term that nothing in a step has a weight for."""


def sum_divisors(
    objective: Objective, items: Sequence[Any], device: torch.device
) -> tuple[list[Any], dict[str, float]]:
    """The micro-batches of a step on this process, and the divisor of each term over all processes. Fails in all of
    them if a sample could not be made, or if no term has a weight."""
    batches = [item for item in items if not isinstance(item, InputError)]
    lambdas = objective.lambdas
    batch_divisors = [objective.divisors(batch) for batch in batches]
    sums = [sum(divisors[name] for divisors in batch_divisors) for name in lambdas]
    failed = len(items) - len(batches)
    totals = sum_over_processes(torch.tensor([*sums, failed], dtype=torch.float64, device=device)).tolist()
    for item in items:
        if isinstance(item, InputError):
            raise item
    if totals[-1]:
        raise InputError(STOPPED_ELSEWHERE)
    if not any(totals[:-1]):
        raise InputError(
            f"training: there is nothing to compare in {_names_of(batches)}: no Gaussian has a target with a weight, "
            f"and no cell of the teacher passes the thresholds; check {objective.advice}, and these scenes"
        )
    return batches, {name: max(total, NO_WEIGHT) for name, total in zip(lambdas, totals, strict=False)}


def _names_of(batches: Sequence[Any]) -> str:
    return "; ".join(name for batch in batches for name in batch.names)


def finite_terms(
    step: int,
    batches: Sequence[Any],
    names: Sequence[str],
    micro_terms: Float64[Tensor, "micro terms"],
    norm: float,
    *,
    processes: int,
) -> dict[str, float]:
    """The loss terms of a step over all processes, by name, given what each micro-batch of this one adds to them and
    the norm of the gradient over all. Fails in all of them if one of these is not finite."""
    bad_loss = bad_gradient = ""
    for batch, row in zip(batches, micro_terms.tolist(), strict=True):
        for name, value in zip(names, row, strict=True):
            if not math.isfinite(value):
                bad_loss = bad_loss or f"the {name} loss of {_names_of([batch])}"
    if not bad_loss and not math.isfinite(norm):
        # Gradients are already summed over processes, so samples of any of them may be the cause.
        others = " or of samples of other processes" if processes > 1 else ""
        bad_gradient = f"the gradient of {_names_of(batches)}{others}"
    flags = micro_terms.new_tensor([float(bool(bad_loss)), float(bool(bad_gradient))])
    *totals, bad_losses, bad_gradients = sum_over_processes(torch.cat((micro_terms.sum(dim=0), flags))).tolist()
    if bad_losses or bad_gradients:
        # A loss identifies the samples that cause it; the gradient is named only if all losses are finite.
        where = bad_loss or ("a loss of another process" if bad_losses else bad_gradient)
        raise InputError(
            f"training: {where} is not finite at step {step}; parameters were not changed. Use a lower "
            "learning_rate, or check these scenes (`gsencoder inspect`)"
        )
    return dict(zip(names, totals, strict=True))


TRAINING_CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingState:
    """The state of a training run that is not in tensors: completed steps, their duration, the losses since the last
    row of the log, to be averaged in the next row, and whether logging and validation after the last step are
    completed."""

    step: int = 0
    seconds: float = 0.0
    unlogged: tuple[dict[str, float], ...] = ()
    closed: bool = True


def save_checkpoint(
    path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, state: TrainingState, settings: dict[str, Any]
) -> None:
    """Writes model, AdamW's moments and state; an existing checkpoint is replaced only by a complete new one.
    `settings` are those that a run must share to resume from here, as JSON values."""
    arrays = {f"model.{name}": value.detach().cpu().numpy() for name, value in trained_state(model).items()}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            arrays[f"optimizer.{key}.{name}"] = value.detach().float().cpu().numpy()
    with_moments = [name for name, parameter in model.named_parameters() if optimizer.state.get(parameter)]
    write_archive(path, arrays, {**asdict(state), "settings": settings, "moved": with_moments})


def trained_state(model: nn.Module) -> dict[str, Tensor]:
    """What a training changes of a network: its state, or, where parameters are frozen, the others alone: frozen ones
    and buffers are those of a model that adapters are trained on, and are read from its own files."""
    state = model.state_dict()
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    if all(parameter.requires_grad for parameter in model.parameters()):
        return state
    return {name: value for name, value in state.items() if name in trained}


def load_checkpoint(
    path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, settings: dict[str, Any]
) -> TrainingState:
    """Restores model and optimizer from a checkpoint; of a run with other settings the first that differs is named."""
    with error_hint(_advice(path)), open_archive(path) as file:
        stored_settings = file.value("settings", dict)
        if stored_settings != settings:
            raise InputError(f"{path}: {_describe_difference(stored_settings, settings)}")
        parameters = {
            name: torch.from_numpy(file.array(f"model.{name}", "float32", tuple(value.shape)))
            for name, value in trained_state(model).items()
        }
        moments: dict[nn.Parameter, dict[str, Tensor]] = {}
        with_moments = file.value("moved", list)
        for name, parameter in model.named_parameters():
            if name in with_moments:
                shape = tuple(parameter.shape)
                moments[parameter] = {
                    key: torch.from_numpy(file.array(f"optimizer.{key}.{name}", "float32", size).copy())
                    for key, size in (("step", ()), ("exp_avg", shape), ("exp_avg_sq", shape))
                }
        step, seconds = file.value("step", int), float(file.value("seconds", float, int))
        unlogged, closed = file.value("unlogged", list), bool(file.value("closed", bool))
        numeric = all(
            isinstance(row, dict) and all(isinstance(v, (int, float)) for v in row.values()) for row in unlogged
        )
        if step < 1 or not 0 <= seconds < math.inf or not numeric or not (unlogged or closed):
            raise InputError(f"the state is not one that training writes (step {step}, {len(unlogged)} steps unlogged)")
    # Of a network with frozen parameters these are a part, which is complete, since it was asked for by name.
    model.load_state_dict(parameters, strict=parameters.keys() == model.state_dict().keys())
    for parameter, values in moments.items():
        optimizer.state[parameter] = {key: value.to(parameter.device) for key, value in values.items()}
    return TrainingState(step=step, seconds=seconds, unlogged=tuple(unlogged), closed=closed)


def check_same_teachers(path: Path, teachers: Sequence[str]) -> None:
    """Checks that a checkpoint, if there is one, is of a run with these teachers in this order, which is known before
    anything is prepared for them."""
    if path.is_file():
        with error_hint(_advice(path)), open_archive(path) as file:
            stored = file.value("settings", dict)
            if stored.get("teachers") != list(teachers):
                raise InputError(f"{path}: {_describe_difference(stored, {'teachers': list(teachers)})}")


def _advice(path: Path) -> str:
    return f"give resume=false to begin again, or remove {path}"


def _describe_difference(stored: dict[str, Any], settings: dict[str, Any]) -> str:
    """The first difference between the settings of a checkpoint and of this run, and what to do about it."""
    if stored.get("teachers") == settings.get("teachers"):
        if any(stored.get(name) != settings.get(name) for name in ("spaces", "scenes")):
            return "the prepared scenes have changed since; give the former prepared=, or another out="
        before, now = stored.get("samples_per_step"), settings.get("samples_per_step")
        if before != now:
            return (
                f"a step had {before} samples, and this run has {now} (train.batch × train.accumulate × processes); "
                "change train.accumulate= or the number of processes, or give another out="
            )
    else:
        stored, settings = ({"teachers": each.get("teachers")} for each in (stored, settings))
    return f"was made with {first_difference(stored, settings)}; give the same settings or another out="


MAX_WORKERS = 8
"""Four of them made a sample of 32,000 Gaussians each 21 ms while steps took 36 ms; larger samples take more."""
SHARED_MEMORY = Path("/dev/shm")
WORKER_BYTES = 1 << 30
"""Shared memory that is left for the samples that a worker makes ahead; two of 250,000 Gaussians are 0.3 GB."""
SAMPLE_THREADS = 4
"""Threads while a sample is made in the training process: its arrays are small, and sixteen take 3 times as long."""


def automatic_workers(device: torch.device, process: ProcessRank) -> int:
    """How many processes make samples for a training process: without a GPU none, since the network has all cores; else
    one for each core of this process's share of the machine but one, at most `MAX_WORKERS`, as far as /dev/shm has
    room."""
    if device.type == "cpu":
        return 0
    cores = available_cores() // process.local_world_size - 1
    room = MAX_WORKERS
    if SHARED_MEMORY.is_dir():
        room = shutil.disk_usage(SHARED_MEMORY).free // process.local_world_size // WORKER_BYTES
    return max(0, min(MAX_WORKERS, cores, room))


def start_worker(worker: int) -> None:  # noqa: ARG001
    """Sets a data worker to one thread, and makes it ignore signals that are sent to the process group: the training
    process ends its workers after it has saved, and a worker that dies earlier would be an error while it saves."""
    torch.set_num_threads(1)
    for name in ("SIGTERM", "SIGHUP", "SIGINT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    sys.excepthook = silence_connection_errors


def silence_connection_errors(
    error_type: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """An excepthook of data workers that does not print errors of connections: a training process that stops while it
    receives a sample reports the reason itself."""
    if not issubclass(error_type, ConnectionError | EOFError):
        sys.__excepthook__(error_type, error, trace)


@contextmanager
def lost_workers() -> Iterator[None]:
    """Turns the error of torch about a data worker that the system ended, which is raised anywhere in the block, into
    one that says what may be behind it."""
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


def micro_batches(first: int, last: int, *, batch: int, accumulate: int, rank: int, world: int) -> list[list[int]]:
    """The numbers of the samples of each micro-batch of a process, in order of steps.

    Step s of a run takes samples s·n to (s + 1)·n − 1, where n = batch · accumulate · world. Each micro-batch of each
    process takes `batch` consecutive ones of them.
    """
    starts = [(number * world + rank) * batch for number in range(first * accumulate, last * accumulate)]
    return [list(range(start, start + batch)) for start in starts]


class ValidationResult(NamedTuple):
    """The result of a validation: numbers, and images uint8 [H, W, 3], by name."""

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
        collate: Callable[[Any], Any],
        folder: Path,
        settings: Mapping[str, Any],
        process: ProcessRank = ProcessRank(),
        device: torch.device = torch.device("cpu"),
        weight_decay: float = 0.05,
        final_rate: float = 0.01,
        tensorboard: bool = False,
        validate: Callable[[Any], ValidationResult] | None = None,
    ) -> None:
        """Sets up training, and resumes from the checkpoint in `folder` if there is one.

        Args:
            network: trained in place and moved to `device`.
            objective: gives the loss of the network once it is wrapped for several processes.
            collate: joins samples to a batch: tuples and mappings of tensors, with the `names` of the samples.
            folder: existing folder for checkpoint and log.
            settings: what a run must share with the one that it resumes besides `config`, as JSON values.
            weight_decay: of matrices; norms and biases have none.
            final_rate: learning rate at the end, as a share of the highest.
            validate: is called in all processes with the network in evaluation mode; the result of the first is logged.
        """
        self.config, self.dataset, self.process, self.device = config, dataset, process, device
        self.folder, self.validate, self._final_rate = folder, validate, final_rate
        fixed = {name: value for name, value in plain(config).items() if name not in CHANGEABLE_ON_RESUME}
        self.settings = {"train": fixed, "samples_per_step": config.samples_per_step(process.world_size), **settings}
        self.network, self._collate = network.to(device), collate
        self.optimizer = torch.optim.AdamW(
            _parameter_groups(network, weight_decay), lr=config.learning_rate, betas=(0.9, 0.98), fused=True
        )
        self.state = TrainingState()
        self.last_validation: ValidationResult | None = None
        path = folder / TRAINING_CHECKPOINT_FILE
        if path.is_file():
            self.state = load_checkpoint(path, network, self.optimizer, self.settings)
            if self.state.step > config.steps:
                raise InputError(
                    f"{path}: is at step {self.state.step}, beyond the last step {config.steps}; {_advice(path)}"
                )
        if process.world_size > 1:
            check_agreement("the settings of training", digest_of(self.settings))
            state = f"{self.state.step} {digest_of_weights(network)}"
            check_agreement("the step and the weights that training begins with", state)
        # If the run was interrupted before the last step was closed, the step's row of the log is written again.
        closed_steps = self.state.step - (not self.state.closed)
        has_log = self.state.step > len(self.state.unlogged)
        self._log = Log(folder, done=closed_steps, events=tensorboard, begun=has_log) if process.is_first else None
        self._parallel: nn.parallel.DistributedDataParallel | None = None
        if process.world_size > 1:
            device_ids = [device.index] if device.type == "cuda" else None
            self._parallel = nn.parallel.DistributedDataParallel(network, device_ids=device_ids)
        self.objective = objective(self._parallel or network)
        self._autocast = autocast_dtype(config.precision, device, training=True)

    def run(self, track: Track = untracked) -> TrainingState:
        """Runs the remaining steps. An error of a sample, or of a loss or gradient that is not finite, names the
        samples and the term; parameters are not changed."""
        with lost_workers(), closing(self._micro_batches(track)) as remaining, self._saving_when_stopped():
            start, saved = time.monotonic() - self.state.seconds, time.monotonic()
            if not self.state.closed:
                self._close_step()
            for step, items in remaining:
                with lost_processes(self.process, distributed.STEP_MINUTES):
                    losses = self._gradients(step, items)
                unlogged = (*self.state.unlogged, losses)
                # A signal between these lines would save a checkpoint of parameters and state of different steps.
                with defer_signals():
                    self.optimizer.step()
                    seconds = time.monotonic() - start
                    self.state = TrainingState(step=step + 1, seconds=seconds, unlogged=unlogged, closed=False)
                self._close_step()
                if time.monotonic() - saved >= self.config.checkpoint_every or self.state.step == self.config.steps:
                    self.save()
                    saved = time.monotonic()
        # DistributedDataParallel holds the process group, whose threads must end before the interpreter exits.
        self.objective.network, self._parallel = self.network, None
        return self.state

    @contextmanager
    def _saving_when_stopped(self) -> Iterator[None]:
        """Saves a checkpoint of the last completed step if an interrupt, a signal or an InputError ends the block."""
        try:
            yield
        except BaseException as stop:
            can_resume = isinstance(stop, InputError) or not isinstance(stop, Exception) or stop_of(stop) is not None
            if can_resume and self.state.step:
                with suppress(InputError):
                    self.save()
            raise

    def save(self) -> None:
        """Writes the checkpoint, on the first process only."""
        if self.process.is_first:
            path = self.folder / TRAINING_CHECKPOINT_FILE
            save_checkpoint(path, self.network, self.optimizer, self.state, self.settings)

    def _micro_batches(self, track: Track) -> Generator[tuple[int, list[Any]], None, None]:
        """The remaining steps, each with the micro-batches of this process, or the errors of their samples."""
        config, process, first = self.config, self.process, self.state.step
        workers = automatic_workers(self.device, process) if config.workers is None else config.workers
        batch, accumulate, rank, world = config.batch, config.accumulate, process.rank, process.world_size
        # Workers are spawned: a forked child would inherit the state of threads that do not exist in it.
        loader: DataLoader[Any] = DataLoader(
            ErrorsAsValues(self.dataset),
            batch_sampler=micro_batches(
                first, config.steps, batch=batch, accumulate=accumulate, rank=rank, world=world
            ),
            collate_fn=partial(join_unless_error, collate=self._collate),
            num_workers=workers,
            multiprocessing_context="spawn" if workers else None,
            worker_init_fn=start_worker if workers else None,
            prefetch_factor=config.prefetch if workers else None,
        )
        batches, threads = iter(loader), torch.get_num_threads()
        try:
            for step in track(range(first, config.steps), "training"):
                with threads_of_torch(threads if workers else min(SAMPLE_THREADS, threads)):
                    items = [next(batches) for _ in range(accumulate)]
                yield step, items
        finally:
            if workers:
                # They ignore signals; Python would wait for them at its end wherever a traceback keeps the iterator.
                batches._shutdown_workers()  # type: ignore[attr-defined]

    def _gradients(self, step: int, items: list[Any]) -> dict[str, float]:
        """Computes the gradients of one optimizer step; returns the losses over all processes."""
        self.optimizer.zero_grad(set_to_none=True)
        rate = self.config.rate_at(step, self._final_rate)
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
                terms = self.objective(to_device(batch, self.device))
            shares = torch.stack([terms[name] / divisors[name] for name in lambdas])
            loss = (shares * shares.new_tensor(list(lambdas.values()))).sum()
            # DistributedDataParallel averages gradients over processes; the step needs their sum.
            (loss * self.process.world_size).backward()
            micro_terms.append(shares.detach().double())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), CLIP).item()
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

    def _close_step(self) -> None:
        """Closes a step: validates if it is due, and writes a row of the log if it is due."""
        config, step, recent = self.config, self.state.step, self.state.unlogged
        is_last = step == config.steps
        row: dict[str, float] = {}
        if log_due := is_last or step % config.log_every == 0:
            # A term of a teacher that no scene of a step has is not among the losses of that step.
            names = dict.fromkeys(name for losses in recent for name in losses)
            row = {name: float(np.mean([losses[name] for losses in recent if name in losses])) for name in names}
        if self.validate is not None and (is_last or (config.validate_every and step % config.validate_every == 0)):
            with fail_together():
                row |= self._run_validation(step, self.validate)
        if row and self._log is not None:
            self._log.add(step, row | {"seconds": self.state.seconds})
        self.state = replace(self.state, unlogged=() if log_due else recent, closed=True)

    def _run_validation(self, step: int, validate: Callable[[Any], ValidationResult]) -> dict[str, float]:
        """Validates in all processes; returns the columns of the log, which are empty on all but the first."""
        self.network.eval()
        self.last_validation = result = validate(self.network)
        if self._log is None:
            return {}
        for name, pixels in result.pictures.items():
            self._log.picture(step, f"validation/{name}", pixels)
        return {f"validation/{name}": float(value) for name, value in result.scores.items()}


def _parameter_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Parameters with weight decay (matrices) and without (norms and biases); frozen ones are in neither group."""
    trained = [value for value in network.parameters() if value.requires_grad]
    matrices = [value for value in trained if value.ndim > 1]
    vectors = [value for value in trained if value.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
