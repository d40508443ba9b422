"""Runs commands in forked children, each with a fault of `fault_shim.c` in it: a fresh process would take seconds for
its imports, and a case takes a tenth of that.

Reads one JSON object a line from standard input and answers with one on standard output. Started by `fault_runs.py`,
with the shim preloaded and one thread, since a forked child has none of its parent's.
"""

import ctypes
import gc
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

SHIM = ctypes.CDLL(None)


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
        os.environ.update(asked.get("environment", {}))
        os.chdir(asked["folder"])
        names = (asked["writes"], asked["reads"])
        SHIM.fault_arm(
            *(os.fsencode(name) for name in names),
            ctypes.c_long(asked["at"]),
            ctypes.c_int(asked["action"]),
            os.fsencode(asked["trace"]),
        )
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
            os.environ.update(asked["environment"])
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
