"""What a basis that was fitted on some scenes keeps of a teacher's vectors elsewhere, for several ranks.

    python bench/basis.py HOUSE [--others PLUSH KITCHEN] [--fit 32] [--held-out 8] [--views 3] [--views-of-others 16]

HOUSE is a folder of rooms: the basis is fitted to maps of the first rooms, and applied to those of the last ones and of
the other scenes. The teacher is DINOv2-S as in conf/teacher/dinov2_s14.yaml. No encoder in the basis can come closer to
the teacher than these figures, which are those of `gsencoder train` and `encode basis_views=`.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.arrays import even_indices
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.fusion.basis import Moments, fit_basis
from gsencoder.fusion.errors import ProjectionSums
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import build_teacher

RANKS = (16, 32, 64, 128, 192, 256, 320, 384)


def vectors_of(scenes: list[Path], teacher: Teacher, count: int) -> Iterator[np.ndarray]:
    """The teacher's vectors in `count` evenly spaced views of each scene, a map at a time."""
    for path in scenes:
        views = load_scene(path).views
        assert views is not None
        for view in even_indices(len(views), count):
            rows = teacher.feature_map(views, int(view)).rows()
            yield rows[np.isfinite(rows[:, 0])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house")
    parser.add_argument("--others", nargs="*", default=[])
    parser.add_argument("--fit", type=int, default=32, help="rooms that the basis is fitted to")
    parser.add_argument("--held-out", type=int, default=8, help="rooms, the last ones, that it is applied to")
    parser.add_argument("--views", type=int, default=3, help="views of a room")
    parser.add_argument("--views-of-others", type=int, default=16, help="views of another scene")
    add_json_option(parser)
    arguments = parser.parse_args()
    rooms = find_scenes((arguments.house,))
    config = compose("train", TrainCommandConfig, ["-", "teacher=dinov2_s14"])
    teacher = build_teacher(config.teacher, load_scene(rooms[0]), None)

    fitted = list(vectors_of(rooms[: arguments.fit], teacher, arguments.views))
    moments = Moments(teacher.space.channels)
    for rows in fitted:
        moments.add(rows)
    covariance = moments.covariance()
    bases = [fit_basis(moments.mean, covariance, teacher.space, energy=1.0, max_rank=rank) for rank in RANKS]

    sources = {"rooms of the fit": iter(fitted)}
    sources["other rooms"] = vectors_of(rooms[-arguments.held_out :], teacher, arguments.views)
    for path in arguments.others:
        sources[Path(path).name] = vectors_of([Path(path)], teacher, arguments.views_of_others)
    print("| vectors of | rank | energy kept | mean cosine | worst 5 % below |")
    print("|---|---|---|---|---|", flush=True)
    figures: dict[str, dict[int, dict[str, float]]] = {}
    for name, maps in sources.items():
        sums = [ProjectionSums() for _ in bases]
        for rows in maps:
            for each, basis in zip(sums, bases, strict=True):
                each.add(basis, rows)
        for each, basis in zip(sums, bases, strict=True):
            fit = each.fit()
            found = {"energy": fit.energy, "cosine": fit.cosine, "worst": fit.worst}
            figures.setdefault(name, {})[basis.rank] = found
            print(f"| {name} | {basis.rank} | {fit.energy:.3f} | {fit.cosine:.3f} | {fit.worst:.3f} |", flush=True)
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
