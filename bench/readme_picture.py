"""The picture at the head of the README: a photograph, the features of its Gaussians, and boxes for words.

    python -m bench.readme_picture ../shared/scenes/house/train_041 --view 6

`house`, one of the encoders that come with gsencoder, gives the features. It sees Gaussians that were seeded from RGB-D
frames, and no photograph; the room is one of those that it was not trained on.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gsencoder import Encoder, load_scene, localize
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.infer.draw import contact_sheet, draw_boxes, fit_pca_colors, pca_picture
from gsencoder.render import blend


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--words", default="coffee table,pitcher,detergent,plate")
    parser.add_argument("--out", type=Path, default=Path("docs/overview.png"))
    given = parser.parse_args()

    scene = with_gaussians(load_scene(given.scene))
    encoder = Encoder.load("house")
    features = encoder.encode(scene.gaussians, space="labels", up=scene.up)
    found = localize(replace(scene, features={features.space.name: features}), given.words.split(","), encoder.words)

    view, cameras = given.view, scene.views.cameras
    photograph = scene.views.images[view]
    b = blend(scene.gaussians, cameras, view)
    rendered = b.render(torch.from_numpy(features.features)).numpy().reshape(*b.shape, -1)
    alpha = b.alpha.numpy().reshape(b.shape)
    best = [next(box for box in found.boxes if box.query == word) for word in found.queries]
    colors = fit_pca_colors(features.features[features.seen])
    pictures = [
        photograph,
        pca_picture(rendered, colors, alpha),
        draw_boxes(photograph, best, cameras.cam_from_world[view], cameras.Ks[view], origin=scene.origin),
    ]
    shape = max(picture.shape[:2] for picture in pictures)
    enlarged = [np.asarray(Image.fromarray(each).resize(shape[::-1], Image.Resampling.BICUBIC)) for each in pictures]
    titles = [
        "a photograph",
        "features of the Gaussians, as three colors",
        f"the best box for each of {len(best)} words",
    ]
    sheet = Image.fromarray(contact_sheet(enlarged, titles, columns=3, width=420))
    sheet.quantize(256).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
