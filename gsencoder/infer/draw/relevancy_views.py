"""Pictures of relevancy: views of the scene, and beside them heat maps of a word, with its boxes in both."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Integer
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.draw.pictures import contact_sheet, draw_boxes, relevancy_overlay
from gsencoder.render import BlendConfig, blend
from gsencoder.render.images import render_image, visible_shares
from gsencoder.types import Cameras, Gaussians, Localization, Scene
from gsencoder.types.orientation import upright_views

SPARE = 4
"""At least so many views beside the wanted ones are blended before the best are chosen."""
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


def relevancy_pictures(
    scene: Scene,
    localization: Localization,
    *,
    per_word: int,
    config: BlendConfig = BlendConfig(),
) -> Iterator[tuple[str, Image.Image]]:
    """For each word its best views: on the left the photograph, or where there is none the rendered view, on the right
    the relevancy of the word over the rendered view; the word's boxes are in both.

    Args:
        scene: Gaussians, and cameras with photographs or without.
        localization: relevancy and boxes of the words.
        per_word: views drawn for each word.
        config: accuracy of the rendering.

    Yields:
        A name (word and view, safe for a file) and the picture, view by view.

    Raises:
        InputError: the scene has no Gaussians or no cameras.
    """
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
        b = blend(scene.gaussians, cameras, view, config=config)
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
