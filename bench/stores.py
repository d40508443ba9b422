"""Every way to store a scene's features: bytes against the centered cosine and the boxes that are found with it.

    python bench/stores.py SCENE … [--teacher teacher=labels] [--plot stores.png] [--optimize]

Features of the scenes are fused. Bytes are those of the files that hold features, bases, banks and tables, without the
splat and the words: an array of float16 vectors (dense), a folder of `fuse` (basis), packages with several budgets
(compact), index packages with several thresholds, and memories with several widths of their queries, not optimized, or,
with --optimize, optimized. The cosine is with the fused features, over Gaussians; Acc@0.25 and Acc@0.5 are of the
objects of labeled scenes, of all scenes together. Seconds are those of making codes from fused features.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.benchmarks.localization import Hit, LocalizationProtocol, score_queries, scores
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.folder import FEATURES_FILE, MEMORY_FILE, load_features, save_features, save_memories
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.package import PACKAGE_FILE, save_index_package, save_package
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.memory.bank import BankConfig
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.teachers.build import words_of
from gsencoder.train.memory import MemoryConfig, memory_training, prepare_memory, train_memory, untrained_memory
from gsencoder.types import GaussianFeatures, Scene

Stored = tuple[str, str, int, GaussianFeatures, float]
"""Kind, setting, bytes, what is read back, and seconds."""


@dataclass
class Row:
    """Figures of one way to store features, over scenes."""

    bytes: list[int] = field(default_factory=list)
    gaussians: list[int] = field(default_factory=list)
    cosine: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    hits: list[Hit] = field(default_factory=list)


def stores(scene: Scene, fused: GaussianFeatures, work: Path) -> Iterator[Stored]:
    """The features as each way gives them back."""
    yield "dense", "float16", 2 * fused.space.channels * len(fused), fused, 0.0
    start = time.perf_counter()
    save_features(work / "basis", scene, fused)
    size = (work / "basis" / FEATURES_FILE).stat().st_size
    yield "basis", "float16", size, only(work / "basis"), time.perf_counter() - start
    for error in (0.003, 0.01, 0.03, 0.1):
        folder = work / f"compact_{error}"
        folder.mkdir()
        start = time.perf_counter()
        save_package(folder, scene, fused, error=error)
        seconds = time.perf_counter() - start
        yield "compact", f"error {error}", (folder / PACKAGE_FILE).stat().st_size, only(folder), seconds
    for threshold in (0.7, 0.8, 0.9, 0.95):
        folder = work / f"index_{threshold}"
        folder.mkdir()
        start = time.perf_counter()
        made = index_features(fused, IndexConfig(threshold=threshold))
        seconds = time.perf_counter() - start
        save_index_package(folder, scene, made.features, error=made.error)
        yield "index", f"θ {threshold}", (folder / PACKAGE_FILE).stat().st_size, only(folder), seconds


def only(folder: Path) -> GaussianFeatures:
    """The features of a folder."""
    (features,) = load_features(folder).features.values()
    return features


def memories(scene: Scene, words: list[str], work: Path, *, optimize: bool) -> Iterator[Stored]:
    """Memories of the scene."""
    config = compose("fuse", FuseCommandConfig, ["-", *words])
    teacher = config.teacher.build(scene, words_of(config.teacher, config.text))
    prepared = prepare_memory(scene, teacher, work / "prepared", BankConfig())
    for channels in (4, 8, 16, 32):
        setting = MemoryConfig(channels=channels)
        start = time.perf_counter()
        if optimize:
            training = work / f"training_{channels}"
            training.mkdir()
            memory = train_memory({"a": prepared}, setting, memory_training(), work=training)[0]["a"]
        else:
            memory = untrained_memory(prepared, setting)
        seconds = time.perf_counter() - start
        folder = work / f"memory_{channels}_{optimize}"
        save_memories(folder, scene, {"a": memory})
        kind = "queries, optimized" if optimize else "queries"
        yield kind, f"{channels} channels", (folder / MEMORY_FILE).stat().st_size, only(folder), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--teacher", nargs="*", default=["teacher=labels"], help="settings of the teacher")
    parser.add_argument("--splat", default="")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--optimize", action="store_true")
    add_json_option(parser)
    arguments = parser.parse_args()
    config = compose("fuse", FuseCommandConfig, ["-", *arguments.teacher])
    words = words_of(config.teacher, config.text)
    rows: dict[tuple[str, str], Row] = defaultdict(Row)
    for path in arguments.scenes:
        scene = with_gaussians(load_scene(path, splat=arguments.splat or None))
        fused = fuse(scene, config.teacher.build(scene, words), FuseConfig()).features
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            makers = [
                partial(stores, scene, fused, work),
                partial(memories, scene, arguments.teacher, work, optimize=False),
            ]
            if arguments.optimize:
                makers.append(partial(memories, scene, arguments.teacher, work / "again", optimize=True))
            for maker in makers:
                for kind, setting, size, features, seconds in maker():
                    row = rows[kind, setting]
                    row.bytes.append(size)
                    row.gaussians.append(len(fused))
                    row.seconds.append(seconds)
                    row.cosine.append(1 - field_error(features, fused).total)
                    if scene.objects and words is not None:
                        row.hits += score_queries(scene, features, words, LocalizationProtocol(), LocalizeConfig())[0]
    print("| store | setting | MB a scene | bytes a Gaussian | centered cosine | Acc@0.25 | Acc@0.5 | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    figures = {}
    for (kind, setting), row in rows.items():
        scored = scores(row.hits) if row.hits else None
        accuracies = f"{scored['acc_25']:.3f} | {scored['acc_50']:.3f}" if scored else "| "
        size, each = np.mean(row.bytes) / 1e6, sum(row.bytes) / sum(row.gaussians)
        print(
            f"| {kind} | {setting} | {size:.3g} | {each:.3g} | {np.mean(row.cosine):.4f} | {accuracies} | "
            f"{np.mean(row.seconds):.2f} |"
        )
        figures[f"{kind}, {setting}"] = {"bytes a Gaussian": each, "cosine": np.mean(row.cosine), **(scored or {})}
    write_figures(arguments.json, figures)
    if arguments.plot:
        plot(rows, arguments.plot)


def plot(rows: dict[tuple[str, str], Row], path: Path) -> None:
    """Bytes a scene against each score, a color for each kind."""
    from matplotlib.figure import Figure

    has_hits = any(row.hits for row in rows.values())
    figure = Figure(figsize=(15 if has_hits else 7, 4.8), layout="constrained")
    columns = figure.subplots(1, 3 if has_hits else 1, squeeze=False)[0]
    kinds = list(dict.fromkeys(kind for kind, _ in rows))
    values = {
        "1 − centered cosine with dense": lambda row: max(1 - float(np.mean(row.cosine)), 1e-5),
        "Acc@0.25": lambda row: scores(row.hits)["acc_25"],
        "Acc@0.5": lambda row: scores(row.hits)["acc_50"],
    }
    for axes, (title, value) in zip(columns, values.items(), strict=False):
        for number, kind in enumerate(kinds):
            chosen = [(setting, row) for (each, setting), row in rows.items() if each == kind]
            x = [float(np.mean(row.bytes)) / 1e6 for _, row in chosen]
            y = [value(row) for _, row in chosen]
            axes.plot(x, y, "o-", color=f"C{number}", label=kind, markersize=5)
            # The other panels have the same bytes, and scores that lie on each other.
            for (setting, _), a, b in zip(chosen, x, y, strict=True) if axes is columns[0] else ():
                axes.annotate(setting, (a, b), xytext=(4, 5), textcoords="offset points", fontsize=7)
        axes.set_xscale("log")
        axes.set_xlabel("MB a scene, without splat and words")
        axes.set_title(title)
        axes.grid(alpha=0.3)
    columns[0].set_yscale("log")
    columns[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
