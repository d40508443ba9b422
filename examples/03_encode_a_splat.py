"""Features of a splat in one pass, with the encoder that comes with gsencoder: no photographs, no teacher.

gsencoder demo out=outputs/demo
python examples/03_encode_a_splat.py outputs/demo/room table,sofa
"""

import sys
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from gsencoder import Encoder, load_scene, localize, render_image, save_features, save_splat, seed
from gsencoder.render import blend


def main(folder: str, words: str) -> None:
    scene = load_scene(folder)
    scene = replace(scene, gaussians=scene.gaussians or seed(scene))

    # The network sees means and colors of the Gaussians, upright and in metres.
    encoder = Encoder.load("rooms")
    features = encoder.encode(scene.gaussians, metres_per_unit=scene.metres_per_unit or 1.0, up=scene.up)
    print(f"{len(features):,} features of {features.space.describe()}")

    # It knows the names that it was trained on; the words lie next to the weights.
    scene = replace(scene, features={features.space.name: features})
    localization = localize(scene, words.split(","), encoder.words)
    for word in localization.queries:
        boxes = [box for box in localization.boxes if box.query == word]
        best = f", the best with probability {boxes[0].probability:.2f}" if boxes else ""
        print(f"{word}: {len(boxes)} boxes{best}")

    # Features as colors: their three principal directions, of which each render is a product with B.
    values = torch.as_tensor(features.features[:, :3])
    values = (values - values.mean(0)) / (4 * values.std(0)) + 0.5
    b = blend(scene.gaussians, scene.views.cameras, 0)
    colors = (255 * b.render(values.clamp(0, 1)).clamp(0, 1)).byte().reshape(*b.shape, 3).numpy()
    picture = render_image(scene.gaussians, scene.views.cameras, 0, blended=b)
    Image.fromarray(np.hstack([picture, colors])).save("encoded.png")

    # A folder of features is what `gsencoder localize`, `views`, `ask` and `pack` take.
    save_features("encoded", scene, features, {"encoder": "rooms"})
    save_splat("room.ply", scene.gaussians)
    print("encoded.png: view 0, and its features as colors; encoded: the features; room.ply: the splat alone")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
