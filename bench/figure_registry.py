"""The figures of README.md and docs/measurements.md that `bench/run.py` remakes, as `bench/figures.yaml` lists them."""

import json
import math
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import dacite
import yaml

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
class NotRemade:
    """Figures of a section that no entry remakes, and why."""

    section: str
    figures: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Registry:
    entries: tuple[Entry, ...]
    not_remade: tuple[NotRemade, ...]


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
