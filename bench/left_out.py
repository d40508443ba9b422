"""How well features explain photographs that they were not made from, against what the teacher says of these.

    python bench/left_out.py write SCENE OUT [--splat FILE] [--every 8]
    python bench/left_out.py score OUT [--teacher dinov2_s14] [--weights ENCODER …]

`write` makes two scenes of one: OUT/kept holds all views but every n-th, and the Gaussians as splat.ply (of --splat,
or seeds), OUT/left_out the other views. `score` fuses the teacher over the views of OUT/kept, renders features into
those of OUT/left_out, and compares with the teacher's maps there, in cells that are covered (alpha of 0.5 or more): the
cosine as it is, and after the mean of the fused space has been subtracted from both. With --weights it does the same
with encoded features, of encoders that were trained on such kept scenes:

    gsencoder train OUT/kept splat=splat.ply teacher=dinov2_s14 out=ENCODER
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from json_option import add_json_option, write_figures
from PIL import Image

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.data.splats.files import save_splat
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.infer.encode import Encoder
from gsencoder.render import blend
from gsencoder.teachers.build import words_of
from gsencoder.types import FeatureMap, GaussianFeatures, Gaussians, Scene
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid

MIN_ALPHA = 0.5
SPLAT = "splat.ply"


def write_views(scene: Scene, rows: Sequence[int], folder: Path) -> None:
    """Writes some views of a scene as transforms.json with undistorted photographs and depth."""
    views = scene.views
    (folder / "images").mkdir(parents=True)
    frames = []
    for row in rows:
        name = Path(views.names[row]).stem
        K = views.cameras.Ks[row]
        Image.fromarray(views.images[row]).save(folder / "images" / f"{name}.png")
        world_from_cam = invert_rigid(views.cameras.cam_from_world[row].astype(np.float64)) @ OPENCV_FROM_OPENGL
        frame = {
            "file_path": f"images/{name}.png",
            **{"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])},
            **{"w": int(views.cameras.widths[row]), "h": int(views.cameras.heights[row])},
            "transform_matrix": world_from_cam.tolist(),
        }
        if views.depths is not None:
            millimeters = np.round(views.depths[row] * 1000).clip(0, 65535).astype(np.uint16)
            Image.fromarray(millimeters).save(folder / "images" / f"{name}.depth.png")
            frame |= {"depth_file_path": f"images/{name}.depth.png", "depth_unit_scale_factor": 0.001}
        frames.append(frame)
    content = {"frames": frames}
    if scene.metres_per_unit is not None:
        content["metres_per_unit"] = scene.metres_per_unit
    (folder / "transforms.json").write_text(json.dumps(content))


def rendered_cosines(
    gaussians: Gaussians, features: GaussianFeatures, scene: Scene, maps: Sequence[FeatureMap]
) -> tuple[float, float, float]:
    """Mean raw and centered cosine of rendered features with maps, and the share of the cells that are covered."""
    views = scene.views
    raw, centered, covered, cells = 0.0, 0.0, 0, 0
    coordinates = features.features if features.basis is not None else features.features - features.mean
    values = torch.from_numpy(coordinates * features.seen[:, None])
    for view, teacher_map in enumerate(maps):
        b = blend(gaussians, views.cameras, view, like=teacher_map)
        alpha = b.alpha.numpy()
        rows = np.flatnonzero(alpha >= MIN_ALPHA)
        rendered = (b.render(values).numpy() / np.maximum(alpha, 1e-6)[:, None])[rows]
        about_mean = rendered @ features.basis.components if features.basis is not None else rendered
        target = teacher_map.rows()[rows]
        raw += cosines(about_mean + features.mean, target).sum()
        centered += cosines(about_mean, target - features.mean).sum()
        covered += len(rows)
        cells += len(alpha)
    return raw / covered, centered / covered, covered / cells


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    products = (a * b).sum(axis=1)
    return np.asarray(products / np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1) + 1e-12))


def write(arguments: argparse.Namespace) -> None:
    scene = load_scene(arguments.scene, splat=str(Path(arguments.splat).resolve()) if arguments.splat else None)
    rows = np.arange(len(scene.views))
    out = rows % arguments.every == arguments.every // 2
    write_views(scene, rows[~out].tolist(), arguments.out / "kept")
    write_views(scene, rows[out].tolist(), arguments.out / "left_out")
    kept = load_scene(arguments.out / "kept")
    gaussians = scene.gaussians if arguments.splat else with_gaussians(kept).gaussians
    save_splat(arguments.out / "kept" / SPLAT, gaussians)
    print(f"{arguments.out}: {(~out).sum()} views kept, {out.sum()} left out, {len(gaussians):,} Gaussians")


def score(arguments: argparse.Namespace) -> None:
    config = compose("fuse", FuseCommandConfig, ["-", f"teacher={arguments.teacher}"])
    kept = load_scene(arguments.out / "kept", splat=SPLAT)
    left_out = load_scene(arguments.out / "left_out")
    teacher = config.teacher.build(kept, words_of(config.teacher, config.text))
    maps = [teacher.feature_map(left_out.views, view) for view in range(len(left_out.views))]
    fused = fuse(kept, teacher, FuseConfig()).features
    print("| features | rank | raw cosine | centered cosine | cells covered |")
    print("|---|---|---|---|---|")
    rows = {"fused": fused}
    for weights in arguments.weights:
        encoder = Encoder.load(weights)
        unit = unit_of(kept)
        rows[Path(weights).name] = encoder.encode(kept.gaussians, metres_per_unit=unit)
    figures = {}
    for name, features in rows.items():
        raw, centered, covered = rendered_cosines(kept.gaussians, features, left_out, maps)
        print(f"| {name} | {features.features.shape[1]} | {raw:.3f} | {centered:.3f} | {covered:.3f} |", flush=True)
        figures[name] = {"raw": raw, "centered": centered, "covered": covered}
    write_figures(arguments.json, figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    writing = actions.add_parser("write")
    writing.add_argument("scene")
    writing.add_argument("out", type=Path)
    writing.add_argument("--splat", default="")
    writing.add_argument("--every", type=int, default=8)
    scoring = actions.add_parser("score")
    scoring.add_argument("out", type=Path)
    scoring.add_argument("--teacher", default="dinov2_s14")
    scoring.add_argument("--weights", nargs="*", default=[])
    add_json_option(scoring)
    arguments = parser.parse_args()
    retain_freed_memory()
    if arguments.action == "write":
        write(arguments)
    else:
        score(arguments)


if __name__ == "__main__":
    main()
