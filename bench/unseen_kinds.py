"""Labeled rooms without some kinds of objects, for encoders that never saw these kinds.

    python bench/unseen_kinds.py OUT SCENE… [--kinds 'mug,banana,…']
    gsencoder train OUT experiment=house_cpu holdout= out=house_unseen

Copies of the rooms in OUT mask the pixels of every object of the kinds in every view, so that neither seeds nor targets
nor the table of targets hold any of them, and set their names to null. The default kinds are two times eight.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

KINDS = (
    "mug,banana,hammer,tennis ball,soup,plate,lego,sponge,"
    "drill,lemon,bowl,scissors,cracker,marker,plum,baseball"
)  # fmt: skip


def write_without(scene: Path, target: Path, kinds: frozenset[str]) -> None:
    """A copy of the scene in which no pixel shows an object of the kinds."""
    shutil.copytree(scene, target)
    for path in target.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    objects = json.loads((target / "objects.json").read_text())
    hidden = [each["id"] for each in objects if each["name"] in kinds]
    for each in objects:
        if each["name"] in kinds:
            each["name"] = None
    (target / "objects.json").write_text(json.dumps(objects))
    transforms = json.loads((target / "transforms.json").read_text())
    (target / "masks").mkdir()
    for frame in transforms["frames"]:
        instances = np.asarray(Image.open(target / frame["instance_file_path"]))
        frame["mask_path"] = f"masks/{Path(frame['instance_file_path']).name}"
        mask = np.where(np.isin(instances, hidden), 0, 255).astype(np.uint8)
        Image.fromarray(mask).save(target / frame["mask_path"])
    (target / "transforms.json").write_text(json.dumps(transforms))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--kinds", default=KINDS)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True)
    for scene in arguments.scenes:
        write_without(scene, arguments.out / scene.name, frozenset(arguments.kinds.split(",")))


if __name__ == "__main__":
    main()
