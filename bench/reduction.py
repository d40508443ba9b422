"""Reductions of raw features to principal scene components, beside a transcription of M3's Algorithm 1.

    python bench/reduction.py SCENE [--rows 100000] [--thresholds 0.8 0.9] [--teacher teacher=dinov2_s14]
        [--maps FOLDER] [--repeats 2]

Raw features are those of the teacher's maps of all views, evenly thinned to --rows. The transcription compares chunks
of 5,000 rows with all others by float32 matrix products on all cores. Each figure of a reduction is the fastest of
--repeats. --maps keeps the teacher's maps for the next time. With --replicas K, both reductions are of K noisy copies
of the features that are given part by part, and their memory is printed.
"""

import argparse
import resource
import threading
import time
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.archive import RowFile
from gsencoder.core.arrays import even_indices
from gsencoder.data.scenes import load_scene
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.memory.reduction import (
    CoverReduction,
    reduce_as_published,
    unit_rows,
)
from gsencoder.teachers.build import build_teacher, words_of

CHUNK = 5000


def raw_features(scene_path: Path, teacher_words: list[str], maps: Path | None) -> np.ndarray:
    """The vectors of all cells of all views, in order."""
    config = compose("fuse", FuseCommandConfig, ["-", *teacher_words])
    scene = load_scene(scene_path)
    teacher = build_teacher(config.teacher, scene, words_of(config.teacher, config.text))
    views = scene.views
    assert views is not None
    source = teacher if maps is None else CachedTeacher(teacher, maps)
    if maps is not None:
        maps.mkdir(parents=True, exist_ok=True)
    rows = [source.feature_map(views, view).rows() for view in range(len(views))]
    return np.concatenate([each[np.isfinite(each[:, 0])] for each in rows])


def reduce_to_published(features: np.ndarray, threshold: float) -> np.ndarray:
    return reduce_as_published(unit_rows(features), threshold)[0]


def reduce_to_cover(features: np.ndarray, threshold: float) -> np.ndarray:
    cover = CoverReduction(features.shape[1], threshold)
    cover.add(features)
    return cover.rows


def transcription(features: np.ndarray, threshold: float) -> np.ndarray:
    """Algorithm 1, line by line, with the last chunk."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    components, used = [], np.zeros(len(unit), bool)
    for start in range(0, len(unit), CHUNK):
        similarities = unit[start : start + CHUNK] @ unit.T
        for j, row in enumerate(similarities, start=start):
            if not used[j]:
                neighbors = np.flatnonzero(row >= threshold)
                if not used[neighbors].any():
                    components.append(j)
                    used[neighbors] = True
    return np.array(components, np.int64)


def nearest_cosines(features: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """For each feature the cosine with the nearest component."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    parts = [unit[start : start + CHUNK] @ unit[rows].T for start in range(0, len(unit), CHUNK)]
    return np.concatenate([part.max(axis=1) for part in parts])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--thresholds", type=float, nargs="*", default=[0.8, 0.9])
    parser.add_argument("--teacher", nargs="*", default=["teacher=dinov2_s14"], help="settings of the teacher")
    parser.add_argument("--maps", type=Path)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--replicas", type=int, default=0)
    add_json_option(parser)
    arguments = parser.parse_args()
    features = raw_features(arguments.scene, arguments.teacher, arguments.maps)
    features = features[even_indices(len(features), arguments.rows)]
    print(f"{len(features):,} features of {features.shape[1]} channels")
    if arguments.replicas:
        of_many(features, arguments.thresholds, arguments.replicas)
        of_many_as_published(features, arguments.thresholds, arguments.replicas)
        return
    print("| θ | algorithm | seconds | × | components | coverage | mean cosine | same set |")
    print("|---|---|---|---|---|---|---|---|")
    figures: dict[str, dict[str, float]] = {}
    for threshold in arguments.thresholds:
        start = time.perf_counter()
        published = transcription(features, threshold)
        reference = time.perf_counter() - start
        rows = [("transcription", reference, published)]
        for name, reduce in (("paper", reduce_to_published), ("cover", reduce_to_cover)):
            seconds = []
            for _ in range(arguments.repeats):
                start = time.perf_counter()
                made = reduce(features, threshold)
                seconds.append(time.perf_counter() - start)
            rows.append((name, min(seconds), made))
        for name, each, made in rows:
            best = nearest_cosines(features, made)
            figures[f"{name}, {threshold}"] = {
                "faster": reference / each,
                "components": len(made),
                "coverage": (best >= threshold - 1e-6).mean(),
                "cosine": best.mean(),
            }
            print(
                f"| {threshold} | {name} | {each:.2f} | {reference / each:.1f} | {len(made):,} | "
                f"{(best >= threshold - 1e-6).mean():.3f} | {best.mean():.3f} | "
                f"{'yes' if np.array_equal(made, published) else 'no'} |",
                flush=True,
            )
    write_figures(arguments.json, figures)


def of_many(features: np.ndarray, thresholds: list[float], replicas: int) -> None:
    """Covers of many features that are never all in memory."""
    for threshold in thresholds:
        rng, start, before = np.random.default_rng(0), time.perf_counter(), peak_memory()
        cover = CoverReduction(features.shape[1], threshold)
        deviation = 0.1 * features.std(axis=0)
        for _ in range(replicas):
            for part in np.array_split(features, 50):
                noise = rng.standard_normal(part.shape, np.float32)
                cover.add(part + noise * deviation)
        print(
            f"θ = {threshold}: {replicas * len(features):,} features to {len(cover):,} components in "
            f"{time.perf_counter() - start:.1f} s; peak {peak_memory():.0f} MB, {before:.0f} MB before"
        )


def of_many_as_published(features: np.ndarray, thresholds: list[float], replicas: int) -> None:
    """Algorithm 1 over many features in a file that is mapped into memory. Pages of the file are the system's, which
    drops them when memory is short; what the process holds itself is measured beside them."""
    for threshold in thresholds:
        rng, start = np.random.default_rng(0), time.perf_counter()
        deviation = 0.1 * features.std(axis=0)
        with RowFile(features.shape[1]) as file:
            for _ in range(replicas):
                for part in np.array_split(features, 50):
                    file.append(unit_rows(part + rng.standard_normal(part.shape, np.float32) * deviation))
            before = own_memory()
            watch = MemoryWatch()
            with watch:
                made, _ = reduce_as_published(file.array(), threshold)
        print(
            f"θ = {threshold}, paper: {replicas * len(features):,} features to {len(made):,} components in "
            f"{time.perf_counter() - start:.1f} s; own memory at most {watch.highest:.0f} MB, {before:.0f} MB before",
            flush=True,
        )


class MemoryWatch:
    """The largest own memory of this process while it runs, looked at ten times a second."""

    def __enter__(self) -> "MemoryWatch":
        self.highest, self._stop = own_memory(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def _look(self) -> None:
        while not self._stop.wait(0.1):
            self.highest = max(self.highest, own_memory())

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def own_memory() -> float:
    """Megabytes of this process that are not pages of a file."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["RssAnon"].split()[0]) / 1e3


def peak_memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
