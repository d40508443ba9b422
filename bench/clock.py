"""Whether announced and promised times of `reconstruct` are kept, with quiet and with busy cores.

    python bench/clock.py [SCENE …] [--seconds 120] [--busy 2] [--out FOLDER] [--json FILE]

Each scene is reconstructed twice by the command line, in processes of their own: with --minutes, where the time that is
announced before the first step is held against what steps, prunings and validations took, and with --seconds, which
are held against the wall clock of the whole process, imports included. --busy starts so many processes beside it that
compute all the time. Without scenes: the plush at half its size and three rooms of the house.
"""

import argparse
import json
import os
import re
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


def announced_seconds(printed: str) -> float:
    """The time that a run announced before its first step.

    Raises:
        ValueError: it announced none, or several.
    """
    times = ANNOUNCED.findall(printed)
    if len(times) != 1:
        raise ValueError(f"expected one time that is announced, found {len(times)} in {printed!r}")
    number, unit = times[0]
    return float(number) * (60 if unit == "minutes" else 1)


def measured(scene: Path, out: Path, options: Sequence[str]) -> dict[str, Any]:
    """Figures of one run.

    Raises:
        CalledProcessError: it failed.
    """
    command = [sys.executable, "-m", "gsencoder", "reconstruct", str(scene), f"out={out}", "overwrite=true", *options]
    began = time.perf_counter()
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    wall = time.perf_counter() - began
    summary = json.loads((out / "summary.json").read_text())
    announced, taken = announced_seconds(printed), summary["timings"]["optimise"]
    results = {"announced": announced, "taken": taken, "announced_by_taken": announced / taken, "wall": wall}
    return results | {"steps": summary["results"]["steps"], "budget": summary["results"].get("budget", {})}


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
    shared = Path(os.environ.get("GSENCODER_SHARED", "../shared"))
    chosen = {path: [] for path in arguments.scenes} if arguments.scenes else scenes_of(shared)
    figures: dict[str, Any] = {}
    print(f"{'scene':<12}{'run':<16}{'steps':>6}{'announced':>10}{'taken':>8}{'ratio':>7}{'wall':>8}{'of budget':>10}")
    with tempfile.TemporaryDirectory() as temporary, busy_cores(arguments.busy):
        for scene, options in chosen.items():
            aims = [f"budget.minutes={arguments.minutes:g}"] if arguments.minutes else []
            for budget in (*aims, *(f"budget.seconds={seconds:g}" for seconds in arguments.seconds)):
                out = (arguments.out or Path(temporary)) / scene.name / budget
                out.parent.mkdir(parents=True, exist_ok=True)
                found = measured(scene, out, [budget, *options])
                share = found["wall"] / float(budget.split("=")[1]) if "seconds" in budget else float("nan")
                figures.setdefault(scene.name, {})[budget] = found | {"wall_by_budget": share}
                numbers = f"{found['steps']:>6}{found['announced']:>10.1f}{found['taken']:>8.1f}"
                ratios = f"{found['announced_by_taken']:>7.2f}{found['wall']:>8.1f}{share:>10.3f}"
                print(f"{scene.name:<12}{budget:<16}{numbers}{ratios}", flush=True)
                write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
