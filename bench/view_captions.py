"""Captions of views for `evaluate protocol=retrieval` from the labels of scenes: one name for one view.

    python bench/view_captions.py SCENE … --out captions.json [--min-share 0.005]

Names and views are paired so that the sum of the shares of pictures that show a named thing is largest; pairs of less
than `--min-share` are left out. A name may be seen in other views too, where it is smaller: texts of single views are
ambiguous, and recall of exact labels stays below 1.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from gsencoder.core.errors import InputError
from gsencoder.data.labels.captions import ViewCaption, write_view_captions
from gsencoder.data.scenes import load_scene


def shares_of(path: str) -> dict[tuple[str, str], dict[str, float]]:
    """The share of the pixels of each name in each view, by scene and view."""
    scene = load_scene(path)
    if scene.views is None or scene.views.instances is None:
        raise InputError(f"{path}: has no instance maps")
    names = {thing.id: thing.name for thing in scene.objects if thing.name}
    shares: dict[tuple[str, str], dict[str, float]] = {}
    for view, labels in zip(scene.views.names, scene.views.instances, strict=True):
        row = shares.setdefault((scene.name, view), {})
        for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
            if name := names.get(int(label)):
                row[name] = row.get(name, 0.0) + count / labels.size
    return shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--min-share", default=0.005, type=float)
    settings = parser.parse_args()
    shares = {view: row for path in settings.scenes for view, row in shares_of(path).items()}
    views, names = list(shares), sorted({name for row in shares.values() for name in row})
    table = np.array([[shares[view].get(name, 0.0) for name in names] for view in views])
    pairs = [pair for pair in zip(*linear_sum_assignment(-table), strict=True) if table[pair] >= settings.min_share]
    captions = [ViewCaption(scene=views[i][0], view=views[i][1], caption=names[j]) for i, j in pairs]
    write_view_captions(settings.out, captions)
    print(f"{settings.out}: {len(captions)} captions of {len(views)} views, {len(names)} names")


if __name__ == "__main__":
    main()
