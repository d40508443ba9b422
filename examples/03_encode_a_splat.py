"""Features of a splat in one pass, with the encoder that comes with gsencoder: no photographs, no teacher.

gsencoder demo out=outputs/demo
python examples/03_encode_a_splat.py outputs/demo/room table,chair
"""

import sys
from dataclasses import replace

from gsencoder import load_encoder, load_scene, localize, save_features, seed


def main(folder: str, words: str) -> None:
    scene = load_scene(folder)
    scene = replace(scene, gaussians=scene.gaussians or seed(scene))

    # The network sees means, rotations, scales, opacities and colors of the Gaussians, in metres.
    encoder = load_encoder("house_cpu")
    features = encoder.encode(scene.gaussians, metres_per_unit=scene.metres_per_unit or 1.0)
    print(f"{len(features):,} features of {features.space.describe()}")

    # It knows the names that it was trained on; the words lie beside the weights.
    scene = replace(scene, features={features.space.name: features})
    localization = localize(scene, words.split(","), encoder.words)
    for word, threshold in zip(localization.queries, localization.thresholds, strict=True):
        scores = [f"{box.score:.2f}" for box in localization.boxes if box.query == word]
        print(f"{word}: {len(scores)} boxes above {threshold:.2f} ({', '.join(scores) or 'none'})")

    # A folder of features is what `gsencoder localize`, `views`, `ask` and `pack` take.
    save_features("encoded", scene, features, {"encoder": "house_cpu"})


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
