"""Splats against the photographs of their scenes: are good ones left alone, and wrong frames called?

    python bench/fit.py SCENES… [--splats PATTERN] [--frames 3] [--json FILE]

Each scene is checked with its own seeds, and with the splat that PATTERN names, in which {scene} stands for the name of
its folder; where there is none, that is left out. In the first --frames scenes the splats are then put into wrong
frames: 23 orders and signs of the axes, half and twice the size, moved by a tenth of the extent along each axis where
that moves pictures by more than two pixels, and intrinsics of photographs of half and twice the size. A frame is called
if it is refused, and warned of if the scene is used with a warning. Seconds are those of the check alone, without the
first, in which kernels are compiled.
"""

import argparse
import time
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.fusion.fit import (
    SmallViews,
    SplatFrame,
    agreement,
    identity_frame,
    moved,
    usual_frames,
    with_fitting_splat,
)
from gsencoder.types import Gaussians, Scene


def outcome(scene: Scene, splat: Path) -> str:
    """refused, warned, or passed."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", SceneWarning)
        try:
            with_fitting_splat(scene, str(splat), SceneConfig())
        except InputError:
            return "refused"
        except SceneWarning:
            return "warned"
    return "passed"


def wrong_frames(scene: Scene, gaussians: Gaussians) -> list[SplatFrame]:
    """Frames that the splat is put into, named by their kind."""
    frames = [replace(frame, name=frame.name.split(" (")[0]) for frame in usual_frames()]
    assert scene.views is not None
    cameras = scene.views.cameras
    means = gaussians.means[np.linspace(0, len(gaussians) - 1, 2000).astype(int)]
    extent = np.quantile(means, 0.95, axis=0) - np.quantile(means, 0.05, axis=0)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = extent.max() / 10
        (here, depths), (there, _) = cameras.project(means), cameras.project(means + shift.astype(np.float32))
        seen = cameras.in_image(here, depths)
        if seen.any() and np.median(np.linalg.norm(here - there, axis=-1)[seen]) > 2:
            frames.append(replace(identity_frame(), name="moved by a tenth", shift=shift))
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--splats", default="")
    parser.add_argument("--frames", type=int, default=3)
    add_json_option(parser)
    args = parser.parse_args()
    good, correlations, seconds = Counter[str](), [], []
    wrong: dict[str, Counter[str]] = {}
    for number, path in enumerate(args.scenes):
        warnings.simplefilter("ignore")
        scene = load_scene(path)
        splats = {"seeds": with_gaussians(scene).gaussians}
        pattern = args.splats.replace("{scene}", path.name)
        if pattern and Path(pattern).is_file():
            splats["fitted"] = load_scene(path, splat=pattern).gaussians
        for kind, gaussians in splats.items():
            assert gaussians is not None
            with_splat = replace(scene, gaussians=gaussians)
            start = time.perf_counter()
            result = outcome(with_splat, path)
            seconds.append(time.perf_counter() - start)
            good[f"{kind} {result}"] += 1
            assert scene.views is not None
            fit = agreement(gaussians, SmallViews(scene.views), identity_frame(), scene.origin)
            correlations.append(fit.correlation)
            print(f"{path.name} {kind}: {len(gaussians):,} Gaussians, {fit.correlation:.2f}, {result}", flush=True)
            for frame in wrong_frames(scene, gaussians) if number < args.frames else ():
                if frame.intrinsics_factor != 1:
                    Ks = scene.views.cameras.Ks.copy()
                    Ks[:, :2] *= frame.intrinsics_factor
                    cameras = replace(scene.views.cameras, Ks=Ks)
                    placed = replace(with_splat, views=replace(scene.views, cameras=cameras))
                else:
                    placed = replace(with_splat, gaussians=moved(gaussians, frame, scene.origin))
                result = outcome(placed, path)
                wrong.setdefault(frame.name, Counter())[result] += 1
                if result == "passed":
                    print(f"  passed: {frame.name} {frame.rotation.tolist()} {frame.shift}", flush=True)
    print(f"good: {dict(good)}; smallest correlation {min(correlations):.2f}")
    print(f"seconds: median {np.median(seconds[1:] or seconds):.2f}, largest {max(seconds[1:] or seconds):.2f}")
    for name, counts in wrong.items():
        print(f"{name}: {dict(counts)}")
    write_figures(
        args.json,
        {
            "good": dict(good),
            "smallest": min(correlations),
            "wrong": {name: dict(each) for name, each in wrong.items()},
        },
    )


if __name__ == "__main__":
    main()
