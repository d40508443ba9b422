"""Numbered marks on what was found, by which a VLM can name it (Yang et al. 2023, "Set-of-Mark prompting")."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from gsencoder.infer.boxes_ply import word_color
from gsencoder.infer.pictures import ink_on, label_font
from gsencoder.infer.view_targets import Target
from gsencoder.render import Blend

SOLID = 0.5
"""A pixel shows a target from so much weight on."""
LEAST_PIXELS = 12
"""A target is marked where so many pixels show it."""


def draw_marks(
    picture: UInt8[np.ndarray, "h w 3"], blended: Blend, targets: Sequence[Target]
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture with a numbered disc on each target that it shows, from 1 on in their order.

    A disc stands on the pixel of the target that is nearest to the middle of what is visible of it.

    Args:
        picture: the view.
        blended: the blending weights of its pixels.
        targets: what is marked.
    """
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    radius = max(7, round(max(image.size) / 45))
    for number, target in enumerate(targets):
        member = torch.zeros(blended.gaussians)
        member[torch.from_numpy(np.asarray(target.rows, np.int64))] = 1
        shown = np.argwhere(blended.render(member).reshape(blended.shape).numpy() >= SOLID)
        if len(shown) < LEAST_PIXELS:
            continue
        y, x = shown[np.linalg.norm(shown - shown.mean(axis=0), axis=1).argmin()] + 0.5
        color = word_color(number)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline=(255, 255, 255), width=2)
        draw.text((x, y), str(number + 1), fill=ink_on(color), font=label_font(round(1.3 * radius)), anchor="mm")
    return np.asarray(image)
