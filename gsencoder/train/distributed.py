"""One process or many, on one machine or many: who this process is, and sums over all of them.

torchrun and SLURM (srun, submitit) give a process its rank through the environment; without either there is one.
Nothing else in the package asks how many there are.
"""

import gc
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import Tensor, distributed

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.device import choose_device
from gsencoder.core.runtime.device_names import Device

STOPPED_ELSEWHERE = "training: another process stopped; its own message says why"


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessRank:
    """A process among those that train together.

    Attributes:
        rank: its number.
        world_size: how many there are.
        local_rank: its number on its machine.
    """

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0


def rank_from_environment(environment: Mapping[str, str]) -> tuple[ProcessRank, str]:
    """The rank that an environment gives, and where processes meet ("tcp://…", or "env://" under torchrun).

    Raises:
        InputError: an environment that contradicts itself.
    """
    if "RANK" in environment and "WORLD_SIZE" in environment:
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        rank, size, local = (_number(environment, name, "0") for name in names)
        meeting = "env://"
    elif "SLURM_STEP_ID" in environment and _number(environment, "SLURM_NTASKS", "1") > 1:
        # Without a step this is the batch script itself, which runs once however many tasks the job has.
        names = ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_LOCALID")
        rank, size, local = (_number(environment, name, "0") for name in names)
        nodes = environment.get("SLURM_STEP_NODELIST") or environment.get("SLURM_JOB_NODELIST", "")
        host = environment.get("MASTER_ADDR") or first_host(nodes)
        # Jobs that share a machine must not meet at one port; their numbers differ.
        port = environment.get("MASTER_PORT") or str(20_000 + _number(environment, "SLURM_JOB_ID", "0") % 20_000)
        meeting = f"tcp://{host}:{port}"
    else:
        return ProcessRank(), ""
    if not 0 <= rank < size:
        raise InputError(f"{names[0]}={rank} is not below {names[1]}={size}; start all processes with one launcher")
    return ProcessRank(rank=rank, world_size=size, local_rank=local), meeting


def gpu_of(process: ProcessRank, meeting: str) -> int:
    """The number of this process's GPU among those that it sees.

    Where SLURM gives each task a GPU of its own, a task sees that one alone.
    """
    bound = meeting.startswith("tcp://") and torch.cuda.device_count() == 1
    return 0 if bound else process.local_rank


def first_host(nodes: str) -> str:
    """The first machine of a SLURM list such as `a[03-07,9],b1`.

    Raises:
        InputError: an empty list.
    """
    found = re.match(r"([^\[,\s]+)(?:\[([^\]]*)\])?([^\[,\s]*)", nodes)
    if not found:
        raise InputError("SLURM: the list of machines (SLURM_STEP_NODELIST) is empty; set MASTER_ADDR")
    before, numbers, after = found.groups()
    return before + (re.split(r"[-,]", numbers)[0] if numbers else "") + after


def _number(environment: Mapping[str, str], name: str, default: str) -> int:
    value = environment.get(name, default)
    if not value.isdigit():
        raise InputError(f"{name}: expected a whole number in the environment, got {value!r}")
    return int(value)


@contextmanager
def joined(device: Device = "auto", *, timeout_hours: float = 24.0) -> Iterator[tuple[ProcessRank, torch.device]]:
    """Meets the other processes for the block; yields the rank and the device of this one.

    Args:
        device: "auto" (a GPU for each process of a machine where torch sees any, else the CPU), "cpu" or "cuda".
        timeout_hours: how long to wait for the others: preparation may keep one busy. A process that dies is noticed by
            the launcher, not by this.

    Raises:
        InputError: no such device, or the others cannot be met.
    """
    process, meeting = rank_from_environment(os.environ)
    chosen = choose_device(device, gpu_of(process, meeting))
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    if process.world_size == 1:
        yield process, chosen
        return
    backend = "nccl" if chosen.type == "cuda" else "gloo"
    # Its functions take the group that exists when they are imported as a default argument, and would keep it forever;
    # DistributedDataParallel imports them. A group that is still there when the interpreter ends may abort the process.
    from torch.distributed import nn  # noqa: F401

    try:
        distributed.init_process_group(
            backend,
            init_method=meeting,
            rank=process.rank,
            world_size=process.world_size,
            timeout=timedelta(hours=timeout_hours),
        )
    except (RuntimeError, ValueError) as error:
        message = " ".join(str(error).split())[:200]
        ranks = f"process {process.rank} of {process.world_size}"
        raise InputError(f"training: {ranks} cannot meet the others: {message}") from error
    yield process, chosen
    # Not after an error: the others may be waiting for a sum, and leaving the group would wait for them.
    # A network that was wrapped refers to itself and to the group, which ends with its last reference.
    gc.collect()
    distributed.destroy_process_group()


def sum_over_processes(values: Tensor) -> Tensor:
    """The sum of each entry over all processes; what was given where there is one."""
    if distributed.is_available() and distributed.is_initialized():
        distributed.all_reduce(values)
    return values


@contextmanager
def fail_together() -> Iterator[None]:
    """A block that processes go through on their own, one of them perhaps doing all the work. They leave it together,
    and if one of them fails in it, all do: none is left waiting.

    Raises:
        Exception: this process's own.
        InputError: another process failed.
    """
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    failed = torch.tensor([float(failure is not None)])
    if distributed.is_available() and distributed.is_initialized() and distributed.get_backend() == "nccl":
        failed = failed.cuda()
    count = int(sum_over_processes(failed).item())
    if failure is not None:
        raise failure
    if count:
        raise InputError(STOPPED_ELSEWHERE)
