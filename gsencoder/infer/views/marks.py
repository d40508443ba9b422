"""Numbered marks on targets, by which a VLM can refer to them (Yang et al. 2023, "Set-of-Mark prompting")."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from PIL import Image, ImageDraw

from gsencoder.infer.draw.boxes_ply import word_color
from gsencoder.infer.draw.pictures import ink_on, label_font
from gsencoder.infer.views.targets import Target
from gsencoder.render import Blend

SOLID_WEIGHT = 0.5
"""A pixel shows a target from so much weight on."""
MIN_MARKED_PIXELS = 12
"""A target is marked where so many pixels show it."""
MAX_MARK_COVER = 0.25
"""A disc stands on its target if it hides no more of it than that, and beside it otherwise."""
DIRECTIONS = 8
"""Ways from a target to places beside it."""


def draw_marks(
    picture: UInt8[np.ndarray, "h w 3"], blended: Blend, targets: Sequence[Target]
) -> tuple[UInt8[np.ndarray, "h w 3"], frozenset[int]]:
    """A picture with a numbered disc for each target that it shows, from 1 on in their order.

    A disc stands on the pixel of the target that is nearest to the middle of what is visible of it; where it would
    hide a small target, another disc, or leave the picture, it stands beside it, and a line leads to that pixel.

    Args:
        picture: the view.
        blended: the blending weights of its pixels.
        targets: what is marked.

    Returns:
        The picture, and the numbers that it carries.
    """
    image = Image.fromarray(picture)
    radius = max(7, round(max(image.size) / 45))
    placed: dict[int, tuple[tuple[float, float], tuple[float, float]]] = {}
    for number, target in enumerate(targets, start=1):
        member = torch.zeros(blended.gaussians)
        member[torch.from_numpy(np.asarray(target.rows, np.int64))] = 1
        shown = blended.render(member).reshape(blended.shape).numpy() >= SOLID_WEIGHT
        if shown.sum() >= MIN_MARKED_PIXELS:
            photograph_at = [disc for _, disc in placed.values()]
            placed[number] = _mark_position(shown, radius, photograph_at)
    draw = ImageDraw.Draw(image)
    for number, (on, (x, y)) in placed.items():
        draw.line((*on, x, y), fill=(255, 255, 255), width=4)
        draw.line((*on, x, y), fill=word_color(number - 1), width=2)
    for number, (_, (x, y)) in placed.items():
        color = word_color(number - 1)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline=(255, 255, 255), width=2)
        draw.text((x, y), str(number), fill=ink_on(color), font=label_font(round(1.3 * radius)), anchor="mm")
    return np.asarray(image), frozenset(placed)


def _mark_position(
    shown: Bool[np.ndarray, "h w"], radius: int, photograph_at: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """The pixel of a target that its mark means, and where its disc stands; x and y of each."""
    pixels = np.argwhere(shown)[:, ::-1] + 0.5
    on = pixels[np.linalg.norm(pixels - pixels.mean(axis=0), axis=1).argmin()]
    size = np.array([shown.shape[1], shown.shape[0]], np.float64)
    inner = np.minimum(radius + 1.0, size / 2)
    candidates = [on] if math.pi * radius**2 <= MAX_MARK_COVER * len(pixels) else []
    half = (pixels.max(axis=0) - pixels.min(axis=0)) / 2
    middle = (pixels.max(axis=0) + pixels.min(axis=0)) / 2
    for ring in (1.5, 4.0, 6.5):
        for turn in np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS) - math.pi / 2:
            way = np.array([math.cos(turn), math.sin(turn)])
            candidates.append(middle + way * (np.minimum(half, 4 * radius) + ring * radius))
    inside = [np.clip(position, inner, size - inner) for position in candidates]
    others = np.array(photograph_at, np.float64).reshape(-1, 2)

    def faults(position: Float64[np.ndarray, "2"]) -> tuple[bool, bool]:
        near = np.linalg.norm(others - position, axis=1).min(initial=math.inf) < 2 * radius + 2
        return bool(near), bool((np.linalg.norm(pixels - position, axis=1) <= radius).mean() > MAX_MARK_COVER)

    # Of equal places the first: on the target, then nearest to it.
    x, y = min(inside, key=faults)
    return (float(on[0]), float(on[1])), (float(x), float(y))
