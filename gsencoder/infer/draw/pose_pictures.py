"""Pictures of what is seen from a pose: the rendered view, relevancy over it, and the pixel marked in both."""

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image, ImageDraw

from gsencoder.infer.draw.pictures import contact_sheet, enlarge, ink_on, label_font, legible_factor, relevancy_overlay
from gsencoder.infer.localize.from_pose import PosePoint, SeenField
from gsencoder.render.images import render_image

VISIBLE, HIDDEN = (255, 255, 255), (150, 150, 150)
MAX_SIDE = 2000
"""Longer side of a picture, at most."""


def view_picture(seen: SeenField) -> UInt8[np.ndarray, "H W 3"]:
    """The view in color, whatever the stride is: in all its pixels, or reduced to a longer side of `MAX_SIDE`."""
    cameras = seen.cameras.select([seen.view])
    small = cameras.resized(MAX_SIDE, enlarge=False)
    same = np.array_equal([small.widths, small.heights], [cameras.widths, cameras.heights])
    blended = seen.b if same and seen.b.lattice.dx == 1 else None
    return render_image(seen.field.gaussians, small, 0, blended=blended, config=seen.field.config.blend)


def pose_picture(
    rgb: UInt8[np.ndarray, "H W 3"], seen: SeenField, point: PosePoint, relevancy: Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "H2 W2 3"]:
    """A view, and beside it the view with the relevancy of a word over it, the word's pixel in a ring in both; small
    views are enlarged.

    Args:
        rgb: of `view_picture`.
        seen: what the camera sees.
        point: of the word.
        relevancy: of the word at the pixels that were looked at; NaN where there is no surface.
    """
    lattice, (height, width) = seen.b.lattice, rgb.shape[:2]
    reduced = np.array([seen.cameras.widths[seen.view] / width, seen.cameras.heights[seen.view] / height])
    # Each pixel takes the ray of its block; pixels beyond the last block that of the last.
    columns, rows = (
        np.minimum(((np.arange(size) + 0.5) * factor / step).astype(np.int64), last - 1)
        for size, factor, step, last in (
            (width, reduced[0], lattice.dx, lattice.width),
            (height, reduced[1], lattice.dy, lattice.height),
        )
    )
    factor = legible_factor(width)
    heat = relevancy_overlay(rgb, relevancy[rows[:, None], columns])
    halves = [_marked(half, factor, point, point.pixel / reduced) for half in (rgb, heat)]
    titles = ("rendered", f"relevancy of {point.query!r}, threshold {point.threshold:.2f}")
    return contact_sheet(halves, titles, columns=2, width=halves[0].shape[1])


def _marked(
    picture: UInt8[np.ndarray, "H W 3"], factor: int, point: PosePoint, pixel: Float64[np.ndarray, "2"]
) -> UInt8[np.ndarray, "H2 W2 3"]:
    """A picture, enlarged, with the pixel of a word in a ring, and the word's relevancy and depth."""
    image = Image.fromarray(enlarge(picture, factor))
    draw = ImageDraw.Draw(image)
    if not np.isfinite(point.pixel).all():
        _write(draw, image.size, f"{point.query}: nothing with features in view", HIDDEN, None)
        return np.asarray(image)
    at = pixel * factor
    color = VISIBLE if point.visible else HIDDEN
    for radius, ink, line in ((15, (0, 0, 0), 6), (14, color, 3)):
        draw.ellipse([*(at - radius), *(at + radius)], outline=ink, width=line)
    for ink, line in (((0, 0, 0), 4), (color, 2)):
        for step in ((1, 0), (0, 1)):
            draw.line([*(at - np.multiply(step, 5)), *(at + np.multiply(step, 5))], fill=ink, width=line)
    verdict = f"depth {point.depth:.3g}" if point.visible else f"not visible (needs {point.threshold:.2f})"
    _write(draw, image.size, f"{point.query} {point.relevancy:.2f}, {verdict}", color, at)
    return np.asarray(image)


def _write(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], text: str, color: tuple[int, int, int], at: np.ndarray | None
) -> None:
    """A label in the upper left corner, or in the lower one where the upper one would cover what is marked."""
    text = "".join(character if character.isprintable() else " " for character in text)
    font = label_font(18)
    wide, high = draw.textlength(text, font) + 10, 26
    covers = at is not None and at[0] < wide + 20 and at[1] < high + 20
    top = max(size[1] - high, 0) if covers else 0
    draw.rectangle([0, top, wide, top + high], fill=color)
    draw.text((5, top + high / 2), text, fill=ink_on(color), font=font, anchor="lm")
