"""The ablations that the papers report, on the house scenes: short trainings that differ in one setting each.

    python bench/ablations.py HOUSE --prepared outputs/house_cpu.prepared [--out outputs/ablations] [--only render]
                                    [--settings 'all cells'] [--seeds 0] [--steps 1000] [--processes 2]

Every training is `experiment=house_cpu` but for its steps and what is listed below; `recipe` is what the others are
held against. A training that is in OUT already is not done again, so that the table grows over several calls. `letter`
takes back every departure from SplatDistill; settings of preparation have prepared scenes of their own, beside those of
--prepared, which are made when they are missing (`--prepare-only` makes them and stops).
Accuracies are averaged over the names of the held-out scenes; the peak of memory is that of one process.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from pathlib import Path

from errors import one_line_errors, positive

from gsencoder.core.errors import listed
from gsencoder.train.samples import AugmentConfig

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
NO_CONTRAST = ["loss.contrast_weight=0", "loss.confidence=false"]
"""Terms that are in typical distances from the mean, and therefore off where targets are not scaled."""
NO_AUGMENTATION = [f"augment.{name}=0" for name in AugmentConfig.__dataclass_fields__]
LETTER: dict[str, list[str]] = {
    # Fusion: what is fused, and in which coordinates targets are.
    "lift of centers": ["prepare.fusion.lift=center", "prepare.fusion.visibility.against=[rendered]"],
    "all channels": ["prepare.fusion.basis=false"],
    "not scaled": ["prepare.scale=false", *NO_CONTRAST],
    "not centered": ["prepare.center=false", "prepare.fusion.basis=false", "loss.confidence=false"],
    "neither": ["prepare.center=false", "prepare.scale=false", "prepare.fusion.basis=false", *NO_CONTRAST],
    "all weights of B": ["prepare.render_min_weight=0"],
    # The network.
    "stem of 5³": ["model.stem=5"],
    "one linear layer": ["model.projector=0"],
    "shuffled at each pooling": ["model.transformer.shuffle_orders=pooling"],
    "never shuffled": ["model.transformer.shuffle_orders=never"],
    # Losses.
    "plain Eq. 3": ["loss.confidence=false"],
    "plain Eq. 3 without contrast": NO_CONTRAST,
    "smooth L1 of 0.1": ["loss.smooth_l1=0.1"],
    "without contrast": ["loss.contrast_weight=0"],
    "equal weights": ["loss.rarity=0"],
    "composited not divided": ["loss.divide_by_alpha=false"],
    "all cells": ["loss.min_alpha=1e-6", "loss.min_kept=1e-6"],
    "sum over 3 views": ["loss.render_weight=0.6"],
    # Training.
    "even centers": ["sampling.rare_centers=0"],
    "whole frusta": ["sampling.gaussians=0"],
    "without augmentation": NO_AUGMENTATION,
    "all of the paper": ["experiment=[house_cpu,splatdistill]", "model=tiny"],
}
"""Every departure of the defaults and of `house_cpu` from SplatDistill, taken back by itself, and all of them. Those
that compare with another row than `recipe`: "not scaled" and "neither" with "plain Eq. 3 without contrast", "not
centered" with "plain Eq. 3"."""
GROUPS["letter"] = {
    f"{name}, seed {seed}": [*overrides, f"train.seed={seed}"]
    for name, overrides in LETTER.items()
    for seed in range(2)
}
SHARE_OF_STEPS = {"whole frusta": 0.35, "whole scenes": 0.1, "all of the paper": 0.35}
"""Larger samples take longer; so many of the steps take about the time that the others do."""


def prepared_folder(prepared: str, overrides: list[str]) -> str:
    """The folder of scenes that are prepared with these settings; settings of preparation have folders of their own."""
    settings = [word for word in overrides if word.startswith(("prepare.", "experiment="))]
    return f"{prepared}.{hashlib.sha256(' '.join(settings).encode()).hexdigest()[:8]}" if settings else prepared


def command(arguments: argparse.Namespace, overrides: list[str]) -> list[str]:
    """The command of a training with these settings."""
    words = [sys.executable, "-m"]
    if arguments.processes > 1:
        words += ["torch.distributed.run", "--standalone", f"--nproc_per_node={arguments.processes}", "-m"]
    words += ["gsencoder", "train", arguments.scenes, f"prepared={prepared_folder(arguments.prepared, overrides)}"]
    if not any(word.startswith("experiment=") for word in overrides):
        words.append("experiment=house_cpu")
    return [*words, *overrides, "tensorboard=false", "quiet=true"]


def run(words: list[str]) -> None:
    """Runs a command of gsencoder, also under torchrun.

    Each of its processes prints the line of an error, after which torchrun prints its report and a traceback of its
    own: only the first of these lines is shown.

    Raises:
        CalledProcessError: the command failed.
    """
    after: list[str] = []
    refused = False
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, errors="replace") as process:
        assert process.stderr is not None
        for line in process.stderr:
            if refused:
                after.append(line)
            else:
                print(line, end="", file=sys.stderr, flush=True)
            refused = refused or line.startswith("error: ")
    if process.returncode:
        raise subprocess.CalledProcessError(2 if refused else process.returncode, words)
    print(*after, sep="", end="", file=sys.stderr)


def choose(
    parser: argparse.ArgumentParser, only: list[str], settings: list[str], seeds: list[str]
) -> list[tuple[str, str, list[str]]]:
    """The trainings of groups, settings and seeds, each with its group, name and overrides; an empty list chooses all.

    A word that matches nothing ends the script.
    """

    def check(option: str, noun: str, words: list[str], known: list[str]) -> None:
        unknown = [word for word in words if word not in known]
        if unknown:
            parser.error(
                f"{option} {','.join(unknown)}: no such {noun}; there are: {listed(known, limit=40) or 'none'}"
            )

    check("--only", "group", only, list(GROUPS))
    groups = only or list(GROUPS)
    parts = [name.partition(", seed ") for group in groups for name in GROUPS[group]]
    check("--settings", "setting of these groups", settings, list(dict.fromkeys(setting for setting, _, _ in parts)))
    check("--seeds", "seed", seeds, sorted({seed for _, _, seed in parts if seed}))
    rows = [
        (group, name, overrides)
        for group in groups
        for name, overrides in GROUPS[group].items()
        if (not settings or name.split(", seed")[0] in settings) and (not seeds or name.rpartition(" ")[2] in seeds)
    ]
    if not rows:
        names = [name for group in groups for name in GROUPS[group] if name.split(", seed")[0] in settings]
        parser.error(f"--seeds {','.join(seeds)}: none of these settings has it; they are: {listed(names, limit=40)}")
    return rows


def train(arguments: argparse.Namespace, group: str, name: str, overrides: list[str]) -> dict[str, object]:
    """One training, unless it has been done; its row of the table."""
    out = Path(arguments.out) / group / name.replace(" ", "_").replace(",", "")
    share = SHARE_OF_STEPS.get(name.split(", seed")[0], 1.0)
    steps = max(min(20, arguments.steps), round(arguments.steps * share))
    if not (out / "summary.json").is_file():
        words = [f"out={out}", f"train.steps={steps}", "train.validate_every=0"]
        run([*command(arguments, overrides), *words])
    summary = json.loads((out / "summary.json").read_text())
    results = summary["results"]
    return {
        "group": group,
        "setting": name,
        "steps": results["steps"],
        "seconds": round(results["seconds"]),
        "peak_mib": round(summary["peak_memory_mb"]),
        "names": round(results["validation"]["names"], 3),
        "cosine": round(results["validation"]["cosine_named"], 3),
    }


def prepare(arguments: argparse.Namespace, rows: list[list[str]]) -> None:
    """Prepares the scenes of all settings, each once."""
    for folder, overrides in {prepared_folder(arguments.prepared, row): row for row in rows}.items():
        start = time.monotonic()
        run([*command(arguments, overrides), "prepare_only=true"])
        print(f"{folder}: {time.monotonic() - start:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--prepared", required=True)
    parser.add_argument("--out", default="outputs/ablations")
    parser.add_argument("--only", default="", help="groups, separated by commas")
    parser.add_argument("--settings", default="", help="settings of these groups, separated by commas; empty = all")
    parser.add_argument("--seeds", default="", help="seeds, separated by commas; empty = all")
    parser.add_argument("--prepare-only", action="store_true", help="prepare the scenes that are missing, and stop")
    parser.add_argument("--steps", type=positive, default=1000)
    parser.add_argument("--processes", type=positive, default=2)
    arguments = parser.parse_args()
    given = (arguments.only, arguments.settings, arguments.seeds)
    rows = choose(parser, *(words.split(",") if words else [] for words in given))
    if arguments.prepare_only:
        prepare(arguments, [overrides for _, _, overrides in rows])
        return
    print("| group | setting | steps | seconds | peak MiB | names | cosine of named |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for group, name, overrides in rows:
        row = train(arguments, group, name, overrides)
        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    with one_line_errors():
        main()
