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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import dacite
import yaml
from machine import machine_of_now

REGISTRY = Path(__file__).with_name("figures.yaml")
OUTPUT = "figures.json"
"""What an entry's command writes into $OUT, if the figure names no other file."""
Kind = Literal["accuracy", "error", "ratio", "count", "bytes", "memory", "seconds"]
REPEATABLE = ("accuracy", "error", "count", "bytes", "memory")
"""Kinds that do not depend on what else the machine does."""
NEEDS: dict[str, tuple[Callable[[Path], bool], str]] = {
    "shared": (lambda shared: (shared / "scenes").is_dir(), "no folder of shared data (GSENCODER_SHARED)"),
    "java": (lambda _: shutil.which("java") is not None, "no Java"),
    "chromium": (lambda _: shutil.which("chromium") is not None, "no Chromium"),
    "compiler": (lambda _: shutil.which("gcc") is not None or shutil.which("cc") is not None, "no C compiler"),
    "onnxscript": (lambda _: find_spec("onnxscript") is not None, "no onnxscript (the extra `export`)"),
    "gpu": (lambda _: shutil.which("nvidia-smi") is not None, "no GPU"),
}
"""What an entry may need: whether it is there, given the folder of shared data, and what is said where it is not."""


class RegistryError(Exception):
    """A registry or an output that cannot be read; the message is one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One number.

    Attributes:
        name: what it is, unique in its entry.
        at: keys that lead to it in the JSON file, separated by " > "; or, with `pattern`, unused.
        kind: ratios are of times taken in turn; seconds are shown and not judged.
        recorded: what the documents say.
        spread: how far from it a run on the same machine may lie.
        file: of $OUT.
        pattern: a regular expression whose group is the number in what the command prints, in place of a file.
        stated: how the document says it, where not as the number.
    """

    name: str
    kind: Kind
    recorded: float
    spread: float
    at: str = ""
    file: str = OUTPUT
    pattern: str = ""
    stated: str = ""

    @property
    def judged(self) -> bool:
        return self.kind != "seconds"

    def read(self, out: Path, printed: str) -> float:
        """The number in what a command left and printed.

        Raises:
            RegistryError: it is not there, or no finite number.
        """
        if self.pattern:
            found = re.findall(self.pattern, printed)
            if len(found) != 1:
                raise RegistryError(f"{self.name}: {self.pattern!r} matches {len(found)} times, expected once")
            return float(found[0].replace(",", ""))
        try:
            value: Any = json.loads((out / self.file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RegistryError(f"{self.name}: {self.file} cannot be read: {error}") from error
        for key in self.at.split(" > "):
            try:
                value = value[int(key)] if isinstance(value, list) else value[key]
            except (KeyError, IndexError, TypeError, ValueError):
                known = ", ".join(value) if isinstance(value, dict) else type(value).__name__
                raise RegistryError(
                    f"{self.name}: no {key!r} of {self.at!r} in {self.file}; there is {known}"
                ) from None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise RegistryError(f"{self.name}: {self.at!r} of {self.file} is no number: {value!r}")
        return float(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A command and the figures that it remakes.

    Attributes:
        section: heading of docs/measurements.md, or "README.md".
        command: bash; $S is the folder of shared data, $OUT an empty folder for what it writes.
        minutes: of one run on two quiet cores.
        needs: keys of NEEDS.
        repeats: runs, for figures that spread.
    """

    name: str
    section: str
    command: str
    minutes: float
    figures: tuple[Figure, ...]
    needs: tuple[str, ...] = ()
    repeats: int = 1

    @property
    def minutes_of_all_runs(self) -> float:
        return self.minutes * self.repeats

    @property
    def deterministic(self) -> bool:
        return all(figure.kind in REPEATABLE or not figure.judged for figure in self.figures)

    def missing(self, shared: Path) -> str:
        """What it needs and is not here; empty if it can run."""
        return "; ".join(why for there, why in (NEEDS[need] for need in self.needs) if not there(shared))


@dataclass(frozen=True, slots=True, kw_only=True)
class Registry:
    entries: tuple[Entry, ...]


def load_registry(file: Path = REGISTRY) -> Registry:
    """Reads and checks a registry.

    Raises:
        RegistryError: a field is missing, unknown or wrong, or a name stands twice.
    """
    try:
        registry = dacite.from_dict(
            Registry, _tuples(yaml.safe_load(file.read_text("utf-8"))), dacite.Config(strict=True, cast=[float])
        )
    except (OSError, yaml.YAMLError, dacite.DaciteError, ValueError) as error:
        raise RegistryError(f"{file}: {' '.join(str(error).split())}") from error
    _unique(str(file), [entry.name for entry in registry.entries])
    for entry in registry.entries:
        where = f"{file}: {entry.name}"
        _unique(where, [figure.name for figure in entry.figures])
        if unknown := set(entry.needs) - set(NEEDS):
            raise RegistryError(
                f"{where}: needs: expected some of {', '.join(NEEDS)}, got {', '.join(sorted(unknown))}"
            )
        if not entry.figures or entry.repeats < 1 or not entry.minutes > 0:
            raise RegistryError(f"{where}: expected figures, repeats of 1 or more, and minutes above 0")
        for figure in entry.figures:
            if bool(figure.at) == bool(figure.pattern):
                raise RegistryError(f"{where}: {figure.name}: expected either at or pattern")
            if not figure.spread >= 0:
                raise RegistryError(f"{where}: {figure.name}: expected a spread of 0 or more, got {figure.spread}")
    return registry


def _tuples(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_tuples, value))
    return {key: _tuples(each) for key, each in value.items()} if isinstance(value, dict) else value


def _unique(where: str, names: list[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise RegistryError(f"{where}: stands twice: {', '.join(twice)}")


def record(file: Path, values: Mapping[tuple[str, str], tuple[float, float]]) -> None:
    """Writes new values and spreads, by entry and figure, into the lines of a registry; all else stays as it is.

    Accuracies and errors get as many decimals as were recorded, which is what the documents state.

    Raises:
        RegistryError: a figure has no line of its own with `recorded` and `spread`.
    """
    lines, entry, left = file.read_text("utf-8").splitlines(keepends=True), "", dict(values)
    for number, line in enumerate(lines):
        if match := re.match(r"- name: (.*)", line):
            entry = yaml.safe_load(match[1])
        elif re.match(r"\s+- \{name: .*\}\s*$", line):
            figure = yaml.safe_load(line)[0]
            if (key := (entry, figure["name"])) in left:
                value, spread = left.pop(key)
                # A name may hold the words as well, after a space and not after a comma.
                text, decimals = _number(value), re.search(r", recorded: -?\d+\.(\d+)[,}]", line)
                if decimals and figure["kind"] in ("accuracy", "error"):
                    text = f"{value:.{len(decimals[1])}f}"
                line = re.sub(r", recorded: [^,}]+", f", recorded: {text}", line)
                if spread != figure["spread"]:
                    line = re.sub(r", spread: [^,}]+", f", spread: {_number(spread)}", line)
                lines[number] = line
    if left:
        raise RegistryError(f"{file}: no line of its own: {', '.join(map(' / '.join, left))}")
    file.write_text("".join(lines), encoding="utf-8")


def _number(value: float) -> str:
    """Four digits, in a form that YAML reads as a number."""
    text = str(int(value)) if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


ENOUGH_FOR_A_SPREAD = 3
"""Runs whose range is recorded as the spread of a figure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run of an entry.

    Attributes:
        state: "ok", or what went wrong.
        cpu: processor seconds of the command and all that it started.
        load: load average before it.
        figures: numbers by name.
    """

    entry: str
    round: int
    state: str
    seconds: float
    cpu: float
    load: float
    figures: Mapping[str, float]


def spread_of(values: Sequence[float]) -> float:
    """Half the range."""
    return (max(values) - min(values)) / 2


def has_moved(figure: Figure, values: Sequence[float]) -> bool:
    """Whether all values lie beyond what is recorded, plus or minus the spread, on one side."""
    # What YAML reads and a script writes may differ in the last bit.
    most = figure.spread + 1e-9 * abs(figure.recorded)
    return min(values) > figure.recorded + most or max(values) < figure.recorded - most


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
            row = {
                "entry": entry.name, "section": entry.section, "figure": figure.name, "kind": figure.kind,
                "recorded": figure.recorded, "spread": figure.spread, "values": values,
            }  # fmt: skip
            if values:
                row |= {"now": statistics.median(values), "now_spread": spread_of(values)}
            if missing := entry.missing(shared):
                state = f"skipped: {missing}"
            elif bad:
                state = bad[-1].state
            elif not values:
                state = "not run"
            elif not figure.judged:
                state = "not judged"
            else:
                state = "moved" if has_moved(figure, values) else "as recorded"
            rows.append({**row, "state": state})
    return rows


def markdown(machine: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> str:
    """The report."""
    moved = [row for row in rows if row["state"] == "moved"]
    lines = [f"# Figures remade on {machine['date']}", ""]
    measured = [row for row in rows if row["values"]]
    lines += [f"{len(moved)} of {len(measured)} figures moved by more than their spread; {len(rows)} were asked for."]
    lines += ["Seconds are shown and not judged, as machines differ.", ""]
    lines += [f"- {name}: {value}" for name, value in machine.items()]
    lines += ["", "| entry | figure | recorded | now | |", "|---|---|---|---|---|"]
    for row in rows:
        now = f"{row['now']:.6g} ± {row['now_spread']:.2g} ({len(row['values'])})" if row["values"] else ""
        state = row["state"].replace("|", "\\|")
        state = f"**{state}**" if row["state"] == "moved" else state
        what = f"{row['figure']} ({row['kind']})"
        lines.append(f"| {row['entry']} | {what} | {row['recorded']:.6g} ± {row['spread']:.2g} | {now} | {state} |")
    return "\n".join(lines) + "\n"


def listing(registry: Registry, shared: Path) -> str:
    """All entries, and what is not remade."""
    lines = []
    for entry in registry.entries:
        runs = f" × {entry.repeats}" if entry.repeats > 1 else ""
        missing = f"; skipped: {entry.missing(shared)}" if entry.missing(shared) else ""
        kind = "" if entry.deterministic else ", depends on load"
        lines.append(f"{entry.name}: {entry.minutes:g} min{runs}, {len(entry.figures)} figures{kind}{missing}")
    total = sum(entry.minutes_of_all_runs for entry in registry.entries)
    lines.append(f"{len(registry.entries)} entries, {total:.0f} minutes")
    return "\n".join(lines)


def recorded_values(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], tuple[float, float]]:
    """What `record` writes: medians, and spreads of figures with enough runs. Of figures that do not depend on load
    only those that moved are written, with the spread that they have, half of the last digit that is stated."""
    recorded = {}
    for row in rows:
        repeatable = row["kind"] in REPEATABLE
        if row["values"] and (row["state"] == "moved" or not repeatable):
            several = len(row["values"]) >= ENOUGH_FOR_A_SPREAD and not repeatable
            recorded[row["entry"], row["figure"]] = row["now"], row["now_spread"] if several else row["spread"]
    return recorded


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
