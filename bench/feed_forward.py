"""Memories of unseen rooms in one pass, against dense features of the same encoder and fused ones.

    python bench/feed_forward.py ROOM … [--weights house] [--bank-rooms ROOM …]

An encoder predicts features of each room; its queries are their principal coordinates. They attend to a bank of the
room's own views, which the labels teacher has looked at, so that it holds the names that are in the room; or to one of
all views of --bank-rooms, which the room has no part in. The index memory is a table of the predicted features alone.
"Per scene" rows are made from the room's own labels. Names: as `gsencoder evaluate protocol=naming`; bytes: of a
Gaussian, without bank or table.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.evaluate.benchmarks.naming import compare_names, naming_scores
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.encode import Encoder
from gsencoder.memory.bank import MapStream, build_bank, principal_queries
from gsencoder.memory.index import index_features
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.vocabulary import words_of_table
from gsencoder.train.memory import MemoryConfig, memory_training, prepare_memory, train_memory
from gsencoder.types import FeatureMap, QueryMemory, Scene

WIDTHS = (16, 32)


def maps_of(scenes: list[tuple[Scene, Teacher]]) -> MapStream:
    """The maps of all views of some scenes."""

    def stream() -> Iterator[tuple[int, FeatureMap]]:
        for scene, teacher in scenes:
            for view in range(len(scene.views)):
                yield view, teacher.feature_map(scene.views, view)

    return stream


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", type=Path)
    parser.add_argument("--weights", default="house")
    parser.add_argument("--bank-rooms", nargs="*", default=[], type=Path)
    parser.add_argument("--optimize", action="store_true", help="also optimize a memory of each room")
    add_json_option(parser)
    arguments = parser.parse_args()
    encoder, labels = Encoder.load(arguments.weights), LabelsConfig()
    teacher_name = next(name for name, space in encoder.spaces.items() if space.teacher == "labels")
    words = words_of_table(encoder.tables[teacher_name])
    others = [load_scene(path) for path in arguments.bank_rooms]
    shared_maps = maps_of([(scene, labels.build(scene, words)) for scene in others])
    results, seconds = defaultdict(list), defaultdict(list)
    for path in arguments.rooms:
        scene = with_gaussians(load_scene(path), SeedConfig())
        teacher = labels.build(scene, words)
        assert isinstance(teacher, LabelsTeacher)
        truth = fuse(scene, teacher).features
        start = time.perf_counter()
        unit = unit_of(scene)
        dense = encoder.encode(scene.gaussians, space=teacher_name, metres_per_unit=unit)
        seconds["encoded, dense"].append(time.perf_counter() - start)
        made = {"encoded, dense": (dense, 2 * dense.features.shape[1])}
        start = time.perf_counter()
        index = index_features(dense).features
        seconds["encoded, index"].append(time.perf_counter() - start)
        made["encoded, index"] = (index, 1 if len(index.features) < 256 else 2)
        banks = {"its own bank": maps_of([(scene, teacher)])}
        if others:
            banks["a bank of other rooms"] = shared_maps
        for name, stream in banks.items():
            start = time.perf_counter()
            bank = build_bank(stream, dense.space, dense.mean)
            bank_seconds = time.perf_counter() - start
            for width in WIDTHS:
                start = time.perf_counter()
                queries, projection = principal_queries(dense, bank, width)
                features = QueryMemory(
                    queries=queries,
                    weights=dense.weights,
                    projection=projection,
                    bank=bank,
                    scoring="centered",
                    temperature=0.05,
                    mean=dense.mean,
                    basis=dense.basis,
                ).features()
                key = f"encoded queries of {width}, {name}"
                seconds[key].append(time.perf_counter() - start + bank_seconds)
                made[key] = (features, 2 * width)
        made["per scene, fused, dense"] = (truth, 2 * truth.features.shape[1])
        made["per scene, fused, index"] = (index_features(truth).features, 1)
        if arguments.optimize:
            start = time.perf_counter()
            with tempfile.TemporaryDirectory() as work:
                prepared = prepare_memory(scene, teacher, Path(work) / "labels")
                memory = train_memory({"a": prepared}, MemoryConfig(), memory_training(), work=Path(work))[0]["a"]
            made["per scene, queries of 16, optimized"] = (memory.features(), 32)
            seconds["per scene, queries of 16, optimized"].append(time.perf_counter() - start)
        for key, (features, size) in made.items():
            counts = compare_names(truth, features, teacher)
            results[key].append((counts, size))
    print(
        "| features | names | centered cosine with fused | bytes a Gaussian | seconds a room |\n|---|---|---|---|---|"
    )
    figures = {}
    for key, rows in results.items():
        scored = naming_scores([counts for counts, _ in rows])
        spent = f"{np.mean(seconds[key]):.2f}" if key in seconds else ""
        cosine = np.nanmean([counts.cosine for counts, _ in rows])
        size = np.mean([size for _, size in rows])
        print(f"| {key} | {scored['accuracy_named']:.3f} | {cosine:.3f} | {size:.0f} | {spent} |")
        figures[key] = {"names": scored["accuracy_named"], "cosine": cosine, "bytes a Gaussian": size}
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
