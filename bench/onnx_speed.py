"""An exported encoder under onnxruntime against the same under torch: seconds, memory, and how soon the first answer.

    python bench/onnx_speed.py MODEL.onnx SCENE [--weights house] [--sizes 20000,100000]

Each figure is of a process of its own, which reads the model, encodes the Gaussians that are nearest to the middle of
the scene once, and then again and again; the two take turns. Seconds are the best of the later passes, memory is the
process's peak, and "cold" runs from the start of the process to its first features.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from json_option import add_json_option, write_figures

ROUNDS, PASSES = 3, 5


def measure(model: str, splat: str) -> dict[str, float]:
    """One process's figures; runs in the child."""
    from gsencoder.core.process import peak_memory_mb, retain_freed_memory
    from gsencoder.data.splats.files import load_splat
    from gsencoder.infer.encode import EncodeConfig, Encoder

    gaussians = load_splat(splat)
    retain_freed_memory()
    encoder = Encoder.load(model, "cpu")
    # A file computes in what it was exported in.
    config = EncodeConfig(chunk=0, precision="auto" if model.endswith(".onnx") else "float32", device="cpu")
    encoder.encode_spaces(gaussians, config)
    # Linux counts a process's start in clock ticks since boot.
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    cold = float(Path("/proc/uptime").read_text().split()[0]) - ticks / os.sysconf("SC_CLK_TCK")
    seconds = []
    for _ in range(PASSES):
        start = time.perf_counter()
        encoder.encode_spaces(gaussians, config)
        seconds.append(time.perf_counter() - start)
    return {"seconds": min(seconds), "peak": peak_memory_mb(), "cold": cold}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model")
    parser.add_argument("scene")
    parser.add_argument("--weights", default="house")
    parser.add_argument("--sizes", default="20000,100000")
    parser.add_argument("--child", action="store_true")
    add_json_option(parser)
    chosen = parser.parse_args()
    if chosen.child:
        print(json.dumps(measure(chosen.model, chosen.scene)))
        return
    import numpy as np

    from gsencoder.data.scenes import load_scene
    from gsencoder.data.seeding.seed import with_gaussians
    from gsencoder.data.splats.files import save_splat

    everything = with_gaussians(load_scene(chosen.scene)).gaussians
    far = np.linalg.norm(everything.means - np.median(everything.means, axis=0), axis=1)
    figures: dict[int, dict[str, float]] = {}
    for size in map(int, chosen.sizes.split(",")):
        with TemporaryDirectory() as folder:
            part = everything.select(np.sort(np.argsort(far, kind="stable")[:size]))
            save_splat(Path(folder) / "part.ply", part)
            found: dict[str, list[dict[str, float]]] = {"torch": [], "onnx": []}
            for _ in range(ROUNDS):
                for engine, model in (("torch", chosen.weights), ("onnx", chosen.model)):
                    words = [sys.executable, __file__, model, f"{folder}/part.ply", "--child"]
                    done = subprocess.run(words, capture_output=True, text=True, check=True)
                    found[engine].append(json.loads(done.stdout))
        print(f"{len(part):,} Gaussians")
        figures[size] = {}
        for key in ("seconds", "peak", "cold"):
            theirs, ours = (statistics.median(each[key] for each in found[name]) for name in ("torch", "onnx"))
            figures[size][key], figures[size][f"{key} / torch"] = ours, ours / theirs
            print(f"  {key}: torch {theirs:.3f}, onnxruntime {ours:.3f}, ratio {ours / theirs:.2f}")
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    main()
