"""Pictures of what a pixel attends to: the view with the pixel, and the photographs that its components come from."""

import warnings
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from PIL import Image, ImageDraw

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.draw import FAINT, PAPER, contact_sheet, draw_ring
from gsencoder.memory.attention import render_queries
from gsencoder.memory.bank import RawSample
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.images import RenderedImages, render_image
from gsencoder.types import MemoryBank, QueryMemory, Scene
from gsencoder.types.features import attention_keys

MIN_ALPHA = 0.5
"""Opacity, of Gaussians with a query, from which a pixel may be chosen."""
GRID = 64
"""Pixels of the longer side among which one is chosen."""


def strongest_components(
    memory: QueryMemory, b: Blend, pixel: tuple[int, int], count: int
) -> tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
    """At most `count` components, rows of the bank, that a pixel's rendered query gives the largest weights, and these
    weights; of equal ones the first."""
    (x, y), (height, width) = pixel, b.shape
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"pixel ({x}, {y}): expected a column from 0 to {width - 1} and a row from 0 to {height - 1}")
    # A camera of this pixel alone would see Gaussians at its rim linearized elsewhere.
    queries, alpha = (rows[[y * width + x]] for rows in render_queries(memory, b))
    if not alpha[0] > 0:
        raise InputError(
            f"pixel ({x}, {y}): no Gaussian with a query is seen in this pixel; choose one in which the rendered view "
            "shows something"
        )
    weights = memory.attention(queries)[0]
    order = np.argsort(-weights, kind="stable")[:count]
    return order, weights[order]


def salient_pixel(memory: QueryMemory, b: Blend) -> tuple[int, int] | None:
    """The pixel whose attention has the lowest entropy, so that few components are most of it: among evenly spaced
    pixels that are opaque, those of the middle half of the view if any of them is. None where no pixel is opaque."""
    height, width = b.shape
    columns, rows = (even_indices(size, max(1, size * GRID // max(height, width))) for size in (width, height))
    x, y = (each.ravel() for each in np.meshgrid(columns, rows))
    queries, alpha = render_queries(memory, b)
    opaque = alpha[y * width + x] >= MIN_ALPHA
    middle = (abs(2 * x + 1 - width) <= width / 2) & (abs(2 * y + 1 - height) <= height / 2)
    chosen = opaque & middle if (opaque & middle).any() else opaque
    if not chosen.any():
        return None
    pixels = (y * width + x)[chosen]
    entropy = attention_entropy(memory.attention(queries[pixels]))
    best = int(pixels[int(entropy.argmin())])
    return best % width, best // width


def attention_entropy(weights: Float32[np.ndarray, "n M"]) -> Float32[np.ndarray, " n"]:
    """−Σ w log w of each row of weights that sum to 1, in nats: 0 for one component, log M for M equal ones."""
    logs = np.log(np.maximum(weights, np.finfo(np.float32).tiny))
    return np.asarray(-(weights * logs).sum(axis=1), np.float32)


MARK, HALO = (255, 214, 0), (0, 0, 0)
"""The pixel and the cells are marked in one color, with a dark rim."""
SIDE, CLOSE_SIDE = 480, 150
"""Longer side of the view and of photographs, and the side of the close-up in a photograph's corner, in pixels."""
CLOSE_CELLS = 3.0
"""Cells along the side of a close-up."""
LEAST_OUTLINE = 7.0
"""Cells smaller than this many pixels of the picture are outlined as if they were this large."""


def attention_pictures(
    memory: QueryMemory, scene: Scene, *, views: int, config: BlendConfig = BlendConfig()
) -> Iterator[tuple[int, Image.Image]]:
    """For a number of evenly spaced views a picture of what their most salient pixel attends to."""
    if scene.gaussians is None or scene.views is None:
        raise InputError(f"pictures: scene {scene.name} needs Gaussians and cameras")
    for view in even_indices(len(scene.views), views).tolist():
        picture = attention_picture(memory, scene, view, config=config)
        if picture is None:
            name = scene.views.names[view]
            warnings.warn(f"pictures: view {name} shows no Gaussian with a query and is not drawn", SceneWarning, 2)
        else:
            yield view, Image.fromarray(picture)


def attention_picture(
    memory: QueryMemory,
    scene: Scene,
    view: int,
    pixel: tuple[int, int] | None = None,
    *,
    count: int = 6,
    config: BlendConfig = BlendConfig(),
) -> UInt8[np.ndarray, "H W 3"] | None:
    """A rendered view with a pixel marked, and for each of the pixel's strongest components the photograph that it
    comes from, with its cell outlined and enlarged in a corner, its rank, and its weight in the attention.

    Where the scene has no photographs, the views that the components come from are rendered.

    Args:
        scene: Gaussians, and the views that the memory was made from.
        pixel: column and row; None = `salient_pixel`, and no picture where no pixel is opaque.
        count: components that are drawn, at most.
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
    b = blend(gaussians, views.cameras, view, config=config)
    if pixel is None and (pixel := salient_pixel(memory, b)) is None:
        return None
    strongest, weights = strongest_components(memory, b, pixel, count)
    images = RenderedImages(gaussians, views.cameras, config) if views.images is None else views.images
    pictures = [mark_pixel(render_image(gaussians, views.cameras, view, blended=b), pixel)]
    titles = [f"{views.names[view]}, column {pixel[0]}, row {pixel[1]}, attends to …"]
    for rank, (component, weight) in enumerate(zip(strongest.tolist(), weights, strict=True), start=1):
        source, row, column = bank.sources[component].tolist()
        pictures.append(cell_tile(images[source], bank.cells[component]))
        rendered = ", rendered" if views.images is None else ""
        titles.append(f"{rank}.  {100 * weight:.1f} %  row {row}, column {column} of {views.names[source]}{rendered}")
    return contact_sheet(pictures, titles, columns=4, width=SIDE)


def fit_in(rgb: UInt8[np.ndarray, "h w 3"], side: int) -> tuple[Image.Image, float]:
    """A picture enlarged or reduced so that its longer side has this many pixels, and the factor."""
    factor = side / max(rgb.shape[:2])
    size = tuple(max(1, round(length * factor)) for length in (rgb.shape[1], rgb.shape[0]))
    return Image.fromarray(np.ascontiguousarray(rgb)).resize(size, Image.Resampling.BICUBIC), factor


def mark_pixel(rgb: UInt8[np.ndarray, "h w 3"], pixel: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """A view, its longer side `SIDE` pixels, with a ring around a pixel and lines that point at it."""
    image, factor = fit_in(rgb, SIDE)
    draw_ring(ImageDraw.Draw(image), (np.array(pixel) + 0.5) * factor, MARK)
    return np.asarray(image)


def cell_tile(rgb: UInt8[np.ndarray, "h w 3"], cell: Float64[np.ndarray, "4"]) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph, its longer side `SIDE` pixels, with a cell outlined; in the corner that is farthest from the
    cell the cell and what is around it, enlarged.

    Args:
        cell: left, top, right and bottom edge in its pixels; what is outside the photograph is cut off.
    """
    height, width = rgb.shape[:2]
    left, right = np.clip(cell[[0, 2]], 0, width)
    top, bottom = np.clip(cell[[1, 3]], 0, height)
    image, factor = fit_in(rgb, SIDE)
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


if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW_COLOR, COMPONENT_COLOR = "#5b8db8", "#d62728"
UMAP_LEAST = 10
"""Fewer features have no neighborhoods that UMAP could keep."""
UMAP_NEIGHBORS = 15
LONGEST_NAME = 60
MIN_SHARE = 1e-13
"""Smaller shares of the variance are rounding of float32."""


def check_umap() -> None:
    """Raises:
    InputError: the package umap-learn is not installed."""
    if find_spec("umap") is None:
        raise InputError("umap=true needs the package umap-learn: pip install 'gsencoder[umap]', or give umap=false")


def component_scatter(bank: MemoryBank, sample: RawSample, *, umap: bool = False) -> UInt8[np.ndarray, "H W 3"]:
    """Draws raw features as small blue dots and components as red ones, in the plane of the two directions along which
    the raw features vary most, and with `umap` also by UMAP (McInnes et al. 2018) of the cosines that the bank
    compares features by, as the paper does."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if sample.features.shape[1] != bank.space.channels:
        raise InputError(
            f"component_scatter: raw features of {sample.features.shape[1]} channels and components of "
            f"{bank.space.channels}; expected those of the same teacher"
        )
    if umap:
        check_umap()
    figure = Figure(figsize=(15 if umap else 8.4, 7.6), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2 if umap else 1, squeeze=False)[0]
    raw = sample.features
    mean, directions, shares = principal_plane(raw)
    _dots(panels[0], (raw - mean) @ directions, (bank.components - mean) @ directions)
    first, second = (f"{100 * share:.1f} % of their variance" for share in shares)
    panels[0].set_xlabel(f"first principal direction of the raw features, {first}", fontsize=12)
    panels[0].set_ylabel(f"second principal direction, {second}", fontsize=12)
    if umap:
        panels[0].set_title(f"PCA: {100 * shares.sum():.1f} % of the variance", fontsize=13)
        panels[1].set_title("UMAP: close dots have features of a high cosine", fontsize=13)
        panels[1].set_xticks([])
        panels[1].set_yticks([])
        both = attention_keys(np.concatenate([raw, bank.components]), bank.mean, "centered")
        if len(both) < UMAP_LEAST:
            text = f"UMAP needs {UMAP_LEAST} features or more;\nthere are {len(both)}."
            panels[1].text(0.5, 0.5, text, ha="center", va="center", fontsize=12, transform=panels[1].transAxes)
        else:
            plane = umap_plane(both)
            _dots(panels[1], plane[: len(raw)], plane[len(raw) :])
    figure.suptitle("\n".join(_title(bank, sample)), fontsize=13)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def principal_plane(
    features: Float32[np.ndarray, "n D"],
) -> tuple[Float64[np.ndarray, " D"], Float64[np.ndarray, "D 2"], Float64[np.ndarray, "2"]]:
    """The mean of features, the two orthonormal directions along which they vary most, and the shares of the variance
    along these. Where features have no variance along a direction, it is zero and its share is 0."""
    from sklearn.decomposition import PCA

    channels = features.shape[1]
    axes, shares = np.zeros((channels, 2)), np.zeros(2)
    if not len(features) or not np.ptp(features, axis=0).any():
        return features[:1].sum(axis=0, dtype=np.float64), axes, shares
    pca = PCA(min(2, *features.shape), random_state=0).fit(features.astype(np.float64))
    for number, share in enumerate(pca.explained_variance_ratio_):
        if share > MIN_SHARE:
            axis = pca.components_[number]
            # The largest entry is positive.
            axes[:, number] = axis * np.sign(axis[np.abs(axis).argmax()])
            shares[number] = share
    return pca.mean_, axes, shares


def umap_plane(vectors: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n 2"]:
    """UMAP's coordinates of `UMAP_LEAST` vectors or more, which are compared by their distances; its seed is fixed."""
    check_umap()
    if len(vectors) < UMAP_LEAST:
        raise InputError(f"umap: expected {UMAP_LEAST} features or more, got {len(vectors)}")
    with warnings.catch_warnings():
        # It warns about its own dependencies and about features far from all others, which are drawn all the same.
        warnings.simplefilter("ignore")
        from umap import UMAP

        neighbors = min(UMAP_NEIGHBORS, len(vectors) - 1)
        # Its own start needs a solver that fails where vectors are few or equal.
        mean, axes, shares = principal_plane(vectors)
        start = (vectors - mean) @ axes if shares.all() else "random"
        reducer = UMAP(n_neighbors=neighbors, init=start, random_state=0, n_jobs=1)
        return np.asarray(reducer.fit_transform(vectors), np.float32)


def _dots(axes: "Axes", raw: Float[np.ndarray, "n 2"], components: Float[np.ndarray, "M 2"]) -> None:
    from matplotlib.collections import PathCollection

    few = len(components) <= 100
    size, rim = (60, 0.6) if few else (16, 0.3)
    axes.scatter(
        raw[:, 0], raw[:, 1], s=5, color=RAW_COLOR, alpha=0.35, linewidths=0, label="raw feature", rasterized=True
    )
    x, y = components.T
    axes.scatter(x, y, s=size, color=COMPONENT_COLOR, label="component", linewidths=rim, edgecolors="white")
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    legend = axes.legend(loc="best", fontsize=12, framealpha=0.9)
    for handle, size in zip(legend.legend_handles, (40, 60), strict=True):
        assert isinstance(handle, PathCollection)
        handle.set_alpha(1)
        handle.set_sizes([size])


def _title(bank: MemoryBank, sample: RawSample) -> list[str]:
    name, drawn = bank.space.name, len(sample.features)
    shown = "" if drawn == sample.total else f", of which {drawn:,} are drawn"
    return [
        name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…",
        f"{len(bank):,} {'component' if len(bank) == 1 else 'components'} for {sample.total:,} "
        f"raw {'feature' if sample.total == 1 else 'features'}{shown}",
        f"{100 * bank.coverage:.1f} % of the raw features have a component within the threshold, "
        f"a cosine of {bank.threshold:.3f}",
    ]
