"""Whether announced and promised times of `reconstruct` are kept, with quiet and with busy cores.

    python bench/clock.py [SCENE …] [--seconds 120] [--busy 2] [--out FOLDER] [--json FILE]

Each scene is reconstructed by the command line, in processes of their own: with --minutes, where the time that is
announced before the first step is held against the time from then to the end of the process, and with --seconds, which
are held against the wall clock of the whole process, imports included; a refused budget has no steps. --busy starts
processes that compute all the time. Without scenes: the plush at half its size and three rooms of the house.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from json_option import add_json_option, write_figures

ROOMS = ("train_000", "train_010", "train_020")
ANNOUNCED = re.compile(r"Gaussians, .*: about ([0-9.]+) (s|minutes)$", re.MULTILINE)


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Processes that compute while the block runs."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: sum(range(10**6))"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def measured(scene: Path, out: Path, options: Sequence[str]) -> dict[str, Any]:
    """Figures of one run; its steps are 0 where the budget was refused (exit code 2).

    Raises:
        CalledProcessError: it failed.
        ValueError: no time was announced.
    """
    command = [sys.executable, "-u", "-m", "gsencoder", "reconstruct", str(scene), f"out={out}", "overwrite=true"]
    began, announced = time.perf_counter(), {}
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if match := ANNOUNCED.search(line):
                announced[time.perf_counter()] = float(match[1]) * (60 if match[2] == "minutes" else 1)
    ended = time.perf_counter()
    nothing = {"announced": None, "taken": None, "announced_by_taken": None}
    if process.returncode == 2 and any(option.startswith("budget.seconds=") for option in options):
        return {"steps": 0, "wall": ended - began, **nothing}
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    if len(announced) != 1:
        raise ValueError(f"expected one time that is announced, found {list(announced.values())}")
    ((at, seconds),) = announced.items()
    results = json.loads((out / "summary.json").read_text())["results"]
    times = {"announced": seconds, "taken": ended - at, "announced_by_taken": seconds / (ended - at)}
    return {"steps": results["steps"], "wall": ended - began, **times, "budget": results.get("budget", {})}


def scenes_of(shared: Path) -> dict[Path, list[str]]:
    """The usual scenes with their options."""
    rooms: dict[Path, list[str]] = {shared / "scenes" / "house" / room: [] for room in ROOMS}
    return {shared / "scenes" / "plush": ["data.image_scale=0.5"], **rooms}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE")
    parser.add_argument("--minutes", type=float, default=2.0, help="aim of the run without a promise; 0 = no such run")
    parser.add_argument("--seconds", type=float, nargs="*", default=[120.0], help="promises, a run each")
    parser.add_argument("--busy", type=int, default=0, help="processes that compute at the same time")
    parser.add_argument("--out", type=Path, help="folder for the results")
    add_json_option(parser)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the busy processes end, too
    shared = Path(os.environ.get("GSENCODER_SHARED", "../shared"))
    chosen = {path: [] for path in arguments.scenes} if arguments.scenes else scenes_of(shared)
    figures: dict[str, Any] = {}
    headings = ("announced", "taken", "ratio", "wall", "of budget")
    print(f"{'scene':<12}{'run':<20}{'steps':>6}" + "".join(f"{heading:>10}" for heading in headings))
    with tempfile.TemporaryDirectory() as temporary, busy_cores(arguments.busy):
        for scene, options in chosen.items():
            aims = [f"budget.minutes={arguments.minutes:g}"] if arguments.minutes else []
            for budget in (*aims, *(f"budget.seconds={seconds:g}" for seconds in arguments.seconds)):
                out = (arguments.out or Path(temporary)) / scene.name / budget
                out.parent.mkdir(parents=True, exist_ok=True)
                found = measured(scene, out, [budget, *options])
                promised = budget.startswith("budget.seconds") and found["steps"]
                share = found["wall"] / float(budget.split("=")[1]) if promised else None
                figures.setdefault(scene.name, {})[budget] = found | {"wall_by_budget": share}
                columns = (found["announced"], found["taken"], found["announced_by_taken"], found["wall"], share)
                numbers = "".join(f"{'-' if each is None else format(each, '.2f'):>10}" for each in columns)
                print(f"{scene.name:<12}{budget:<20}{found['steps']:>6}{numbers}", flush=True)
                write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
