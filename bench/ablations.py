"""The ablations that the papers report, on the house scenes: short trainings that differ in one setting each.

    python bench/ablations.py HOUSE --prepared outputs/house_cpu.prepared [--out outputs/ablations] [--only render]
                                    [--steps 1000] [--processes 2]

Every training is `experiment=house_cpu` but for its steps and what is listed below; `recipe` is what the others are
held against. A training that is in OUT already is not done again, so that the table grows over several calls.
Accuracies are averaged over the names of the held-out scenes; the peak of memory is that of one process.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

GROUPS: dict[str, dict[str, list[str]]] = {
    "recipe": {f"as it is, seed {seed}": [f"train.seed={seed}"] for seed in range(3)},
    "render": {f"without L_render, seed {seed}": [f"train.seed={seed}", "loss.render_weight=0"] for seed in range(3)},
    "contrast": {"without L_contrast": ["loss.contrast_weight=0"], "L_contrast alone": ["loss.field_weight=0"]},
    "selection": {
        "whole frusta": ["sampling.gaussians=0"],
        "whole scenes": ["sampling.scope=scene", "sampling.gaussians=0"],
    },
    "views": {"1 target view": ["sampling.views=1"], "8 target views": ["sampling.views=8"]},
    "patch": {"patch 32": ["model.transformer.patch=32"], "patch 512": ["model.transformer.patch=512"]},
    "inputs": {
        "color alone": ["model.inputs=[color]"],
        "color and offset": ["model.inputs=[color,offset]"],
        "without color": ["model.inputs=[offset,opacity,scale,rotation]"],
        "without rotation": ["model.inputs=[offset,color,opacity,scale]"],
    },
}
SHARE_OF_STEPS = {"whole frusta": 0.35, "whole scenes": 0.1}
"""Larger samples take longer; so many of the steps take about the time that the others do."""


def train(arguments: argparse.Namespace, group: str, name: str, overrides: list[str]) -> dict[str, object]:
    """One training, unless it has been done; its row of the table."""
    out = Path(arguments.out) / group / name.replace(" ", "_").replace(",", "")
    steps = max(20, round(arguments.steps * SHARE_OF_STEPS.get(name, 1.0)))
    if not (out / "summary.json").is_file():
        launcher = [sys.executable, "-m"]
        if arguments.processes > 1:
            launcher += ["torch.distributed.run", "--standalone", f"--nproc_per_node={arguments.processes}", "-m"]
        words = ["gsencoder", "train", arguments.scenes, "experiment=house_cpu", f"prepared={arguments.prepared}"]
        words += [f"out={out}", f"train.steps={steps}", "train.validate_every=0", "tensorboard=false", "quiet=true"]
        subprocess.run([*launcher, *words, *overrides], check=True)
    found = json.loads((out / "summary.json").read_text())
    results = found["results"]
    return {
        "group": group,
        "setting": name,
        "steps": results["steps"],
        "seconds": round(results["seconds"]),
        "peak_mib": round(found["peak_memory_mb"]),
        "names": round(results["validation"]["names"], 3),
        "cosine": round(results["validation"]["cosine_named"], 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--prepared", required=True)
    parser.add_argument("--out", default="outputs/ablations")
    parser.add_argument("--only", default="", help="groups, separated by commas")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    chosen = arguments.only.split(",") if arguments.only else list(GROUPS)
    print("| group | setting | steps | seconds | peak MiB | names | cosine of named |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for group in chosen:
        for name, overrides in GROUPS[group].items():
            row = train(arguments, group, name, overrides)
            print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
