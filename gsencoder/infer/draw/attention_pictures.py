"""Pictures of what a pixel attends to: the view with the pixel, and the photographs that its components come from."""

import warnings
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, ImageDraw

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.draw.pictures import FAINT, INK, PAPER, fit_text, label_font
from gsencoder.infer.draw.strongest_components import PixelAttention, salient_pixel, strongest_components
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.images import RenderedImages, render_image
from gsencoder.types import MemoryBank, QueryMemory, Scene

MARK, HALO = (255, 214, 0), (0, 0, 0)
"""The pixel and the cells are marked in one color, with a dark rim."""
VIEW_SIDE, TILE_SIDE, CLOSE_SIDE = 660, 300, 96
"""Longer sides of the view and of the tiles, and the side of the close-up in a tile's corner, in pixels."""
CLOSE_CELLS = 3.0
"""Cells along the side of a close-up."""
LEAST_OUTLINE = 7.0
"""Cells smaller than this many pixels of the picture are outlined as if they were this large."""
GAP, HEAD, CAPTION, BAR = 18, 74, 54, 8
LEAST_LEFT, LEAST_RIGHT = 520, 620
"""Smallest widths of the two parts, which hold their headings."""
EMPTY_BAR, FULL_BAR = (226, 228, 232), (230, 160, 0)


def attention_pictures(
    memory: QueryMemory, scene: Scene, *, views: int, count: int = 6, config: BlendConfig = BlendConfig()
) -> Iterator[tuple[int, Image.Image]]:
    """For evenly spaced views a picture of what their most salient pixel attends to: the pixel whose attention has the
    lowest entropy.

    Args:
        memory: of the scene's Gaussians.
        scene: Gaussians, and the views that the memory was made from.
        views: so many, or all if there are fewer.
        count: components that are shown, at most.
        config: accuracy of the rendering.

    Yields:
        The number of the view and the picture. A view that shows nothing with a query is left out with a warning.

    Raises:
        InputError: the scene has no Gaussians or no cameras, or other ones than the memory was made of.
    """
    if scene.gaussians is None or scene.views is None:
        raise InputError(f"pictures: scene {scene.name} needs Gaussians and cameras")
    for view in even_indices(len(scene.views), views).tolist():
        b = blend(scene.gaussians, scene.views.cameras, view, config=config)
        pixel = salient_pixel(memory, b)
        if pixel is None:
            name = scene.views.names[view]
            warnings.warn(f"pictures: view {name} shows no Gaussian with a query and is not drawn", SceneWarning, 2)
            continue
        picture = attention_picture(memory, scene, view, pixel, count=count, config=config, blended=b)
        yield view, Image.fromarray(picture)


def attention_picture(
    memory: QueryMemory,
    scene: Scene,
    view: int,
    pixel: tuple[int, int],
    *,
    count: int = 6,
    config: BlendConfig = BlendConfig(),
    blended: Blend | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """A rendered view with a pixel marked, and for each of the pixel's strongest components the photograph that it
    comes from, with its cell outlined and enlarged in a corner, its rank, and its weight in the attention.

    Where the scene has no photographs, the views that the components come from are rendered.

    Args:
        memory: of the scene's Gaussians.
        scene: Gaussians, and the views that the memory was made from.
        view: number of the view.
        pixel: its column x and row y.
        count: components that are shown, at most.
        config: accuracy of the rendering.
        blended: the view's pixel blend, where it has been made already.

    Raises:
        InputError: the scene has no Gaussians or no cameras, or other ones than the memory was made of; or no such
            pixel, or nothing with a query is seen in it.
    """
    gaussians, views, bank = scene.gaussians, scene.views, memory.bank
    if gaussians is None or views is None:
        raise InputError(f"pictures: scene {scene.name} needs Gaussians and cameras")
    last = int(bank.sources[:, 0].max())
    if not 0 <= view < len(views) or last >= len(views):
        raise InputError(
            f"pictures: scene {scene.name} has {len(views)} views, and view {view} is asked for and components come "
            f"from view {last}; expected the views that the memory was made from"
        )
    b = blended if blended is not None else blend(gaussians, views.cameras, view, config=config)
    strongest = strongest_components(memory, gaussians, views.cameras, view, pixel, count, config=config, blended=b)
    shown = render_image(gaussians, views.cameras, view, blended=b)
    images = RenderedImages(gaussians, views.cameras, config) if views.images is None else views.images
    cells, tiles = bank.cells, []
    for component in strongest.components.tolist():
        source, row, column = bank.sources[component].tolist()
        where = f"{views.names[source]}{', rendered' if views.images is None else ''}"
        tiles.append((cell_tile(images[source], cells[component]), where, f"row {row}, column {column} of its map"))
    return _sheet(mark_pixel(shown, pixel), views.names[view], strongest, tiles, bank)


def fit_in(rgb: UInt8[np.ndarray, "h w 3"], side: int) -> tuple[Image.Image, float]:
    """A picture enlarged or reduced so that its longer side has so many pixels, and the factor."""
    factor = side / max(rgb.shape[:2])
    size = tuple(max(1, round(length * factor)) for length in (rgb.shape[1], rgb.shape[0]))
    return Image.fromarray(np.ascontiguousarray(rgb)).resize(size, Image.Resampling.BICUBIC), factor


def mark_pixel(rgb: UInt8[np.ndarray, "h w 3"], pixel: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """A view, its longer side `VIEW_SIDE` pixels, with a ring around a pixel and lines that point at it."""
    image, factor = fit_in(rgb, VIEW_SIDE)
    draw = ImageDraw.Draw(image)
    x, y = ((coordinate + 0.5) * factor for coordinate in pixel)
    radius, reach = 11, 22
    for color, width in ((HALO, 7), (MARK, 3)):
        outer = radius + width / 2
        draw.ellipse([x - outer, y - outer, x + outer, y + outer], outline=color, width=width)
        rim = 2 if color == HALO else 0
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            start, end = radius, reach + rim
            draw.line([x + dx * start, y + dy * start, x + dx * end, y + dy * end], fill=color, width=width)
    return np.asarray(image)


def cell_tile(rgb: UInt8[np.ndarray, "h w 3"], cell: Float64[np.ndarray, "4"]) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph, its longer side `TILE_SIDE` pixels, with a cell outlined; in the corner that is farthest from the
    cell the cell and what is around it, enlarged.

    Args:
        rgb: the photograph.
        cell: left, top, right and bottom edge in its pixels; what is outside the photograph is cut off.
    """
    height, width = rgb.shape[:2]
    left, right = np.clip(cell[[0, 2]], 0, width)
    top, bottom = np.clip(cell[[1, 3]], 0, height)
    image, factor = fit_in(rgb, TILE_SIDE)
    _outline(image, [left * factor, top * factor, right * factor, bottom * factor])
    middle_x, middle_y = (left + right) / 2, (top + bottom) / 2
    reach = max(CLOSE_CELLS * max(right - left, bottom - top), 12.0) / 2
    box = (middle_x - reach, middle_y - reach, middle_x + reach, middle_y + reach)
    scale = CLOSE_SIDE / (2 * reach)
    if scale <= 1.5 * factor:
        # The cell is large enough to be seen as it is.
        return np.asarray(image)
    close = Image.fromarray(np.ascontiguousarray(rgb)).transform(
        (CLOSE_SIDE, CLOSE_SIDE), Image.Transform.EXTENT, box, Image.Resampling.BICUBIC, fillcolor=FAINT
    )
    edges = [(edge - start) * scale for edge, start in zip((left, top, right, bottom), box[:2] * 2, strict=True)]
    _outline(close, edges)
    framed = Image.new("RGB", (CLOSE_SIDE + 4, CLOSE_SIDE + 4), PAPER)
    framed.paste(close, (2, 2))
    at_x = image.width - framed.width if middle_x < width / 2 else 0
    at_y = image.height - framed.height if middle_y < height / 2 else 0
    image.paste(framed, (at_x, at_y))
    return np.asarray(image)


def _outline(image: Image.Image, edges: Sequence[float]) -> None:
    """Outlines a rectangle from outside, so that what is in it stays as it is, but within the picture."""
    left, top, right, bottom = edges
    x, y = (left + right) / 2, (top + bottom) / 2
    half_x, half_y = (max(size, LEAST_OUTLINE) / 2 for size in (right - left, bottom - top))
    last_x, last_y = image.width - 1, image.height - 1
    draw = ImageDraw.Draw(image)
    for color, outside, width in ((HALO, 3, 4), (MARK, 2, 2)):
        # Where the picture ends, the outline lies in its last pixels.
        rim = 3 - outside
        corners = (
            np.clip(round(x - half_x - outside), rim, last_x),
            np.clip(round(y - half_y - outside), rim, last_y),
            np.clip(round(x + half_x + outside), 0, last_x - rim),
            np.clip(round(y + half_y + outside), 0, last_y - rim),
        )
        draw.rectangle([int(corner) for corner in corners], outline=color, width=width)


def _sheet(
    view: UInt8[np.ndarray, "h w 3"],
    view_name: str,
    strongest: PixelAttention,
    tiles: Sequence[tuple[UInt8[np.ndarray, "_h _w 3"], str, str]],
    bank: MemoryBank,
) -> UInt8[np.ndarray, "H W 3"]:
    """The view on the left and the tiles on the right, up to three in a row, with what they are above and below."""
    columns = min(3, len(tiles))
    block = max(tile.shape[0] for tile, _, _ in tiles) + BAR + CAPTION
    rows = -(-len(tiles) // columns)
    view_width = max(view.shape[1], LEAST_LEFT)
    left = 3 * GAP + view_width
    width = left + max(columns * (TILE_SIDE + GAP), LEAST_RIGHT)
    height = HEAD + max(view.shape[0] + CAPTION, rows * block)
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)

    def write(at: tuple[int, int], text: str, room: int, size: int, color: tuple[int, int, int] = INK) -> None:
        draw.text(at, fit_text(draw, text, room, size), fill=color, font=label_font(size))

    (x, y), total = strongest.pixel, 100 * float(strongest.weights.sum())
    write((GAP, GAP), "The query that is rendered in the marked pixel …", view_width, 19)
    write((GAP, GAP + 28), f"memory of {bank.space.name}", view_width, 15, FAINT)
    sheet.paste(Image.fromarray(view), (GAP, HEAD))
    write((GAP, HEAD + view.shape[0] + 6), f"column {x}, row {y} of {view_name}", view_width, 15, FAINT)
    room = width - left - GAP
    kinds = "component" if len(bank) == 1 else "components"
    write(
        (left, GAP), f"… attends most to these {len(tiles)} of {len(bank):,} {kinds}: {total:.1f} % together", room, 19
    )
    legend = "outlined: the cell whose feature the component is; enlarged in the corner"
    write((left, GAP + 28), legend, room, 15, FAINT)
    for number, (tile, where, cell) in enumerate(tiles):
        row, column = divmod(number, columns)
        at_x, at_y = left + column * (TILE_SIDE + GAP), HEAD + row * block
        sheet.paste(Image.fromarray(tile), (at_x, at_y))
        below = at_y + tile.shape[0] + 4
        weight = float(strongest.weights[number])
        draw.rectangle([at_x, below, at_x + TILE_SIDE - 1, below + BAR - 3], fill=EMPTY_BAR)
        if (filled := round(weight * TILE_SIDE)) > 0:
            draw.rectangle([at_x, below, at_x + filled - 1, below + BAR - 3], fill=FULL_BAR)
        write((at_x, below + BAR), f"{number + 1}.  {100 * weight:.1f} %", TILE_SIDE, 17)
        draw.text((at_x + TILE_SIDE, below + BAR + 3), cell, fill=FAINT, font=label_font(13), anchor="ra")
        write((at_x, below + BAR + 24), where, TILE_SIDE, 13, FAINT)
    return np.asarray(sheet)
