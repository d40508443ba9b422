"""Which processes of a training are there: where they meet, and which of them still run.

A thread of each process counts up its entry of a store in the first process (torchrun's: in its agent) and reads those
of the others. A process that computes for hours counts on; one that has ended, or whose machine is gone, does not.
"""

import os
import socket
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta

from torch.distributed import DistNetworkError, PrefixStore, TCPStore  # type: ignore[attr-defined]

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.process import ProcessRank, store_address

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
    """The meeting of this process with the others, and what it knows of them.

    Attributes:
        store: for `torch.distributed.init_process_group`.
    """

    def __init__(self, process: ProcessRank, init_method: str, *, wait: timedelta) -> None:
        """Waits until all processes have come.

        Args:
            process: the rank of this process.
            init_method: as `rank_from_environment` gives it.
            wait: longest wait of an operation of `store`.

        Raises:
            InputError: a process does not come; it is named.
        """
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
