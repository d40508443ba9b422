"""Rendering is a product with a sparse matrix, and lifting and gradients are products with its transpose.

gsencoder demo out=outputs/demo
python examples/02_blend_is_a_matrix.py outputs/demo/room
"""

import sys

import numpy as np
import torch
from PIL import Image

from gsencoder import load_scene, seed
from gsencoder.render import blend


def main(folder: str) -> None:
    scene = load_scene(folder)
    gaussians = seed(scene)

    # B for the first camera: one row a patch of 8 × 8 pixels, one column a Gaussian. It depends on geometry alone.
    b = blend(gaussians, scene.views.cameras, 0, patch=8)
    print(f"B: {b.rows:,} patches × {b.gaussians:,} Gaussians, {len(b.weight):,} entries that are not zero")

    # Colors, from the spherical harmonics of degree 0, as the matrix renders them: one mean color a patch.
    colors = 0.5 + 0.2820948 * torch.as_tensor(gaussians.sh[:, 0])
    patches = (255 * b.render(colors).clamp(0, 1)).byte().reshape(*b.shape, 3).numpy()
    patches = patches.repeat(8, axis=0).repeat(8, axis=1)
    photograph = scene.views.images[0][: len(patches), : patches.shape[1]]
    Image.fromarray(np.hstack([photograph, patches[: len(photograph)]])).save("patches.png")
    print("patches.png: the photograph, and B @ colors")

    # Any number of channels is rendered at once: here 64.
    values = torch.randn(len(gaussians), 64, requires_grad=True)
    maps = b.render(values)
    print(f"B @ values: {tuple(maps.shape)}; rows of B sum to alpha, {float(b.alpha.mean()):.3f} on average")

    # Lifting is the transpose: ⟨B v, m⟩ = ⟨v, Bᵀ m⟩ for all maps m.
    others = torch.randn_like(maps)
    left, right = (maps * others).sum().item(), (values * b.lift(others)).sum().item()
    print(f"⟨B v, m⟩ = {left:.3f}, ⟨v, Bᵀ m⟩ = {right:.3f}")

    # So the gradient of a render is a lift.
    (gradient,) = torch.autograd.grad((maps * others).sum(), values)
    print(f"largest difference of gradient and lift: {(gradient - b.lift(others)).abs().max().item():.1e}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
