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
from json_option import add_json_option, write_figures
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.data.up import up_of_scene, with_up
from gsencoder.evaluate.boxes import queryable_objects
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.teachers.build import build_teacher, text_table_of
from gsencoder.teachers.labels import LabelsConfig
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


def labeled(scene: Scene, words: TextTable) -> Scene:
    """The scene with seeds of its own, up, and labels fused over them."""
    scene, _ = with_up(replace(scene, gaussians=seed(scene)))
    features = fuse(scene, build_teacher(LabelsConfig(), scene, words)).features
    return replace(scene, features={features.space.name: features})


def turned_splat(scene: Scene, other: Scene, rotation: np.ndarray) -> Scene:
    """The Gaussians and features of a scene in the turned world, with the up that is estimated there."""
    assert scene.gaussians is not None
    quats = Rotation.from_matrix(rotation) * Rotation.from_quat(scene.gaussians.quats, scalar_first=True)
    gaussians = replace(
        scene.gaussians,
        means=(scene.gaussians.means.astype(np.float64) @ rotation.T).astype(np.float32),
        quats=quats.as_quat(scalar_first=True).astype(np.float32),
    )
    result, _ = with_up(replace(other, gaussians=gaussians))
    return replace(result, features=scene.features)


def first_boxes(scene: Scene, words: TextTable, names: list[str]) -> dict[str, Box]:
    """The best box of each name."""
    config = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.5))
    result = localize(scene, names, words, config)
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
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    words = text_table_of(LabelsConfig())
    assert words is not None
    angles: dict[str, list[float]] = {"cameras and depth": [], "cameras": [], "bare seeds": []}
    seconds, as_is = [], []
    same: dict[str, list[float]] = {"the same Gaussians, turned": [], "seeded anew": []}
    back: dict[str, list[float]] = {name: [] for name in same}
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
        whole = labeled(scene, words)
        boxes = first_boxes(whole, words, list(objects))
        others = {
            "the same Gaussians, turned": first_boxes(turned_splat(whole, other, rotation), words, list(objects)),
            "seeded anew": first_boxes(labeled(other, words), words, list(objects)),
        }
        for name, item in objects.items():
            if name not in boxes:
                continue
            box = boxes[name]
            mine = (box.obb_center, box.obb_rotation, box.obb_size)
            label = ((item.aabb_min + item.aabb_max) / 2, np.eye(3), item.aabb_max - item.aabb_min)
            as_is.append(overlap(*mine, label))
            for kind, of_kind in others.items():
                turn = of_kind[name]
                theirs = (rotation.T @ turn.obb_center, rotation.T @ turn.obb_rotation, turn.obb_size)
                same[kind].append(overlap(*mine, theirs))
                back[kind].append(overlap(*theirs, label))
        print(f"{path.name}: {', '.join(f'{values[-1]:.2f}' for values in angles.values())}°", flush=True)
    print("\n| up from | median | worst |\n|---|---|---|")
    for name, values in angles.items():
        print(f"| {name} | {np.median(values):.2f}° | {max(values):.2f}° |")
    print(f"\n{np.median(seconds):.2f} s to estimate it from cameras and depth")
    print(f"{len(as_is)} oriented boxes; room as it is: Acc@0.5 {np.mean(np.array(as_is) >= 0.5):.3f}")
    figures = {f"degrees from {name}": {"median": np.median(each), "worst": max(each)} for name, each in angles.items()}
    figures["room as it is"] = {"objects": len(as_is), "Acc@0.5": np.mean(np.array(as_is) >= 0.5)}
    for kind, values in same.items():
        accuracy = np.mean(np.array(back[kind]) >= 0.5)
        print(f"{kind}: median IoU with those of the room as it is {np.median(values):.3f}, Acc@0.5 {accuracy:.3f}")
        figures[kind] = {"IoU": np.median(values), "Acc@0.5": accuracy}
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
