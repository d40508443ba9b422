"""Drawing: relevancy over views, boxes in views and as .ply, features as colors, depth, contact sheets.

Pictures are uint8 [H, W, 3], RGB, of arrays that were rendered elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file
from gsencoder.types import Box, Localization, Scene
from gsencoder.types.scene import project_points, transform

EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1], np.int32)
"""The 12 edges of a box whose corner k lies at the upper end of axis d where bit d of k is set."""
POINTS_ON_EDGE = 100
_TEN = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189),
    (140, 86, 75), (227, 119, 194), (127, 127, 127), (188, 189, 34), (23, 190, 207),
)  # fmt: skip
"""Tableau's ten colors, which matplotlib calls tab10."""


def word_color(index: int) -> tuple[int, int, int]:
    """The color of a localization's word, by its place; ten differ, then they repeat."""
    return _TEN[index % len(_TEN)]


def box_corners(box: Box, *, oriented: bool = True) -> Float64[np.ndarray, "8 3"]:
    """The corners of a box's oriented or axis-aligned box, in the order that `EDGES` joins."""
    unit = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)], np.float64)
    if oriented:
        return box.obb_center + ((unit - 0.5) * box.obb_size) @ box.obb_rotation.T
    return box.aabb_min + unit * (box.aabb_max - box.aabb_min)


def write_boxes_ply(
    path: str | Path,
    scene: Scene,
    localization: Localization,
) -> None:
    """Writes the Gaussians of all boxes as points in their word's color, and the edges of the boxes.

    Edges are rows of points, which every viewer shows, and `edge` elements between the corners. Boxes after a word's
    first are darker. Positions are doubles in world coordinates.
    """
    means = np.zeros((0, 3), np.float32) if scene.gaussians is None else scene.gaussians.means
    points: list[np.ndarray] = []
    colors: list[np.ndarray] = []
    edges: list[np.ndarray] = []
    count = 0
    steps = np.linspace(0, 1, POINTS_ON_EDGE)[1:-1, None]
    for box in localization.boxes:
        if box.rows.size and int(box.rows.max()) >= len(means):
            raise InputError(
                f"write_boxes_ply: box of {box.query!r} has row {box.rows.max()} of {len(means)} Gaussians"
            )
        corners = box_corners(box, oriented=False)
        lines = [corners[a] + steps * (corners[b] - corners[a]) for a, b in EDGES]
        inside = means[box.rows].astype(np.float64) + scene.origin
        part = np.concatenate([corners, *lines, inside])
        points.append(part)
        shade = 1.0 if box.rank == 0 else 0.6
        color = np.array(word_color(localization.queries.index(box.query))) * shade
        colors.append(np.broadcast_to(color.astype(np.uint8), part.shape))
        edges.append(EDGES + count)
        count += len(part)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element edge {12 * len(edges)}", "property int vertex1", "property int vertex2", "end_header\n"]
    vertices = np.empty(count, [("position", "<f8", 3), ("color", "u1", 3)])
    if points:
        vertices["position"], vertices["color"] = np.concatenate(points), np.concatenate(colors)
    with atomic_file(path) as stream:
        stream.write("\n".join(header).encode() + vertices.tobytes())
        stream.write(b"".join(each.astype("<i4").tobytes() for each in edges))


Picture = UInt8[np.ndarray, "_h _w 3"]

LEGIBLE_WIDTH = 640
"""Smaller pictures are enlarged by a whole factor before anything is written on them."""
NEAR = 0.05
RING = 11
OPACITY = 0.6
"""Of relevancy over a view."""
PAPER, INK, FAINT = (255, 255, 255), (32, 33, 36), (120, 124, 130)


@lru_cache(maxsize=8)
def label_font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib brings along: Latin, Greek, Cyrillic, mathematical signs."""
    from matplotlib import get_data_path

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


@lru_cache(maxsize=4)
def _colormap(name: str) -> np.ndarray:
    """A matplotlib color map as 256 colors."""
    from matplotlib import colormaps

    return (np.asarray(colormaps[name](np.arange(256)))[:, :3] * 255).round().astype(np.uint8)


def _colors(values: Float[np.ndarray, "*n"], low: float, high: float, name: str) -> UInt8[np.ndarray, "*n 3"]:
    share = (values.astype(np.float64) - low) / (high - low if high > low else 1.0)
    return _colormap(name)[(np.clip(np.nan_to_num(share), 0, 1) * 255).round().astype(np.uint8)]


def enlarge(picture: UInt8[np.ndarray, "H W 3"], factor: int) -> UInt8[np.ndarray, "H2 W2 3"]:
    """A picture `factor` times as wide and high, smoothly interpolated."""
    if factor == 1:
        return picture
    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC))


def legible_factor(width: int) -> int:
    """How often a picture is enlarged before labels are drawn on it."""
    return max(1, -(-LEGIBLE_WIDTH // max(width, 1))) if width < LEGIBLE_WIDTH else 1


def relevancy_overlay(
    rgb: UInt8[np.ndarray, "H W 3"], relevancy: Float32[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Relevancy as color (turbo: 0 blue, 1 red) over the grey view; NaN shows the grey view alone."""
    if rgb.shape[:2] != relevancy.shape:
        raise InputError(f"relevancy_overlay: relevancy {relevancy.shape} over a picture of {rgb.shape[:2]}")
    grey = (rgb @ np.array([0.299, 0.587, 0.114]))[..., None]
    mixed = (1 - OPACITY) * grey + OPACITY * _colors(relevancy, 0.0, 1.0, "turbo")
    shown = np.where(np.isfinite(relevancy)[..., None], mixed, grey)
    return shown.round().clip(0, 255).astype(np.uint8)


def color_bar(width: int, low: float, high: float, *, mark: float | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """The scale of `relevancy_overlay`: ends in figures, and a mark at the threshold."""
    image = Image.new("RGB", (width, 40), PAPER)
    draw = ImageDraw.Draw(image)
    ramp = _colors(np.linspace(low, high, width), low, high, "turbo")
    image.paste(Image.fromarray(np.broadcast_to(ramp, (16, width, 3)).copy()), (0, 0))
    draw.text((2, 20), f"{low:.3g}", fill=INK, font=label_font(14))
    draw.text((width - 2, 20), f"{high:.3g}", fill=INK, font=label_font(14), anchor="ra")
    if mark is not None and low < mark < high:
        x = round((mark - low) / (high - low) * (width - 1))
        draw.line([(x, 0), (x, 19)], fill=(0, 0, 0), width=3)
        draw.line([(x, 0), (x, 19)], fill=PAPER, width=1)
        if 50 < x < width - 50:
            draw.text((x, 20), f"{mark:.3g}", fill=INK, font=label_font(14), anchor="ma")
    return np.asarray(image)


def draw_boxes(
    rgb: UInt8[np.ndarray, "H W 3"],
    boxes: Sequence[Box],
    cam_from_world: Float32[np.ndarray, "4 4"],
    K: Float32[np.ndarray, "3 3"],
    *,
    origin: Float64[np.ndarray, "3"] | None = None,
) -> UInt8[np.ndarray, "H2 W2 3"]:
    """Draws the edges of oriented boxes, also behind surfaces, and word and score of each; edges end at the near plane.

    Small pictures are enlarged by a whole factor first (`legible_factor`). Words take colors in order of appearance.

    Args:
        boxes: in world coordinates, origin included.
    """
    factor = legible_factor(rgb.shape[1])
    image = Image.fromarray(enlarge(rgb, factor))
    draw = ImageDraw.Draw(image)
    pose, intrinsics = cam_from_world.astype(np.float64), K.astype(np.float64) * [[factor], [factor], [1]]
    order = {word: index for index, word in enumerate(dict.fromkeys(box.query for box in boxes))}
    labels: list[tuple[np.ndarray, str, tuple[int, int, int]]] = []
    # The best box of a word is drawn last, over the others.
    for box in sorted(boxes, key=lambda each: -each.rank):
        corners = box_corners(box) if origin is None else box_corners(box) - origin
        segments = _project_edges(pose, corners, intrinsics, image.width, image.height)
        if not segments:
            continue
        color = word_color(order[box.query])
        for back, width in (((0, 0, 0), 5 if box.rank == 0 else 3), (color, 3 if box.rank == 0 else 1)):
            for segment in segments:
                draw.line(segment.ravel().tolist(), fill=back, width=width)
        ends = np.concatenate(segments)
        labels.append((ends[ends[:, 1].argmin()], f"{_printable(box.query)} {box.score:.2f}", color))
    draw_labels(draw, image.size, labels[::-1])
    return np.asarray(image)


def _project_edges(
    pose: Float64[np.ndarray, "4 4"],
    corners: Float64[np.ndarray, "8 3"],
    intrinsics: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> list[np.ndarray]:
    """The visible part [2, 2] of each edge, in pixels; edges outside the picture are left out."""
    segments, local = [], transform(pose, corners)
    for a, b in EDGES:
        start, end = local[a], local[b]
        if max(start[2], end[2]) <= NEAR:
            continue
        if min(start[2], end[2]) < NEAR:
            cut = start + (NEAR - start[2]) / (end[2] - start[2]) * (end - start)
            start, end = (cut, end) if start[2] < NEAR else (start, cut)
        # A box of 1e20 units may be cut so near its end that rounding leaves nothing to divide by.
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            inside = _clip_to_picture(project_points(np.stack([start, end]), intrinsics), width, height)
        if inside is not None and np.isfinite(inside).all():
            segments.append(inside)
    return segments


def _clip_to_picture(segment: Float64[np.ndarray, "2 2"], width: int, height: int) -> Float64[np.ndarray, "2 2"] | None:
    """Liang and Barsky's clipping of a line to the picture."""
    step = segment[1] - segment[0]
    first, last = 0.0, 1.0
    for axis, limit in ((0, width), (1, height)):
        for slope, room in ((-step[axis], segment[0, axis]), (step[axis], limit - 1 - segment[0, axis])):
            if slope == 0:
                if room < 0:
                    return None
            elif slope < 0:
                first = max(first, room / slope)
            else:
                last = min(last, room / slope)
    return np.stack([segment[0] + first * step, segment[0] + last * step]) if first <= last else None


def ink_on(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Black or white, whichever is legible on a color."""
    bright = float(np.dot(color, [0.299, 0.587, 0.114])) > 140
    return (0, 0, 0) if bright else (255, 255, 255)


def draw_ring(draw: ImageDraw.ImageDraw, at: Float64[np.ndarray, "2"], color: tuple[int, int, int]) -> None:
    """A ring around a point and lines that point at it; the point itself stays as it is."""
    for ink, width, rim in (((0, 0, 0), 7, 2), (color, 3, 0)):
        outer = RING + width / 2
        draw.ellipse([*(at - outer), *(at + outer)], outline=ink, width=width)
        for way in np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]):
            draw.line([*(at + RING * way), *(at + (2 * RING + rim) * way)], fill=ink, width=width)


def _printable(text: str, longest: int = 28) -> str:
    clean = "".join(character if character.isprintable() else " " for character in text)
    return clean if len(clean) <= longest else clean[: longest - 1] + "…"


def draw_labels(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], labels: Sequence[tuple[np.ndarray, str, tuple[int, int, int]]]
) -> None:
    """Labels above their boxes, inside the picture, each moved down until it covers no earlier one."""
    font = label_font(18)
    occupied: list[tuple[float, float, float, float]] = []
    for at, label, color in labels:
        text = _printable(label, 200)
        wide, high = draw.textlength(text, font) + 10, 26
        x = float(np.clip(at[0] - wide / 2, 0, max(size[0] - wide, 0)))
        y = float(np.clip(at[1] - high - 4, 0, max(size[1] - high, 0)))
        # Two labels overlap unless one is wholly to the side of or above the other.
        for left, top, right, bottom in sorted(occupied, key=lambda rectangle: rectangle[1]):
            if x < right and left < x + wide and y < bottom and top < y + high:
                y = bottom + 1
        y = min(y, size[1] - high)
        occupied.append((x, y, x + wide, y + high))
        draw.rectangle([x, y, x + wide, y + high], fill=color)
        draw.text((x + 5, y + high / 2), text, fill=ink_on(color), font=font, anchor="lm")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PcaColors:
    """One map from features to colors for all views of a scene: about a mean, along the three principal directions for
    red, green and blue, from the 1st percentile along each, which becomes 0, to the 99th."""

    mean: Float64[np.ndarray, " R"]
    axes: Float64[np.ndarray, "R 3"]
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]


def fit_pca_colors(features: Float32[np.ndarray, "n R"], *, sample: int = 50_000) -> PcaColors:
    """Fits colors to features or basis coordinates, such as those of all seen Gaussians.

    Signs are chosen so that the largest entry of each direction is positive; fewer than three directions leave a
    channel at its middle."""
    if len(features) == 0:
        raise InputError("fit_pca_colors: no features to fit colors to; were any Gaussians seen?")
    chosen = features[:: max(1, len(features) // sample)].astype(np.float64)
    mean = chosen.mean(axis=0)
    _, directions = np.linalg.eigh((chosen - mean).T @ (chosen - mean))
    axes = np.zeros((features.shape[1], 3))
    count = min(3, features.shape[1])
    axes[:, :count] = directions[:, ::-1][:, :count]
    largest = np.abs(axes).argmax(axis=0)
    axes *= np.where(axes[largest, np.arange(3)] < 0, -1, 1)
    low, high = np.percentile((chosen - mean) @ axes, [1, 99], axis=0)
    return PcaColors(mean=mean, axes=axes, low=low, high=high)


def pca_picture(
    features: Float32[np.ndarray, "h w R"], colors: PcaColors, alpha: Float32[np.ndarray, "h w"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """A rendered feature map as colors that mean the same in every view.

    With `alpha`, what was composited is divided by it first, and fades to white where nothing was hit.
    """
    cover = np.ones(features.shape[:2]) if alpha is None else np.clip(alpha.astype(np.float64), 0, 1)
    values = features.astype(np.float64) / np.maximum(cover, 1e-6)[..., None]
    spread = colors.high - colors.low
    flat = spread <= 1e-12 * max(float(spread.max()), 1e-300)
    share = ((values - colors.mean) @ colors.axes - colors.low) / np.where(flat, 1, spread)
    share = np.where(flat, 0.5, np.clip(np.nan_to_num(share, nan=0.5), 0, 1))
    return ((share * cover[..., None] + (1 - cover[..., None])) * 255).round().astype(np.uint8)


def depth_picture(depth: Float32[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth as color (viridis, near is bright, from the 2nd percentile to the 98th); 0, NaN and Inf, which mean none,
    are dark grey."""
    valid: Bool[np.ndarray, "H W"] = np.isfinite(depth) & (depth > 0)
    low, high = np.percentile(depth[valid], [2, 98]) if valid.any() else (0.0, 1.0)
    shown = _colors(-np.where(valid, depth, 0), -float(high), -float(low), "viridis")
    return np.where(valid[..., None], shown, np.uint8(48)).astype(np.uint8)


def contact_sheet(
    pictures: Sequence[Picture],
    titles: Sequence[str],
    *,
    columns: int,
    width: int = 480,
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures in a grid on white, each brought to one width, with its title above."""
    if not pictures or len(pictures) != len(titles) or columns < 1:
        raise InputError(f"contact_sheet: {len(pictures)} pictures, {len(titles)} titles, {columns} columns")
    gap, head = 12, 28
    images = [Image.fromarray(np.ascontiguousarray(picture)) for picture in pictures]
    images = [image.resize((width, max(1, round(image.height * width / image.width)))) for image in images]
    columns = min(columns, len(images))
    rows = [range(start, min(start + columns, len(images))) for start in range(0, len(images), columns)]
    heights = [head + max(images[i].height for i in row) + gap for row in rows]
    sheet = Image.new("RGB", (gap + columns * (width + gap), gap + sum(heights)), PAPER)
    draw = ImageDraw.Draw(sheet)
    top = gap
    for row, height in zip(rows, heights, strict=True):
        for column, i in enumerate(row):
            left = gap + column * (width + gap)
            draw.text((left, top + 2), fit_text(draw, titles[i], width), fill=INK, font=label_font(17))
            sheet.paste(images[i], (left, top + head))
        top += height
    return np.asarray(sheet)


def fit_text(draw: ImageDraw.ImageDraw, text: str, width: int, size: int = 17) -> str:
    """The text, cut with an ellipsis to what a line of a width in pixels holds in the label font of this size."""
    text = _printable(text, 200)
    if draw.textlength(text, label_font(size)) <= width:
        return text
    while text and draw.textlength(text + "…", label_font(size)) > width:
        text = text[:-1]
    return text.rstrip() + "…"
