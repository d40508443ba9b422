"""Whether budgets of encoding hold, and what choosing costs.

    python bench/encode_budgets.py SCENE… [--errors 0.001,0.003,0.01] [--weights house] [--chunk 250000]

A line for each scene and limit: the setting, the error that was predicted, its bound, the error on a tenth of the
Gaussians, drawn after the choice, and over all of them; CPU seconds of choosing, of the encoding, and of preset=exact.
Kernels are compiled before, on a few Gaussians.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
from budgets import summary_of
from json_option import add_json_option, write_figures

from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.basis import field_error, judge
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.encode_budget import EncodeBudget, encode_within


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--errors", default="0.001,0.003,0.01")
    parser.add_argument("--weights", default="house")
    parser.add_argument("--chunk", type=int, default=EncodeConfig().chunk)
    parser.add_argument("--out", type=Path, default=Path("encode_budgets.csv"))
    add_json_option(parser)
    given = parser.parse_args()
    retain_freed_memory()
    encoder = Encoder.load(given.weights)
    config, lines = EncodeConfig(chunk=given.chunk), []
    for path in given.scenes:
        scene = with_gaussians(load_scene(path), SeedConfig())
        gaussians, unit = scene.gaussians, unit_of(scene)
        for precision in encoder.precisions("auto"):
            few = gaussians.select(np.arange(min(1000, len(gaussians))))
            encoder.encode_spaces(few, EncodeConfig(precision=precision), metres_per_unit=unit)
        exact, cpu_exact = None, 0.0
        for error in map(float, given.errors.split(",")):
            budget = EncodeBudget(error=error)
            made = encode_within(
                gaussians, encoder, list(encoder.spaces), config, budget, metres_per_unit=unit, clock=time.process_time
            )
            if exact is None:
                start = time.process_time()
                exact = encoder.encode_spaces(gaussians, made.exact, metres_per_unit=unit)
                cpu_exact = time.process_time() - start
            lines.append(
                {
                    "scene": scene.name,
                    "gaussians": len(gaussians),
                    "limit": error,
                    "precision": made.choice.setting.precision,
                    "halo": made.choice.setting.halo,
                    "predicted": made.choice.estimate.error,
                    "bound": made.choice.estimate.bound,
                    "realised": max(judge(made.features[name], exact[name]).total for name in exact),
                    "over_all": max(field_error(made.features[name], exact[name], sample=0).total for name in exact),
                    "cpu_choosing": made.choosing,
                    "cpu_encoding": made.seconds - made.choosing,
                    "cpu_exact": cpu_exact,
                    "choosing_of_exact": made.choosing / cpu_exact,
                }
            )
            print(lines[-1], flush=True)
    with given.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        for line in lines:
            writer.writerow({key: f"{value:.4g}" if isinstance(value, float) else value for key, value in line.items()})
    write_figures(given.json, summary_of(lines))


if __name__ == "__main__":
    main()
