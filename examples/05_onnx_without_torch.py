"""Finds a word in a splat with an exported encoder, without torch.

gsencoder export out=encoder.onnx
python examples/05_onnx_without_torch.py encoder.onnx room.ply table   # room.ply is from 03_encode_a_splat.py
"""

import sys

from gsencoder import Encoder, InputError, Scene, load_splat, localize


def main(model: str, splat: str, word: str) -> None:
    encoder = Encoder.load(model)
    if encoder.words is None:
        raise InputError(f"{model} holds no words")
    gaussians = load_splat(splat)
    features = encoder.encode(gaussians)  # of a splat in metres, z up; else give metres_per_unit=, up=
    scene = Scene(name="scene", gaussians=gaussians, features={features.space.name: features})
    for box in localize(scene, [word], encoder.words).boxes[:3]:  # best first
        size = " × ".join(f"{side:.2f}" for side in box.aabb_max - box.aabb_min)
        print(f"{word} at {box.center.round(2)}, {size}, probability {box.probability:.2f}")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except InputError as error:
        sys.exit(f"error: {error}")
