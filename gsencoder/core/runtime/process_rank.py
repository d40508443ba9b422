"""The rank of this process among those that one launcher started.

torchrun and SLURM (srun, submitit) give a process its rank through environment variables; without either there is one
process. No other module reads these variables.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessRank:
    """The rank of a process among those that one launcher started.

    Attributes:
        rank: its number among all processes, from 0.
        world_size: number of processes.
        local_rank: its number among the processes of its machine.
        local_world_size: number of processes of its machine; 1 where the launcher does not state it.
    """

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0
    local_world_size: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and prints."""
        return self.rank == 0


def rank_from_environment(environment: Mapping[str, str]) -> tuple[ProcessRank, str]:
    """Reads the rank of this process from environment variables of torchrun or SLURM.

    Returns:
        The rank, and the init_method for `torch.distributed`: "tcp://…" under SLURM, "env://" under torchrun, else "".

    Raises:
        InputError: the variables contradict each other.
    """
    if "RANK" in environment and "WORLD_SIZE" in environment:
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        rank, size, local = (_read_number(environment, name, "0") for name in names)
        local_size = _read_number(environment, "LOCAL_WORLD_SIZE", "1")
        init_method = "env://"
    elif "SLURM_STEP_ID" in environment and _read_number(environment, "SLURM_NTASKS", "1") > 1:
        # Without a step this is the batch script itself, which runs once for any number of tasks.
        names = ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_LOCALID")
        rank, size, local = (_read_number(environment, name, "0") for name in names)
        local_size = _local_tasks(environment)
        nodes = environment.get("SLURM_STEP_NODELIST") or environment.get("SLURM_JOB_NODELIST", "")
        host = environment.get("MASTER_ADDR") or first_host(nodes)
        # Jobs that share a machine need different ports; their job ids differ.
        port = environment.get("MASTER_PORT") or str(20_000 + _read_number(environment, "SLURM_JOB_ID", "0") % 20_000)
        init_method = f"tcp://{host}:{port}"
    else:
        return ProcessRank(), ""
    if not 0 <= rank < size:
        raise InputError(f"{names[0]}={rank} is not below {names[1]}={size}; start all processes with one launcher")
    return (
        ProcessRank(rank=rank, world_size=size, local_rank=local, local_world_size=max(1, min(local_size, size))),
        init_method,
    )


def store_address(environment: Mapping[str, str], init_method: str) -> tuple[str, int]:
    """The host and the port at which the processes of a launcher meet.

    Raises:
        InputError: the variables do not say it.
    """
    if init_method.startswith("tcp://"):
        host, _, port = init_method.removeprefix("tcp://").rpartition(":")
        environment = {"MASTER_ADDR": host, "MASTER_PORT": port}
    if not (environment.get("MASTER_ADDR") and environment.get("MASTER_PORT")):
        raise InputError(
            "RANK and WORLD_SIZE are set, and MASTER_ADDR or MASTER_PORT is not: give the host of process 0 and a free "
            "port there to all processes, or unset RANK and WORLD_SIZE for one process"
        )
    return environment["MASTER_ADDR"], _read_number(environment, "MASTER_PORT", "")


def refuse_several(subject: str, advice: str) -> None:
    """Checks that a launcher started this process alone, for work that is not shared: all would write the same results.

    Args:
        subject: what runs in one process, for the error.
        advice: what to do instead.

    Raises:
        InputError: in every process: there are several.
    """
    process, _ = rank_from_environment(os.environ)
    if process.world_size > 1:
        raise InputError(
            f"{subject}: runs in one process, and this is process {process.rank} of {process.world_size} that a "
            f"launcher (torchrun, SLURM) started; {advice}"
        )


def first_host(nodes: str) -> str:
    """The first host of a SLURM node list such as `a[03-07,9],b1`.

    Raises:
        InputError: the list is empty.
    """
    match = re.match(r"([^\[,\s]+)(?:\[([^\]]*)\])?([^\[,\s]*)", nodes)
    if not match:
        raise InputError("SLURM: the node list (SLURM_STEP_NODELIST) is empty; set MASTER_ADDR")
    prefix, numbers, suffix = match.groups()
    return prefix + (re.split(r"[-,]", numbers)[0] if numbers else "") + suffix


def _local_tasks(environment: Mapping[str, str]) -> int:
    """The number of tasks on this node, the first of a list such as `8(x3),4`: a step's nodes rarely differ, and fewer
    threads than cores are no error."""
    tasks = environment.get("SLURM_STEP_TASKS_PER_NODE") or environment.get("SLURM_TASKS_PER_NODE", "1")
    match = re.match(r"\d+", tasks)
    return int(match[0]) if match else 1


def _read_number(environment: Mapping[str, str], name: str, default: str) -> int:
    value = environment.get(name, default)
    if not value.isdigit():
        raise InputError(f"{name}: expected a whole number in the environment variable, got {value!r}")
    return int(value)
