"""Reductions of raw features to principal scene components, against a transcription of M3's Algorithm 1.

    python bench/reduction.py SCENE [--rows 100000] [--thresholds 0.8 0.9] [--teacher teacher=dinov2_s14]
        [--maps FOLDER] [--repeats 2]

Raw features are those of the teacher's maps of all views, evenly thinned to --rows. The transcription compares chunks
of 5,000 rows with all others by float32 matrix products on all cores. Each figure of a reduction is the fastest of
--repeats. --maps keeps the teacher's maps for the next time.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.arrays import even_indices
from gsencoder.data.scenes import load_scene
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.memory.reduction import CoverReduction, reduce_algorithm1, unit_rows
from gsencoder.teachers.build import words_of

CHUNK = 5000


def raw_features(scene_path: Path, teacher_words: list[str], maps: Path | None) -> np.ndarray:
    """The vectors of all cells of all views, in order."""
    config = compose("fuse", FuseCommandConfig, ["-", *teacher_words])
    scene = load_scene(scene_path)
    teacher = config.teacher.build(scene, words_of(config.teacher, config.text))
    views = scene.views
    source = teacher if maps is None else CachedTeacher(teacher, maps)
    if maps is not None:
        maps.mkdir(parents=True, exist_ok=True)
    rows = [source.feature_map(views, view).rows() for view in range(len(views))]
    return np.concatenate([each[np.isfinite(each[:, 0])] for each in rows])


def reduce_to_published(features: np.ndarray, threshold: float) -> np.ndarray:
    return reduce_algorithm1(unit_rows(features), threshold)[0]


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
    add_json_option(parser)
    arguments = parser.parse_args()
    features = raw_features(arguments.scene, arguments.teacher, arguments.maps)
    features = features[even_indices(len(features), arguments.rows)]
    print(f"{len(features):,} features of {features.shape[1]} channels")
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


if __name__ == "__main__":
    main()
