"""Up of rooms that were turned at random and whose files' up was removed, and what it does to oriented boxes.

    python bench/up.py $S/scenes/house [--rooms 48]

Each room's cameras are turned by one random rotation. Up is estimated from cameras and depth, from cameras alone, and
from the bare seeds. Then labels are fused over the turned room's own seeds, and the oriented box of each object's name
is turned back: its IoU with the oriented box of the room as it is, and with the labeled box.
"""

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.data.up import up_of_scene, with_up
from gsencoder.evaluate.boxes import queryable_objects
from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.teachers.build import build_teacher, text_table_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.infer.localize.relevancy import ThresholdConfig
from gsencoder.text.table import TextTable
from gsencoder.types import Box, Scene

STEPS = 48


def turned(scene: Scene, rotation: np.ndarray) -> Scene:
    """The scene in a world that is turned, without its up."""
    assert scene.views is not None
    poses = scene.views.cameras.cam_from_world.astype(np.float64)
    poses[:, :3, :3] = poses[:, :3, :3] @ rotation.T
    cameras = replace(scene.views.cameras, cam_from_world=poses.astype(np.float32))
    return replace(scene, up=None, views=replace(scene.views, cameras=cameras))


def degrees(direction: np.ndarray, true: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(direction @ true, -1, 1))))


def first_boxes(scene: Scene, words: TextTable, names: list[str]) -> dict[str, Box]:
    """The best box of each name, of labels that are fused over the scene's seeds."""
    scene = replace(scene, gaussians=seed(scene))
    scene, _ = with_up(scene)
    features = fuse(scene, build_teacher(LabelsConfig(), scene, words)).features
    config = LocalizeConfig(threshold=ThresholdConfig(fixed=0.5))
    result = localize(replace(scene, features={features.space.name: features}), names, words, config)
    return {box.query: box for box in result.boxes if box.rank == 0}


def overlap(
    center: np.ndarray, axes: np.ndarray, size: np.ndarray, other: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> float:
    """IoU of two oriented boxes, by the share of a lattice in the first that lies in the second."""
    lattice = (np.stack(np.meshgrid(*[np.arange(STEPS) + 0.5] * 3), axis=-1).reshape(-1, 3) / STEPS - 0.5) * size
    points = center + lattice @ axes.T
    inside = (np.abs((points - other[0]) @ other[1]) <= other[2] / 2).all(axis=1).mean()
    both = float(inside * np.prod(size))
    return both / float(np.prod(size) + np.prod(other[2]) - both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=48)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    words = text_table_of(LabelsConfig())
    assert words is not None
    angles: dict[str, list[float]] = {"cameras and depth": [], "cameras": [], "bare seeds": []}
    seconds, same, as_is, back = [], [], [], []
    for number, path in enumerate(find_scenes([options.folder])[: options.rooms]):
        scene = load_scene(path)
        rotation = Rotation.random(random_state=number).as_matrix()
        other = turned(scene, rotation)
        true = rotation @ np.array([0.0, 0, 1])
        assert other.views is not None
        start = time.perf_counter()
        up = up_of_scene(other)
        seconds.append(time.perf_counter() - start)
        alone = up_of_scene(replace(other, views=replace(other.views, depths=None)))
        bare = up_of_scene(replace(other, gaussians=seed(other), views=None))
        for name, estimate in zip(angles, (up, alone, bare), strict=True):
            assert estimate is not None
            angles[name].append(degrees(estimate.direction, true))
        objects = {item.name: item for item in queryable_objects(scene.objects) if item.name}
        boxes, others = first_boxes(scene, words, list(objects)), first_boxes(other, words, list(objects))
        for name, item in objects.items():
            if name not in boxes or name not in others:
                continue
            box, turn = boxes[name], others[name]
            mine = (box.obb_center, box.obb_rotation, box.obb_size)
            theirs = (rotation.T @ turn.obb_center, rotation.T @ turn.obb_rotation, turn.obb_size)
            label = ((item.aabb_min + item.aabb_max) / 2, np.eye(3), item.aabb_max - item.aabb_min)
            same.append(overlap(*mine, theirs))
            as_is.append(overlap(*mine, label))
            back.append(overlap(*theirs, label))
        print(f"{path.name}: {', '.join(f'{values[-1]:.2f}' for values in angles.values())}°", flush=True)
    print("\n| up from | median | worst |\n|---|---|---|")
    for name, values in angles.items():
        print(f"| {name} | {np.median(values):.2f}° | {max(values):.2f}° |")
    print(f"\n{np.median(seconds):.2f} s to estimate it from cameras and depth")
    print(f"{len(same)} oriented boxes: IoU with those of the room as it is: median {np.median(same):.3f}")
    for name, values in (("as it is", as_is), ("turned", back)):
        print(f"room {name}: Acc@0.5 of oriented boxes {np.mean(np.array(values) >= 0.5):.3f}")


if __name__ == "__main__":
    main()
