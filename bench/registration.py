"""How well the colors of one surface agree across the views of an RGB-D scene, as registered on load and as files are.

    python bench/registration.py $S/scenes/kitchen

Points of each depth image are carried into other views; where the depth there confirms them, the colors of both
photographs are compared: the correlation of their details (intensity less its mean over 25 pixels), and the share whose
RGB differ by at most 0.06 of the full range on average.
"""

import argparse
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from scipy.ndimage import gaussian_filter, map_coordinates

from gsencoder import load_scene
from gsencoder.data.scenes import SceneConfig
from gsencoder.types import Views

SAMPLES, REACH, TOLERANCE, COLOR_TOLERANCE = 500, 4, 0.02, 0.06


def agreement(views: Views) -> tuple[float, float, int]:
    """Correlation of details, share of colors that agree, and number of compared pixels."""
    assert views.images is not None
    assert views.depths is not None
    made, cameras = np.random.default_rng(0), views.cameras
    images = [np.asarray(image, np.float64) / 255 for image in views.images]
    depths = [np.asarray(depth) for depth in views.depths]
    grey = [image.mean(axis=2) for image in images]
    details = [gaussian_filter(image, 1.0) - gaussian_filter(image, 12.0) for image in grey]
    correlations, shares, compared = [], [], 0
    for view in range(len(views)):
        rows, columns = np.nonzero(depths[view])
        picked = made.permutation(len(rows))[:SAMPLES]
        pixels = np.stack((columns[picked], rows[picked]), axis=1) + 0.5
        points = cameras.unproject(pixels, depths[view][rows[picked], columns[picked]].astype(np.float64), view)
        for other in range(max(0, view - REACH), min(len(views), view + REACH + 1)):
            if other == view:
                continue
            there, z = cameras.project(points, other)
            inside = np.flatnonzero(cameras.in_image(there, z, other))
            column, row = there[inside].astype(int).T
            measured = depths[other][row, column]
            inside = inside[(measured > 0) & (np.abs(z[inside] - measured) <= TOLERANCE * measured)]
            if len(inside) < 50:
                continue
            ours, theirs = pixels[inside].T[::-1] - 0.5, there[inside].T[::-1] - 0.5
            pair = [
                map_coordinates(details[index], at, order=1, mode="nearest")
                for index, at in ((view, ours), (other, theirs))
            ]
            correlations.append(np.corrcoef(*pair)[0, 1])
            color = [
                np.stack([map_coordinates(images[index][..., k], at, order=1, mode="nearest") for k in range(3)])
                for index, at in ((view, ours), (other, theirs))
            ]
            shares.append((np.abs(color[0] - color[1]).mean(axis=0) <= COLOR_TOLERANCE).mean())
            compared += len(inside)
    return float(np.nanmean(correlations)), float(np.mean(shares)), compared


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--stride", type=int, default=1, help="every n-th view")
    add_json_option(parser)
    chosen = parser.parse_args()
    identity = tuple(np.eye(4).reshape(-1).tolist())
    depth_camera = (585.0, 585.0, 320.0, 240.0)
    as_files = SceneConfig(intrinsics=depth_camera, depth_intrinsics=depth_camera, depth_from_color=identity)
    print("| depth | correlation of details | colors that agree | compared |\n|---|---|---|---|")
    figures = {}
    for name, options in (("as in the files", as_files), ("registered on load", SceneConfig())):
        views = load_scene(chosen.scene, options=options).views
        assert views is not None
        correlation, share, compared = agreement(views)
        print(f"| {name} | {correlation:.3f} | {share:.3f} | {compared:,} |", flush=True)
        figures[name] = {"correlation": correlation, "share": share, "compared": compared}
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    main()
