"""Runs that are killed at random moments, and given again: what they end with, beside a run that nobody killed.

    python bench/kills.py SCENE [--kills 25] [--seed 0] [--cases fuse train reconstruct]

SCENE is a labeled RGB-D scene. Each case is run once to its end, then again, killed (SIGKILL) after a random share of
the time that it took, until the kills are used up, and then to its end. An out= folder that is there must hold whole
results, and results must be the same arrays to the last bit.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from gsencoder.data.splats import load_splat


def commands(scene: Path) -> dict[str, tuple[list[str], str]]:
    """The words of each case, without out=, and the file that holds its result."""
    small = ["model.transformer.encoder_channels=[32,32,32,32,32]", "model.transformer.decoder_channels=[32,32,32,32]"]
    model = ["teacher=dinov2_s14", "teacher.size=224", "seeds.voxel=0.04", "fusion.views=12"]
    train = [
        "train.steps=40",
        "train.warmup=2",
        "train.checkpoint_every=1",
        "sampling.gaussians=4000",
        "seeds.voxel=0.05",
        *small,
    ]
    fit = ["optimize.steps=60", "checkpoint_every=1", "seeds.voxel=0.05", "data.image_scale=0.5"]
    words = "teacher.words=clip_vitb32_names.npz"
    return {
        "fuse": (["fuse", str(scene), *model], "features.safetensors"),
        "train": (["train", str(scene), words, "tensorboard=false", *train], "encoder.safetensors"),
        "reconstruct": (["reconstruct", str(scene), *fit], "splat.ply"),
    }


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    if path.suffix == ".ply":
        splat = load_splat(path)
        return {name: getattr(splat, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    return dict(load_file(path))


def killed(words: list[str], out: Path, kills: int, seconds: float, rng: random.Random) -> int:
    """Kills a run so many times, and then lets it end; how many of the kills met a run that was still at work."""
    done = 0
    command = [sys.executable, "-m", "gsencoder", *words, f"out={out}", "quiet=true"]
    while done < kills:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        time.sleep(rng.uniform(0.05, 1.0) * seconds)
        if process.poll() is not None:
            assert process.returncode == 0, process.stderr.read().decode() if process.stderr else ""
            break
        process.kill()
        process.wait()
        if out.exists():
            # It came after the results, which are whole or not there: the caller compares them.
            break
        done += 1
    if not out.exists():
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--kills", type=int, default=25)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="*", default=["fuse", "train", "reconstruct"])
    given = parser.parse_args()
    rng, left = random.Random(given.seed), given.kills
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases = {case: commands(given.scene.resolve())[case] for case in given.cases}
        references, seconds = {}, {}
        for case, (words, result) in cases.items():
            began = time.perf_counter()
            killed(words, folder / "whole" / case, 0, 0.0, rng)
            references[case], seconds[case] = arrays_of(folder / "whole" / case / result), time.perf_counter() - began
        counts, number = dict.fromkeys(cases, 0), 0
        while left:
            case = list(cases)[number % len(cases)]
            words, result = cases[case]
            out = folder / str(number) / case
            out.parent.mkdir()
            done = killed(words, out, min(left, 3), seconds[case], rng)
            left, number, counts[case] = left - done, number + 1, counts[case] + done
            got = arrays_of(out / result)
            assert got.keys() == references[case].keys()
            for array in got:
                np.testing.assert_array_equal(got[array], references[case][array], err_msg=f"{case}: {array}")
    print(f"{given.kills} kills ({', '.join(f'{case} {count}' for case, count in counts.items())}): nothing lost")


if __name__ == "__main__":
    main()
