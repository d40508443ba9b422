"""The training loop, resumable, with equal results on one process or several."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from gsencoder.core.errors import InputError
from gsencoder.core.files.step_log import Log
from gsencoder.core.runtime.device import autocast_dtype
from gsencoder.core.runtime.device_names import Precision
from gsencoder.core.runtime.process_rank import ProcessRank
from gsencoder.core.runtime.signals import defer_signals, stop_of
from gsencoder.core.runtime.threads import threads_of_torch
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.train import distributed
from gsencoder.train.checkpoint import TRAINING_CHECKPOINT_FILE, TrainingState, load_checkpoint, save_checkpoint
from gsencoder.train.data_workers import automatic_workers, lost_workers, start_worker
from gsencoder.train.distributed import (
    STOPPED_ELSEWHERE,
    check_agreement,
    digest_of,
    digest_of_weights,
    fail_together,
    lost_processes,
    sum_over_processes,
)
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
SAMPLE_THREADS = 4
"""Threads while a sample is made in the training process: its arrays are small, and sixteen take 3 times as long."""
NO_WEIGHT = 1e-12
"""Divisor of a term that nothing in a step has a weight for."""


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


class ValidationResult(NamedTuple):
    """The result of a validation.

    Attributes:
        scores: numbers by name.
        pictures: images uint8 [H, W, 3] by name.
    """

    scores: Mapping[str, float]
    pictures: Mapping[str, np.ndarray] = {}


@runtime_checkable
class TrainingBatch(Protocol):
    """A batch of samples.

    Attributes:
        names: of the samples, for messages.
    """

    @property
    def names(self) -> Sequence[str]: ...

    def to(self, device: torch.device) -> "TrainingBatch": ...


@runtime_checkable
class Objective(Protocol):
    """The loss of a network as weighted terms. Each is, in a step, Σ total / Σ divisor over all micro-batches of all
    processes.

    Attributes:
        network: that is called, possibly compiled or wrapped for several processes.
        lambdas: the weights of the terms that are not 0, by name.
        advice: what to check where no term has a divisor above 0, for the error.
    """

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
            config: settings of the loop.
            collate: joins samples to a batch, or returns the error of one of them.
            folder: existing folder for checkpoint and log.
            settings: the settings that a run must share with the one that it resumes, as JSON values.
            process: rank of this process.
            device: device of this process.
            tensorboard: whether to write TensorBoard events.
            validate: validates the network, which is given in evaluation mode; called in all processes, which may
                share the work, and the result of the first one is logged.

        Raises:
            InputError: the folder holds a run with other settings.
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

        Raises:
            InputError: a sample cannot be made, or a loss or gradient is not finite; the error names the samples and
                the loss term, and parameters are not changed. Or a data worker was ended.
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
            step: number of the step.
            items: micro-batches of this process, or the errors of their samples.
        """
        self.optimizer.zero_grad(set_to_none=True)
        rate = self.rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.network.train()
        batches, divisors = self._sum_divisors(items)
        lambdas = self.objective.lambdas
        micro_losses = []
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
            micro_losses.append(shares.detach().double())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip or math.inf).item()
        totals = self._finite_totals(step, batches, torch.stack(micro_losses), norm)
        losses = dict(zip(lambdas, totals, strict=True))
        total = sum(lambdas[name] * loss for name, loss in losses.items())
        losses = {name: loss for name, loss in losses.items() if divisors[name] > NO_WEIGHT}
        return {"loss": total, **losses, "gradient": norm, "learning_rate": rate}

    def _sum_divisors(self, items: list[Any]) -> tuple[list[TrainingBatch], dict[str, float]]:
        """Separates the batches of a step from errors, and sums the divisors of its loss terms over all processes.

        Raises:
            InputError: a sample could not be made, here or on another process, or no term has a weight.
        """
        batches = [item for item in items if not isinstance(item, InputError)]
        lambdas = self.objective.lambdas
        batch_divisors = [self.objective.divisors(batch) for batch in batches]
        sums = [sum(divisors[name] for divisors in batch_divisors) for name in lambdas]
        failed = len(items) - len(batches)
        totals = sum_over_processes(torch.tensor([*sums, failed], dtype=torch.float64, device=self.device)).tolist()
        for item in items:
            if isinstance(item, InputError):
                raise item
        if totals[-1]:
            raise InputError(STOPPED_ELSEWHERE)
        if not any(totals[:-1]):
            names = "; ".join(name for batch in batches for name in batch.names)
            raise InputError(
                f"training: there is nothing to compare in {names}: no Gaussian has a target with a weight, and no "
                f"cell of the teacher passes the thresholds; check {self.objective.advice}, and these scenes"
            )
        return batches, {name: max(total, NO_WEIGHT) for name, total in zip(lambdas, totals, strict=False)}

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

    def _finite_totals(
        self, step: int, batches: list[TrainingBatch], micro_losses: Float64[Tensor, "micro terms"], norm: float
    ) -> list[float]:
        """The loss terms of the step over all processes.

        Raises:
            InputError: a loss of any process, or the gradient, is not finite.
        """
        bad_loss = bad_gradient = ""
        for batch, row in zip(batches, micro_losses.tolist(), strict=True):
            for name, value in zip(self.objective.lambdas, row, strict=True):
                if not math.isfinite(value):
                    bad_loss = bad_loss or f"the {name} loss of {'; '.join(batch.names)}"
        if not bad_loss and not math.isfinite(norm):
            # Gradients are already summed over processes, so samples of any of them may be the cause.
            names = "; ".join(name for batch in batches for name in batch.names)
            bad_gradient = (
                f"the gradient of {names}{' or of samples of other processes' if self.process.world_size > 1 else ''}"
            )
        flags = micro_losses.new_tensor([float(bool(bad_loss)), float(bool(bad_gradient))])
        *totals, bad_losses, bad_gradients = sum_over_processes(torch.cat((micro_losses.sum(dim=0), flags))).tolist()
        if bad_losses or bad_gradients:
            # A loss identifies the samples that cause it; the gradient is named only if all losses are finite.
            where = bad_loss or ("a loss of another process" if bad_losses else bad_gradient)
            raise InputError(
                f"training: {where} is not finite at step {step}; parameters were not changed. Use a lower "
                "learning_rate, or check these scenes (`gsencoder inspect`)"
            )
        return totals

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: linear warm-up, then a half cosine down to `final_rate`."""
        config = self.config
        if step < config.warmup:
            return config.learning_rate * (step + 1) / config.warmup
        progress = (step - config.warmup) / max(config.steps - config.warmup, 1)
        final = config.final_rate
        return config.learning_rate * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))

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
