"""Runs of commands with a fault in them: the shim is compiled, a server of forked runs is started, and what they leave
is compared with what a run without a fault writes. A fresh process would take seconds for its imports, and a case takes
a tenth of that."""

import csv
import ctypes
import gc
import hashlib
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
COUNT, KILL, TEAR, FULL, IO_ERROR, SHORT, SHORT_FULL, DENY, VANISH, CUT, READ_ERROR, HALT = range(12)
"""What `fault_shim.c` does at the call that is asked for: nothing; end the process before it, or in the middle of it;
a disk that is full from then on; one error; a short write, alone or before a full disk; of inputs: refuse, remove or
halve the file, and an error of reading; stop before it until another run has ended."""
VOLATILE = {"timings", "peak_memory_mb", "versions", "platform", "seconds", "seconds_per_step", "mib", "settings"}
VOLATILE |= {"files", "continued"}
"""Keys of JSON values in which two runs differ; `continued` counts what a run took over from an unfinished one."""


@dataclass(frozen=True)
class Call:
    """A counted call with its bytes and its file."""

    number: int
    name: str
    size: int
    path: str


@dataclass(frozen=True)
class Run:
    """What a forked run came to."""

    code: int | None
    """Negative = the signal that ended it; None = it did not end in time."""
    lines: tuple[str, ...]
    calls: tuple[Call, ...]
    seconds: float
    other: "Run | None" = None
    """The run that was started while this one stood still."""

    @property
    def error(self) -> str:
        """Its only line that is an error, or all that it printed."""
        errors = [line for line in self.lines if line.startswith("error: ")]
        return errors[0] if len(errors) == 1 else "\n".join(self.lines)


def compile_shim(folder: Path) -> Path | None:
    """The shim as a library; None where there is no C compiler, or no Linux."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or sys.platform != "linux" or sysconfig.get_config_var("SOABI") is None:
        return None
    library = folder / "fault_shim.so"
    made = subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(HERE / "fault_shim.c"), "-ldl"], check=False
    )
    return library if made.returncode == 0 else None


class FaultServer:
    """A process that forks a child for each run."""

    def __init__(self, shim: Path, given: Path) -> None:
        self.given = given
        environment = {
            **os.environ, "LD_PRELOAD": str(shim), "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)]),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "GSENCODER_CACHE": "off",
            "OPENAI_API_KEY": "none", "GSENCODER_VLM_MODEL": "tiny", "TOKENIZERS_PARALLELISM": "false",
        }  # fmt: skip
        environment.pop("OPENAI_BASE_URL", None)
        self._log = (given.parent / "server.log").open("w")
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(HERE / "fault_runs.py"), str(given)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, env=environment, text=True,
        )  # fmt: skip

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the server ended: {Path(self._log.name).read_text()[-3000:]}")
        return json.loads(line)

    def prepare(self, name: str) -> None:
        """Makes the inputs of a case."""
        self._ask({"prepare": name})

    def run(
        self,
        words: list[str],
        folder: Path,
        *,
        at: int = 0,
        action: int = COUNT,
        reads: Path | None = None,
        warm: bool = False,
        meanwhile: list[str] | None = None,
    ) -> Run:
        """Runs a command line in a child.

        Args:
            folder: where it runs; changes below it are counted.
            at: the number of the call at which the fault is; 0 = none.
            reads: a folder whose files are counted as inputs as they are opened; changes are not counted then.
            warm: whether to run it in the server itself, so that children have its modules and kernels.
            meanwhile: a command line that is run while this one stands still (`HALT`). Where it waits for this one,
                this one goes on after some seconds.
        """
        side = folder.parent / f"{folder.name}.run"
        side.mkdir(exist_ok=True)
        trace = side / "trace"
        trace.unlink(missing_ok=True)
        asked = {
            "words": words, "folder": str(folder), "writes": "" if reads else str(folder), "reads": str(reads or ""),
            "at": at, "action": action, "trace": str(trace), "log": str(side / "log"), "warm": warm,
            "meanwhile": meanwhile or [], "log of the other": str(side / "other"),
        }  # fmt: skip
        for name in ("log", "other"):
            (side / name).unlink(missing_ok=True)
        answer = self._ask(asked)
        log, other = (
            (side / name).read_text(errors="replace") if (side / name).exists() else "" for name in ("log", "other")
        )
        second = Run(answer["other"], tuple(other.splitlines()), (), 0.0) if "other" in answer else None
        calls = []
        for line in trace.read_text(errors="replace").splitlines() if trace.exists() else ():
            number, name, size, path = line.split("\t", 3)
            calls.append(Call(int(number), name, int(size), path))
        calls.sort(key=lambda call: call.number)
        return Run(answer["code"], tuple(log.splitlines()), tuple(calls), answer["seconds"], second)

    def close(self) -> None:
        """Ends the server."""
        self._process.stdin.close()
        self._process.wait(30)
        self._process.stdout.close()
        self._log.close()


@contextmanager
def fault_server(folder: Path) -> Iterator[FaultServer | None]:
    """A server while the block lasts; None where there is no C compiler."""
    shim = compile_shim(folder)
    if shim is None:
        yield None
        return
    (folder / "given").mkdir()
    server = FaultServer(shim, folder / "given")
    try:
        yield server
    finally:
        server.close()


def contents(path: Path) -> dict[str, str]:
    """A digest of each file below a folder (or of a file), of what two runs have in common: no times, no memory."""
    files = sorted(each for each in path.rglob("*") if not each.is_dir()) if path.is_dir() else [path]
    return {
        str(file.relative_to(path)) if file != path else file.name: digest_of(file)
        for file in files
        if file.exists() or file.is_symlink()
    }


def digest_of(file: Path) -> str:
    """Of what is the same in every run; of a file that is cut off, of its bytes."""
    try:
        return _digest_of(file)
    except Exception:
        return "cut off: " + hashlib.sha256(file.read_bytes()).hexdigest()


def _digest_of(file: Path) -> str:
    data = file.read_bytes()
    if file.suffix == ".json":
        value = json.loads(data)
        data = json.dumps(lasting(value), sort_keys=True).encode()
        if file.name == "summary.json" and isinstance(value.get("files"), dict):
            # Some of these files differ in each run; the checksums are those of the files that are there.
            sums = {name: hashlib.sha256((file.parent / name).read_bytes()).hexdigest() for name in value["files"]}
            names = sorted(re.sub(r"tfevents.*", "tfevents", name) for name in sums)
            data += json.dumps([sorted(set(names)), sums == value["files"]]).encode()
    elif file.suffix == ".jsonl":
        data = json.dumps([lasting(json.loads(line)) for line in data.splitlines()], sort_keys=True).encode()
    elif file.suffix == ".csv":
        rows = list(csv.DictReader(data.decode().splitlines()))
        data = repr([{k: v for k, v in row.items() if "second" not in k and k != "mib"} for row in rows]).encode()
    elif file.suffix == ".safetensors":
        import numpy as np
        from safetensors import safe_open

        with safe_open(file, framework="numpy") as opened:
            header = json.loads((opened.metadata() or {}).get("gsencoder", "{}"))
            arrays = {name: opened.get_tensor(name) for name in sorted(opened.keys())}
        for name in ("digest", "checksums"):
            header.pop(name, None)
        sums = {
            name: hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest() for name, value in arrays.items()
        }
        data = json.dumps([lasting(header), sums], sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


def lasting(value: Any) -> Any:
    """A JSON value without times and paths."""
    if isinstance(value, dict):
        return {key: lasting(each) for key, each in value.items() if key not in VOLATILE}
    if isinstance(value, list):
        return [lasting(each) for each in value]
    if isinstance(value, str) and value.startswith("/"):
        return Path(value).name
    return None if isinstance(value, float) and math.isnan(value) else value


# The server: a process with the shim preloaded and one thread, since a forked child has none of its parent's.

LONGEST = 600.0
"""Seconds after which a run counts as one that does not end."""
PATIENCE = 2.0
"""Seconds after which a run that stands still goes on: the other may be waiting for it."""


def forked(asked: dict[str, Any]) -> int:
    """Runs a command line in a child; its process."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        streams = os.open(asked["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(streams, 1)
        os.dup2(streams, 2)
        os.chdir(asked["folder"])
        writes, reads, trace = (os.fsencode(asked[name]) for name in ("writes", "reads", "trace"))
        at, action = ctypes.c_long(asked["at"]), ctypes.c_int(asked["action"])
        ctypes.CDLL(None).fault_arm(writes, reads, at, action, trace)
        from gsencoder.app import main as cli

        code = cli.main(asked["words"])
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(child: int, deadline: float, *, stops: bool = False) -> int | None:
    """The status of a child once it has ended, or (`stops`) stands still; None if it does neither in time."""
    while True:
        done, status = os.waitpid(child, os.WNOHANG | (os.WUNTRACED if stops else 0))
        if done:
            return status
        if time.monotonic() > deadline:
            return None
        time.sleep(0.002)


def run_forked(asked: dict[str, Any]) -> dict[str, Any]:
    """Runs a command line in a child; its exit code (negative: the signal that ended it) and seconds, and the exit code
    of another that is run while it stands still."""
    began = time.perf_counter()
    # What the parent has is not looked at, and so not copied, by its children.
    gc.collect()
    gc.freeze()
    deadline = time.monotonic() + LONGEST
    answer: dict[str, Any] = {}
    children = {"code": forked(asked)}
    statuses = {"code": ended(children["code"], deadline, stops=bool(asked["meanwhile"]))}
    if statuses["code"] is not None and os.WIFSTOPPED(statuses["code"]):
        other = {"words": asked["meanwhile"], "log": asked["log of the other"], "at": 0, "action": 0, "trace": ""}
        children["other"] = forked({**asked, **other, "writes": "", "reads": ""})
        statuses["other"] = ended(children["other"], time.monotonic() + PATIENCE)
        os.kill(children["code"], signal.SIGCONT)
        statuses["code"] = ended(children["code"], deadline)
        if statuses["other"] is None:
            statuses["other"] = ended(children["other"], deadline)
    for name, status in statuses.items():
        if status is None:
            os.kill(children[name], signal.SIGKILL)
            os.waitpid(children[name], 0)
        answer[name] = None if status is None else os.waitstatus_to_exitcode(status)
    return answer | {"seconds": time.perf_counter() - began}


def main() -> None:
    import fault_commands
    from composed_once import compose_once

    compose_once()
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    given = Path(sys.argv[1])
    for line in sys.stdin:
        asked = json.loads(line)
        began = time.perf_counter()
        answer: dict[str, Any]
        if "prepare" in asked:
            fault_commands.prepare(given, asked["prepare"])
            answer = {"seconds": time.perf_counter() - began}
        elif asked["warm"]:
            # Its modules and kernels are then those of all children.
            os.chdir(asked["folder"])
            from gsencoder.app import main as cli

            answer = {"code": cli.main(asked["words"]), "seconds": time.perf_counter() - began}
            # The folder of the run may be removed.
            os.chdir(given)
        else:
            answer = run_forked(asked)
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    main()
