"""What an encoder does with kinds of things that it was never trained on.

    python bench/unseen_kinds.py without HOUSE OUT --kinds mug,banana
    torchrun --nproc_per_node=2 -m gsencoder train OUT experiment=house_cpu out=encoder
    python bench/unseen_kinds.py score HOUSE --kinds mug,banana --weights encoder [--rooms 'train_04*']

`without` copies labeled rooms without the objects of some kinds: their pixels, and those beside them, are masked, so
that neither seeds nor targets come from them, and objects.json does not list them. `score` localizes names in the whole
rooms:

- the unseen kinds in every room that has them, since no room showed them to the encoder,
- the other placed objects in the rooms of --rooms, which were not trained on either,
- wrong names: for each object of an unseen kind, every other unseen kind that its room lacks; a hit is a first box that
  overlaps the object by 0.25,

with the fixed threshold of 0.5 and with the adaptive default, and with `localize.min_probability` of 0 and 0.02.
Standard errors are over rooms.
"""

import argparse
import fnmatch
import json
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation

from gsencoder.core.errors import SceneWarning
from gsencoder.core.runtime.heap import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.boxes import queryable_objects, score_boxes
from gsencoder.evaluate.sources import FeatureSource, encoder_source, fusion_source, with_features
from gsencoder.fusion.teachers.build import text_table_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.load_encoder import load_encoder
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.infer.localize.threshold import ThresholdConfig
from gsencoder.text.build import Words
from gsencoder.types import Scene

RIM = 2
"""Pixels around an object that are masked with it: compressed photographs mix colors across outlines."""
SETTINGS = {
    "fixed": LocalizeConfig(threshold=ThresholdConfig(kind="fixed")),
    "fixed, every box": LocalizeConfig(threshold=ThresholdConfig(kind="fixed"), min_probability=0),
    "adaptive": LocalizeConfig(),
    "adaptive, every box": LocalizeConfig(min_probability=0),
}


def write_without(source: Path, target: Path, kinds: Sequence[str]) -> int:
    """Copies a room without the objects of some kinds; returns the number of these objects."""
    shutil.copytree(source, target)
    objects = json.loads((source / "objects.json").read_text())
    left_out = [each["id"] for each in objects if each["name"] in kinds]
    transforms = json.loads((source / "transforms.json").read_text())
    (target / "masks").mkdir()
    for number, frame in enumerate(transforms["frames"]):
        instances = np.asarray(Image.open(source / frame["instance_file_path"]))
        hidden = binary_dilation(np.isin(instances, left_out), iterations=RIM)
        frame["mask_path"] = f"masks/{number:03d}.png"
        Image.fromarray(np.where(hidden, 0, 255).astype(np.uint8)).save(target / frame["mask_path"])
    (target / "transforms.json").write_text(json.dumps(transforms))
    kept = [each for each in objects if each["name"] not in kinds]
    (target / "objects.json").write_text(json.dumps(kept))
    return len(left_out)


def hits_of(scene: Scene, words: Words, kinds: Sequence[str], *, unseen: bool) -> dict[str, list[tuple[str, float]]]:
    """For each setting, and for wrong names, the name and IoU of each queried object of a scene with features."""
    targets = [
        each
        for each in queryable_objects(scene.objects, min_views=5, min_pixels=60)
        if each.name is not None and (each.name in kinds) == unseen
    ]
    if not targets:
        return {}
    present = {each.name for each in scene.objects}
    wrong = [kind for kind in kinds if kind not in present] if unseen else []
    names = sorted({str(each.name) for each in targets})
    rows: dict[str, list[tuple[str, float]]] = {}
    for setting, config in SETTINGS.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)
            found = localize(scene, [*names, *wrong], words, config)
        rows[setting] = [(str(hit.name), hit.iou) for hit in score_boxes(scene, found, targets)]
        rows[f"{setting}: wrong names"] = [
            (str(target.name), hit.iou)
            for word in wrong
            for target in targets
            for renamed in [replace(target, name=word)]
            for hit in score_boxes(replace(scene, objects=(renamed,)), found, [renamed])
        ]
    return rows


def report(title: str, rooms: list[dict[str, list[tuple[str, float]]]]) -> None:
    """Prints Acc@0.25 and Acc@0.5 of each setting over all objects, with the standard error over rooms."""
    for setting in sorted({setting for room in rooms for setting in room}):
        parts = [np.array([iou for _, iou in room[setting]]) for room in rooms if room.get(setting)]
        if not parts:
            continue
        ious = np.concatenate(parts)
        accuracy = float((ious >= 0.25).mean())
        spread = [float(((part >= 0.25) - accuracy).sum()) for part in parts]
        error = float(np.sqrt(np.square(spread).sum())) / len(ious)
        print(
            f"{title}, {setting}: {len(ious)} in {len(parts)} rooms, Acc@0.25 {accuracy:.3f} ± {error:.3f}, "
            f"Acc@0.5 {(ious >= 0.5).mean():.3f}"
        )
    adaptive = [hit for room in rooms for hit in room.get("adaptive, every box", [])]
    by_name = {
        name: [iou >= 0.25 for other, iou in adaptive if other == name] for name in sorted({hit[0] for hit in adaptive})
    }
    print(f"{title}, adaptive, every box: " + ", ".join(f"{k} {sum(v)}/{len(v)}" for k, v in by_name.items()))


def score(paths: Sequence[Path], held_out: str, source: FeatureSource, words: Words, kinds: Sequence[str]) -> None:
    unseen, seen = [], []
    for path in paths:
        scene = load_scene(path)
        test = fnmatch.fnmatch(path.name, held_out)
        if not test and not any(each.name in kinds for each in scene.objects):
            continue
        scene, features, _ = with_features(scene, source, SeedConfig())
        scene = replace(scene, features={features.space.name: features})
        unseen.append(hits_of(scene, words, kinds, unseen=True))
        if test:
            seen.append(hits_of(scene, words, kinds, unseen=False))
    report("unseen kinds", unseen)
    report("other kinds", seen)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("without", "score"))
    parser.add_argument("house", type=Path)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--kinds", required=True)
    parser.add_argument("--weights", help="an encoder; without it features are fused from labels")
    parser.add_argument("--rooms", default="train_04*")
    arguments = parser.parse_args()
    kinds = arguments.kinds.split(",")
    rooms = sorted(path for path in arguments.house.iterdir() if path.is_dir())
    if arguments.action == "without":
        assert arguments.out is not None, "without needs OUT"
        count = sum(write_without(room, arguments.out / room.name, kinds) for room in rooms)
        print(f"{count} objects left out of {len(rooms)} rooms")
        return
    retain_freed_memory()
    words = text_table_of(LabelsConfig())
    assert words is not None
    source = (
        encoder_source(load_encoder(arguments.weights)) if arguments.weights else fusion_source(LabelsConfig(), words)
    )
    score(rooms, arguments.rooms, source, words, kinds)


if __name__ == "__main__":
    main()
