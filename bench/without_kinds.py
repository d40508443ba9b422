"""Labeled scenes in which things of some kinds have no name, for encoders that are judged on kinds they never saw.

    python bench/without_kinds.py HOUSE OUT --kinds couch,desk [--names 'train_0[0-3]*']
    gsencoder train OUT experiment=rooms rooms.libraries=LIBRARIES rooms.without=[couch,desk] holdout=[] \
        data.allow_outside=true out=fold
    python bench/furnished.py fold LIBRARIES --kinds couch,desk --boxes

An object loses its name if this, or its last word, is one that kinds.csv has for these kinds (sofa, dining table). All
other files are links to those of HOUSE.
"""

import argparse
from typing import Any

from errors import comma_separated, existing_folder, matching_names, one_line_errors, output_folder

from gsencoder.core.errors import listed
from gsencoder.core.files import write_json
from gsencoder.data.furnished.kinds import kinds
from gsencoder.data.readers.transforms_json import read_json


def without_names(objects: list[dict[str, Any]], names: list[str]) -> set[str]:
    """Takes the names of things of some kinds, and returns them."""
    words = {word: kind.name for kind in kinds().values() for word in kind.words}
    lost = set()
    for each in objects:
        name = each["name"] or ""
        # A coffee table is a kind of its own, a dining table is a table.
        if words.get(name, words.get(name.split(" ")[-1])) in names:
            lost.add(name)
            each["name"] = None
    return lost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house", type=existing_folder)
    parser.add_argument("out", type=output_folder)
    parser.add_argument("--kinds", type=comma_separated, required=True)
    parser.add_argument("--names", default="train_0[0-3]*")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.kinds if name not in kinds()]:
        parser.error(f"--kinds {unknown[0]}: no such kind; the kinds are {listed(list(kinds()), 8)}")
    lost = set[str]()
    for scene in matching_names(parser, arguments.house, arguments.names):
        objects = read_json(scene / "objects.json")
        lost |= without_names(objects, arguments.kinds)
        target = arguments.out / scene.name
        target.mkdir(parents=True, exist_ok=True)
        for path in scene.iterdir():
            link = target / path.name
            if path.name != "objects.json" and not link.is_symlink():
                link.symlink_to(path.resolve())
        write_json(target / "objects.json", objects)
    print(f"without names: {listed(sorted(lost), 40) or 'none'}")


if __name__ == "__main__":
    with one_line_errors():
        main()
