"""Runs commands in forked children, each with a fault of `fault_shim.c` in it: a fresh process would take seconds for
its imports, and a case takes a tenth of that.

Reads one JSON object a line from standard input and answers with one on standard output. Started by `fault_runs.py`,
with the shim preloaded and one thread, since a forked child has none of its parent's.
"""

import ctypes
import gc
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

SHIM = ctypes.CDLL(None)


def run_forked(asked: dict[str, Any]) -> dict[str, Any]:
    """Runs a command line in a child; its exit code (negative: the signal that ended it) and seconds."""
    began = time.perf_counter()
    sys.stdout.flush()
    # What the parent has is not looked at, and so not copied, by its children.
    gc.collect()
    gc.freeze()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            streams = os.open(asked["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(streams, 1)
            os.dup2(streams, 2)
            os.environ.update(asked.get("environment", {}))
            os.chdir(asked["folder"])
            names = (asked["writes"], asked["reads"])
            if "clock" in asked:
                SHIM.fault_clock(ctypes.c_long(asked["clock"][0]), ctypes.c_long(asked["clock"][1]))
            SHIM.fault_arm(
                *(os.fsencode(name) for name in names),
                ctypes.c_long(asked["at"]),
                ctypes.c_int(asked["action"]),
                os.fsencode(asked["trace"]),
            )
            from gsencoder.app import cli

            code = cli.main(asked["words"])
        except BaseException:
            import traceback

            traceback.print_exc()
            code = 1
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    deadline = time.monotonic() + asked.get("timeout", 120)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > deadline:
            os.kill(child, 9)
            os.waitpid(child, 0)
            return {"code": None, "seconds": time.perf_counter() - began}
        time.sleep(0.002)
    return {"code": os.waitstatus_to_exitcode(status), "seconds": time.perf_counter() - began}


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
            from gsencoder.app import cli

            answer = {"code": cli.main(asked["words"]), "seconds": time.perf_counter() - began}
            # The folder of the run may be removed.
            os.chdir(given)
        else:
            answer = run_forked(asked)
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    main()
