"""Remakes the figures of README.md and docs/measurements.md that `bench/figures.yaml` lists, and marks what moved.

    python bench/run.py [--only 'encode*' …] [--minutes 60] [--out outputs/bench] [--resume] [--list] [--record]

Commands run one after the other, each in a process group of its own with a time limit. Those whose figures spread run
several times, in rounds, so that what else the machine does falls on all alike. Each run is written to OUT/runs.jsonl
as it ends; OUT/results.json and OUT/results.md are of all runs so far. --resume goes on with what has not ended well.

A figure has moved if all its runs lie beyond the recorded value plus or minus its spread, on one side. Seconds are
shown and not judged, since machines differ. The exit code is 1 if a figure moved or a command failed. --record writes
the medians of this run into the registry as what is recorded, and of figures with three runs or more their spread.
"""

import argparse
import fnmatch
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from figure_registry import REGISTRY, Entry, RegistryError, load_registry, record
from figure_report import Run, listing, markdown, recorded_values, table
from machine import machine_of_now

ROOT = Path(__file__).resolve().parents[1]
RUNS = "runs.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Where commands run and write.

    Attributes:
        out: folder of results.
        shared: folder of shared data, $S.
        patience: a command may take so many times the minutes of its entry.
    """

    out: Path
    shared: Path
    patience: float


def choose(entries: Iterable[Entry], only: Sequence[str], minutes: float) -> list[Entry]:
    """Entries whose names match a pattern, deterministic ones first, as many as fit into so many minutes (0 = all).

    Raises:
        RegistryError: a pattern matches nothing.
    """
    entries = list(entries)
    for pattern in only:
        if not any(fnmatch.fnmatch(entry.name, pattern) for entry in entries):
            raise RegistryError(f"--only {pattern!r}: no such entry; there are {', '.join(e.name for e in entries)}")
    matching = [e for e in entries if not only or any(fnmatch.fnmatch(e.name, pattern) for pattern in only)]
    chosen, left = [], minutes or float("inf")
    # The cheapest first: an hour then gives the most figures.
    for entry in sorted(matching, key=lambda entry: (not entry.deterministic, entry.minutes_of_all_runs)):
        if entry.minutes_of_all_runs <= left:
            chosen.append(entry)
            left -= entry.minutes_of_all_runs
    return chosen


def run_once(entry: Entry, number: int, setting: Setting) -> Run:
    """Runs the command of an entry, and reads its figures; whatever goes wrong is its state."""
    # Shells part words at spaces, and commands name $OUT without quotes.
    name = re.sub(r"[^\w.-]+", "_", entry.name)
    work, log = setting.out / "work" / name, setting.out / "logs" / f"{name}.{number}.txt"
    shutil.rmtree(work, ignore_errors=True)
    for folder in (work, log.parent):
        folder.mkdir(parents=True, exist_ok=True)
    shared = str(setting.shared.resolve())
    environment = {
        **os.environ,
        **{"S": shared, "OUT": str(work.resolve()), "GSENCODER_SHARED": shared},
        "GSENCODER_MODELS": os.environ.get("GSENCODER_MODELS", f"{shared}/models"),
        "PATH": os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))),
        "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", "")))),
    }
    limit, figures, load = 60 * setting.patience * entry.minutes, {}, os.getloadavg()[0]
    start, before = time.perf_counter(), _children_seconds()
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            ["bash", "-e", "-o", "pipefail", "-c", entry.command], cwd=ROOT, env=environment, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            code = process.wait(timeout=limit)
            state = "ok" if code == 0 else f"failed with exit code {code}"
        except subprocess.TimeoutExpired:
            state = f"stopped after {limit / 60:.3g} minutes"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    seconds, cpu, printed = (
        time.perf_counter() - start,
        _children_seconds() - before,
        log.read_text(encoding="utf-8", errors="replace"),
    )
    if state != "ok":
        state = f"{state}: {(printed.strip().splitlines() or [''])[-1][:200]} ({log})"
    else:
        try:
            figures = {figure.name: figure.read(work, printed) for figure in entry.figures}
        except RegistryError as error:
            state = f"unreadable: {error}"
    shutil.rmtree(work, ignore_errors=True)
    return Run(entry=entry.name, round=number, state=state, seconds=seconds, cpu=cpu, load=load, figures=figures)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def read_runs(file: Path) -> tuple[dict[str, str], list[Run]]:
    """The machine and the runs of an earlier call; a last line that was cut off is dropped."""
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        file.write_text("".join(lines[:-1]), encoding="utf-8")
        lines = lines[:-1]
    if not lines:
        raise RegistryError(f"{file}: empty; remove it, or choose another --out")
    return json.loads(lines[0]), [Run(**json.loads(line)) for line in lines[1:]]


def remake(
    reported: Sequence[Entry],
    chosen: Sequence[Entry],
    machine: Mapping[str, str],
    earlier: Sequence[Run],
    setting: Setting,
) -> list[dict[str, Any]]:
    """Runs what of the chosen entries has not ended well yet, and writes the results after each run."""
    runs, done = list(earlier), {(run.entry, run.round) for run in earlier if run.state == "ok"}
    rows = table(reported, runs, setting.shared)
    for number in range(max((entry.repeats for entry in chosen), default=0)):
        for entry in chosen:
            if number >= entry.repeats or (entry.name, number) in done or entry.missing(setting.shared):
                continue
            print(f"{entry.name} ({number + 1} of {entry.repeats}, about {entry.minutes:g} min) …", flush=True)
            run = run_once(entry, number, setting)
            runs.append(run)
            with (setting.out / RUNS).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({name: getattr(run, name) for name in run.__slots__}) + "\n")
            print(f"  {run.state}, {run.seconds:.0f} s, {run.cpu:.0f} s of CPU time", flush=True)
            rows = table(reported, runs, setting.shared)
            (setting.out / "results.json").write_text(
                json.dumps({"machine": machine, "figures": rows}, indent=1) + "\n"
            )
            (setting.out / "results.md").write_text(markdown(machine, rows), encoding="utf-8")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registry", type=Path, default=REGISTRY)
    parser.add_argument("--only", nargs="*", default=[], metavar="PATTERN", help="of names of entries")
    parser.add_argument("--minutes", type=float, default=0, help="take entries up to this sum; 0 = all")
    parser.add_argument("--patience", type=float, default=5, help="times its minutes that a command may take")
    parser.add_argument("--out", type=Path, default=Path("outputs/bench"))
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("GSENCODER_SHARED", ROOT.parent / "shared")))
    parser.add_argument("--resume", action="store_true", help="go on with the runs in OUT")
    parser.add_argument("--list", action="store_true", help="print the entries, and what is not remade")
    parser.add_argument("--record", action="store_true", help="write the medians into the registry")
    options = parser.parse_args()
    # A runner that is asked to end takes its command with it.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        registry = load_registry(options.registry)
        if options.list:
            print(listing(registry, options.shared))
            return 0
        chosen, file = choose(registry.entries, options.only, options.minutes), options.out / RUNS
        machine, earlier = machine_of_now(ROOT), list[Run]()
        if file.exists():
            if not options.resume:
                raise RegistryError(f"{file} is there: give --resume to go on with it, or another --out")
            before, earlier = read_runs(file)
            if before["commit"] != machine["commit"]:
                raise RegistryError(f"{file} is of commit {before['commit']}, and this is {machine['commit']}")
            machine = before
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(machine) + "\n", encoding="utf-8")
        setting = Setting(out=options.out, shared=options.shared, patience=options.patience)
        names = {run.entry for run in earlier} | {entry.name for entry in chosen}
        reported = [entry for entry in registry.entries if entry.name in names]
        rows = remake(reported, chosen, machine, earlier, setting)
        if options.record:
            record(options.registry, recorded_values(rows))
    except RegistryError as error:
        parser.error(str(error))
    print(f"\n{markdown(machine, rows)}\n{options.out}/results.md, {options.out}/results.json")
    fine = ("as recorded", "not judged", "skipped")
    return int(any(not row["state"].startswith(fine) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
