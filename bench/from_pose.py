"""How fast words are answered from a pose, and how often the position lies in an object of that name.

    python bench/from_pose.py SCENE FEATURES [--width 640] [--view 3] [--runs 7]

SCENE has instance maps and an objects.json, FEATURES was fused from it with real names (`gsencoder fuse SCENE`). Times
are medians; those with kept geometry and those that make it anew alternate. Each name is asked in each view in which
an object of the name fills --pixels pixels, from the pose of the view, and from that pose moved by --shift metres and
turned by --turn degrees, each in a random direction. There instances that were lifted onto the Gaussians, and rendered,
say what is in view. A position is right inside the box of an object of that name, or at most --margin metres beside it.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from errors import existing_folder, one_line_errors, positive
from json_option import add_json_option, write_figures

from gsencoder.core.errors import InputError
from gsencoder.data.scenes import load_scene
from gsencoder.fusion.folder import WORDS_FILE, load_features
from gsencoder.infer.from_pose import FeatureField, PosePoint, SeenField
from gsencoder.render import Blend, blend
from gsencoder.text.table import TextTable, load_text_table
from gsencoder.types import Cameras, Scene


def timings(
    field: FeatureField, cameras: Cameras, view: int, names: list[str], text: TextTable, runs: int
) -> dict[str, float]:
    """Prints the seconds of each part, and of an answer with kept geometry beside one that makes it anew; their ratio
    and the seconds are returned."""

    def timed(title: str, work: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = work()
        seconds.setdefault(title, []).append(time.perf_counter() - start)
        return result

    def whole(b: Blend | None = None) -> SeenField:
        seen = field.at(cameras, view, b=b)
        seen.find(names[:1], text)
        return seen

    seconds: dict[str, list[float]] = {}
    many = (names * 16)[:16]
    kept = whole()
    kept.find(many, text)
    for _ in range(runs):
        b = timed("blend", lambda: blend(field.gaussians, cameras, view, config=field.config.blend))
        timed("lengths of features", partial(field.at, cameras, view, b=b))
        timed("one word, kept", lambda: kept.find(names[:1], text))
        timed("one word, anew", whole)
        timed("16 words, kept", lambda: kept.find(many, text))
    medians = {title: float(np.median(values)) for title, values in seconds.items()}
    for title, value in medians.items():
        print(f"{title:24s} {1e3 * value:8.1f} ms")
    print(f"anew / kept, one word    {medians['one word, anew'] / medians['one word, kept']:8.1f}")
    print(f"16 words, each           {1e3 * medians['16 words, kept'] / 16:8.1f} ms")
    print(f"entries a pixel          {len(kept.b.col) / kept.b.rows:8.1f}")
    return {**medians, "anew / kept": medians["one word, anew"] / medians["one word, kept"]}


def moved(cameras: Cameras, shift: float, turn: float, rng: np.random.Generator) -> Cameras:
    """The cameras, each shifted and turned about an axis through its center, both in random directions."""
    poses = cameras.cam_from_world.astype(np.float64)
    for pose in poses:
        axis, direction = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        cross = np.cross(np.eye(3), axis)
        angle = np.radians(turn)
        pose[:3] = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ pose[:3]
        pose[:3, 3] += shift * direction
    return Cameras(
        cam_from_world=poses.astype(np.float32), Ks=cameras.Ks, widths=cameras.widths, heights=cameras.heights
    )


def instances_of_gaussians(scene: Scene, field: FeatureField) -> np.ndarray:
    """The instance to which each Gaussian gives most of its weight in the views of the scene."""
    assert scene.views is not None
    assert scene.views.instances is not None
    count = 1 + max(int(scene.views.instances[view].max()) for view in range(len(scene.views)))
    sums = torch.zeros(len(field.gaussians), count)
    for view in range(len(scene.views)):
        b = blend(field.gaussians, scene.views.cameras, view)
        b.lift_codes_into(torch.from_numpy(scene.views.instances[view].astype(np.int32).ravel()), sums)
    return sums.argmax(dim=1).numpy()


def right(point: PosePoint, scene: Scene, margin: float) -> bool:
    return any(
        bool(((point.position >= each.aabb_min - margin) & (point.position <= each.aabb_max + margin)).all())
        for each in scene.objects
        if each.name == point.query
    )


def truth(
    scene: Scene, field: FeatureField, cameras: Cameras, text: TextTable, maps: Callable[[int, Blend], np.ndarray],
    *, pixels: int, margin: float,
) -> dict[str, float]:  # fmt: skip
    """Asks all names of the scene in all views; `maps` gives the instances of a view's pixels."""
    named = sorted({each.name for each in scene.objects if each.name is not None and each.name in text.names})
    asked = inside = visible = hidden = absent = 0
    for view in range(len(cameras)):
        seen = field.at(cameras, view)
        counts = np.bincount(maps(view, seen.b).ravel(), minlength=1 + max(each.id for each in scene.objects))
        for point in seen.find(named, text):
            ids = [each.id for each in scene.objects if each.name == point.query]
            if counts[ids].max() >= pixels:
                asked += 1
                inside += right(point, scene, margin)
                visible += point.visible
            elif counts[ids].sum() == 0:
                absent += 1
                hidden += not point.visible
    return {
        "asked": asked,
        "right": inside / max(asked, 1),
        "visible": visible / max(asked, 1),
        "absent": absent,
        "hidden": hidden / max(absent, 1),
    }


def told(found: dict[str, float]) -> str:
    return (
        f"{found['asked']} asked, position right {found['right']:.4f}, said to be visible {found['visible']:.4f}; "
        f"{found['absent']} not in view, said so {found['hidden']:.4f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=existing_folder)
    parser.add_argument("features", type=existing_folder)
    parser.add_argument("--width", type=positive, default=640)
    parser.add_argument("--view", type=int, default=3)
    parser.add_argument("--runs", type=positive, default=7)
    parser.add_argument("--pixels", type=positive, default=200)
    parser.add_argument("--margin", type=float, default=0.05)
    parser.add_argument("--shift", type=float, default=0.2)
    parser.add_argument("--turn", type=float, default=15.0)
    add_json_option(parser)
    options = parser.parse_args()
    scene, text = load_scene(options.scene), load_text_table(Path(options.features) / WORDS_FILE)
    views = scene.views
    if views is None or views.instances is None or not scene.objects:
        raise InputError(f"{options.scene}: no views with instance maps, or no labeled objects")
    if not 0 <= options.view < len(views):
        raise InputError(f"--view: expected 0 to {len(views) - 1}, got {options.view}")
    instances = views.instances
    start = time.perf_counter()
    field = FeatureField(load_features(options.features))
    print(f"{len(field.gaussians):,} Gaussians; read and prepared in {time.perf_counter() - start:.2f} s")
    large = views.cameras.resized(options.width)
    names = [each.name for each in scene.objects if each.name is not None and each.name in text.names]
    print(f"view {options.view} at {large.widths[options.view]}×{large.heights[options.view]}:")
    seconds = timings(field, large, options.view, names, text, options.runs)

    limits = {"pixels": options.pixels, "margin": options.margin}
    own = truth(scene, field, views.cameras, text, lambda view, _: instances[view], **limits)
    print(f"views: {told(own)}")
    of_gaussians = torch.from_numpy(instances_of_gaussians(scene, field))
    shares = torch.nn.functional.one_hot(of_gaussians).float()

    def rendered(_: int, b: Blend) -> np.ndarray:
        return np.where(b.alpha.numpy() >= 0.5, b.render(shares).argmax(dim=1).numpy(), 0)

    poses = moved(views.cameras, options.shift, options.turn, np.random.default_rng(0))
    away = truth(scene, field, poses, text, rendered, **limits)
    print(f"moved by {options.shift:g} m and {options.turn:g}°: {told(away)}")
    write_figures(options.json, {"seconds": seconds, "views": own, "moved": away})


if __name__ == "__main__":
    with one_line_errors():
        main()
