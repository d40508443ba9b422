"""What checksums cost a training: seconds in the checks of mapped scenes, beside the seconds of the steps.

    python bench/checksums.py SCENE… [--steps 30] [--options experiment=house_cpu …]

Every block is checked when it is first read, so a short run over few scenes is the worst case: all of its steps meet
blocks that nobody has read. Samples are made in the process that trains.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from gsencoder.app import main as cli
from gsencoder.core import archive as mapped_arrays

CHECKED = {"seconds": 0.0, "bytes": 0.0, "calls": 0.0}


def timed(data: Any, checksums: str, blocks: Any = None) -> list[int]:
    began = time.perf_counter()
    wrong = plain(data, checksums, blocks)
    CHECKED["seconds"] += time.perf_counter() - began
    CHECKED["bytes"] += len(blocks) * mapped_arrays.BLOCK_BYTES
    CHECKED["calls"] += 1
    return wrong


plain = mapped_arrays.damaged_blocks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--options", nargs="*", default=[])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = ["train", *given.scenes, *given.options, f"prepared={folder}/prepared", "quiet=true", "holdout="]
        assert cli.main([*run, "prepare_only=true"]) == 0
        mapped_arrays.damaged_blocks = timed
        steps = [f"train.steps={given.steps}", "train.warmup=1", "train.workers=0", "train.validate_every=0"]
        assert cli.main([*run, f"out={folder}/out", *steps, "tensorboard=false"]) == 0
        seconds = json.loads((Path(folder) / "out" / "summary.json").read_text())["results"]["seconds"]
    print(
        f"{given.steps} steps in {seconds:.1f} s; {CHECKED['bytes'] / 2**20:.0f} MiB checked in "
        f"{CHECKED['seconds']:.3f} s ({CHECKED['calls']:.0f} calls): {CHECKED['seconds'] / seconds:.2%} of a step"
    )


if __name__ == "__main__":
    main()
