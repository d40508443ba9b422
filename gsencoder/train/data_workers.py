"""Processes that make training samples ahead: how many, and how each begins."""

import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import torch

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, available_cores

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

    Raises:
        InputError: a worker was ended.
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
