"""What encoding in chunks costs and changes: against the whole scene at once, and against the fused features.

    python bench/chunks.py SCENE… [--weights house_cpu] [--chunks 125000,80000,40000] [--halos 0,0.64,1.28]

Cosine: centered, with the features of the whole scene in float32. Names: `evaluate`'s protocol. Seconds are of `encode`
alone, warm.
"""

import argparse
import time
from itertools import product

import numpy as np
from json_option import add_json_option, write_figures
from per_scene import labeled, quality

from gsencoder.core.files.model_files import find_file
from gsencoder.core.runtime.heap import retain_freed_memory
from gsencoder.evaluate.boxes import accuracy
from gsencoder.evaluate.protocols.naming import naming_scores
from gsencoder.fusion.feature_error import field_error
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.encode.chunks import EncodeConfig, cut
from gsencoder.infer.encode.encode import encode
from gsencoder.models.weights import load_weights
from gsencoder.text.table import load_text_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--weights", default="house_cpu")
    parser.add_argument("--words", default="clip_vitb32_names.npz")
    parser.add_argument("--chunks", default="125000,80000,40000")
    parser.add_argument("--halos", default="0,0.64,1.28")
    add_json_option(parser)
    chosen = parser.parse_args()
    retain_freed_memory()
    words = load_text_table(find_file(chosen.words, "words"))
    encoder, outputs, _ = load_weights(chosen.weights)
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
            parts = len(cut(scene.gaussians.means, config.chunk, config.halo))
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


if __name__ == "__main__":
    main()
