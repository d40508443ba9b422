"""What an encoder does with kinds of things that it was never trained on.

    python bench/unseen_kinds.py without HOUSE OUT --kinds mug,banana
    torchrun --nproc_per_node=2 -m gsencoder train OUT experiment=house_cpu out=encoder
    python bench/unseen_kinds.py score HOUSE --kinds mug,banana --weights encoder [--space labels] [--rooms 'train_04*']

`without` copies labeled rooms without the objects of some kinds: their pixels, and those beside them, are masked, so
that neither seeds nor targets come from them, and objects.json does not list them. A room appears in OUT once it is
whole. `score` localizes names in the whole rooms:

- the unseen kinds in every room that has them, since no room showed them to the encoder,
- the other placed objects in the rooms of --rooms, which were not trained on either,
- wrong names: for each object of an unseen kind, every other unseen kind that its room lacks; a hit is a first box that
  overlaps the object by 0.25,

with the fixed threshold of 0.5 and with the adaptive default, and with several levels of `localize.min_probability`. It
also prints how well the probability of a word's best box tells unseen kinds that are in a room from those that are not,
and how it is calibrated on them. Standard errors are over rooms.
"""

import argparse
import fnmatch
import json
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from errors import comma_separated, existing_folder, one_line_errors, output_folder
from PIL import Image
from scipy.ndimage import binary_dilation

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.absent import auroc, auroc_standard_error, calibration_error, names_of
from gsencoder.evaluate.benchmarks.localization import aabb_iou, queryable_objects
from gsencoder.evaluate.sources import FeatureSource, encoder_source, find_table, fusion_source, with_features
from gsencoder.infer.load import load_encoder
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.teachers.build import text_table_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import Words, with_training_names
from gsencoder.types import Scene

RIM = 2
"""Pixels around an object that are masked with it: compressed photographs mix colors across outlines."""
THRESHOLDS = {"fixed": ThresholdConfig(kind="fixed"), "adaptive": ThresholdConfig()}
LEVELS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
"""Levels of `localize.min_probability`; the default is among them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """A word asked about an object.

    Attributes:
        room: number of the room.
        word: what was asked.
        right: whether it is the object's name.
        boxes: probability and IoU with the object (or, for its own name, with the best of that name), best box first.
    """

    room: int
    word: str
    right: bool
    boxes: tuple[tuple[float, float], ...]

    def iou(self, level: float) -> float:
        """IoU of the first box that is at least as probable as `level`; 0 without one."""
        return next((iou for probability, iou in self.boxes if probability >= level), 0.0)

    @property
    def probability(self) -> float:
        return max((probability for probability, _ in self.boxes), default=0.0)


def read_labels(room: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The contents of a room's transforms.json and objects.json.

    Raises:
        InputError: a file is missing or wrong, or the room has masks already.
    """
    contents = []
    for name in ("transforms.json", "objects.json"):
        try:
            contents.append(json.loads((room / name).read_text()))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{room / name}: cannot be read ({reason}); expected a labeled room") from error
    transforms, objects = contents
    if not all("instance_file_path" in frame for frame in transforms["frames"]):
        raise InputError(f"{room / 'transforms.json'}: a frame has no instance_file_path; expected a labeled room")
    if (room / "masks").exists() or any("mask_path" in frame for frame in transforms["frames"]):
        raise InputError(f"{room}: has masks already, as rooms that were written without objects do; give whole rooms")
    return transforms, objects


def write_without(source: Path, target: Path, kinds: Sequence[str]) -> int:
    """Copies a room without the objects of some kinds; returns the number of these objects.

    The copy is made under a hidden name beside `target`, and renamed once it is whole.
    """
    transforms, objects = read_labels(source)
    left_out = [each["id"] for each in objects if each["name"] in kinds]
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as made:
        copy = Path(made) / target.name
        shutil.copytree(source, copy)
        (copy / "masks").mkdir()
        for number, frame in enumerate(transforms["frames"]):
            instances = np.asarray(Image.open(source / frame["instance_file_path"]))
            hidden = binary_dilation(np.isin(instances, left_out), iterations=RIM)
            frame["mask_path"] = f"masks/{number:03d}.png"
            Image.fromarray(np.where(hidden, 0, 255).astype(np.uint8)).save(copy / frame["mask_path"])
        (copy / "transforms.json").write_text(json.dumps(transforms))
        others = [each for each in objects if each["name"] not in kinds]
        (copy / "objects.json").write_text(json.dumps(others))
        os.rename(copy, target)
    return len(left_out)


def write_rooms(rooms: Sequence[Path], out: Path, kinds: Sequence[str]) -> int:
    """Copies rooms without the objects of some kinds; returns the number of these objects.

    Raises:
        InputError: a kind is in no room, a room is not labeled, or its copy exists; nothing is copied then.
    """
    names = sorted({each["name"] for room in rooms for each in read_labels(room)[1] if each["name"]})
    missing = [kind for kind in kinds if kind not in names]
    if missing:
        raise InputError(f"--kinds {','.join(missing)}: no room has an object of this name; some are: {listed(names)}")
    existing = [str(out / room.name) for room in rooms if (out / room.name).exists()]
    if existing:
        raise InputError(f"{listed(existing, 3)}: exists already; remove it, or give another OUT")
    out.mkdir(parents=True, exist_ok=True)
    return sum(write_without(room, out / room.name, kinds) for room in rooms)


def ask(
    scene: Scene, words: Words, kinds: Sequence[str], threshold: ThresholdConfig, room: int, *, unseen: bool
) -> list[Asked]:
    """Asks the names of the objects of unseen kinds, and of each wrong names; or the names of the other objects."""
    targets = [
        each
        for each in queryable_objects(scene.objects, min_views=5, min_pixels=60)
        if each.name is not None and (each.name in kinds) == unseen
    ]
    present = {each.name for each in scene.objects}
    wrong = [kind for kind in kinds if kind not in present] if unseen else []
    names = sorted({str(each.name) for each in targets})
    if not names:
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        boxes = localize(scene, [*names, *wrong], words, LocalizeConfig(threshold=threshold, min_probability=0)).boxes
    asked = []
    for target in targets:
        for word in [str(target.name), *wrong]:
            right = word == target.name
            same = [each for each in scene.objects if each.name == word] if right else [target]
            ious = tuple(
                (box.probability, max(aabb_iou(box.aabb_min, box.aabb_max, o.aabb_min, o.aabb_max) for o in same))
                for box in sorted(boxes, key=lambda box: box.rank)
                if box.query == word
            )
            asked.append(Asked(room=room, word=word, right=right, boxes=ious))
    return asked


def share(asked: Sequence[Asked], level: float, least: float) -> tuple[float, float]:
    """The share of words whose first box has at least the IoU `least`, and its standard error over rooms."""
    hits = np.array([each.iou(level) >= least for each in asked])
    _, room = np.unique([each.room for each in asked], return_inverse=True)
    deviations = np.bincount(room, weights=hits - hits.mean())
    return float(hits.mean()), float(np.sqrt(np.square(deviations).sum())) / len(hits)


def report(title: str, asked: Sequence[Asked]) -> None:
    """Prints the shares of right and wrong names at every level."""
    right, wrong = ([each for each in asked if each.right == kind] for kind in (True, False))
    print(f"\n{title}: {len(right)} objects, {len(wrong)} wrong names")
    if not right:
        print("  none is seen well enough to be asked")
        return
    for level in LEVELS:
        (near, error), (half, _) = share(right, level, 0.25), share(right, level, 0.5)
        line = f"  min_probability {level}: Acc@0.25 {near:.3f} ± {error:.3f}, Acc@0.5 {half:.3f}"
        if wrong:
            value, error = share(wrong, level, 0.25)
            line += f"; by wrong names {value:.3f} ± {error:.3f}"
        print(line)
    names = sorted({each.word for each in right})
    hits = {name: [each.iou(0) >= 0.25 for each in right if each.word == name] for name in names}
    print("  every box: " + ", ".join(f"{name} {sum(each)}/{len(each)}" for name, each in hits.items()))
    if wrong:
        keys = {(each.room, each.word): each for each in asked}
        present = np.array([each.right for each in keys.values()])
        probability = np.array([each.probability for each in keys.values()])
        rooms = np.array([each.room for each in keys.values()])
        error = auroc_standard_error(present, probability, rooms)
        boxed = probability >= LocalizeConfig().min_probability
        print(
            f"  words in a room or not: {present.sum()} and {(~present).sum()}, AUROC "
            f"{auroc(present, probability):.3f} ± {error:.3f}, calibration error "
            f"{calibration_error(present, probability):.3f}; boxed by default "
            f"{boxed[present].mean():.3f} and {boxed[~present].mean():.3f}"
        )


def score(paths: Sequence[Path], held_out: str, source: FeatureSource, words: Words, kinds: Sequence[str]) -> None:
    asked: dict[str, list[Asked]] = {}
    for room, path in enumerate(paths):
        scene = load_scene(path)
        test = fnmatch.fnmatch(path.name, held_out)
        if not test and not any(each.name in kinds for each in scene.objects):
            continue
        scene, features, _ = with_features(scene, source, SeedConfig())
        scene = replace(scene, features={features.space.name: features})
        for name, threshold in THRESHOLDS.items():
            rows = ask(scene, words, kinds, threshold, room, unseen=True)
            asked.setdefault(f"unseen kinds, {name}", []).extend(rows)
            if test:
                rows = ask(scene, words, kinds, threshold, room, unseen=False)
                asked.setdefault(f"other kinds, {name}", []).extend(rows)
    for title in sorted(asked):
        report(title, asked[title])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("without", "score"))
    parser.add_argument("house", type=existing_folder)
    parser.add_argument("out", type=output_folder, nargs="?")
    parser.add_argument("--kinds", type=comma_separated, required=True)
    parser.add_argument("--weights", help="an encoder; without it features are fused from labels")
    parser.add_argument("--space", help="of an encoder with several teachers, the one whose words are asked")
    parser.add_argument("--rooms", default="train_04*")
    arguments = parser.parse_args()
    kinds = arguments.kinds
    if arguments.action == "without" and arguments.out is None:
        parser.error("without: needs OUT, the folder for the copies of the rooms")
    if arguments.space and not arguments.weights:
        parser.error("--space: is of an encoder; give --weights too, or leave it out")
    rooms = sorted(path for path in arguments.house.iterdir() if path.is_dir() and not path.name.startswith("."))
    if not rooms:
        parser.error(f"{arguments.house}: has no folders; expected a folder of labeled rooms")
    if arguments.action == "without":
        print(f"{write_rooms(rooms, arguments.out, kinds)} objects left out of {len(rooms)} rooms")
        return
    if not fnmatch.filter([room.name for room in rooms], arguments.rooms):
        present = listed([room.name for room in rooms])
        parser.error(f"--rooms {arguments.rooms!r}: matches no room of {arguments.house} ({present})")
    names = names_of(load_scene(room) for room in rooms)
    missing = [kind for kind in kinds if kind not in names]
    if len(missing) == len(kinds):
        some = listed(names) or "none"
        parser.error(
            f"--kinds {','.join(kinds)}: no room of {arguments.house} has an object of these names; some are: {some}"
        )
    if missing:
        print(f"warning: --kinds {','.join(missing)}: in no room, and so asked as wrong names only", file=sys.stderr)
    retain_freed_memory()
    words = text_table_of(LabelsConfig())
    assert words is not None
    source = fusion_source(LabelsConfig(), words)
    if arguments.weights:
        encoder = load_encoder(arguments.weights)
        if arguments.space and arguments.space not in encoder.spaces:
            parser.error(f"--space {arguments.space}: the encoder has the spaces {listed(list(encoder.spaces))}")
        source = encoder_source(encoder, space=arguments.space)
        words = encoder.tables.get(arguments.space or "", words)
        words = with_training_names(words, find_table(encoder, arguments.space))
    score(rooms, arguments.rooms, source, words, kinds)


if __name__ == "__main__":
    with one_line_errors():
        main()
