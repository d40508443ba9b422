"""Labeled scenes in which things of some kinds have no name, for encoders that are judged on kinds they never saw.

    python bench/without_kinds.py HOUSE OUT --kinds couch,desk [--names 'train_0[0-3]*']
    gsencoder train OUT experiment=rooms rooms.libraries=LIBRARIES rooms.without=[couch,desk] holdout=[] out=fold
    python bench/furnished.py fold LIBRARIES --kinds couch,desk --boxes

An object loses its name if this, or its last word, is one that kinds.csv has for these kinds (sofa, dining table). All
other files are links to those of HOUSE.
"""

import argparse
import json
from typing import Any

from errors import comma_separated, existing_folder, one_line_errors, output_folder

from gsencoder.core.errors import listed
from gsencoder.core.files import atomic_file
from gsencoder.data.furnished.kinds import kinds


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
    for scene in sorted(arguments.house.glob(arguments.names)):
        target = arguments.out / scene.name
        target.mkdir(parents=True, exist_ok=True)
        for path in scene.iterdir():
            link = target / path.name
            if path.name != "objects.json" and not link.is_symlink():
                link.symlink_to(path.resolve())
        objects = json.loads((scene / "objects.json").read_text(encoding="utf-8"))
        lost |= without_names(objects, arguments.kinds)
        with atomic_file(target / "objects.json") as file:
            file.write(json.dumps(objects).encode())
    print(f"without names: {listed(sorted(lost), 40) or 'none'}")


if __name__ == "__main__":
    with one_line_errors():
        main()
