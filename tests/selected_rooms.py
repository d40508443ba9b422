"""A table with two boxes on it, whose features fade at their edges, that tests of selections stand on."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from feature_fields import plain_features
from splats import gaussians_at

from gsencoder.app.commands.select import LABELS_JSON, LABELS_PLY, PROPERTY
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.splats.files import load_property, load_splat
from gsencoder.text.table import TextTable, make_text_table
from gsencoder.types import Cameras, FeatureSpace, Gaussians, Scene, Views

NAMES = ("mug", "book", "table", "lamp")
EMBEDDINGS = np.eye(4, 8, dtype=np.float32)
STEP = 0.02
UP = np.array([0.0, 0.0, 1.0])
MUG, BOOK = np.array([0.0, 0.0, 0.05]), np.array([0.25, 0.1, 0.04])
SPACE = FeatureSpace(name="names", channels=8, teacher="labels", text_encoder="table")


def words() -> TextTable:
    return make_text_table(NAMES, EMBEDDINGS, "table")


def shell(center: np.ndarray, half: tuple[float, float, float], rng: np.random.Generator) -> np.ndarray:
    """Points on the surface of a box without a bottom, a little off a grid, so that no two distances are equal."""
    axes = [np.arange(-size, size + 1e-9, STEP) for size in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    outer = (np.abs(grid[:, :2]) >= np.array(half[:2]) - STEP / 2).any(axis=1) | (grid[:, 2] >= half[2] - STEP / 2)
    return center + grid[outer] + rng.normal(size=(outer.sum(), 3)) * STEP / 40


def splat_of(means: np.ndarray, opacities: np.ndarray | float = 0.99) -> Gaussians:
    return gaussians_at(means, 0.6 * STEP, opacities, seed=1)


def circling(center: np.ndarray = MUG, count: int = 8, distance: float = 0.7) -> Cameras:
    """Cameras above the table, around a point."""
    turns = 2 * np.pi * (np.arange(count) + 0.3) / count
    offsets = np.stack([np.cos(turns), np.sin(turns), np.full(count, 0.8)], axis=1) * distance
    forward = -offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    return looking_cameras(center + offsets, forward, UP, 90.0, 96, 72)


def selected_room(*, under: bool = True) -> tuple[Scene, np.ndarray]:
    """The scene, and the name of each Gaussian as a number; `under`: whether the table goes on below the boxes."""
    rng = np.random.default_rng(0)
    mug, book = shell(MUG, (0.04, 0.04, 0.05), rng), shell(BOOK, (0.06, 0.04, 0.03), rng)
    side = np.arange(-0.4, 0.6, STEP)
    table = np.stack([*np.meshgrid(side, side), np.zeros((len(side), len(side)))], axis=-1).reshape(-1, 3)
    table += rng.normal(size=table.shape) * STEP / 40
    if not under:
        table = table[np.abs(table[:, :2] - MUG[:2]).max(axis=1) > 0.05]
    means = np.concatenate([mug, book, table])
    kinds = np.repeat([0, 1, 2], [len(mug), len(book), len(table)])
    vectors = EMBEDDINGS[kinds].astype(np.float64)
    # The table has some of the mug near it, and the lowest Gaussians of the mug some of the table.
    near = (kinds == 2) & (np.linalg.norm(means - MUG * [1, 1, 0], axis=1) < 0.07)
    low = (kinds == 0) & (means[:, 2] < 0.015)
    vectors[near] = 0.3 * EMBEDDINGS[0] + 0.7 * EMBEDDINGS[2]
    vectors[low] = 0.65 * EMBEDDINGS[0] + 0.35 * EMBEDDINGS[2]
    features = plain_features(vectors, SPACE, mean=EMBEDDINGS[:3].mean(axis=0))
    cameras = circling()
    views = Views(cameras=cameras, names=tuple(f"frame {number:02d}" for number in range(len(cameras))))
    scene = Scene(
        name="table", gaussians=splat_of(means), views=views, features={"names": features},
        origin=np.array([1000.0, -20.0, 3.0]), up=UP, metres_per_unit=1.0,
    )  # fmt: skip
    return scene, kinds


def with_more(scene: Scene, means: np.ndarray, *, opacity: float) -> Scene:
    """The scene with further Gaussians that have no features, at the end."""
    gaussians, features = scene.gaussians, scene.features["names"]
    more = splat_of(means, opacity)
    joined = {
        name: np.concatenate([getattr(gaussians, name), getattr(more, name)])
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    padded = replace(
        features,
        features=np.concatenate([features.features, np.zeros((len(means), 8), np.float32)]),
        weights=np.concatenate([features.weights, np.zeros(len(means), np.float32)]),
    )
    return replace(scene, gaussians=Gaussians(**joined), features={"names": padded})


def permuted(scene: Scene, order: np.ndarray) -> Scene:
    """The same scene with its Gaussians in another order."""
    features = scene.features["names"]
    moved = replace(features, features=features.features[order], weights=features.weights[order])
    return replace(scene, gaussians=scene.gaussians.select(order), features={"names": moved})


def read_labels(folder: Path) -> SimpleNamespace:
    """The splat, the label of each Gaussian, and what the labels stand for, of the files of `select`."""
    content = json.loads((folder / LABELS_JSON).read_text())
    origin = np.array(content["origin"])
    gaussians = load_splat(folder / LABELS_PLY, origin=origin)
    labels = load_property(folder / LABELS_PLY, PROPERTY).astype(np.int32)
    names = [SimpleNamespace(**row) for row in content["labels"]]
    return SimpleNamespace(gaussians=gaussians, labels=labels, origin=origin, names=names)
