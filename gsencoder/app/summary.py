"""The record of a run in summary.json, and the report of its budget."""

import math
import platform
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gsencoder
from gsencoder.app.progress import console
from gsencoder.core.errors import SceneWarning
from gsencoder.core.files import SUMMARY_NAME, plain, sha256_of, write_json
from gsencoder.core.process import raise_dropped_stop
from gsencoder.core.settings import Budget, describe_values, shown_value
from gsencoder.core.threads import available_cores
from gsencoder.types import FeatureBasis

LIBRARIES = {
    "numpy": "numpy",
    "torch": "torch",
    "numba": "numba",
    "scipy": "scipy",
    "sklearn": "scikit-learn",
    "open3d": "open3d",
    "trimesh": "trimesh",
    "pycolmap": "pycolmap",
    "onnxruntime": "onnxruntime",
    "gsply": "gsply",
    "safetensors": "safetensors",
    "transformers": "transformers",
    "gsplat": "gsplat",
    "triton": "triton",
}
"""Module and distribution of the libraries whose versions are recorded, if the run imported them."""


def peak_memory_mb() -> float:
    """Peak resident memory of this process, MiB."""
    # On Linux ru_maxrss starts from the size of the parent at the fork; VmHWM is that of the process alone.
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return math.nan
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


class Summary:
    """Collects the settings of a run, the seconds of each step, warnings and results.

    Attributes:
        results: figures and file names; filled by the command.
        warnings: one line each, in order; see `add_warning`.
        timings: seconds by step, in order of first start.
        began: when the run began, by `time.perf_counter`.
    """

    def __init__(self, command: str, settings: Mapping[str, Any], began: float | None = None) -> None:
        self.command = command
        self.settings = dict(settings)
        self.results: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.timings: dict[str, float] = {}
        self.began = time.perf_counter() if began is None else began
        self._scene: tuple[str, Path, Summary] | None = None

    def add_warning(self, text: str) -> str:
        """Adds a warning; the command line adds every `SceneWarning` of the run. Returns it as the run shows it: with
        the name of the scene, if there are several and it names none."""
        if self._scene is not None:
            name, path, of_scene = self._scene
            of_scene.warnings.append(text)
            if not text.startswith(f"{name}: ") and str(path) not in text:
                text = f"{name}: {text}"
        self.warnings.append(text)
        return text

    @contextmanager
    def of_scene(self, name: str, path: Path, common: Sequence[str]) -> Iterator["Summary"]:
        """The summary of one of several scenes, which has the warnings that the run gets in the block.

        Args:
            common: warnings of the run as a whole, which are about each scene.
        """
        summary = Summary(self.command, self.settings)
        summary.warnings += common
        self._scene = (name, path, summary)
        try:
            yield summary
        finally:
            self._scene = None

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Adds the seconds of the block to the step, also if it fails."""
        raise_dropped_stop()
        start = time.perf_counter()
        self.timings.setdefault(name, 0.0)
        try:
            yield
        finally:
            self.timings[name] += time.perf_counter() - start
        raise_dropped_stop()

    def add_seconds(self, steps: Mapping[str, float]) -> None:
        """Adds the seconds of steps that were timed elsewhere."""
        for name, seconds in steps.items():
            self.timings[name] = self.timings.get(name, 0.0) + seconds

    def to_dict(self) -> dict[str, Any]:
        """The record as JSON values. `non_finite` lists the results that were not finite and are null."""
        lost: list[str] = []
        results = plain(self.results, "results", lost)
        total = time.perf_counter() - self.began
        record = {
            "command": self.command,
            "version": gsencoder.__version__,
            "settings": plain(self.settings, "settings", lost),
            "timings": {name: round(seconds, 4) for name, seconds in (*self.timings.items(), ("total", total))},
            "peak_memory_mb": plain(round(peak_memory_mb(), 1)),
            "warnings": list(self.warnings),
            "results": results,
            "versions": _versions(),
            "platform": {
                "system": platform.system(),
                "machine": platform.machine(),
                "processors": available_cores(),
            },
        }
        return record | ({"non_finite": lost} if lost else {})


def write_beside(file: Path, summary: Summary) -> None:
    """Writes the summary of a run whose result is one file as FILE.summary.json, with the checksum of the file."""
    files = {file.name: sha256_of(file)} if file.is_file() else {}
    write_json(f"{file}.{SUMMARY_NAME}", summary.to_dict() | {"files": files})


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for module, distribution in LIBRARIES.items():
        if module in sys.modules:
            try:
                versions[module] = version(distribution)
            except PackageNotFoundError:
                versions[module] = "unknown"
    return versions


def report_choice(
    summary: Summary,
    scene: str,
    knobs: Mapping[str, Any],
    *,
    predicted: Mapping[str, float | None],
    notes: Sequence[str],
    quiet: bool,
    of: str = "",
    **more: Any,
) -> None:
    """Prints a setting that a budget chose, warns of what it does not keep, and adds both to the summary.

    Args:
        predicted: of the setting, by promise; None = not predicted.
        notes: what budgets in conflict do not keep.
        of: what the values are of, on the screen.
    """
    summary.results["budget"] = {
        "chosen": dict(knobs),
        "predicted": {name: value for name, value in predicted.items() if value is not None},
        "notes": list(notes),
        **more,
    }
    console(quiet).print(f"{scene}: budget: {describe_values(knobs)}{of}")
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=3)


def report_promises(summary: Summary, budget: Budget, realised: Mapping[str, float]) -> list[str]:
    """A line for each promise that is not broken; warns of those that are, and adds what became of all to the summary.

    Args:
        realised: what was measured, by promise; one that is missing was not.
    """
    promised = {name: budget.promise(name) for name in budget.promised}
    summary.results["budget"].update(promised=promised, realised=dict(realised))
    predicted = summary.results["budget"]["predicted"]
    lines = []
    for name, promise in promised.items():
        if name not in realised:
            lines.append(f"budget.{name}: promised {shown_value(promise)}, not measured (budget.check=false)")
            continue
        if realised[name] <= promise:
            lines.append(f"budget.{name}: promised {shown_value(promise)}, realised {realised[name]:.4g}")
        else:
            more = "; the summary says what was predicted" if name in predicted else ""
            warnings.warn(
                f"budget.{name}: promised {shown_value(promise)}, and it became {realised[name]:.4g}{more}",
                SceneWarning,
                stacklevel=3,
            )
    return lines


def basis_figures(basis: FeatureBasis | None, rank: int) -> dict[str, int | float]:
    """The rank of a basis, and the share of the energy that it keeps of the vectors that it was fitted to; `rank` is
    the number of columns of the features, which without a basis are all channels."""
    return {"rank": rank, "energy_kept": basis.energy_kept if basis is not None else 1.0}


def describe_basis(figures: Mapping[str, Any], scenes: str) -> str:
    """The figures in a phrase.

    Args:
        figures: those of `basis_figures`, and those of `BasisFit.figures` where they are known.
        scenes: the scenes that the latter are of.
    """
    phrase = f"rank {figures['rank']}, keeps {figures['energy_kept']:.4f} of the energy"
    if "other_energy" not in figures:
        return phrase
    return (
        f"{phrase}, and {figures['other_energy']:.4f} in {scenes} (cosine {figures['other_cosine']:.3f}, worst 5 % "
        f"below {figures['other_worst']:.3f})"
    )
