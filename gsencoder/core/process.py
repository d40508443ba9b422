"""The process of a command: signals, its rank among those that one launcher started, seconds, and memory.

torchrun and SLURM (srun, submitit) give a process its rank through environment variables, which no other module reads;
without either there is one process.
"""

import ctypes
import gc
import math
import os
import re
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any, Literal, ParamSpec, TypeVar

from gsencoder.core.errors import InputError

SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name))
"""Signals with which a user, a shell or a cluster ends a process."""


class Stopped(BaseException):
    """The process received a signal to end; raised where it was running, so that half-written output is removed."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Interrupted(KeyboardInterrupt):
    """Ctrl-C. A class of its own, since `python -m` ends by SIGINT in place of its exit code if a `KeyboardInterrupt`
    proper has left an `exec`, such as dataclasses run when they are made, even though it was caught."""


def stop_of(error: BaseException) -> Stopped | KeyboardInterrupt | None:
    """The signal or interrupt behind an exception, or None. A signal that arrives within a compiled function leaves it
    wrapped in a `SystemError`, and in one more for each function that had called it."""
    inner: BaseException | None = error
    while isinstance(inner, SystemError):
        inner = inner.__cause__ or inner.__context__
    return inner if isinstance(inner, Stopped | KeyboardInterrupt) else None


def _import_depth(frame: FrameType | None) -> int:
    """The number of imports that a frame is in."""
    depth = 0
    while frame is not None:
        depth += frame.f_code.co_name == "_find_and_load"
        frame = frame.f_back
    return depth


@contextmanager
def stopping_signals() -> Iterator[None]:
    """Signals that end the process raise an exception within the block, for the main thread of a command; signals that
    are ignored (nohup) remain so. Python drops the exception where it is raised in a destructor or a weakref's
    callback, as training does often enough to miss one, and libraries that it interrupts while they are imported drop
    it or stay half imported: the signal is then sent once more."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    outer_imports = _import_depth(sys._getframe())

    def send_soon(number: int) -> None:
        threading.Timer(0.05, os.kill, (os.getpid(), number)).start()

    def stop(number: int, frame: FrameType | None) -> None:
        if _import_depth(frame) > outer_imports:
            send_soon(number)
        else:
            raise Interrupted() if number == signal.SIGINT else Stopped(number)

    def send_again(dropped: Any) -> None:
        if (stopped := stop_of(dropped.exc_value)) is None:
            report(dropped)
        else:
            # Not from here, where the exception of the handler would be dropped, too.
            send_soon(stopped.number if isinstance(stopped, Stopped) else signal.SIGINT)

    replaced = {number: signal.getsignal(number) for number in SIGNALS}
    replaced = {
        number: handler
        for number, handler in replaced.items()
        if handler in (signal.SIG_DFL, signal.default_int_handler)
    }
    report, sys.unraisablehook = sys.unraisablehook, send_again
    try:
        for number in replaced:
            signal.signal(number, stop)
        yield
    finally:
        sys.unraisablehook = report
        for number, handler in replaced.items():
            signal.signal(number, handler)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Signals that end the process are handled after the block, so that they do not interrupt it.

    Handlers run in the main thread alone; in other threads nothing is deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    deferred: list[tuple[int, FrameType | None]] = []
    block_ended = False

    def defer(number: int, frame: FrameType | None) -> None:
        if block_ended:
            before[number](number, frame)
        else:
            deferred.append((number, frame))

    try:
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, defer)
        yield
    finally:
        block_ended = True
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in deferred:
            before[number](number, frame)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessRank:
    """The rank of a process among those that one launcher started, and among those of its machine."""

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0
    local_world_size: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and prints."""
        return self.rank == 0


def rank_from_environment(environment: Mapping[str, str]) -> tuple[ProcessRank, str]:
    """The rank of this process, and the init_method for `torch.distributed`: "tcp://…" under SLURM, "env://" under
    torchrun, else ""."""
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
    """The host and the port at which the processes of a launcher meet."""
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
    """Checks that a launcher started this process alone, for work that is not shared: all would write the same."""
    process, _ = rank_from_environment(os.environ)
    if process.world_size > 1:
        raise InputError(
            f"{subject}: runs in one process, and this is process {process.rank} of {process.world_size} that a "
            f"launcher (torchrun, SLURM) started; {advice}"
        )


def first_host(nodes: str) -> str:
    """The first host of a SLURM node list such as `a[03-07,9],b1`."""
    match = re.match(r"([^\[,\s]+)(?:\[([^\]]*)\])?([^\[,\s]*)", nodes)
    if not match:
        raise InputError("SLURM: the node list (SLURM_STEP_NODELIST) is empty; set MASTER_ADDR")
    prefix, numbers, suffix = match.groups()
    return prefix + (re.split(r"[-,]", numbers)[0] if numbers else "") + suffix


def _local_tasks(environment: Mapping[str, str]) -> int:
    """The number of tasks on this node, the first of a list such as `8(x3),4`: a step's nodes rarely differ."""
    tasks = environment.get("SLURM_STEP_TASKS_PER_NODE") or environment.get("SLURM_TASKS_PER_NODE", "1")
    match = re.match(r"\d+", tasks)
    return int(match[0]) if match else 1


def _read_number(environment: Mapping[str, str], name: str, default: str) -> int:
    value = environment.get(name, default)
    if not value.isdigit():
        raise InputError(f"{name}: expected a whole number in the environment variable, got {value!r}")
    return int(value)


Track = Callable[[Iterable[Any], str], Iterable[Any]]
"""Yields the items of a loop and shows its progress; the text says what the loop does."""


def untracked(items: Iterable[Any], label: str) -> Iterable[Any]:  # noqa: ARG001
    """Yields the items and shows nothing."""
    return items


P = ParamSpec("P")
R = TypeVar("R")

_running: ContextVar["Clock | None"] = ContextVar("running_clock", default=None)


class Clock:
    """Adds up the seconds that each step of a stage takes. A step is a block, `with clock("lift"): …`, or, within
    `with clock.running():`, a call of a function that is decorated with `@timed("lift")`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        with self._lock:
            self.seconds[step] = self.seconds.get(step, 0.0) + seconds

    @contextmanager
    def running(self) -> Iterator["Clock"]:
        """Lets functions decorated with `timed` that are called inside the block, also in threads of `ahead`, count
        towards this clock. Where threads work at the same time, their steps share the seconds of the wall clock."""
        token, before, start = _running.set(self), dict(self.seconds), time.perf_counter()
        try:
            yield self
        finally:
            _running.reset(token)
            added = {step: seconds - before.get(step, 0.0) for step, seconds in self.seconds.items()}
            share = min(1.0, (time.perf_counter() - start) / max(sum(added.values()), 1e-9))
            self.seconds = {step: before.get(step, 0.0) + share * seconds for step, seconds in added.items()}


def timed(step: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a function as one step of a stage: its calls are timed while a clock is running."""

    def mark(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*arguments: P.args, **settings: P.kwargs) -> R:
            clock = _running.get()
            if clock is None:
                return function(*arguments, **settings)
            with clock(step):
                return function(*arguments, **settings)

        return call

    return mark


STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Growth:
    """Peak resident memory of a block minus that at its start, MiB; NaN where the system does not report it."""

    def __init__(self) -> None:
        self.mib = math.nan


@contextmanager
def memory_growth() -> Iterator[Growth]:
    """Measures the memory of a block. Linux records the peak of resident memory of each process (VmHWM) and can reset
    it to the present value. Freed heap memory is returned to the system first, so that the block cannot reuse it."""
    growth = Growth()
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        CLEAR.write_text("5")
        before = status_kib("VmRSS")
    except OSError:
        yield growth
        return
    yield growth
    growth.mib = max(status_kib("VmHWM") - before, 0) / 1024


def available_cores() -> int:
    """The cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def peak_memory_mb() -> float:
    """Peak resident memory of this process, MiB."""
    # On Linux ru_maxrss starts from the size of the parent at the fork; VmHWM is that of the process alone.
    with suppress(OSError):
        return status_kib("VmHWM") / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 2**20


def status_kib(name: str) -> int:
    """A size of this process in KiB by its name in /proc/self/status, which Linux has; OSError elsewhere."""
    for line in STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    raise OSError(f"{STATUS} has no {name}")


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8


def retain_freed_memory() -> None:
    """Makes the process of a command reuse freed memory from now on, where the C library is glibc; it never shrinks
    below its peak then.

    glibc returns every block above 32 MB to the system when it is freed, and threads other than the first get heaps
    that cannot grow beyond 64 MB. Each layer's activations are then new pages, which the system must clear: that costs
    more than the arithmetic. To be called before the first network runs, since oneDNN reads the capacity of its cache
    of compiled products once; the default of 1,024 is too small for the sizes that occur in a training.
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16384")
    with suppress(OSError, AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for name, value in ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, (1 << 31) - 1), (_M_ARENA_MAX, 1)):
            mallopt(name, value)


Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
Stored = Literal["float32", "float16", "int8_weights", "int8_dynamic"]
"""Precision of an exported graph."""
