"""Remakes the figures that `bench/figures.yaml` lists, of README.md and the pages of results, and marks what moved.

    python bench/run.py [--only 'encode*' …] [--minutes 60] [--out outputs/bench] [--list]

Commands run one after the other, each in a process group of its own with a time limit. Those whose figures spread run
several times, in rounds, so that other load on the machine falls on all alike. Each run is a line of OUT/runs.jsonl;
the same command continues with the runs that have not ended well. OUT/results.json and OUT/results.md hold all of them.

A figure has moved if all its runs lie beyond the recorded value plus or minus its spread, on one side. Seconds are
shown and not judged, since machines differ. The exit code is 1 if a figure moved or a command failed.
"""

import argparse
import fnmatch
import json
import math
import os
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import dacite
import yaml
from machine import machine_of_now

ROOT = Path(__file__).resolve().parents[1]
REGISTRY = Path(__file__).with_name("figures.yaml")
REPEATABLE = ("accuracy", "error", "count", "bytes", "memory")
"""Kinds of figures that do not depend on the load of the machine."""
NEEDS = {"java": "java", "chromium": "chromium", "compiler": "gcc", "gpu": "nvidia-smi"}
"""Programs that an entry may need, besides `shared`, the folder of shared data, and `furniture`, Debian's library."""
FURNITURE = Path("/usr/share/sweethome3d/furniture")
PATIENCE = 5
"""A command may take this multiple of its minutes."""


class RegistryError(Exception):
    """A registry or an output that cannot be read; the message is one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One number.

    Attributes:
        at: keys that lead to it in the JSON file `file` of $OUT, separated by " > ".
        pattern: instead of `at`, a regular expression whose group is the number in what the command prints.
        recorded: what the documents say; `stated`: in these words.
        spread: how far from it a run on the same machine may lie.
    """

    name: str
    kind: Literal["accuracy", "error", "ratio", "count", "bytes", "memory", "seconds"]
    recorded: float
    spread: float
    at: str = ""
    file: str = "figures.json"
    pattern: str = ""
    stated: str = ""

    def read(self, out: Path, printed: str) -> float:
        """The number in what a command wrote and printed.

        Raises:
            RegistryError: it is missing, or not a finite number.
        """
        if self.pattern:
            matches = re.findall(self.pattern, printed)
            if len(matches) != 1:
                raise RegistryError(f"{self.name}: {self.pattern!r} matches {len(matches)} times, expected once")
            return float(matches[0].replace(",", ""))
        try:
            value: Any = json.loads((out / self.file).read_text(encoding="utf-8"))
            for key in self.at.split(" > "):
                value = value[int(key)] if isinstance(value, list) else value[key]
        except (OSError, ValueError) as error:
            raise RegistryError(f"{self.name}: {self.file} cannot be read: {error}") from error
        except (KeyError, IndexError, TypeError) as error:
            there = ", ".join(value) if isinstance(value, dict) else type(value).__name__
            raise RegistryError(f"{self.name}: no {key!r} of {self.at!r} in {self.file}; there is {there}") from error
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise RegistryError(f"{self.name}: {self.at!r} of {self.file} is no number: {value!r}")
        return float(value)

    def has_moved(self, values: Sequence[float]) -> bool:
        """Whether all values lie beyond what is recorded, plus or minus the spread, on one side."""
        # What YAML reads and a script writes may differ in the last bit.
        most = self.spread + 1e-9 * abs(self.recorded)
        return min(values) > self.recorded + most or max(values) < self.recorded - most


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A command and the figures that it remakes.

    Attributes:
        section: heading of a page of results, or "README.md".
        command: bash; $S is the folder of shared data, $OUT an empty folder for what it writes.
        minutes: of one run on two quiet cores.
        needs: "shared", "furniture", or keys of NEEDS.
        repeats: number of runs, for figures that spread.
    """

    name: str
    section: str
    command: str
    minutes: float
    figures: tuple[Figure, ...]
    needs: tuple[str, ...] = ()
    repeats: int = 1

    def missing(self, shared: Path) -> str:
        """What it needs and is not here; empty if it can run."""
        here = {"shared": (shared / "scenes").is_dir(), "furniture": FURNITURE.is_dir()}
        here |= {need: bool(shutil.which(NEEDS[need])) for need in NEEDS}
        return ", ".join(need for need in self.needs if not here[need])


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run of an entry: "ok" or what went wrong, seconds of wall and processor, and its figures by name."""

    entry: str
    round: int
    state: str
    seconds: float
    cpu: float
    figures: Mapping[str, float]


def load_registry(file: Path = REGISTRY) -> tuple[Entry, ...]:
    """Reads and checks a registry.

    Raises:
        RegistryError: a field is missing, unknown or wrong, or a name stands twice.
    """

    def tuples(value: Any) -> Any:
        if isinstance(value, list):
            return tuple(map(tuples, value))
        return {key: tuples(each) for key, each in value.items()} if isinstance(value, dict) else value

    try:
        rows = tuples(yaml.safe_load(file.read_text("utf-8")))["entries"]
        entries = tuple(dacite.from_dict(Entry, row, dacite.Config(strict=True, cast=[float])) for row in rows)
    except (OSError, yaml.YAMLError, dacite.DaciteError, ValueError, TypeError, KeyError) as error:
        raise RegistryError(f"{file}: {' '.join(str(error).split())}") from error
    names = [entry.name for entry in entries] + [f"{e.name}: {figure.name}" for e in entries for figure in e.figures]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise RegistryError(f"{file}: stands twice: {', '.join(twice)}")
    for entry in entries:
        if unknown := set(entry.needs) - {"shared", "furniture", *NEEDS}:
            raise RegistryError(f"{file}: {entry.name}: unknown needs: {', '.join(sorted(unknown))}")
        if not entry.figures or entry.repeats < 1 or not entry.minutes > 0:
            raise RegistryError(f"{file}: {entry.name}: expected figures, repeats of 1 or more, and minutes above 0")
        for figure in entry.figures:
            if bool(figure.at) == bool(figure.pattern) or not figure.spread >= 0:
                raise RegistryError(f"{file}: {entry.name}: {figure.name}: expected at or pattern, and a spread from 0")
    return entries


def choose(entries: Sequence[Entry], only: Sequence[str], minutes: float) -> list[Entry]:
    """Entries whose names match a pattern, repeatable and cheap ones first, as many as fit into the minutes (0 = all).

    Raises:
        RegistryError: a pattern matches nothing.
    """
    for pattern in only:
        if not any(fnmatch.fnmatch(entry.name, pattern) for entry in entries):
            raise RegistryError(f"--only {pattern!r}: no such entry; there are {', '.join(e.name for e in entries)}")

    def cost(entry: Entry) -> tuple[bool, float]:
        depends = any(figure.kind not in (*REPEATABLE, "seconds") for figure in entry.figures)
        return depends, entry.minutes * entry.repeats

    chosen, left = [], minutes or math.inf
    for entry in sorted(entries, key=cost):
        matches = not only or any(fnmatch.fnmatch(entry.name, pattern) for pattern in only)
        if matches and cost(entry)[1] <= left:
            chosen.append(entry)
            left -= cost(entry)[1]
    return chosen


def run_once(entry: Entry, number: int, out: Path, shared: Path) -> Run:
    """Runs the command of an entry, and reads its figures; whatever goes wrong is its state."""
    name = re.sub(r"[^\w.-]+", "_", entry.name)
    work, log = out / "work" / name, out / "logs" / f"{name}.{number}.txt"
    shutil.rmtree(work, ignore_errors=True)
    for folder in (work, log.parent):
        folder.mkdir(parents=True, exist_ok=True)
    environment = {
        **os.environ,
        **{"S": str(shared.resolve()), "OUT": str(work.resolve()), "GSENCODER_SHARED": str(shared.resolve())},
        "GSENCODER_MODELS": os.environ.get("GSENCODER_MODELS", f"{shared.resolve()}/models"),
        "PATH": os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))),
        "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", "")))),
    }
    limit, figures = 60 * PATIENCE * entry.minutes, {}
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
    seconds, cpu = time.perf_counter() - start, _children_seconds() - before
    printed = log.read_text(encoding="utf-8", errors="replace")
    if state == "ok":
        try:
            figures = {figure.name: figure.read(work, printed) for figure in entry.figures}
        except RegistryError as error:
            state = f"unreadable: {error}"
    else:
        state = f"{state}: {(printed.strip().splitlines() or [''])[-1][:200]} ({log})"
    shutil.rmtree(work, ignore_errors=True)
    return Run(entry=entry.name, round=number, state=state, seconds=seconds, cpu=cpu, figures=figures)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(entries: Iterable[Entry], runs: Sequence[Run], shared: Path) -> list[dict[str, Any]]:
    """A row for each figure."""
    rows = []
    for entry in entries:
        own = [run for run in runs if run.entry == entry.name]
        good = [run for run in own if run.state == "ok"]
        # A failure that a later call made good is none any more.
        bad = [run for run in own if run.state != "ok" and run.round not in {each.round for each in good}]
        for figure in entry.figures:
            values = [run.figures[figure.name] for run in good]
            if missing := entry.missing(shared):
                state = f"skipped: needs {missing}"
            elif bad:
                state = bad[-1].state
            elif not values:
                state = "not run"
            elif figure.kind == "seconds":
                state = "not judged"
            else:
                state = "moved" if figure.has_moved(values) else "as recorded"
            row = {"entry": entry.name, "section": entry.section, "figure": figure.name, "kind": figure.kind}
            row |= {"recorded": figure.recorded, "spread": figure.spread, "values": values, "state": state}
            rows.append(row)
    return rows


def markdown(machine: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> str:
    """The report."""
    moved, measured = sum(row["state"] == "moved" for row in rows), sum(bool(row["values"]) for row in rows)
    lines = [f"# Figures remade on {machine['date']}", ""]
    lines += [f"{moved} of {measured} figures moved by more than their spread; {len(rows)} were asked for.", ""]
    lines += [f"- {name}: {value}" for name, value in machine.items()]
    lines += ["", "| entry | figure | recorded | now | |", "|---|---|---|---|---|"]
    for row in rows:
        values, now = row["values"], ""
        if values:
            now = f"{statistics.median(values):.6g} ± {(max(values) - min(values)) / 2:.2g} ({len(values)})"
        state = row["state"].replace("|", "\\|")
        state = f"**{state}**" if state == "moved" else state
        what = f"{row['figure']} ({row['kind']})"
        lines.append(f"| {row['entry']} | {what} | {row['recorded']:.6g} ± {row['spread']:.2g} | {now} | {state} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registry", type=Path, default=REGISTRY)
    parser.add_argument("--only", nargs="*", default=[], metavar="PATTERN", help="of names of entries")
    parser.add_argument("--minutes", type=float, default=0, help="take entries up to this sum; 0 = all")
    parser.add_argument("--out", type=Path, default=Path("outputs/bench"))
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("GSENCODER_SHARED", ROOT.parent / "shared")))
    parser.add_argument("--list", action="store_true", help="print the entries")
    options = parser.parse_args()
    # A runner that is asked to end takes its command with it.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    out, shared, machine, runs = options.out, options.shared, machine_of_now(ROOT), list[Run]()
    try:
        entries = load_registry(options.registry)
        chosen = choose(entries, options.only, options.minutes)
        if options.list:
            for entry in chosen:
                missing = entry.missing(shared) and f"; skipped: needs {entry.missing(shared)}"
                print(f"{entry.name}: {entry.minutes:g} min × {entry.repeats}, {len(entry.figures)} figures{missing}")
            return 0
        out.mkdir(parents=True, exist_ok=True)
        file = out / "runs.jsonl"
        if file.exists():
            # A last line that was cut off is dropped.
            lines = [json.loads(line) for line in file.read_text("utf-8").splitlines(keepends=True) if line[-1] == "\n"]
            if not lines or lines[0]["commit"] != machine["commit"]:
                raise RegistryError(f"{file}: is of another commit; give another --out")
            machine, runs = lines[0], [Run(**line) for line in lines[1:]]
        file.write_text("".join(json.dumps(each) + "\n" for each in (machine, *map(asdict, runs))), encoding="utf-8")
        names = {run.entry for run in runs} | {entry.name for entry in chosen}
        reported = [entry for entry in entries if entry.name in names]
        done = {(run.entry, run.round) for run in runs if run.state == "ok"}
        for number in range(max((entry.repeats for entry in chosen), default=0)):
            for entry in chosen:
                if number >= entry.repeats or (entry.name, number) in done or entry.missing(shared):
                    continue
                print(f"{entry.name} ({number + 1} of {entry.repeats}, about {entry.minutes:g} min) …", flush=True)
                runs.append(run_once(entry, number, out, shared))
                with file.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(asdict(runs[-1])) + "\n")
                print(f"  {runs[-1].state}, {runs[-1].seconds:.0f} s, {runs[-1].cpu:.0f} s of CPU time", flush=True)
                rows = table(reported, runs, shared)
                (out / "results.json").write_text(json.dumps({"machine": machine, "figures": rows}, indent=1) + "\n")
                (out / "results.md").write_text(markdown(machine, rows), encoding="utf-8")
    except RegistryError as error:
        parser.error(str(error))
    rows = table(reported, runs, shared)
    print(f"\n{markdown(machine, rows)}\n{out}/results.md, {out}/results.json")
    fine = ("as recorded", "not judged", "skipped")
    return int(any(not row["state"].startswith(fine) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
