"""Gathers the evidence for boxes in labeled rooms, to which `bench/presence.py` fits their probabilities.

    python bench/presence_evidence.py HOUSE OUT --words names [--weights house --space labels] [--text minilm_l6]

Every room is asked words: the names of all objects of the house (`names`), other words for some of them (`others`),
phrases that describe them (`phrases`, those of `bench/house_phrases.csv`), or a list of names ("mug,banana"). Features
are fused labels without --weights. Each cluster of a word is a row (`gsencoder.infer.relevancy`), and is right
if more than half of its Gaussians lie in the box of an object that the word stands for, widened by 3 cm. OUT gets one
.npy a room, and rooms that it has are not gathered again.
"""

import argparse
import csv
import fnmatch
from pathlib import Path

import numpy as np
from errors import comma_separated, one_line_errors, output_folder, positive

from gsencoder.core.errors import listed
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.absent import AbsentProtocol, names_of, words_to_ask
from gsencoder.evaluate.sources import encoder_source, fusion_source, with_features
from gsencoder.infer.encode import Encoder
from gsencoder.infer.localize import find_candidates
from gsencoder.teachers.build import words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import OnnxTextConfig, TableTextConfig, Words, words_of_table
from gsencoder.types import GaussianFeatures, Scene

OTHER_WORDS = {
    "shears": ("scissors",),
    "electric drill": ("drill",),
    "mallet": ("hammer",),
    "kitchen knife": ("knife",),
    "soupspoon": ("spoon",),
    "dish": ("plate",),
    "jug": ("pitcher",),
    "can": ("tin can",),
    "toy": ("lego",),
    "die": ("cube",),
    "dishwasher detergent": ("detergent",),
    "hot sauce": ("condiment",),
    "mandarin orange": ("orange",),
    "pen": ("marker",),
    "soup bowl": ("bowl",),
    "dessert": ("pudding",),
    "coffee cup": ("cup", "mug"),
    "toiletry": ("cleaning products",),
    "pitchfork": ("fork",),
    "prune": ("plum",),
    "stew": ("soup",),
    "soap": ("sponge",),
}
"""Words that no object of the house is called, and the names of those that they may stand for."""
PHRASES = Path(__file__).with_name("house_phrases.csv")
KEYS = ("mean", "margin", "prominence", "size", "share")
MARGIN = 0.03
"""Metres by which the boxes of objects are widened."""
DTYPE = np.dtype(
    [
        ("scene", "U32"),
        ("word", "i4"),
        ("present", "i1"),
        ("right", "?"),
        *((name, "f8") for name in KEYS),
    ]
)
"""A cluster's evidence. present: 1 and 0, −1 = an object of the name is hardly seen. A word without clusters has one
row of NaN."""


def evidence_of(
    scene: Scene, features: GaussianFeatures, table: Words, names: list[str], words: dict[str, tuple[str, ...]]
) -> np.ndarray:
    """The rows of one room.

    Args:
        scene: with Gaussians.
        features: of the Gaussians.
        table: turns words into the features' space.
        names: of all objects of the house.
        words: what is asked, each with the names of the objects that it stands for.
    """
    protocol = AbsentProtocol()
    groups = words_to_ask(scene.objects, names, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
    present, absent = map(set, groups)
    _, candidates = find_candidates(scene.gaussians, features, list(words), table)
    rows = []
    for number, (kinds, word) in enumerate(zip(words.values(), candidates, strict=True)):
        state = 1 if present & set(kinds) else 0 if set(kinds) <= absent else -1
        for cluster, evidence in zip(word.clusters, word.evidence, strict=True):
            points = scene.gaussians.means[cluster.rows] + scene.origin
            inside = [
                ((points >= each.aabb_min - MARGIN) & (points <= each.aabb_max + MARGIN)).all(axis=1).mean()
                for each in scene.objects
                if each.name in kinds
            ]
            values = (getattr(evidence, key) for key in KEYS)
            rows.append((scene.name, number, state, max(inside, default=0) > 0.5, *values))
        if not word.clusters:
            rows.append((scene.name, number, state, False, *(np.nan for _ in KEYS)))
    return np.array(rows, DTYPE)


def words_asked(which: list[str], names: list[str]) -> dict[str, tuple[str, ...]]:
    """The words of an argument --words, each with the names of the objects that it stands for."""
    if which == ["names"]:
        return {name: (name,) for name in names}
    if which == ["others"]:
        return OTHER_WORDS
    if which == ["phrases"]:
        with PHRASES.open(encoding="utf-8") as stream:
            return {row["phrase"]: tuple(row["right"].split(";")) for row in csv.DictReader(stream)}
    return {name: (name,) for name in which}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house", type=Path)
    parser.add_argument("out", type=output_folder)
    parser.add_argument("--words", type=comma_separated, required=True)
    parser.add_argument("--weights", help="an encoder; without it, labels are fused")
    parser.add_argument("--space", help="of an encoder with several teachers, the one whose words are asked")
    parser.add_argument("--text", help="folder of a text tower, in whose space labels are fused")
    parser.add_argument("--rooms", default="*")
    parser.add_argument("--every", type=positive, default=1, help="take one in N of the rooms")
    arguments = parser.parse_args()
    if arguments.space and not arguments.weights:
        parser.error("--space: is of an encoder; give --weights too, or leave it out")
    retain_freed_memory()
    paths = find_scenes([arguments.house])
    rooms = [path for path in paths if fnmatch.fnmatch(path.name, arguments.rooms)][:: arguments.every]
    if not rooms:
        present = listed([path.name for path in paths])
        parser.error(f"--rooms {arguments.rooms!r}: matches no room of {arguments.house} ({present})")
    names = names_of(load_scene(path) for path in paths)
    asked = words_asked(arguments.words, names)
    if not {name for kinds in asked.values() for name in kinds} & set(names):
        parser.error(
            f"--words {','.join(arguments.words)}: {arguments.house} has no object that they stand for; expected "
            f"names, others, phrases, or some of its names ({listed(names) or 'it has none'})"
        )
    text = OnnxTextConfig(model=arguments.text, pooling="mean") if arguments.text else TableTextConfig()
    if arguments.weights:
        encoder = Encoder.load(arguments.weights)
        space = arguments.space or next(iter(encoder.tables), None)
        if space not in encoder.tables:
            option = f"--space {arguments.space}" if arguments.space else f"--weights {arguments.weights}"
            parser.error(
                f"{option}: no such words with the encoder; it has those of: {listed(list(encoder.tables)) or 'none'}"
            )
        words: Words | None = words_of_table(encoder.tables[space])
        source = encoder_source(encoder, space=arguments.space)
    else:
        words = words_of(LabelsConfig(), text)
        source = fusion_source(LabelsConfig(), words)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for path in rooms:
        file = arguments.out / f"{path.name}.npy"
        if not file.is_file():
            scene, features, _ = with_features(load_scene(path), source, SeedConfig())
            np.save(file, evidence_of(scene, features, words, names, asked))


if __name__ == "__main__":
    with one_line_errors():
        main()
