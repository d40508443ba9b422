"""Views chosen of the objects of labeled scenes: held against instance masks, and against full-size renders.

    python bench/views.py SCENE … [--candidates 16,32,64] [--furniture]

Objects are found by their names in features of the labels teacher. Among the scene's own frames, 8 chosen ones are
held against the 8 with most pixels of the object by its instance mask, and against 8 that are evenly spread. Views
around objects are rendered at full size with all accuracy. Seconds are of choosing, from the loaded scene on. With
--furniture the objects are named pieces of 20 cm or more in every direction that are part of the room.
"""

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.pretrained import find_file
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.benchmarks.localization import queryable_objects
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.localize import localize
from gsencoder.infer.views.candidates import FreeSpace
from gsencoder.infer.views.choose import choose_views, score_views
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet, targets_of
from gsencoder.render import BlendConfig
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.table import load_text_table
from gsencoder.types import Scene, SceneObject

COUNT = 8
WORDS = "clip_vitb32_names.npz"


def furniture(objects: Sequence[SceneObject]) -> list[SceneObject]:
    """Named pieces of the room itself that many frames show well and that are no surfaces."""
    return [
        one
        for one in objects
        if not one.placed
        and one.name
        and one.views >= COUNT
        and one.max_pixels >= 1500
        and (one.aabb_max - one.aabb_min).min() >= 0.2
    ]


def objects_of(path: str, large: bool) -> tuple[Scene, list[tuple[Target, SceneObject]]]:
    """A scene with Gaussians, and what was found of its objects, for comparison with the labels."""
    words = load_text_table(find_file(WORDS, "words"))
    scene = with_gaussians(load_scene(path))
    features = fuse(scene, LabelsConfig(words=WORDS).build(scene, words)).features
    scene = replace(scene, features={features.space.name: features})
    asked = furniture(scene.objects) if large else queryable_objects(scene.objects)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        found = localize(scene, list(dict.fromkeys(one.name for one in asked if one.name)), words)
    pairs = []
    for target in targets_of(scene.gaussians, found):
        same = [one for one in scene.objects if one.name == target.name]
        away = [np.linalg.norm((one.aabb_min + one.aabb_max) / 2 - scene.origin - target.center) for one in same]
        nearest = same[int(np.argmin(away))]
        # Another one of the name may have been found, which is not among those that frames show well.
        if any(one.id == nearest.id for one in asked):
            pairs.append((target, nearest))
    # Frames are judged as renders, as they are when features are all that there is.
    return replace(scene, views=replace(scene.views, images=None)), pairs


def pixels_of(scene: Scene, one: SceneObject) -> np.ndarray:
    """Pixels of an object in each frame, by its instance mask."""
    return np.array([int((mask == one.id).sum()) for mask in scene.views.instances])


def measured(scene: Scene, target: Target, chosen: ViewSet) -> dict[str, np.ndarray]:
    """What full renders of chosen views show."""
    (seen,) = score_views(scene.gaussians, chosen.cameras, [target], side=640, config=BlendConfig())
    free = FreeSpace(scene.gaussians).seen_by(scene.views.cameras)
    centers = chosen.cameras.centers
    return {
        "visible": seen.visible >= 0.9,
        "share": (seen.share >= 0.05) & (seen.share <= 0.6),
        "alpha": seen.alpha >= 0.9,
        "free": (free.clearance(centers) > 0) & free.seen_empty(centers),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--candidates", default="16,32,64")
    parser.add_argument("--furniture", action="store_true")
    add_json_option(parser)
    chosen = parser.parse_args()
    counts = [int(count) for count in chosen.candidates.split(",")]
    frames: dict[str, list[float]] = {"greedy": [], "uniform": []}
    shells: dict[int, list[dict[str, np.ndarray]]] = {count: [] for count in counts}
    seconds: dict[int, list[float]] = {count: [] for count in counts}
    covered: dict[int, list[float]] = {count: [] for count in counts}
    failed: dict[int, list[str]] = {count: [] for count in counts}
    for path in chosen.scenes:
        scene, pairs = objects_of(path, chosen.furniture)
        for target, one in pairs:
            pixels = pixels_of(scene, one)
            best = np.sort(pixels)[::-1][:COUNT].sum()
            for method in ("greedy", "uniform"):
                config = ViewsConfig(source="frames", method=method, candidates=max(64, COUNT))
                views = choose_views(scene, [target], config)
                frames[method].append(float(pixels[[each.frame for each in views.chosen]].sum() / best))
            for count in counts:
                config = ViewsConfig(source="shells", candidates=count)
                start = time.perf_counter()
                try:
                    views = choose_views(scene, [target], config)
                except InputError as error:
                    failed[count].append(f"{scene.name} {target.name}: {error}")
                    continue
                seconds[count].append(time.perf_counter() - start)
                covered[count].append(views.chosen[-1].covered)
                shells[count].append(measured(scene, target, views))
                told = {name: int(good.sum()) for name, good in shells[count][-1].items()}
                print(
                    f"{scene.name} {target.name}: {len(views)} of {views.judged} of {count}, {told}; "
                    f"frames {frames['greedy'][-1]:.3f}, {frames['uniform'][-1]:.3f}",
                    flush=True,
                )
    figures: dict[str, dict[str, float]] = {}
    for method, ratios in frames.items():
        good = np.mean(np.array(ratios) >= 0.9)
        figures[f"frames, {method}"] = {"mean": np.mean(ratios), "least": min(ratios), "at 0.9": good}
        print(
            f"frames, {method}: {np.mean(ratios):.3f} of the best {COUNT}'s pixels, least {min(ratios):.3f}, "
            f"{good:.2f} of {len(ratios)} objects at 0.9"
        )
    for count in counts:
        total = len(shells[count]) + len(failed[count])
        told, shares = [], {}
        for name in ("visible", "share", "alpha", "free"):
            enough = sum(each[name].sum() >= COUNT - 1 for each in shells[count])
            mean = np.concatenate([each[name] for each in shells[count]]).mean()
            shares[name] = enough / total
            told.append(f"{name} {enough / total:.2f} ({mean:.3f} of views)")
        every = sum(np.logical_and.reduce(list(each.values())).sum() >= COUNT - 1 for each in shells[count])
        figures[f"shells of {count}"] = {**shares, "all": every / total, "covered": np.mean(covered[count])}
        print(
            f"shells of {count}: in 7 of 8 views {', '.join(told)}; all of it {every / total:.2f} of "
            f"{total} objects; "
            f"covered {np.mean(covered[count]):.3f}; {np.median(seconds[count]):.2f} s, most {max(seconds[count]):.2f}"
        )
        for line in failed[count]:
            print(f"  {line}")
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    main()
