"""A run of a command: what it prints, the progress that it shows, its record in summary.json, where it writes, and the
queue of several scenes."""

import json
import math
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.segment import Segment

import gsencoder
from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.output import (
    WorkFolder,
    check_output_files,
    output_file,
    output_folder,
    refuse_to_replace_inputs,
    sibling_folder,
)
from gsencoder.core.budget import Budget
from gsencoder.core.errors import BusyError, InputError, SceneWarning, listed, one_line, printable
from gsencoder.core.files import SUMMARY_NAME, plain, read_foreign_text
from gsencoder.core.process import Device, ProcessRank, available_cores, peak_memory_mb, refuse_several
from gsencoder.core.settings import describe_values, format_value
from gsencoder.data.scenes import check_names, scene_name
from gsencoder.data.up import Up

T = TypeVar("T")


class Screen(Console):
    """A console that prints no control characters of the text that it is given: file names and texts of users."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


def console(quiet: bool = False) -> Console:
    """The console for results and tables: standard output without markup, 200 columns wide if it is not a terminal."""
    width = None if sys.stdout.isatty() else 200
    return Screen(file=sys.stdout, quiet=quiet, markup=False, highlight=False, emoji=False, width=width)


class Progress:
    """Shows the progress of loops, `for view in track(views, "lifting views")`: a transient bar on a terminal, else a
    line every few seconds."""

    def __init__(self, *, quiet: bool = False, stream: Any = None, every: float = 10.0) -> None:
        self._stream, self._quiet, self._every = sys.stderr if stream is None else stream, quiet, every
        self._bars: Bars | None = None
        self._depth = 0

    def __call__(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yields the items and shows how many are done."""
        if total is None and isinstance(items, Sized):
            total = len(items)
        if self._quiet:
            return iter(items)
        return self._on_terminal(items, label, total) if self._stream.isatty() else self._in_lines(items, label, total)

    def _on_terminal(self, items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
        if self._bars is None:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
            screen = Screen(file=self._stream, markup=False, highlight=False)
            self._bars = Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=screen, transient=True)
        # Nested loops share one display, since rich draws one at a time.
        if self._depth == 0:
            self._bars.start()
        self._depth += 1
        task = self._bars.add_task(label, total=total)
        try:
            for item in items:
                yield item
                self._bars.advance(task)
        finally:
            self._bars.remove_task(task)
            self._depth -= 1
            if self._depth == 0:
                self._bars.stop()

    def _in_lines(self, items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
        start = last = time.monotonic()
        of, count = f"/{total}" if total is not None else "", 0
        for item in items:
            yield item
            count += 1
            now = time.monotonic()
            if now - last >= self._every:
                last = now
                print(f"{label}: {count}{of} after {now - start:.0f} s", file=self._stream, flush=True)
        if last > start:
            print(f"{label}: {count} done in {time.monotonic() - start:.0f} s", file=self._stream, flush=True)


LIBRARIES = (
    *("numpy", "torch", "numba", "scipy", "open3d", "trimesh", "pycolmap", "onnxruntime"),
    *("gsply", "safetensors", "transformers", "gsplat", "triton", "sklearn"),
)
"""Libraries whose versions are recorded, if the run imported them."""


class Run:
    """A run of a command: what it prints, where it writes, and its record: settings, seconds of each step, warnings and
    results (figures and file names)."""

    def __init__(self, command: str, config: CommonConfig, began: float | None = None) -> None:
        self.command, self.config, self.settings = command, config, settings(config)
        self.screen, self.track = console(config.quiet), Progress(quiet=config.quiet)
        self.results: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.timings: dict[str, float] = {}
        self.began = time.perf_counter() if began is None else began
        self._scene: tuple[str, Path, Run] | None = None

    def add_warning(self, text: str) -> str:
        """Adds a warning as one line; the command line adds every `SceneWarning` of the run. Returns it as the run
        shows it: with the name of the scene, if there are several and it names none."""
        text = one_line(text)
        if self._scene is not None:
            name, path, of_scene = self._scene
            of_scene.warnings.append(text)
            if not text.startswith(f"{name}: ") and str(path) not in text:
                text = f"{name}: {text}"
        self.warnings.append(text)
        return one_line(text)

    @contextmanager
    def warning_lines(self, debug: bool) -> Iterator[None]:
        """Records each `SceneWarning` of the block, and prints it as one line on standard error."""
        with warnings.catch_warnings():
            warnings.simplefilter("always", SceneWarning)
            usual = warnings.showwarning

            def show(
                message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None
            ) -> None:
                if not issubclass(category, SceneWarning):
                    usual(message, category, filename, lineno, file, line)
                    return
                text = self.add_warning(str(message))
                print(f"warning: {text}" + (f" ({filename}:{lineno})" if debug else ""), file=sys.stderr)

            warnings.showwarning = show
            yield

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Adds the seconds of the block to the step, also if it fails."""
        start = time.perf_counter()
        self.timings.setdefault(name, 0.0)
        try:
            yield
        finally:
            self.timings[name] += time.perf_counter() - start

    def add_seconds(self, steps: Mapping[str, float]) -> None:
        """Adds the seconds of steps that were timed elsewhere."""
        for name, seconds in steps.items():
            self.timings[name] = self.timings.get(name, 0.0) + seconds

    def costs(self) -> dict[str, float]:
        """What pages say of the run."""
        return {"seconds": sum(self.timings.values()), "peak memory, MiB": peak_memory_mb()}

    def to_dict(self) -> dict[str, Any]:
        """The record as JSON values. `non_finite` lists the results that were not finite and are null."""
        seconds = {**self.timings, "total": time.perf_counter() - self.began}
        timings, versions = {name: round(value, 4) for name, value in seconds.items()}, _versions()
        peak, processors = peak_memory_mb(), available_cores()
        lost: list[str] = []
        results = plain(self.results, "results", lost)
        record = {
            "command": self.command,
            "version": gsencoder.__version__,
            "settings": plain(self.settings, "settings", lost),
            "timings": timings,
            "peak_memory_mb": round(peak, 1),
            "warnings": list(self.warnings),
            "results": results,
            "versions": versions,
            "platform": {"system": platform.system(), "machine": platform.machine(), "processors": processors},
        }
        return record | ({"non_finite": lost} if lost else {})

    def print(self, *lines: RenderableType, **options: Any) -> None:
        """Prints results, each on a line of its own, unless quiet=true."""
        for line in lines:
            self.screen.print(line, **options)

    def out(self, *default: str) -> Path:
        """Where the results go: out=, or outputs/DEFAULT."""
        return self.config.out or Path("outputs", *default)

    def report_up(self, scene: str, up: Up | None) -> None:
        """Records which way is up in a scene; an estimate is printed."""
        self.results["up"] = up
        if up is not None and up.source != "files":
            self.print(f"up of {scene}: {up.describe()} (data.up= states it)")

    def report_choice(
        self,
        scene: str,
        chosen: Mapping[str, Any],
        *,
        predicted: Mapping[str, float],
        notes: Sequence[str],
        **more: Any,
    ) -> None:
        """Prints the setting that a budget chose, warns of the limits that it is expected to break, and records both
        with what is predicted by limit and with `more`."""
        known = {name: value for name, value in predicted.items() if math.isfinite(value)}
        self.results["budget"] = {"chosen": dict(chosen), "predicted": known, "notes": list(notes), **more}
        self.print(f"{scene}: budget: {describe_values(chosen)}")
        for note in notes:
            warnings.warn(note, SceneWarning, stacklevel=3)

    def report_budget(self, budget: Budget, measured: Mapping[str, float]) -> list[str]:
        """A line for each limit that is kept; warns of those that are broken, and records both numbers, after
        `report_choice`. A limit that is not in `measured` was not measured."""
        limits = {name: budget.limit(name) for name in budget.limits}
        measured = {name: measured[name] for name in limits if name in measured}
        self.results["budget"].update(limits=limits, measured=measured)
        lines = []
        for name, limit in limits.items():
            if name not in measured:
                lines.append(f"budget.{name}: limit {format_value(limit)}, not measured (budget.check=false)")
            elif measured[name] <= limit:
                lines.append(f"budget.{name}: limit {format_value(limit)}, measured {measured[name]:.4g}")
            else:
                text = f"budget.{name}: the limit is {format_value(limit)}, and it became {measured[name]:.4g}"
                warnings.warn(text, SceneWarning, stacklevel=3)
        return lines

    @contextmanager
    def folder(self, out: Path) -> Iterator[Path]:
        """Opens the output folder of the results and of this record; see `output_folder`."""
        with output_folder(out, overwrite=self.config.overwrite, record=self.to_dict) as folder:
            yield folder

    @contextmanager
    def resumable(self, out: Path, state: str, *, resume: bool) -> Iterator[tuple[Path, Path]]:
        """Opens the output folder, and the folder OUT.state of work that an interrupted run leaves for the next."""
        with WorkFolder(sibling_folder(out, state)) as work, self.folder(out) as folder:
            refuse_to_replace_inputs(work.path, self.settings)
            work.take(resume=resume)
            yield folder, work.path

    def check_files(self, *files: Path) -> None:
        """Checks, before the work, that a file of results, its record, and other files can be written."""
        check_output_files((*files, Path(f"{files[0]}.{SUMMARY_NAME}")), self.config.overwrite)

    @contextmanager
    def file(self, out: Path) -> Iterator[None]:
        """Lets the block write the one file of the results, and writes this record next to it; see `output_file`."""
        with output_file(out, overwrite=self.config.overwrite, record=self.to_dict):
            yield

    @contextmanager
    def of_scene(self, name: str, path: Path, common: Sequence[str]) -> Iterator["Run"]:
        """The run of one of several scenes, which has the warnings `common` and those that come in the block."""
        run = type(self)(self.command, self.config)
        run.warnings += common
        self._scene = (name, path, run)
        try:
            yield run
        finally:
            self._scene = None

    def scenes(self, paths: Sequence[Path], part: str, one: Callable[[Path, Path, "Run"], None]) -> None:
        """Runs one scene into out=, or each of several into OUT/NAME; without out= into outputs/NAME/PART.

        Of several scenes those are skipped whose folder holds the results of the same settings, and those that another
        process is writing now: processes with other numbers `worker` share the scenes, and each begins at another one.
        An error in one does not stop the others. `one` does one scene: its path, the folder for its results, its run.
        """
        check_names(paths)
        if len(paths) == 1:
            name = scene_name(paths[0])
            refuse_several(f"{paths[0]}", "start it once, or give several scenes, which processes share")
            one(paths[0], self.out(name, part), self)
            return
        first = int(len(paths) * ((getattr(self.config, "worker", 0) * GOLDEN) % 1))
        failures: dict[Path, str] = {}
        common, overwrite, skipped = tuple(self.warnings), self.config.overwrite, 0
        for path in (*paths[first:], *paths[:first]):
            name = scene_name(path)
            target = self.config.out / name if self.config.out is not None else self.out(name, part)
            try:
                if not overwrite and is_finished(target, self):
                    skipped += 1
                    continue
                with self.of_scene(name, path, common) as run:
                    one(path, target, run)
            except BusyError:
                self.print(f"{target}: another run is writing it now")
            except InputError as error:
                with suppress(InputError):
                    # Another process may have finished the scene in the meantime.
                    if not overwrite and is_finished(target, self):
                        continue
                failures[path] = str(error) if str(error).startswith(f"{path}: ") else f"{path}: {error}"
                print(one_line(f"failed: {failures[path]}"), file=sys.stderr)
        if skipped:
            self.print(f"{skipped} of {len(paths)} scenes were finished before")
        if failures:
            raise ScenesFailedError(
                f"{len(failures)} of {len(paths)} scenes failed, and the same command tries them again: "
                f"{listed([str(path) for path in failures])}",
                tuple(failures.values()),
            )

    @contextmanager
    def processes(self, join: Callable[..., Any], device: Device, out: Path, *, state: str = "") -> Iterator["Group"]:
        """Joins the processes that a launcher started by `gsencoder.train.distributed.join_processes`; with `state`,
        OUT.state is for unfinished work of the group."""
        with (
            WorkFolder(sibling_folder(out, state)) as work,
            join(device, settings=self.settings) as (process, used),
            ExitStack() as results,
        ):
            if not process.is_first:
                self.screen, self.track = console(quiet=True), Progress(quiet=True)
            yield Group(self, out, work, process, used, results)


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for module in (name for name in LIBRARIES if name in sys.modules):
        with suppress(PackageNotFoundError):
            versions[module] = version("scikit-learn" if module == "sklearn" else module)
    return versions


@dataclass(frozen=True, slots=True)
class Group:
    """A run that processes of one launcher share; the first of them writes and prints. `work` is for unfinished work,
    `device` the one that this process computes on."""

    run: Run
    out: Path
    work: WorkFolder
    process: ProcessRank
    device: Any
    results: ExitStack

    def folder(self) -> Path | None:
        """Opens the output folder in the first process, before hours of work; None in the others."""
        return self.results.enter_context(self.run.folder(self.out)) if self.process.is_first else None

    def take(self, *, resume: bool) -> None:
        """Takes the folder of unfinished work in the first process."""
        if self.process.is_first:
            refuse_to_replace_inputs(self.work.path, self.run.settings)
            self.work.take(resume=resume)


NOT_COMPARED = ("paths", "out", "overwrite", "quiet", "worker", "resume", "device", "preset")
"""Settings in which two runs with the same results may differ; what a preset sets is compared."""
GOLDEN = 0.6180339887
"""Workers begin at the fractional parts of its multiples, which are spread evenly however many there are."""


class ScenesFailedError(InputError):
    """Some of several scenes failed, each of which was reported when it did; `reasons` has a line for each."""

    def __init__(self, message: str, reasons: tuple[str, ...]) -> None:
        super().__init__(message)
        self.reasons = reasons


def is_finished(target: Path, run: Run, **results: Any) -> bool:
    """Whether a folder holds the results of this command with these settings, and with these `results` where they are
    known before; an InputError if it holds others."""
    try:
        record = json.loads(read_foreign_text(target / SUMMARY_NAME))
    except FileNotFoundError:
        return False
    except (OSError, ValueError) as error:
        raise InputError(f"{target / SUMMARY_NAME}: cannot be read ({type(error).__name__})") from error
    now = {"command": run.command, **_compared(json.loads(json.dumps(plain(run.settings)))), **results}
    before = {"command": record.get("command"), **_compared(record.get("settings", {}))}
    before |= {key: record.get("results", {}).get(key) for key in results}
    differing = sorted(key for key in {*now, *before} if now.get(key) != before.get(key))
    if differing:
        raise InputError(
            f"{target}: holds the results of other settings ({', '.join(differing[:5])}); give another out= or "
            "overwrite=true"
        )
    return True


def _compared(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in NOT_COMPARED}
