"""A folder of features of the room, with words, that tests of views and questions stand on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from rooms import STEP, cube, room

from gsencoder.app import main as cli
from gsencoder.fusion.folder import save_features
from gsencoder.text.table import WORDS_FILE, make_text_table, save_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures

NAMES = ("cube", "crate", "wall", "pen holder")
ORIGIN = np.array([100.0, -50.0, 7.0])
QUICK = ("choose.source=frames", "choose.candidates=4", "choose.count=2", "quiet=true")
KEY = "sk-never-to-be-written"


def save_room(
    folder: Path,
    names: tuple[str, ...] = (),
    *,
    shift: tuple[float, float, float] = (0, 0, 0),
    scene_name: str = "room",
    step: float = STEP,
) -> None:
    """A cube and two crates in a room, each with features of its name; `names` are those of its frames."""
    center = (0.3 + shift[0], 0.2 + shift[1], 0.8 + shift[2])
    scene, rows = room(cube((-0.8, -0.6, 0.8)), cube((-0.9, 0.9, 0.8)), center=center, step=step)
    if names:
        scene = replace(scene, views=replace(scene.views, names=names))
    n, one = len(scene.gaussians), len(rows)
    kinds = np.full(n, 2)
    kinds[:one], kinds[-2 * one :] = 0, 1
    embeddings = np.eye(4, 16, dtype=np.float32)
    space = FeatureSpace(name="names", channels=16, teacher="labels", text_encoder="table")
    features = GaussianFeatures(
        features=embeddings[kinds], weights=np.ones(n, np.float32), mean=embeddings[kinds].mean(axis=0), space=space
    )
    folder.mkdir()
    save_features(folder, replace(scene, name=scene_name, origin=ORIGIN), features, {})
    save_text_table(folder / WORDS_FILE, make_text_table(NAMES, embeddings, "table"))


def ask(features: Path, out: Path, *words: str) -> int:
    """The exit code of `ask` with few and quick views, and no second try of a request."""
    return cli.main(["ask", str(features), f"out={out}", "vlm.retries=0", *QUICK, *words])
