"""Distributed training with torch.distributed: the process group, and sums over processes."""

import gc
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, distributed

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, ProcessRank, available_cores, rank_from_environment
from gsencoder.train.presence import Presence, named

T = TypeVar("T")

STOPPED_ELSEWHERE = "another process stopped; its own message says why"
WAIT_HOURS = 24.0
"""Longest wait for other processes, which may be preparing scenes or validate. One that dies ends the wait at once."""
STEP_MINUTES = 30.0
"""Longest wait for other processes within a step of training; a step takes seconds."""
LOST = ("timed out", "timeout", "connection closed", "connection reset", "broken pipe", "socket closed")
"""Words of the errors of collectives whose other side died or does not answer; gloo and NCCL have no type for it."""

_presence: Presence | None = None
"""What this process knows of the others, while it is joined with them."""


def gpu_index(process: ProcessRank, init_method: str) -> int:
    """The index of this process's GPU among those that it sees.

    It is 0 where SLURM binds one GPU to each task, so that a task sees only that one.
    """
    is_bound = init_method.startswith("tcp://") and torch.cuda.device_count() == 1
    return 0 if is_bound else process.local_rank


@contextmanager
def join_processes(
    device: Device = "auto", *, settings: Mapping[str, Any] | None = None
) -> Iterator[tuple[ProcessRank, torch.device]]:
    """Joins the process group for the block.

    Args:
        device: "auto" (one GPU per process if torch sees any, else the CPU), "cpu" or "cuda".
        settings: the settings of the run, in which all processes must agree; None = they are not compared.

    Yields:
        The rank and the device of this process.

    Raises:
        InputError: there is no such device, the other processes cannot be reached or have other settings, or one of
            them dies.
    """
    process, init_method = rank_from_environment(os.environ)
    chosen = choose_device(device, gpu_index(process, init_method))
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    if process.world_size == 1:
        yield process, chosen
        return
    backend = "nccl" if chosen.type == "cuda" else "gloo"
    # This module, which DistributedDataParallel needs, is imported before the group exists: default arguments of its
    # functions would hold the group until the interpreter ends, which may abort the process.
    from torch.distributed import nn  # noqa: F401

    global _presence
    wait, done = timedelta(hours=WAIT_HOURS), False
    try:
        try:
            _presence = Presence(process, init_method, wait=wait)
            with _presence.links():
                distributed.init_process_group(
                    backend, store=_presence.store, rank=process.rank, world_size=process.world_size, timeout=wait
                )
        except InputError:
            raise
        except (RuntimeError, ValueError, OSError) as error:
            message = " ".join(str(error).split())[:200]
            ranks = f"process {process.rank} of {process.world_size}"
            raise InputError(f"training: {ranks} cannot reach the others: {message}") from error
        with lost_processes(process):
            if settings is not None:
                shared = {name: value for name, value in settings.items() if name not in ("quiet", "device")}
                check_agreement("the settings", digest_of(shared), advice="give all processes the same command")
            yield process, chosen
        done = True
    finally:
        if _presence is not None:
            _presence.leave(done=done)
            _presence = None
    # Not after an error: other processes may be waiting in a reduction, and leaving the group would wait for them.
    # A wrapped network holds a reference cycle with the group, which must be collected before the group is destroyed.
    gc.collect()
    distributed.destroy_process_group()


@contextmanager
def lost_processes(process: ProcessRank, minutes: float | None = None) -> Iterator[None]:
    """Turns the error of a collective operation whose other side has died, or does not answer, into one that says so.

    Args:
        process: the rank of this process.
        minutes: longest wait for the others within the block; None = that of the group. NCCL has its own watch, which
            ends the process.

    Raises:
        InputError: another process is lost.
    """
    shorter = process.world_size > 1 and minutes is not None
    if minutes is not None and shorter:
        _set_wait(timedelta(minutes=minutes))
    try:
        yield
    except InputError:
        raise
    except RuntimeError as error:
        message = " ".join(str(error).split())
        if process.world_size == 1 or not any(words in message.lower() for words in LOST):
            raise
        hung = "timed out" in message.lower() or "timeout" in message.lower()
        waited = f"did not answer for {minutes:g} minutes" if hung and minutes is not None else "did not answer"
        lost = _presence.find_lost(waits=not hung) if _presence is not None else []
        raise InputError(
            f"training: process {process.rank} of {process.world_size}: {named(lost) if lost else 'another process'} "
            f"{waited if hung else 'ended'}; its own message, if there is one, says why; start all of them again "
            "to continue"
        ) from error
    finally:
        if shorter:
            _set_wait(timedelta(hours=WAIT_HOURS))


def _set_wait(longest: timedelta) -> None:
    """Sets the longest wait of the operations of the group that begin from now on."""
    # torch has no public function for a group that exists.
    change = getattr(distributed.distributed_c10d, "_set_pg_timeout", None)
    if change is not None:
        change(longest)


def digest_of(value: Any) -> str:
    """A digest of JSON values, for `check_agreement`."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def digest_of_weights(network: torch.nn.Module) -> str:
    """A digest of all parameters and buffers, for `check_agreement`."""
    digest = hashlib.sha256()
    for name, value in network.state_dict().items():
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:16]


def sum_over_processes(values: Tensor) -> Tensor:
    """Sums each entry over all processes, in place; with one process the values are unchanged."""
    if _in_group():
        distributed.all_reduce(values)
    return values


def summed_array(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """The sum of each entry over all processes."""
    tensor = torch.from_numpy(values.copy())
    if _is_nccl():
        tensor = tensor.cuda()
    return np.asarray(sum_over_processes(tensor).cpu().numpy())


def value_of_first(value: T) -> T:
    """The value of the first process, in all of them; with one process its own."""
    if not _in_group():
        return value
    values = [value]
    distributed.broadcast_object_list(values, src=0)
    return values[0]


def values_of_all(value: T) -> list[T]:
    """The values of all processes, by rank, in all of them; with one process its own."""
    if not _in_group():
        return [value]
    values: list[T | None] = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]


def current_process() -> ProcessRank:
    """The rank of this process in the group that it has joined; the only one without a group."""
    if not _in_group():
        return ProcessRank()
    return ProcessRank(rank=distributed.get_rank(), world_size=distributed.get_world_size())


def cpu_share(process: ProcessRank, threads: int = 0) -> int:
    """The number of threads with which a process computes on the CPU: `threads`, or where that is 0 what torch has in a
    process that was started alone, else the cores of the machine divided among its processes."""
    if threads:
        return threads
    return torch.get_num_threads() if process.world_size == 1 else max(1, available_cores() // process.local_world_size)


def _in_group() -> bool:
    """Whether this process has joined others (`join_processes`)."""
    return distributed.is_available() and distributed.is_initialized()


def _is_nccl() -> bool:
    return _in_group() and distributed.get_backend() == "nccl"


def check_agreement(subject: str, value: str, advice: str = "give all processes the same files") -> None:
    """Checks that all processes have the same value of something, such as the digest of a teacher's weights.

    Args:
        subject: what it is the value of, for the error.
        value: of this process; empty = it has none, and any fits.
        advice: what to do where they differ.

    Raises:
        InputError: in every process: two processes have different values; both are named.
    """
    stated = [(rank, each) for rank, each in enumerate(values_of_all(value)) if each]
    for rank, each in stated:
        if each != stated[0][1]:
            raise InputError(
                f"training: {subject} differ: their digest is {stated[0][1]} in process {stated[0][0]} and {each} in "
                f"process {rank}; {advice}"
            )


@contextmanager
def fail_together() -> Iterator[None]:
    """Synchronizes processes at the end of a block that they run independently, or that one of them runs for all.

    If one process fails in the block, all fail, so that none waits forever.

    Raises:
        Exception: the error of this process.
        InputError: another process failed.
    """
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    failed = torch.tensor([float(failure is not None)])
    if _is_nccl():
        failed = failed.cuda()
    count = int(sum_over_processes(failed).item())
    if failure is not None:
        raise failure
    if count:
        raise InputError(STOPPED_ELSEWHERE)
