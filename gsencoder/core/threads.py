"""CPU kernels: numba functions without the GIL, called from a pool of Python threads.

numba's parallel loops are not used, since an OpenMP pool aborts a process that was forked after its first use, as data
loaders do. Work is cut into a fixed number of pieces, so that results do not depend on the number of threads.
"""

import contextlib
import functools
import os
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

from gsencoder.core.errors import SceneWarning

Result = TypeVar("Result")


PIECES = 32
"""Number of pieces that work is cut into: enough to balance a dozen cores, few enough to cost nothing on two."""


class Kernel:
    """A numba function that does not hold the GIL. It is compiled when it is first called, with the kernels that it
    calls: numba takes half a second to load, and most commands need few kernels or none."""

    def __init__(self, function: Callable[..., Any], *, fused: bool = True) -> None:
        """With `fused` products are fused with sums; reassociation is off, so that sums have one order."""
        self._function = function
        self._options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"} if fused else False}

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)

    @functools.cached_property
    def dispatcher(self) -> Callable[..., Any]:
        """The compiled function, which is stored for later runs, or a warning says that it cannot be."""
        from numba import njit

        names = getattr(getattr(self._function, "__code__", None), "co_names", ())
        used = getattr(self._function, "__globals__", {})
        for name in names:
            if isinstance(used.get(name), Kernel):
                used[name] = used[name].dispatcher
        try:
            return njit(cache=True, **self._options)(self._function)
        except RuntimeError as error:
            # A package that another user installed, and no home that can be written, as in some containers.
            if "no locator available" not in str(error):
                raise
            _warn_uncached()
            return njit(**self._options)(self._function)


kernel = Kernel
"""Decorates a function that `parallel` calls."""
compiled = functools.partial(Kernel, fused=False)
"""Decorates a function whose products are not fused with sums."""


@functools.cache
def _warn_uncached() -> None:
    warnings.warn(
        "compiled kernels cannot be stored next to the package or in the user's cache, so that every run compiles them "
        "again, for up to a minute; NUMBA_CACHE_DIR=FOLDER names a folder that can be written",
        SceneWarning,
        stacklevel=3,
    )


_here = threading.local()


def _limit_threads(threads: int | None) -> None:
    """Sets the threads that work on this thread may have; None = `thread_count`."""
    _here.threads = threads


def thread_count() -> int:
    """As many threads as torch uses, or would use if it were loaded."""
    cores = os.cpu_count() or 1
    torch_threads = getattr(sys.modules.get("torch"), "get_num_threads", None)
    if torch_threads is not None:
        return min(int(torch_threads()), cores)
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(max(int(limit), 1), cores) if limit.isdecimal() else cores


@contextlib.contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Lets torch and the kernels use `count` threads within the block. torchrun starts each of several processes with
    one thread, which suits a training on GPUs and leaves most cores idle where a CPU computes."""
    import torch

    with threads_unchanged():
        torch.set_num_threads(count)
        yield


@contextlib.contextmanager
def threads_unchanged() -> Iterator[None]:
    """Gives torch the threads again that it had before the block. Where a library runs a parallel loop of numba, OpenMP
    has as many threads as numba ever after, and torch with it."""
    torch = sys.modules.get("torch")
    before = torch.get_num_threads() if torch is not None else 0
    try:
        yield
    finally:
        if torch is not None:
            torch.set_num_threads(before)


def parallel(work: Callable[[int], Result], pieces: Iterable[int]) -> list[Result]:
    """Runs `work` for each piece in `thread_count` threads, the caller's among them, and returns the results in order.
    A nested call runs its pieces one after the other, since all threads are busy. The error of the first piece that
    failed is raised; pieces that no thread has begun are left out."""
    waiting = list(pieces)
    threads = min(getattr(_here, "threads", None) or thread_count(), len(waiting))
    if threads <= 1:
        return [work(piece) for piece in waiting]
    results: dict[int, Result] = {}
    errors: dict[int, BaseException] = {}
    # Each thread takes the next piece by itself: handing pieces over one by one costs more than small ones take.
    following = iter(range(len(waiting)))

    def run() -> None:
        with _one_thread():
            for number in following:
                try:
                    results[number] = work(waiting[number])
                except BaseException as error:
                    errors[number] = error
                if errors:
                    return

    others = [threading.Thread(target=run) for _ in range(threads - 1)]
    try:
        for thread in others:
            thread.start()
        run()
        for thread in others:
            thread.join()
    except BaseException:
        # Interrupted between two pieces, or while it waits: nothing goes on when this returns.
        deque(following, maxlen=0)
        for thread in others:
            if thread.ident is not None:
                thread.join()
        raise
    if errors:
        raise errors[min(errors)]
    return [results[number] for number in range(len(waiting))]


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Lets work within the block have no threads but the one that it runs on."""
    before = getattr(_here, "threads", None)
    _limit_threads(1)
    try:
        yield
    finally:
        _limit_threads(before)


def ahead(work: Callable[[int], Result], items: Iterable[int], workers: int = 1) -> Iterator[Result]:
    """`work` of each item, in order; the next ones are computed in at most `workers` threads while the caller uses the
    last. The threads that `parallel` has are shared out among these, which have the caller's context variables."""
    threads = thread_count()
    workers = min(workers, threads)
    share = threads // workers
    pending: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, initializer=_limit_threads, initargs=(share,)) as pool:
        try:
            for item in items:
                pending.append(pool.submit(copy_context().run, work, item))
                if len(pending) > workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
