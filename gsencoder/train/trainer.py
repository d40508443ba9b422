"""The training loop, resumable, with equal results on one process or several."""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from gsencoder.core.device import autocast_dtype
from gsencoder.core.errors import InputError
from gsencoder.core.logs import Log
from gsencoder.core.process import ProcessRank, Track, defer_signals, stop_of, threads_of_torch, untracked
from gsencoder.train import distributed
from gsencoder.train.checkpoint import TRAINING_CHECKPOINT_FILE, TrainingState, load_checkpoint, save_checkpoint
from gsencoder.train.data_workers import automatic_workers, lost_workers, start_worker
from gsencoder.train.distributed import (
    check_agreement,
    digest_of,
    digest_of_weights,
    fail_together,
    lost_processes,
)
from gsencoder.train.objective import NO_WEIGHT, Objective, TrainingBatch, finite_terms, sum_divisors
from gsencoder.train.samples import StepSampler
from gsencoder.train.trainer_config import TrainerConfig

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
