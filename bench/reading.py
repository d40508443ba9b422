"""How often a reader who follows `fuse`, `encode` and `localize` changes files, and comes back to one he has left.

    python bench/reading.py

One call of each on a synthetic room of three views (`fuse` of a dense teacher, with a work folder) is recorded with
sys.setprofile on the main thread, and only the package's functions count. A stay is a run of consecutive calls in one
file; a return is a stay in a file that an earlier stay was in. Three counts for each stage:

    itself      the calls that the stage's function makes itself, repeated calls (one for each view) included
    two levels  these and the calls that they make, each function at its first call only
    all         every function that is called, at its first call only
"""

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from json_option import add_json_option, write_figures
from synthetic_teacher import SyntheticTeacher

import gsencoder
from gsencoder import encode, fuse, load_weights, localize
from gsencoder.data.synthetic import make_room
from gsencoder.models.weights import SHIPPED_WEIGHTS
from gsencoder.text.table import load_text_table

PACKAGE = str(Path(gsencoder.__file__).parent)


class ExpensiveTeacher(SyntheticTeacher):
    """Its maps are cached, as those of a backbone are."""

    cheap = False


def record(stage: Callable[[], Any]) -> list[tuple[int, str, str]]:
    """Depth below the stage's function, file, and function of each call; generators count each time they resume."""
    calls: list[tuple[int, str, str]] = []
    stack: list[FrameType] = []

    def profile(frame: FrameType, event: str, _: Any) -> None:
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return
        if event == "call":
            calls.append((len(stack), frame.f_code.co_filename, frame.f_code.co_qualname))
            stack.append(frame)
        elif event == "return" and stack:
            stack.pop()

    sys.setprofile(profile)
    try:
        stage()
    finally:
        sys.setprofile(None)
    return calls


def stays(calls: list[tuple[int, str, str]], levels: int, *, repeats: bool) -> tuple[int, int]:
    """Stays and returns of the calls down to some level below the stage's function."""
    chosen = [(file, name) for depth, file, name in calls if depth <= levels]
    files = [file for file, _ in (chosen if repeats else dict.fromkeys(chosen))]
    runs = [file for file, _ in itertools.groupby(files)]
    return len(runs), len(runs) - len(set(runs))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_json_option(parser)
    options = parser.parse_args()
    figures: dict[str, dict[str, int]] = {}
    scene = make_room(views=3)
    assert scene.gaussians is not None
    teacher = ExpensiveTeacher(channels=96, rank=8)
    encoder, outputs, _ = load_weights("house_cpu")
    words = load_text_table(SHIPPED_WEIGHTS / "house_cpu" / "words.safetensors")
    features = encode(scene.gaussians, encoder, outputs)
    encoded = replace(scene, features={features.space.name: features})
    with tempfile.TemporaryDirectory() as folder:
        stages = {
            "fuse": lambda: fuse(scene, teacher, work=Path(folder) / "work"),
            "encode": lambda: encode(scene.gaussians, encoder, outputs),
            "localize": lambda: localize(encoded, ["table"], words),
        }
        print(f"{'stays / returns':16}{'itself':>10}{'two levels':>14}{'all':>10}")
        for name, stage in stages.items():
            fuse(scene, teacher)  # Modules that are imported on first use are no part of the walk.
            calls = record(stage)
            start = next(index for index, (_, _, function) in enumerate(calls) if function == name)
            calls = calls[start:]
            counts = [stays(calls, 1, repeats=True), stays(calls, 2, repeats=False), stays(calls, 99, repeats=False)]
            figures[name] = {"stays": counts[0][0], "returns": counts[0][1]}
            print(
                f"{name:16}"
                + "".join(f"{f'{n} / {again}':>{w}}" for (n, again), w in zip(counts, (10, 14, 10), strict=True))
            )
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
