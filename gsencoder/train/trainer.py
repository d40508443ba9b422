"""The training loop: one step after another, the same on one process or many, and after a kill."""

import math
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn
from torch.utils.data import DataLoader

from gsencoder.core.errors import InputError
from gsencoder.core.files.step_log import Log
from gsencoder.core.runtime.device import autocast_dtype
from gsencoder.core.runtime.device_names import Precision
from gsencoder.core.runtime.signals import held_back, stop_of
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.train.checkpoint import CHECKPOINT_FILE, TrainingState, load_checkpoint, save_checkpoint
from gsencoder.train.distill import Distillation
from gsencoder.train.distributed import STOPPED_ELSEWHERE, ProcessRank, fail_together, sum_over_processes
from gsencoder.train.losses import Head, LossConfig
from gsencoder.train.samples import Batch, SampleDataset, StepSampler, join_samples


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerConfig:
    """How long, how fast, how much at a time."""

    steps: int = field(default=2000, metadata={"help": "optimizer steps"})
    batch: int = field(default=1, metadata={"help": "samples that one process takes at a time"})
    accumulate: int = field(default=1, metadata={"help": "such micro-batches of a process in one step"})
    learning_rate: float = field(default=2e-3, metadata={"help": "highest learning rate"})
    final_rate: float = field(default=0.01, metadata={"help": "learning rate at the end, as a share of the highest"})
    warmup: int = field(default=100, metadata={"help": "steps in which the learning rate rises"})
    weight_decay: float = field(default=0.05, metadata={"help": "of matrices; never of norms and biases"})
    clip: float = field(default=1.0, metadata={"help": "largest norm of the gradient; 0 = not clipped"})
    precision: Precision = field(
        default="auto",
        metadata={"help": "what the encoder computes in; auto = bfloat16 where the device multiplies it"},
    )
    workers: int = field(default=0, metadata={"help": "processes that make samples; 0 = the training process itself"})
    seed: int = field(default=0, metadata={"help": "of everything random"})
    log_every: int = field(default=10, metadata={"help": "steps that one line of the log stands for"})
    validate_every: int = field(default=500, metadata={"help": "steps between validations; 0 = at the end alone"})
    checkpoint_every: float = field(default=300.0, metadata={"help": "seconds between checkpoints"})
    compile: bool = field(default=False, metadata={"help": "torch.compile the encoder"})

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "accumulate", "log_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        for name in ("warmup", "weight_decay", "clip", "workers", "seed", "validate_every", "checkpoint_every"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.seed >= 1 << 63:
            raise InputError(f"seed: expected a number below 2⁶³, got {self.seed}")
        if not 0 < self.learning_rate < math.inf:
            raise InputError(f"learning_rate: expected a positive number, got {self.learning_rate}")
        if not 0 <= self.final_rate <= 1:
            raise InputError(f"final_rate: expected a share in [0, 1], got {self.final_rate}")

    def samples_per_step(self, processes: int) -> int:
        """Samples of one optimizer step, over all processes."""
        return self.batch * self.accumulate * processes


class Validated(NamedTuple):
    """What a validation found.

    Attributes:
        scores: by name.
        pictures: uint8 [H, W, 3], by name.
    """

    scores: Mapping[str, float]
    pictures: Mapping[str, np.ndarray] = {}


Validation = Callable[[GaussianEncoder], Validated]


class Trainer:
    """Trains an encoder on samples; everything that must survive a kill lies in one folder."""

    def __init__(
        self,
        encoder: GaussianEncoder,
        dataset: SampleDataset,
        losses: LossConfig,
        config: TrainerConfig,
        *,
        folder: Path,
        settings: Mapping[str, Any],
        heads: Sequence[tuple[Head, nn.Module]] = (),
        process: ProcessRank = ProcessRank(),
        device: torch.device = torch.device("cpu"),
        tensorboard: bool = False,
        validate: Validation = lambda encoder: Validated({}),  # noqa: ARG005
    ) -> None:
        """Takes up what an earlier run with the same settings left in `folder`.

        Args:
            encoder: trained in place; moved to `device`.
            dataset: what it is trained on.
            losses: what is compared.
            config: see there.
            folder: for checkpoint and log; exists.
            settings: what a run must have in common with one that it continues, as JSON values.
            heads: a teacher's adapter heads, each with what decodes standard units for it.
            process: this process among those that train together.
            device: of this process.
            tensorboard: whether to write events.
            validate: judges the encoder; asked of the first process alone.

        Raises:
            InputError: the folder holds another run.
        """
        self.config, self.dataset, self.process, self.device = config, dataset, process, device
        self.folder, self.settings, self.validate = folder, dict(settings), validate
        self.encoder = encoder.to(device)
        self.optimizer = torch.optim.AdamW(
            _groups(encoder, config), lr=config.learning_rate, betas=(0.9, 0.98), fused=True
        )
        self.state = TrainingState()
        self.validated: Validated | None = None
        if (folder / CHECKPOINT_FILE).is_file():
            self.state = load_checkpoint(folder / CHECKPOINT_FILE, encoder, self.optimizer, self.settings)
            if self.state.step > config.steps:
                raise InputError(
                    f"{folder / CHECKPOINT_FILE}: stands at step {self.state.step} of {config.steps}; give "
                    "resume=false to begin anew"
                )
        # A line that was written for a step whose closing was cut off is written again.
        done = self.state.step - (not self.state.closed)
        begun = self.state.step > len(self.state.unlogged)
        self._log = Log(folder, done=done, events=tensorboard, begun=begun) if process.is_first else None
        network: nn.Module = torch.compile(encoder, dynamic=True) if config.compile else encoder  # type: ignore[assignment]
        self._parallel: nn.parallel.DistributedDataParallel | None = None
        if process.world_size > 1:
            ids = [device.index] if device.type == "cuda" else None
            network = self._parallel = nn.parallel.DistributedDataParallel(network, device_ids=ids)
        codebook = torch.from_numpy(dataset.recipe.rarity.codebook).to(device)
        heads = [(head.to(device), decode.to(device)) for head, decode in heads]
        self.distillation = Distillation(network, losses, codebook, heads=heads)
        self._autocast = autocast_dtype(config.precision, device)

    def run(self, track: Track = untracked) -> TrainingState:
        """All steps that are left. Whatever stops the run, an interrupt, a signal or an error of the input, leaves a
        checkpoint of the last step that was done.

        Raises:
            InputError: a sample cannot be made, or a loss or gradient is not finite; the samples and the term are
                named, and the step is not taken.
        """
        try:
            self._run(track)
        except BaseException as stop:
            foreseen = isinstance(stop, InputError) or not isinstance(stop, Exception) or stop_of(stop) is not None
            if foreseen and self.state.step:
                with suppress(InputError):
                    self.save()
            raise
        finally:
            if self._log is not None:
                self._log.close()
        # DistributedDataParallel holds the process group, whose threads must end before the interpreter does.
        self.distillation.encoder, self._parallel = self.encoder, None
        return self.state

    def _run(self, track: Track) -> None:
        config, start = self.config, time.monotonic() - self.state.seconds
        first, saved = self.state.step, time.monotonic()
        if not self.state.closed:
            self._close()
        batches = iter(self._loader(first))
        for step in track(range(first, config.steps), "training"):
            losses = self._gradients(step, [next(batches) for _ in range(config.accumulate)])
            unlogged = (*self.state.unlogged, losses)
            # A checkpoint of half a step would continue to other losses.
            with held_back():
                self.optimizer.step()
                seconds = time.monotonic() - start
                self.state = TrainingState(step=step + 1, seconds=seconds, unlogged=unlogged, closed=False)
            self._close()
            if time.monotonic() - saved >= config.checkpoint_every or self.state.step == config.steps:
                self.save()
                saved = time.monotonic()

    def _close(self) -> None:
        """What is due after a step: validation, and a line of the log for the last steps."""
        config, done, recent = self.config, self.state.step, self.state.unlogged
        last = done == config.steps
        row: dict[str, float] = {}
        if logged := last or done % config.log_every == 0:
            row = {name: float(np.mean([each[name] for each in recent])) for name in recent[-1]}
        if last or (config.validate_every and done % config.validate_every == 0):
            with fail_together():
                row |= self._validated(done)
        if row and self._log is not None:
            self._log.add(done, row | {"seconds": self.state.seconds})
        self.state = replace(self.state, unlogged=() if logged else recent, closed=True)

    def save(self) -> None:
        """Writes the checkpoint; only the first process does."""
        if self.process.is_first:
            save_checkpoint(self.folder / CHECKPOINT_FILE, self.encoder, self.optimizer, self.state, self.settings)

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
        # Workers are started anew and not forked: a forked child would inherit kernels' threads that no longer run.
        return DataLoader(
            self.dataset,
            batch_sampler=sampler,
            collate_fn=partial(join_samples, patch=self.encoder.config.transformer.patch),
            num_workers=config.workers,
            multiprocessing_context="spawn" if config.workers else None,
            worker_init_fn=_begin_worker if config.workers else None,
            prefetch_factor=4 if config.workers else None,
        )

    def _gradients(self, step: int, made: list[Batch | InputError]) -> dict[str, float]:
        """What one optimizer step goes by; returns the losses of all processes together."""
        self.optimizer.zero_grad(set_to_none=True)
        rate = self.rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.encoder.train()
        batches, divisors = self._divisors(made)
        lambdas = self.distillation.lambdas
        parts = []
        for micro, batch in enumerate(batches):
            self._seed((step * len(batches) + micro) * self.process.world_size + self.process.rank)
            if self._parallel is not None:
                self._parallel.require_backward_grad_sync = micro + 1 == len(batches)
            with torch.autocast(self.device.type, self._autocast, enabled=self._autocast is not None):
                terms = self.distillation(batch.to(self.device))
            shares = torch.stack([terms[name] / divisors[name] for name in lambdas])
            loss = (shares * shares.new_tensor(list(lambdas.values()))).sum()
            # Gradients of several processes are averaged; what is wanted is their sum.
            (loss * self.process.world_size).backward()
            parts.append(shares.detach().double())
        norm = nn.utils.clip_grad_norm_(self.encoder.parameters(), self.config.clip or math.inf).item()
        totals = self._finite_totals(step, batches, torch.stack(parts), norm)
        losses = dict(zip(lambdas, totals, strict=True))
        total = sum(lambdas[name] * loss for name, loss in losses.items())
        return {"loss": total, **losses, "gradient": norm, "learning_rate": rate}

    def _divisors(self, made: list[Batch | InputError]) -> tuple[list[Batch], dict[str, float]]:
        """The batches of a step, and what the totals of its terms are divided by, over all processes.

        Raises:
            InputError: a sample could not be made: its own error here, and at all other processes that there was one.
        """
        batches = [batch for batch in made if isinstance(batch, Batch)]
        lambdas = self.distillation.lambdas
        own = [self.distillation.divisors(batch) for batch in batches]
        sums = [sum(each[name] for each in own) for name in lambdas]
        failed = len(made) - len(batches)
        found = sum_over_processes(torch.tensor([*sums, failed], dtype=torch.float64, device=self.device)).tolist()
        for one in made:
            if isinstance(one, InputError):
                raise one
        if found[-1]:
            raise InputError(STOPPED_ELSEWHERE)
        if not any(found[:-1]):
            names = "; ".join(name for batch in batches for name in batch.names)
            raise InputError(
                f"training: nothing is compared in {names}: no Gaussian has a target that counts, and no cell of the "
                "teacher's; look at loss.min_alpha, loss.min_kept and loss.rarity, or at these scenes"
            )
        return batches, {name: max(count, 1e-12) for name, count in zip(lambdas, found, strict=False)}

    def _seed(self, number: int) -> None:
        """What is random in the network follows the micro-batch's number in the run, not what was drawn before."""
        state = np.random.SeedSequence([self.config.seed, number]).generate_state(1, np.uint64)
        torch.manual_seed(int(state[0] >> np.uint64(1)))

    def _finite_totals(
        self, step: int, batches: list[Batch], parts: Float64[Tensor, "micro terms"], norm: float
    ) -> list[float]:
        """The step's losses over all processes.

        Raises:
            InputError: a loss of any process, or the gradient, is not finite.
        """
        blame = gradient = ""
        for batch, row in zip(batches, parts.tolist(), strict=True):
            for name, value in zip(self.distillation.lambdas, row, strict=True):
                if not math.isfinite(value):
                    blame = blame or f"the {name} loss of {'; '.join(batch.names)}"
        if not blame and not math.isfinite(norm):
            # Gradients have been summed by now: with several processes any of their samples may be the cause.
            names = "; ".join(name for batch in batches for name in batch.names)
            gradient = (
                f"the gradient of {names}{' or of samples of other processes' if self.process.world_size > 1 else ''}"
            )
        flag = parts.new_tensor([float(bool(blame)), float(bool(gradient))])
        *totals, blamed, unsure = sum_over_processes(torch.cat((parts.sum(dim=0), flag))).tolist()
        if blamed or unsure:
            # A loss says whose it is; a gradient only where no loss does.
            where = blame or ("a loss of another process" if blamed else gradient)
            raise InputError(
                f"training: {where} is not finite at step {step}; nothing was changed by it. Lower learning_rate, or "
                "look at these scenes (`gsencoder inspect`)"
            )
        return totals

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: a linear rise, then half a cosine."""
        config = self.config
        if step < config.warmup:
            return config.learning_rate * (step + 1) / config.warmup
        share = (step - config.warmup) / max(config.steps - config.warmup, 1)
        low = config.final_rate
        return config.learning_rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * share)))

    def _validated(self, done: int) -> dict[str, float]:
        scores: dict[str, float] = {}
        if self._log is not None:
            self.encoder.eval()
            self.validated = found = self.validate(self.encoder)
            scores = {f"validation/{name}": float(value) for name, value in found.scores.items()}
            for name, pixels in found.pictures.items():
                self._log.picture(done, f"validation/{name}", pixels)
        return scores


def _groups(encoder: nn.Module, config: TrainerConfig) -> list[dict[str, Any]]:
    matrices = [value for value in encoder.parameters() if value.ndim > 1]
    rest = [value for value in encoder.parameters() if value.ndim <= 1]
    return [{"params": matrices, "weight_decay": config.weight_decay}, {"params": rest, "weight_decay": 0.0}]


def _begin_worker(worker: int) -> None:  # noqa: ARG001
    """One thread; and a signal to the whole group of processes is left to the training process, which ends its workers
    once it has saved: a worker that dies first would be an error in the middle of that."""
    torch.set_num_threads(1)
    for name in ("SIGTERM", "SIGHUP", "SIGINT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    sys.excepthook = _quiet_of_ended_connections


def _quiet_of_ended_connections(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """A training process that is stopped while it takes a sample from a worker says why itself; the thread that handed
    the sample over would print that its connection was reset, or ended."""
    if not issubclass(kind, ConnectionError | EOFError):
        sys.__excepthook__(kind, error, trace)
