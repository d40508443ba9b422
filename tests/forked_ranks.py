"""Scripts as the processes of one training, forked from a server that has imported torch and what they import.

Processes that a launcher starts import torch once each, and the launcher itself does, which takes longer than what most
tests do in them. Those of `started` have the environment that torchrun gives; that torchrun gives it is tested where
one training runs in two processes of it.
"""

import ast
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Ranks:
    """Processes that run a script, by rank."""

    pids: tuple[int, ...]
    logs: tuple[Path, ...]
    server: "RankServer"

    def ended(self, rank: int = 0, timeout: float = 300.0) -> int | None:
        """The exit code of a process (negative: the signal that ended it); None if it does not end in time."""
        return self.server.ask(wait=self.pids[rank], timeout=timeout)["code"]

    def end_well(self) -> None:
        """Waits for all of them, none of which may end with an error."""
        codes = [self.ended(rank) for rank in range(len(self.pids))]
        assert not any(code != 0 for code in codes), (codes, *(log.read_text()[-3000:] for log in self.logs))

    def kill(self) -> None:
        """Ends all of them at once."""
        for rank, pid in enumerate(self.pids):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            self.ended(rank)


class RankServer:
    """A process that forks those of a script."""

    def __init__(self) -> None:
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
            "PYTHONPATH": os.pathsep.join([*map(str, (HERE.parent, HERE, HERE / "train")), *sys.path]),
        }
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(HERE / "forked_ranks.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True,
        )  # fmt: skip

    def ask(self, **request: Any) -> dict[str, Any]:
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def started(self, script: Path, *words: str, count: int = 2) -> Ranks:
        """Starts a script as processes that have one another's address, each of which runs it as `__main__`; what it
        imports at its top is imported by the server, before."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        size = {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count)}
        shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, **size}
        environments = [shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)} for rank in range(count)]
        logs = tuple(script.with_name(f"{script.name}.{rank}.log") for rank in range(count))
        request = {"words": [str(script), *words], "environments": environments, "logs": list(map(str, logs))}
        return Ranks(tuple(self.ask(**request)["pids"]), logs, self)

    def close(self) -> None:
        """Ends the server."""
        self._process.stdin.close()
        self._process.wait(30)
        self._process.stdout.close()


@contextmanager
def rank_server() -> Iterator[RankServer]:
    """A server while the block lasts."""
    server = RankServer()
    try:
        yield server
    finally:
        server.close()


def _import_those_of(script: Path) -> None:
    """Imports the modules that the script imports at its top."""
    for node in ast.parse(script.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            __import__(node.module)
        elif isinstance(node, ast.Import):
            for name in node.names:
                __import__(name.name)


def _forked(words: Sequence[str], environment: dict[str, str], log: str) -> int:
    """Runs a script in a child, and returns its process."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        streams = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(streams, stream)
        os.environ.update(environment)
        sys.argv[:] = words
        runpy.run_path(words[0], run_name="__main__")
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(bool(stop.code))
        print(stop, file=sys.stderr)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _code_of(pid: int, timeout: float, codes: dict[int, int]) -> int | None:
    deadline = time.monotonic() + timeout
    while pid not in codes:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            codes[pid] = os.waitstatus_to_exitcode(status)
        elif time.monotonic() > deadline:
            return None
        else:
            time.sleep(0.005)
    return codes[pid]


def _serve() -> None:
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    codes: dict[int, int] = {}
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            answer: dict[str, Any] = {"code": _code_of(request["wait"], request["timeout"], codes)}
        else:
            _import_those_of(Path(request["words"][0]))
            both = zip(request["environments"], request["logs"], strict=True)
            answer = {"pids": [_forked(request["words"], environment, log) for environment, log in both]}
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    _serve()
