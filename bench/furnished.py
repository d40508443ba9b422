"""Names and boxes that an encoder finds in furnished rooms of makes that no training saw.

    python bench/furnished.py WEIGHTS LIBRARIES [--rooms 16] [--seed 1000] [--recolor gray] [--boxes] [--json FILE]
    python bench/furnished.py WEIGHTS OTHER.sh3f --makes all --boxes         # a library that no training saw
    python bench/furnished.py WEIGHTS LIBRARIES --kinds chair,mug --boxes    # kinds that were left out of the training

A make is one model of the libraries; one in four of each kind with three or more is held out of every training. The
splat of each home is what a walk sees, as seeds of 2 cm. `things` is the share of Gaussians of held-out makes whose
most probable name, of all kinds, is the right one, and `broader` that of those with the right one or a broader word for
it ("chair" for an office chair); `structure` is that of walls, floors and ceilings; `boxes` the share of those things
for whose name the first box has an IoU of 0.25 or more with one of them; with --kinds, `wrong` is the same for names of
theirs that the home lacks. Means over homes, with the standard error.
"""

import argparse
import json
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from errors import comma_separated, one_line_errors, positive

from gsencoder.core.errors import SceneWarning
from gsencoder.data.furnished.kinds import STRUCTURE, kinds
from gsencoder.data.furnished.library import Model, held_out_models, load_libraries, select_makes
from gsencoder.data.furnished.plan import Home, plan_home
from gsencoder.data.furnished.walk import LabeledSplat, furnished_splat, splat_walk
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.infer.encode import Encoder
from gsencoder.infer.localize import localize, spacing_of
from gsencoder.infer.relevancy import relevancy
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

VOXEL = 0.02
SMALLEST = 30
"""Gaussians that a thing must have to be asked for."""
RECOLORS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": lambda sh: sh,
    "permuted": lambda sh: sh[:, :, [2, 0, 1]],
    "gray": lambda sh: np.repeat(sh.mean(axis=2, keepdims=True), 3, axis=2),
    "inverted": lambda sh: -sh,
}


def made_homes(models: Sequence[Model], seed: int, count: int) -> Iterator[tuple[LabeledSplat, np.ndarray, list[str]]]:
    """Homes of these models: the Gaussians with their items, their kinds, and the kind of each item."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        home = plan_home(models, rng)
        labels = furnished_splat(home, splat_walk(home), VOXEL, rng)
        yield labels, kinds_of(labels, home), [item.kind for item in home.items]


def kinds_of(labels: LabeledSplat, home: Home) -> np.ndarray:
    """The number of the kind of each Gaussian."""
    every = list(kinds())
    return np.array([every.index(item.kind) for item in home.items])[labels.items]


def names_of(features: GaussianFeatures, words: TextTable) -> np.ndarray:
    """The number of the kind that is the most probable name of each Gaussian."""
    return relevancy(features, words.encode(list(kinds())), words.mean).argmax(axis=0)


def classes_of_kinds(classes: Sequence[str]) -> np.ndarray:
    """Which classes [C] name each kind [K]: by its name, a synonym or a broader word. "building" names no thing of a
    room, but is a broader word for walls."""
    return np.array(
        [
            [name in (*kind.words, *kind.hypernyms) and name != "building" for name in classes]
            for kind in kinds().values()
        ]
    )


def found_boxes(
    scene: Scene, labels: LabeledSplat, names: Sequence[str], words: TextTable, absent: Sequence[str] = ()
) -> tuple[list[bool], list[bool]]:
    """For each thing of some names, whether the first box of its name overlaps one of that name, and whether that of
    each name that no thing has overlaps it."""
    assert scene.gaussians is not None
    means, spacing = scene.gaussians.means, spacing_of(scene.gaussians)
    boxes: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
    for item, name in enumerate(names):
        rows = np.flatnonzero(labels.items == item)
        if name and len(rows) >= SMALLEST:
            boxes[name].append((means[rows].min(axis=0).astype(float), means[rows].max(axis=0).astype(float)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        result = localize(scene, [*boxes, *absent], words, spacing=spacing) if boxes else None
    first = {box.query: (box.aabb_min, box.aabb_max) for box in reversed(result.boxes)} if result else {}
    hits, wrong = [], []
    for name, of_name in boxes.items():
        best = max((aabb_iou(*first[name], *box) for box in of_name), default=0.0) if name in first else 0.0
        hits += [best >= 0.25] * len(of_name)
        wrong += [other in first and aabb_iou(*first[other], *box) >= 0.25 for box in of_name for other in absent]
    return hits, wrong


def summary(values: Sequence[float]) -> dict[str, float]:
    known = np.array([value for value in values if np.isfinite(value)])
    return {"mean": float(known.mean()), "standard_error": float(known.std(ddof=1) / len(known) ** 0.5)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("libraries", type=Path)
    parser.add_argument("--rooms", type=positive, default=16)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--recolor", action="append", choices=list(RECOLORS), default=None)
    parser.add_argument("--boxes", action="store_true")
    parser.add_argument("--makes", choices=["held_out", "all"], default="held_out")
    parser.add_argument("--kinds", type=comma_separated, default=[])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    every = load_libraries([arguments.libraries])
    everything = arguments.makes == "all" or bool(arguments.kinds)
    held, models = held_out_models(every), select_makes(every, "all" if everything else "held_out")
    scored = sorted({model.kind.name for model in every if everything or model.id in held} - set(STRUCTURE))
    scored = [name for name in scored if name in arguments.kinds or not arguments.kinds]
    encoder = Encoder.load(arguments.weights)
    words = encoder.words
    assert words is not None
    space = next(iter(encoder.tables))
    names = list(kinds())
    structure = np.array([name in STRUCTURE for name in names])
    fits = classes_of_kinds(names)
    table: dict[str, dict[str, list[float]]] = {each: defaultdict(list) for each in arguments.recolor or ["as it is"]}
    of_kind: dict[str, list[float]] = defaultdict(lambda: [0, 0])
    for number, (labels, codes, of_items) in enumerate(made_homes(models, arguments.seed, arguments.rooms)):
        asked = [kind if kind in scored else "" for kind in of_items]
        thing = np.array([bool(each) for each in asked])[labels.items]
        for title, rows in table.items():
            gaussians = labels.gaussians()
            gaussians = replace(gaussians, sh=RECOLORS[title](gaussians.sh).astype(np.float32))
            features = encoder.encode(gaussians, space=space, up=np.array([0.0, 0.0, 1.0]))
            predicted = names_of(features, words)
            right = predicted == codes
            rows["things"].append(float(right[thing].mean()) if thing.any() else np.nan)
            rows["broader"].append(float(fits[codes, predicted][thing].mean()) if thing.any() else np.nan)
            rows["structure"].append(float(right[structure[codes]].mean()))
            if title == "as it is":
                for code in np.unique(codes[thing]):
                    of_kind[names[code]][0] += int(right[thing & (codes == code)].sum())
                    of_kind[names[code]][1] += int((thing & (codes == code)).sum())
            if arguments.boxes:
                scene = Scene(
                    name=f"home {number}", gaussians=gaussians, features={features.space.name: features},
                    metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]),
                )  # fmt: skip
                absent = [name for name in arguments.kinds if name not in of_items]
                hits, wrong = found_boxes(scene, labels, asked, words, absent)
                rows["boxes"].append(float(np.mean(hits)) if hits else np.nan)
                if arguments.kinds:
                    rows["wrong"].append(float(np.mean(wrong)) if wrong else np.nan)
        line = {title: {key: round(values[-1], 3) for key, values in rows.items()} for title, rows in table.items()}
        print(f"home {number}: {len(codes):,} Gaussians, {line}", flush=True)
    figures = {title: {key: summary(values) for key, values in rows.items()} for title, rows in table.items()}
    print(f"{arguments.rooms} homes, {len(scored)} kinds scored")
    for title, of_title in figures.items():
        print(f"{title}: " + ", ".join(f"{k} {v['mean']:.3f} ± {v['standard_error']:.3f}" for k, v in of_title.items()))
    shares = sorted((right / total, name, total) for name, (right, total) in of_kind.items())
    print("by kind: " + ", ".join(f"{name} {share:.2f} ({total:,})" for share, name, total in shares))
    if arguments.json:
        arguments.json.write_text(json.dumps({"scored": scored, **figures}, indent=1))


if __name__ == "__main__":
    with one_line_errors():
        main()
