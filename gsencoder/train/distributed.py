"""Distributed training with torch.distributed: the process group, sums over processes, and which of them still run.

A thread of each process counts up its entry of a store in the first process (torchrun's: in its agent) and reads those
of the others. A process that computes for hours counts on; one that has ended, or whose machine is gone, does not.
"""

import gc
import hashlib
import json
import os
import socket
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, distributed
from torch.distributed import DistNetworkError, PrefixStore, TCPStore  # type: ignore[attr-defined]

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.process import Device, ProcessRank, available_cores, rank_from_environment, store_address

BEAT_SECONDS = 5.0
"""Between two counts of a process."""
SAY_SECONDS = 40.0
"""A process that has not come, or not counted, for as long is named; compiled code may hold the interpreter a while."""
LOST_SECONDS = 240.0
"""Then the others end: the most that a process may come later than the first, or stand still."""
GRACE_SECONDS = 45.0
"""What the main thread has to save its work before the process is ended."""
STORE_SECONDS = 20.0
"""Longest wait for an answer of the store."""
LEFT = "left"


class Presence:
    """The meeting of this process with the others, and what it knows of them; `store` is for
    `torch.distributed.init_process_group`."""

    def __init__(self, process: ProcessRank, init_method: str, *, wait: timedelta) -> None:
        """Waits until all processes have come. `init_method` is as `rank_from_environment` gives it; `wait` is the
        longest wait of an operation of `store`."""
        self._process, self._stopped = process, threading.Event()
        self._others = [rank for rank in range(process.world_size) if rank != process.rank]
        host, port = store_address(os.environ, init_method)
        self._began, self._called = time.monotonic(), False
        is_host = process.is_first and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
        while not is_host:
            try:
                socket.create_connection((host, port), timeout=STORE_SECONDS).close()
                break
            except OSError as error:
                self._await([0], f" at {host}:{port} ({error.strerror or error})")
        seconds = timedelta(seconds=STORE_SECONDS)
        # Two connections: an operation of the group may wait for hours, and counts do not wait for it.
        stores = [
            TCPStore(host, port, process.world_size, serves, seconds, wait_for_workers=False)
            for serves in (is_host, False)
        ]
        stores[0].set_timeout(wait)
        attempt = f"gsencoder {os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}"
        self.store, self._own = (PrefixStore(attempt, store) for store in stores)
        self._own.set(self._key(process.rank), "0")
        while missing := self._missing():
            self._await(missing, says=process.is_first)
        self._seen = dict.fromkeys(self._others, (b"", time.monotonic()))
        self._answers, self._closed, self._read_at = True, False, time.monotonic()
        self._links: set[int] = set()
        self._thread = threading.Thread(target=self._watch, name="presence", daemon=True)
        self._thread.start()

    @contextmanager
    def links(self) -> Iterator[None]:
        """Notes the sockets that are opened in the block, in which this process is connected with the others."""
        before = _descriptors()
        yield
        self._links = _descriptors() - before

    def silent(self, seconds: float) -> list[int]:
        """The ranks of the processes that have not counted for some time, of those that have not left."""
        # Where the store does not answer, the first process, which has it, is missing, and of others nothing is known.
        now, left = time.monotonic(), LEFT.encode()
        until = {rank: now if rank == 0 and not self._answers else self._read_at for rank in self._seen}
        return [rank for rank, (count, at) in self._seen.items() if count != left and until[rank] - at >= seconds]

    def find_lost(self, *, waits: bool) -> list[int]:
        """The ranks of the processes that do not count any more; `waits` for a few counts, when a connection was
        closed a moment ago."""
        until = time.monotonic() + (6 * BEAT_SECONDS if waits else 0)
        while not (lost := self.silent(2.5 * BEAT_SECONDS)) and time.monotonic() < until:
            time.sleep(0.1 * BEAT_SECONDS)
        return lost

    def leave(self, *, done: bool) -> None:
        """Ends the counting. With `done` the others do not miss this process, and the first one, which has the store,
        leaves last."""
        self._stopped.set()
        self._thread.join(2 * STORE_SECONDS)
        while done and self._exchange(LEFT) and self._process.is_first:
            silent = self.silent(SAY_SECONDS)
            if all(count == LEFT.encode() or rank in silent for rank, (count, _) in self._seen.items()):
                break
            time.sleep(0.02)

    def _missing(self) -> list[int]:
        """The ranks of the processes that have not come."""
        try:
            return [rank for rank in self._others if not self._own.check([self._key(rank)])]
        except RuntimeError as error:
            raise InputError(
                f"training: process {self._process.rank} of {self._process.world_size}: process 0 ended; its own "
                "message, if there is one, says why; start all of them again"
            ) from error

    def _await(self, missing: list[int], where: str = "", *, says: bool = True) -> None:
        """Waits a moment for processes that have not come, and names them when it has lasted."""
        waited = time.monotonic() - self._began
        this, names = f"process {self._process.rank} of {self._process.world_size}", named(missing)
        if waited >= LOST_SECONDS:
            raise InputError(
                f"training: {this}: {names} did not come within {waited / 60:.2g} minutes{where}; what ended before "
                "says why in its own message; start all of them again, within a few minutes of one another"
            )
        if waited >= SAY_SECONDS and says and not self._called:
            self._called = True
            _warn(f"training: {this} waits for {names}{where}, and ends in {(LOST_SECONDS - waited) / 60:.2g} minutes")
        time.sleep(min(0.25, 0.1 * SAY_SECONDS))

    def _watch(self) -> None:
        """Counts and reads, names processes that are silent, and ends this one when they are lost."""
        counts, called = 0, list[int]()
        while not self._stopped.wait(BEAT_SECONDS):
            counts += 1
            self._exchange(str(counts))
            missing = self.silent(SAY_SECONDS)
            heard = [rank for rank in (self._process.rank, *self._others) if rank not in missing]
            if missing and missing != called and self._process.rank == min(heard):
                limit = f"if {'it does' if len(missing) == 1 else 'they do'} not answer, all others end"
                _warn(
                    f"training: {named(missing)} of {self._process.world_size} did not answer for "
                    f"{SAY_SECONDS:.3g} seconds; {limit} within {LOST_SECONDS / 60:.2g} minutes"
                )
            called = missing
            if lost := self.silent(LOST_SECONDS):
                self._end(lost)

    def _exchange(self, count: str) -> bool:
        """Writes the count of this process and reads those of the others; returns whether the store answers."""
        if self._closed:
            return False
        try:
            self._own.set(self._key(self._process.rank), count)
            counts = self._own.multi_get([self._key(rank) for rank in self._others])
        except RuntimeError as error:
            # torch prints a stack for each call on a connection that was closed.
            self._answers, self._closed = False, isinstance(error, DistNetworkError)
            return False
        self._answers, self._read_at = True, time.monotonic()
        for rank, value in zip(self._others, counts, strict=True):
            if value != self._seen[rank][0]:
                self._seen[rank] = (value, self._read_at)
        return True

    def _end(self, lost: list[int]) -> None:
        """Ends this process: a closed connection ends what waits for it in the main thread, which saves its work."""
        for number in self._links:
            with suppress(OSError), socket.socket(fileno=os.dup(number)) as link:
                link.getpeername()  # A listening socket has no peer, and gloo aborts if it is closed.
                link.shutdown(socket.SHUT_RDWR)
        if self._stopped.wait(GRACE_SECONDS):
            return
        size = self._process.world_size
        print(
            f"error: training: process {self._process.rank} of {size}: {named(lost)} did not answer for "
            f"{LOST_SECONDS / 60:.2g} minutes; start all of them again to continue",
            file=sys.stderr,
            flush=True,
        )
        os._exit(2)

    @staticmethod
    def _key(rank: int) -> str:
        return f"count of {rank}"


def named(ranks: list[int]) -> str:
    """Processes, for a message."""
    return f"{'process' if len(ranks) == 1 else 'processes'} {listed([*map(str, ranks)])}"


def _warn(message: str) -> None:
    # Where warnings are errors, the thread goes on.
    with suppress(SceneWarning):
        warnings.warn(message, SceneWarning, stacklevel=2)


def _descriptors() -> set[int]:
    """The descriptors that this process has open."""
    with suppress(OSError):
        return {int(name) for name in os.listdir("/dev/fd")}
    return set()


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
    """The index of this process's GPU among those that it sees: 0 where SLURM binds one GPU to each task."""
    is_bound = init_method.startswith("tcp://") and torch.cuda.device_count() == 1
    return 0 if is_bound else process.local_rank


@contextmanager
def join_processes(
    device: Device = "auto", *, settings: Mapping[str, Any] | None = None
) -> Iterator[tuple[ProcessRank, torch.device]]:
    """Joins the process group for the block, and gives the rank and the device of this process.

    Args:
        settings: the settings of the run, in which all processes must agree; None = they are not compared.
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
def lost_processes(process: ProcessRank, minutes: float = 60 * WAIT_HOURS) -> Iterator[None]:
    """Turns the error of a collective operation whose other side has died, or does not answer within some minutes, into
    one that says so. NCCL has its own watch, which ends the process."""
    _set_wait(minutes)
    try:
        yield
    except InputError:
        raise
    except RuntimeError as error:
        message = " ".join(str(error).split())
        if process.world_size == 1 or not any(words in message.lower() for words in LOST):
            raise
        hung = "timed out" in message.lower() or "timeout" in message.lower()
        waited = f"did not answer for {minutes:g} minutes" if minutes < 60 * WAIT_HOURS else "did not answer"
        lost = _presence.find_lost(waits=not hung) if _presence is not None else []
        raise InputError(
            f"training: process {process.rank} of {process.world_size}: {named(lost) if lost else 'another process'} "
            f"{waited if hung else 'ended'}; its own message, if there is one, says why; start all of them again "
            "to continue"
        ) from error
    finally:
        _set_wait(60 * WAIT_HOURS)


def _set_wait(minutes: float) -> None:
    """Sets the longest wait of the operations of the group that begin from now on."""
    # torch has no public function for a group that exists.
    change = getattr(distributed.distributed_c10d, "_set_pg_timeout", None)
    if change is not None and _in_group():
        change(timedelta(minutes=minutes))


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
    """Checks that all processes have the same value of something, such as the digest of a teacher's weights; an empty
    value fits any."""
    digests = [(rank, each) for rank, each in enumerate(values_of_all(value)) if each]
    for rank, each in digests:
        if each != digests[0][1]:
            raise InputError(
                f"training: {subject} differ: their digest is {digests[0][1]} in process {digests[0][0]} and {each} in "
                f"process {rank}; {advice}"
            )


@contextmanager
def fail_together() -> Iterator[None]:
    """Synchronizes processes at the end of a block that they run independently, or that one of them runs for all: if
    one fails in it, all fail, so that none waits forever."""
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
