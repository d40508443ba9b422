"""Selected Gaussians against the true ones of labeled rooms, and what is left of an object that was taken out.

    python bench/selections.py ROOM … [--weights house] [--every 4] [--alone]
    python bench/selections.py ROOM … --boxes [--splats FOLDER]

Every n-th view of a room is left out; the others give seeds, and features of the labels teacher, and of an encoder.
The names of the small objects that are seen well enough are selected together (--alone: each by a call of its own), and
compared with the objects of that name. The truth of a Gaussian is the instance on whose pixels most of its blending
weight falls in the views that were left out; as in fusion, entries that measured depth says are hidden do not count.
For each object are printed, for its first box and for what it has grown to:

    IoU       of the selected and the true Gaussians, over those with a weight of one pixel or more,
    weighted  the same, each Gaussian counting with its weight,
    kept      the blending weight that true Gaussians have in the object's pixels after the removal of the selected
              ones, as a share of what they had before,
    PSNR      between renders before and after, outside of the object's mask dilated by three pixels, over the views
              that were left out and are changed.

`other views` is the IoU that the views that were not left out reach themselves, if their own instance maps label the
Gaussians: no selection from features of these views can be expected to be better.

--boxes localizes the names of all objects that are seen well enough, furniture too, in features of the labels teacher
(all views): on seeds, or on FOLDER/ROOM/splat.ply. Clusters at 1.5 spacings are compared with the default: boxes a
thing, of names that one object has, and the accuracy of first boxes.
"""

import argparse
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from json_option import add_json_option, write_figures
from scipy.ndimage import binary_dilation

from gsencoder.core.errors import SceneWarning
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.benchmarks.localization import is_seen, queryable_objects, score_boxes
from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.lift import VisibilityConfig, keep_visible
from gsencoder.infer.encode import Encoder
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.select import select
from gsencoder.render import Blend, blend
from gsencoder.render.images import render_image
from gsencoder.teachers.build import words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import Words, words_of_table
from gsencoder.types import GaussianFeatures, Gaussians, Scene, SceneObject, Views

MIN_WEIGHT = 1.0
"""Pixels that a Gaussian must cover for its label to count."""
MARGIN = 3
"""Pixels by which masks are dilated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What some views say of the Gaussians.

    Attributes:
        labels: the instance of each, 0 = none.
        weights: its visible blending weight, pixels.
    """

    labels: np.ndarray
    weights: np.ndarray


def truth_of(gaussians: Gaussians, views: Views, blends: Sequence[Blend] | None, instances: int) -> Truth:
    """The instance on whose pixels most of each Gaussian's visible blending weight falls."""
    sums = torch.zeros(len(gaussians), instances)
    for view in range(len(views)):
        b = blends[view] if blends is not None else blend(gaussians, views.cameras, view)
        codes = torch.from_numpy(np.asarray(views.instances[view]).astype(np.int32).ravel())
        keep_visible(b, views.depths[view], VisibilityConfig()).lift_codes_into(codes, sums)
    found = sums.numpy()
    return Truth(labels=found.argmax(axis=1), weights=found.sum(axis=1))


def ious(selected: np.ndarray, true: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """IoU over the Gaussians that are shown well enough, and weighted IoU over all."""
    shown = weights >= MIN_WEIGHT
    count = (selected & true & shown).sum() / max(1, ((selected | true) & shown).sum())
    return float(count), float(weights[selected & true].sum() / max(weights[selected | true].sum(), 1e-9))


def removal(
    gaussians: Gaussians, views: Views, blends: Sequence[Blend], selected: np.ndarray, true: np.ndarray, instance: int
) -> tuple[float, float]:
    """What is kept of an object, and the PSNR outside of it."""
    rest = gaussians.select(~selected)
    left = torch.from_numpy(true[~selected].astype(np.float32))
    marked, given = (torch.from_numpy(each.astype(np.float32)) for each in (true, selected))
    before = after = error = 0.0
    pixels = 0
    for view, b in enumerate(blends):
        mask = np.asarray(views.instances[view]) == instance
        inside = torch.from_numpy(mask.ravel())
        before += float(b.render(marked)[inside].sum())
        if not (b.render(given) > 1e-3).any():
            after += float(b.render(marked)[inside].sum())
            continue
        without = blend(rest, views.cameras, view)
        after += float(without.render(left)[inside].sum())
        outside = ~binary_dilation(mask, iterations=MARGIN) if mask.any() else ~mask
        pictures = [
            render_image(splat, views.cameras, view, blended=each).astype(np.float64) / 255
            for splat, each in ((gaussians, b), (rest, without))
        ]
        error += float(((pictures[0] - pictures[1])[outside] ** 2).mean(axis=1).sum())
        pixels += int(outside.sum())
    psnr = 10 * np.log10(max(pixels, 1) / max(error, 1e-12 * max(pixels, 1)))
    return after / max(before, 1e-9), float(psnr)


def score(
    scene: Scene,
    left_out: Views,
    features: GaussianFeatures,
    words: Words,
    targets: Sequence[SceneObject],
    truth: Truth,
    blends: Sequence[Blend],
    *,
    alone: bool,
) -> dict[str, list[float]]:
    """The figures of each object, by their name."""
    asked = replace(scene, features={features.space.name: features})
    names = list(dict.fromkeys(target.name for target in targets if target.name))
    found = {}
    for group in [[name] for name in names] if alone else [names]:
        selection, localization = select(asked, group, words)
        for number, name in enumerate(group):
            first = [box for box in localization.boxes if box.query == name][:1]
            seeds = np.zeros(len(scene.gaussians), bool)
            if first:
                seeds[first[0].rows] = True
            found[name] = (seeds, selection.labels == number + 1)
    figures: dict[str, list[float]] = defaultdict(list)
    for target in targets:
        true = truth.labels == target.id
        for kind, selected in zip(("first box", "selected"), found[target.name], strict=True):
            count, weighted = ious(selected, true, truth.weights)
            figures[f"{kind}, IoU"].append(count)
            figures[f"{kind}, weighted"].append(weighted)
        kept, psnr = removal(scene.gaussians, left_out, blends, selected, true, target.id)
        figures["kept"].append(kept)
        figures["PSNR"].append(psnr)
    return dict(figures)


def count_boxes(rooms: Sequence[Path], splats: Path | None) -> dict[str, dict[str, float]]:
    """Boxes a thing and the accuracy of first boxes, by radius and kind of object."""
    words = words_of(LabelsConfig())
    configs = {"eps_spacings=1.5": LocalizeConfig(eps_spacings=1.5), "default": LocalizeConfig()}
    found: dict[str, list[tuple[bool, float, float]]] = defaultdict(list)
    seconds: dict[str, float] = defaultdict(float)
    for path in rooms:
        scene = with_gaussians(load_scene(path, splat=splats / path.name / "splat.ply" if splats else None))
        features = fuse(scene, LabelsConfig().build(scene, words)).features
        scene = replace(scene, features={features.space.name: features})
        targets = [each for each in scene.objects if each.name and is_seen(each, min_views=5, min_pixels=60)]
        names = sorted({target.name for target in targets if target.name})
        of_name = Counter(each.name for each in scene.objects)
        for label, config in configs.items():
            start = time.perf_counter()
            localization = localize(scene, names, words, config)
            seconds[label] += time.perf_counter() - start
            boxes = Counter(box.query for box in localization.boxes)
            for target, hit in zip(targets, score_boxes(scene, localization, targets), strict=True):
                count = boxes[hit.name] if of_name[hit.name] == 1 else np.nan
                found[label].append((target.placed, count, hit.iou))
        print(f"{path.name}: {len(scene.gaussians)} Gaussians, {len(targets)} objects", flush=True)
    figures = {}
    print("\n| radius | objects | | boxes a thing | Acc@0.25 | Acc@0.5 | mean IoU |\n|---|---|---|---|---|---|---|")
    for label, rows in found.items():
        placed, counts, ious = np.array(rows).T
        for kind, chosen in (("placed", placed == 1), ("furniture", placed == 0), ("all", placed >= 0)):
            figure = {
                "objects": int(chosen.sum()),
                "boxes": float(np.nanmean(counts[chosen])),
                "Acc@0.25": float((ious[chosen] >= 0.25).mean()),
                "Acc@0.5": float((ious[chosen] >= 0.5).mean()),
                "mean IoU": float(ious[chosen].mean()),
            }
            values = [f"{value:.3f}" for name, value in figure.items() if name != "objects"]
            print(f"| {label} | {kind} | {figure['objects']} | {' | '.join(values)} |")
            figures[f"{label}, {kind}"] = figure
    print("seconds of localizing: " + ", ".join(f"{label} {value:.1f}" for label, value in seconds.items()))
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", type=Path)
    parser.add_argument("--weights", default="house")
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--boxes", action="store_true")
    parser.add_argument("--splats", type=Path)
    add_json_option(parser)
    arguments = parser.parse_args()
    retain_freed_memory()
    warnings.simplefilter("ignore", SceneWarning)
    if arguments.boxes:
        write_figures(arguments.json, count_boxes(arguments.rooms, arguments.splats))
        return
    words, encoder = words_of(LabelsConfig()), Encoder.load(arguments.weights)
    space, table = next(iter(encoder.tables.items()))
    totals: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for path in arguments.rooms:
        start = time.perf_counter()
        scene = load_scene(path)
        out = list(range(arguments.every // 2, len(scene.views), arguments.every))
        left_out = scene.views.select(out)
        kept = [view for view in range(len(scene.views)) if view not in out]
        scene = with_gaussians(replace(scene, views=scene.views.select(kept)))
        targets = queryable_objects(scene.objects)
        blends = [blend(scene.gaussians, left_out.cameras, view) for view in range(len(left_out))]
        instances = max(each.id for each in scene.objects) + 1
        truth = truth_of(scene.gaussians, left_out, blends, instances)
        others = truth_of(scene.gaussians, scene.views, None, instances)
        for target in targets:
            count, weighted = ious(others.labels == target.id, truth.labels == target.id, truth.weights)
            totals["other views"]["IoU"].append(count)
            totals["other views"]["weighted"].append(weighted)
        unit = unit_of(scene)
        sources = {
            "fused": (fuse(scene, LabelsConfig().build(scene, words)).features, words),
            "encoded": (
                encoder.encode(scene.gaussians, space=space, metres_per_unit=unit, up=scene.up),
                words_of_table(table),
            ),
        }
        for name, (features, own) in sources.items():
            figures = score(scene, left_out, features, own, targets, truth, blends, alone=arguments.alone)
            for key, values in figures.items():
                totals[name][key] += values
            listing = ", ".join(f"{key} {np.mean(values):.3f}" for key, values in figures.items())
            print(f"{scene.name} {name}: {len(targets)} objects, {listing}", flush=True)
        print(f"{scene.name}: {time.perf_counter() - start:.0f} s", flush=True)
    print("\n| features | figure | mean | median | worst |\n|---|---|---|---|---|")
    written: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    for name, table in totals.items():
        for key, values in table.items():
            worst = max(values) if key == "kept" else min(values)
            written[name][key] = {"mean": np.mean(values), "median": np.median(values), "worst": worst}
            print(f"| {name} | {key} | " + " | ".join(f"{each:.3f}" for each in written[name][key].values()) + " |")
    write_figures(arguments.json, written)


if __name__ == "__main__":
    main()
