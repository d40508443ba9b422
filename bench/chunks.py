"""What encoding in chunks costs and changes: against the whole scene at once, and against the fused features.

    python bench/chunks.py SCENE… [--weights house_cpu] [--chunks 125000,80000,40000] [--halos 0,0.64,1.28]
    python bench/chunks.py SCENE --apart 100000 [--weights house_cpu]

Cosine: centered, with the features of the whole scene in float32. Names: `evaluate`'s protocol. Seconds are of `encode`
alone, warm.

--apart: that many Gaussians on surfaces, and as isolated ones on a line of 20 km; and the scene with itself 100 m away:
how far the features of the first move by the second, relative to their deviation from the mean. Each as one region with
complete neighborhoods in convolutions, and as `encode` does it.
"""

import argparse
import time
from contextlib import ExitStack
from dataclasses import fields, replace
from itertools import product
from unittest.mock import patch

import numpy as np
from encoder import surface
from json_option import add_json_option, write_figures
from per_scene import labeled, quality

from gsencoder.core.pretrained import find_file
from gsencoder.core.process import retain_freed_memory
from gsencoder.evaluate.boxes import accuracy
from gsencoder.evaluate.protocols.naming import naming_scores
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.fuse import fuse
from gsencoder.infer import chunks as chunks_module
from gsencoder.infer.chunks import EncodeConfig, cut, scene_regions
from gsencoder.infer.encode import encode
from gsencoder.models import neighbors
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpaces
from gsencoder.models.weights import load_weights
from gsencoder.text.table import load_text_table
from gsencoder.types import Gaussians


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--weights", default="house_cpu")
    parser.add_argument("--words", default="clip_vitb32_names.npz")
    parser.add_argument("--chunks", default="125000,80000,40000")
    parser.add_argument("--halos", default="0,0.64,1.28")
    parser.add_argument("--apart", type=int, metavar="COUNT")
    add_json_option(parser)
    chosen = parser.parse_args()
    retain_freed_memory()
    words = load_text_table(find_file(chosen.words, "words"))
    encoder, outputs, _ = load_weights(chosen.weights)
    if chosen.apart:
        room = labeled(chosen.scenes[0], words)[0].gaussians
        assert room is not None
        write_figures(chosen.json, apart(room, chosen.apart, encoder, outputs))
        return
    halos = [float(halo) for halo in chosen.halos.split(",")]
    settings = {
        "whole, float32": EncodeConfig(chunk=0, precision="float32"),
        "whole, bfloat16": EncodeConfig(chunk=0, precision="bfloat16"),
    }
    for chunk, halo in product(map(int, chosen.chunks.split(",")), halos):
        settings[f"chunks of {chunk:,}, halo {halo:g} m"] = EncodeConfig(chunk=chunk, halo=halo, precision="float32")
    rows: dict[str, list[tuple]] = {name: [] for name in settings}
    for path in chosen.scenes:
        scene, teacher = labeled(path, words)
        assert scene.gaussians is not None
        truth = fuse(scene, teacher).features
        whole = encode(scene.gaussians, encoder, outputs, settings["whole, float32"])
        for name, config in settings.items():
            start = time.perf_counter()
            found = encode(scene.gaussians, encoder, outputs, config)
            spent = time.perf_counter() - start
            regions = scene_regions(scene.gaussians.means, encoder.config.voxel)
            parts = len(cut(scene.gaussians.means, config.chunk, config.halo, regions))
            same = 1 - field_error(found, whole).centered
            rows[name].append((*quality(scene, truth, found, teacher, words), same, spent, parts))
    print("| setting | chunks | cosine with the whole | names | Acc@0.25 | seconds |\n|---|---|---|---|---|---|")
    figures = {}
    for name, each in rows.items():
        names = naming_scores([row[0] for row in each])["accuracy"]
        hits = accuracy([hit for row in each for hit in row[1]], 0.25)
        same, spent, parts = (float(np.mean([row[place] for row in each])) for place in (2, 3, 4))
        print(f"| {name} | {parts:.1f} | {same:.4f} | {names:.3f} | {hits:.3f} | {spent:.2f} |")
        figures[name] = {"chunks": parts, "cosine": same, "names": names, "Acc@0.25": hits, "seconds": spent}
    write_figures(chosen.json, figures)


def apart(room: Gaussians, count: int, encoder: GaussianEncoder, outputs: OutputSpaces) -> dict[str, dict[str, float]]:
    """Seconds and change of features of splats whose parts are far from one another."""
    dense = surface(count)
    line = np.arange(len(dense))[:, None] * np.array([20_000 / len(dense), 0, 0])
    far = replace(room, means=room.means + np.float32([100, 0, 0]))
    rooms = {each.name: np.concatenate((getattr(room, each.name), getattr(far, each.name))) for each in fields(room)}
    splats = {
        "dense": dense,
        "isolated": replace(dense, means=line.astype(np.float32)),
        "two rooms": Gaussians(**rooms),
    }
    config = EncodeConfig(precision="float32")
    alone = encode(room, encoder, outputs, config).features
    figures: dict[str, dict[str, float]] = {}
    print("| splat | Gaussians | how | seconds | CPU seconds | change of the first room |\n|---|---|---|---|---|---|")
    for (name, splat), how in product(splats.items(), ("as one", "by region")):
        with ExitStack() as stack:
            if how == "as one":
                one = np.zeros(len(splat), np.int64)
                stack.enter_context(patch.object(chunks_module, "scene_regions", lambda *_, one=one: one))
                stack.enter_context(patch.object(neighbors, "FEW_CELLS", np.inf))
            start, cpu_start = time.perf_counter(), time.process_time()
            features = encode(splat, encoder, outputs, config).features
            spent, cpu = time.perf_counter() - start, time.process_time() - cpu_start
        figures[f"{name}, {how}"] = {"seconds": spent, "CPU seconds": cpu}
        change = ""
        if name == "two rooms":
            deviation = np.linalg.norm(alone - alone.mean(axis=0))
            moved = float(np.linalg.norm(features[: len(room)] - alone) / deviation)
            figures[f"{name}, {how}"]["change"] = moved
            change = f"{moved:.3g}"
        print(f"| {name} | {len(splat):,} | {how} | {spent:.2f} | {cpu:.2f} | {change} |", flush=True)
    return figures


if __name__ == "__main__":
    main()
