"""Relevancy of words at the pixels of a view, cosines with blended features, and the views that show it.

The feature of a pixel is f[p] = Σ w[p, i] f[i] / Σ w[p, i], over the Gaussians that have one, and its relevancy for a
word t is the cosine cos(f[p] − mean, t). A cosine of blended features is no blend of cosines, but its parts are simple:
Σ w[p, i] (f[i] − mean)·t is one channel that B renders, and the length of Σ w[p, i] (f[i] − mean) is the same for all
words. So all channels are rendered once for a view, and one channel for each word.

Q words, N Gaussians, P pixels, D channels, S axes of the features (see `FeatureAxes`).
"""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float32, Float64, Integer
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.draw import contact_sheet, draw_boxes, relevancy_overlay
from gsencoder.infer.relevancy import EPS, MIN_RELATIVE_NORM, GaussianProducts, Mode
from gsencoder.memory.attention import render_queries
from gsencoder.render import Blend, blend
from gsencoder.render.images import render_image, visible_shares
from gsencoder.types import Cameras, Gaussians, Localization, QueryMemory, Scene
from gsencoder.types.orientation import upright_views

BLOCK_AXES = 32
"""Axes that are rendered at once where the lengths of features at pixels are computed."""


class BlendedFeatures:
    """Features of Gaussians as a view blends them; alpha is how opaque those that have a feature make each pixel."""

    alpha: Float32[np.ndarray, " P"]

    def __init__(self, products: GaussianProducts, b: Blend) -> None:
        self._products, self._b = products, b
        alpha = b.render(torch.from_numpy(products.features.seen.astype(np.float32)))
        squares = alpha.double() ** 2 * products.axes.floor
        for start in range(0, len(products.axes.offset), BLOCK_AXES):
            block = products.along(slice(start, start + BLOCK_AXES))
            rendered = b.render(torch.from_numpy(block))
            squares += torch.einsum("ps,ps->p", rendered, rendered)
        self.alpha = alpha.numpy()
        self._inverse_lengths = (1 / squares.clamp(min=EPS).sqrt()).float()

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q P"]:
        """Cosines with words of length 1; rounding may lead a little beyond 1. They mean nothing where alpha is 0."""
        rendered = self._b.render(torch.from_numpy(self._products.products(directions)))
        return (rendered * self._inverse_lengths[:, None]).T.numpy()


class AttendedQueries:
    """Features that the queries of a view's pixels attend to in the bank of a memory; alpha is how opaque the Gaussians
    that have a query make each pixel. Attention is not linear, so that the features of all pixels are computed."""

    alpha: Float32[np.ndarray, " P"]

    def __init__(self, memory: QueryMemory, b: Blend, mode: Mode = "centered") -> None:
        queries, self.alpha = render_queries(memory, b)
        mean = memory.mean.astype(np.float64)
        removed = mean if mode == "centered" else np.zeros_like(mean)
        # The weights of the components sum to 1, so that the mean can be taken off the components.
        local = memory.bank.components - removed
        # Features are means of the components, which lie in as many axes.
        self._axes = np.linalg.qr(local.T)[0] if len(local) < local.shape[1] else np.eye(local.shape[1])
        features = memory.attend(queries, (local @ self._axes).astype(np.float32))
        squares = np.einsum("ps,ps->p", features, features, dtype=np.float64)
        floor = EPS + MIN_RELATIVE_NORM**2 * float(removed @ removed)
        features /= np.sqrt(squares + floor)[:, None].astype(np.float32)
        self._directions = features

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q P"]:
        """See `BlendedFeatures.cosines`."""
        return (self._directions @ (directions @ self._axes).T.astype(np.float32)).T


PixelFeatures = BlendedFeatures | AttendedQueries
"""The features at the pixels of a view, as words are compared with them."""


def pixel_features(
    products: GaussianProducts, b: Blend, *, memory: QueryMemory | None = None, mode: Mode = "centered"
) -> PixelFeatures:
    """The features at the pixels of a view: of a memory if one is given, else of the Gaussians."""
    if b.gaussians != len(products.features):
        raise InputError(f"features of {len(products.features):,} Gaussians, and a view of {b.gaussians:,}")
    return BlendedFeatures(products, b) if memory is None else AttendedQueries(memory, b, mode)


SPARE = 4
"""Smallest number of further views that are blended before the best are chosen."""
_SIDE = 96
"""Views are judged at this size, longer side in pixels, which is enough to see who sees what."""


def best_views(
    gaussians: Gaussians, cameras: Cameras, groups: Sequence[Integer[np.ndarray, "_n"]], count: int
) -> list[list[int]]:
    """For each group of Gaussians the `count` views that show the most of it, best first.

    A view's worth is the share of its picture that the group's rows fill, by their blending weights: what hides them
    counts. It is estimated for all views by a depth buffer, and blended for those that may be among the best: for each
    group the first `count` and as many again, or four. A group that the depth buffer shows in fewer than `count` views
    is blended in all of them.
    """
    small = cameras.resized(_SIDE)
    estimates = visible_shares(gaussians, small, groups)
    chosen = np.zeros((len(gaussians), len(groups)), np.float32)
    for column, rows in enumerate(groups):
        chosen[rows, column] = 1
    members = torch.from_numpy(chosen)
    order = np.argsort(-estimates, axis=0, kind="stable")
    few = (estimates > 0).sum(axis=0) < min(count, len(cameras))
    candidates = order if few.any() else order[: count + max(count, SPARE)]
    # Views that nobody looks at come after all others.
    worth = np.full(estimates.shape, -1.0)
    for view in np.unique(candidates):
        worth[view] = blend(gaussians, small, int(view)).render(members).mean(dim=0).numpy()
    # A stable sort of negated values: of equal views the first.
    return [views[:count].tolist() for views in np.argsort(-worth, axis=0, kind="stable").T]


def relevancy_pictures(scene: Scene, localization: Localization, *, per_word: int) -> Iterator[tuple[str, Image.Image]]:
    """For each word its best views: on the left the photograph, or where there is none the rendered view, on the right
    the relevancy of the word over the rendered view; the word's boxes are in both."""
    if scene.gaussians is None or scene.views is None:
        raise InputError(f"pictures: scene {scene.name} needs Gaussians and cameras")
    views = upright_views(scene.views)
    cameras, images = views.cameras, views.images
    boxes_of = {word: [box for box in localization.boxes if box.query == word] for word in localization.queries}
    groups = [
        boxes_of[word][0].rows if boxes_of[word] else np.flatnonzero(relevancy >= threshold)
        for word, relevancy, threshold in zip(
            localization.queries, localization.relevancy, localization.thresholds, strict=True
        )
    ]
    chosen = best_views(scene.gaussians, cameras, groups, per_word)
    # Each view is looked at once, for all words that want it.
    for view in sorted({view for views in chosen for view in views}):
        b = blend(scene.gaussians, cameras, view)
        rgb = render_image(scene.gaussians, cameras, view, blended=b)
        seen = rgb if images is None else images[view]
        kind = "rendered" if images is None else "photograph"
        pose, K = cameras.cam_from_world[view], cameras.Ks[view]
        word_rows = [index for index, views in enumerate(chosen) if view in views]
        scores = torch.from_numpy(np.nan_to_num(localization.relevancy[word_rows].T, nan=0.0))
        heats = b.render(scores).numpy()
        for column, index in enumerate(word_rows):
            word = localization.queries[index]
            heat = relevancy_overlay(rgb, heats[:, column].reshape(b.shape))
            halves = [draw_boxes(half, boxes_of[word], pose, K, origin=scene.origin) for half in (seen, heat)]
            titles = (
                f"{views.names[view]}, {kind}",
                f"relevancy of {word!r}, threshold {localization.thresholds[index]:.2f}",
            )
            picture = contact_sheet(halves, titles, columns=2, width=halves[0].shape[1])
            safe = "".join(c if c.isalnum() else "_" for c in word)[:60]
            yield f"{index:02d}_{safe}_view{view:03d}", Image.fromarray(picture)
