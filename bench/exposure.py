"""What affine colors gain and cost: photographs as they are, and with exposures that vary, fitted with them and
without.

    python bench/exposure.py $S/scenes/plush --image-scale 0.5

Gains are drawn log-uniformly from 1/1.4 to 1.4 for each photograph, and ±10 % more for each color channel. Every
eighth photograph is held out as it is. PSNR and SSIM are in the exposures that are predicted from the source named. The
last column is the PSNR after an affine map of colors was fitted to each held-out photograph, which is the figure that
an arbitrary mean exposure does not change.

Where the scene is a COLMAP model, the brightness of photographs is measured a second time, from the gray levels along
the tracks of its points and from nothing else, and compared with that of the maps.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from gsencoder import load_scene
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.data.scenes import SceneConfig
from gsencoder.reconstruct import ReconstructConfig, reconstruct
from gsencoder.reconstruct.optimize import OptimizeConfig
from gsencoder.reconstruct.plan import BudgetConfig
from gsencoder.types import Scene

GAIN, BALANCE = 1.4, 0.1


def exposed(scene: Scene, holdout: int, seed: int = 0) -> Scene:
    """The scene with photographs whose exposure varies; those that are held out stay."""
    assert scene.views is not None
    made = np.random.default_rng(seed)
    images = []
    for view, image in enumerate(scene.views.images or ()):
        gain = GAIN ** made.uniform(-1, 1) * (1 + made.uniform(-BALANCE, BALANCE, size=3))
        changed = (np.asarray(image) * gain + 0.5).clip(0, 255).astype(np.uint8)
        images.append(np.asarray(image) if view % holdout == 0 else changed)
    return replace(scene, views=replace(scene.views, images=images))


def tracked_brightness(scene: Scene, model: Path, rounds: int = 200) -> np.ndarray:
    """Brightness of each photograph, so that the points of a COLMAP model have one gray level along their tracks."""
    assert scene.views is not None
    assert scene.views.images is not None
    file = load_pycolmap().Reconstruction(str(model))
    rows = {name: row for row, name in enumerate(scene.views.names)}
    blurred = [gaussian_filter(np.asarray(image, np.float32).mean(axis=2), 2) for image in scene.views.images]
    points, views, levels = [], [], []
    for number, point in enumerate(file.points3D.values()):
        for element in point.track.elements:
            image = file.images[element.image_id]
            grey = blurred[rows[image.name]]
            x, y = image.points2D[element.point2D_idx].xy * grey.shape[1] / file.cameras[image.camera_id].width
            if 0 <= x < grey.shape[1] and 0 <= y < grey.shape[0] and 15 < grey[int(y), int(x)] < 240:
                points.append(number)
                views.append(rows[image.name])
                levels.append(np.log(grey[int(y), int(x)]))
    point, view, level = np.array(points), np.array(views), np.array(levels)
    gains, seen = np.zeros(len(rows)), np.maximum(np.bincount(view, minlength=len(rows)), 1)
    for _ in range(rounds):
        albedo = np.bincount(point, level - gains[view]) / np.maximum(np.bincount(point), 1)
        # Highlights and edges are no gains.
        errors = (level - albedo[point] - gains[view]).clip(-0.3, 0.3)
        gains += np.bincount(view, errors, minlength=len(rows)) / seen
    return np.exp(gains - gains.mean())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--steps", type=int, default=OptimizeConfig().steps)
    chosen = parser.parse_args(arguments)
    scene = load_scene(chosen.scene, options=SceneConfig(image_scale=chosen.image_scale))
    holdout = ReconstructConfig().holdout
    print("| photographs | `optimize.exposure` | PSNR | SSIM | brightness | predicted from | matched PSNR |")
    print("|---|---|---|---|---|---|---|")
    fitted_as_is = None
    for name, one in (("as they are", scene), ("exposures vary", exposed(scene, holdout))):
        for fitted in (True, False):
            config = ReconstructConfig(
                optimize=OptimizeConfig(steps=chosen.steps, exposure=fitted), budget=BudgetConfig(minutes=0)
            )
            result = reconstruct(one, config)
            last = result.log[-1]
            brightness = "–"
            if result.exposure is not None:
                brightness = f"{min(result.exposure):.2f} to {max(result.exposure):.2f}"
            if result.exposure is not None and one is scene:
                fitted_as_is = np.array(result.exposure), np.array(result.training)
            print(
                f"| {name} | {str(fitted).lower()} | {last['psnr']:.2f} | {last['ssim']:.3f} | {brightness} "
                f"| {result.exposure_source or '–'} | {last['matched_psnr']:.2f} |",
                flush=True,
            )
    model = next((path.parent for path in sorted(chosen.scene.rglob("points3D.*"))), None)
    if model is not None and fitted_as_is is not None:
        brightness, training = fitted_as_is
        tracked = tracked_brightness(scene, model)[training]
        tracked = tracked / tracked.mean()
        print(
            f"\nbrightness along tracks: {tracked.min():.2f} to {tracked.max():.2f}; correlation with that of the maps "
            f"{np.corrcoef(tracked, brightness)[0, 1]:.3f}, largest difference {np.abs(tracked - brightness).max():.2f}"
        )


if __name__ == "__main__":
    main()
