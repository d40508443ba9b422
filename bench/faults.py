"""Every write of every command, and a fault at each: what is lost, and what is said.

    python bench/faults.py [--cases fuse train …] [--faults kill tear full error short] [--jobs 2] [--every 1]

The calls of each command that change files (open, write, rename, unlink, fsync …) are counted. Then the command is run
once for each of them and each fault: killed (SIGKILL) before the call, or in the middle of it; a disk that is full from
that call on; one error (EIO) at it; a write that writes half of what it was given. After each, out= holds whole
results, the earlier ones or nothing; an error is one line that names the file; and the same command, given again, ends
with what a run without a fault writes, and leaves nothing else. `--faults inputs`: each file that is read is refused,
gone, cut off or unreadable as it is opened. `tests/faults` does the same with a sample of the calls.
"""

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from chat_server import answer, serving
from fault_checks import Checker
from fault_commands import CASES, EXHAUSTIVE
from fault_runs import CUT, DENY, FULL, IO_ERROR, KILL, READ_ERROR, SHORT, SHORT_FULL, TEAR, VANISH, fault_server

FAULTS = {"kill": (KILL,), "tear": (TEAR,), "full": (FULL, SHORT_FULL), "error": (IO_ERROR,), "short": (SHORT,)}
FAULTS |= {"inputs": (DENY, VANISH, CUT, READ_ERROR)}


def run_case(given: tuple[str, tuple[str, ...], int, bool]) -> tuple[str, int, Counter[str], list[str], float]:
    """Puts faults into a case: its name, the number of its calls, faults by kind, what did not hold, and seconds."""
    name, faults, every, over = given
    began, done, wrong = time.perf_counter(), Counter[str](), list[str]()
    with (
        tempfile.TemporaryDirectory(prefix="gsencoder_faults_") as folder,
        serving(answer("fine")) as chat,
        fault_server(Path(folder)) as server,
    ):
        assert server is not None, "needs a C compiler, and Linux"
        checker = Checker(server, Path(folder), name, chat.url)
        calls = checker.reference.calls
        for kind in faults:
            for action in FAULTS[kind]:
                for call in calls[::every]:
                    if action in (TEAR, SHORT, SHORT_FULL) and call.size < 2:
                        continue
                    found = checker.check(call.number, action)
                    if over and action == KILL:
                        found += [
                            f"over earlier results: {each}" for each in checker.check(call.number, action, over=True)
                        ]
                        done["kill"] += 1
                    done[kind] += 1
                    wrong += found
                    for line in found:
                        print(line, file=sys.stderr, flush=True)
    return name, len(calls), done, wrong, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=[*CASES, *EXHAUSTIVE])
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--every", type=int, default=1, help="take every so many-th call")
    parser.add_argument("--over", action="store_true", help="kill runs that replace earlier results as well")
    given = parser.parse_args()
    for name in given.cases:
        if name not in {**CASES, **EXHAUSTIVE}:
            parser.error(f"--cases: no case {name!r}; there are {', '.join([*CASES, *EXHAUSTIVE])}")
    total, calls, lost = Counter[str](), 0, 0
    jobs = [(name, tuple(given.faults), given.every, given.over) for name in given.cases]
    print(f"{'command':24} {'writes':>6} {'faults':>7} {'wrong':>6} {'seconds':>8}")
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        for name, count, done, wrong, seconds in pool.imap_unordered(run_case, jobs):
            print(f"{name:24} {count:6} {sum(done.values()):7} {len(wrong):6} {seconds:8.0f}", flush=True)
            total, calls, lost = total + done, calls + count, lost + len(wrong)
    kinds = ", ".join(f"{kind} {number}" for kind, number in total.items())
    print(f"{len(jobs)} commands, {calls} writes; {sum(total.values())} faults ({kinds}): {lost} wrong")
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
