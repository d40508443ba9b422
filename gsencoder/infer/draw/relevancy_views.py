"""Pictures of relevancy: heat maps of a word over rendered views of the scene, with its boxes."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Integer
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.draw.pictures import draw_boxes, relevancy_overlay
from gsencoder.render import BlendConfig, blend
from gsencoder.render.images import render_image
from gsencoder.types import Cameras, Gaussians, Localization, Scene

_SIDE = 96
"""Views are judged at this size, longer side in pixels, which is enough to see who sees what."""


def best_views(
    gaussians: Gaussians, cameras: Cameras, groups: Sequence[Integer[np.ndarray, "_n"]], count: int
) -> list[list[int]]:
    """For each group of Gaussians the `count` views that show the most of it, best first.

    A view's worth is the share of its picture that the group's rows fill, by their blending weights: what hides them
    counts.
    """
    small = cameras.resized(_SIDE)
    chosen = np.zeros((len(gaussians), len(groups)), np.float32)
    for column, rows in enumerate(groups):
        chosen[rows, column] = 1
    members = torch.from_numpy(chosen)
    visible_share = np.array(
        [blend(gaussians, small, view).render(members).mean(dim=0).numpy() for view in range(len(cameras))]
    )
    # A stable sort of negated values: of equal views the first.
    return [order[:count].tolist() for order in np.argsort(-visible_share, axis=0, kind="stable").T]


def relevancy_pictures(
    scene: Scene,
    localization: Localization,
    *,
    per_word: int,
    config: BlendConfig = BlendConfig(),
) -> Iterator[tuple[str, Image.Image]]:
    """For each word its best views, rendered, with relevancy over them and its boxes.

    Args:
        scene: Gaussians and cameras.
        localization: relevancy and boxes of the words.
        per_word: views drawn for each word.
        config: accuracy of the rendering.

    Yields:
        A name (word and view, safe for a file) and the picture.

    Raises:
        InputError: the scene has no Gaussians or no cameras.
    """
    if scene.gaussians is None or scene.views is None:
        raise InputError(f"pictures: scene {scene.name} needs Gaussians and cameras")
    cameras = scene.views.cameras
    boxes_of = {word: [box for box in localization.boxes if box.query == word] for word in localization.queries}
    groups = [
        boxes_of[word][0].rows if boxes_of[word] else np.flatnonzero(relevancy >= threshold)
        for word, relevancy, threshold in zip(
            localization.queries, localization.relevancy, localization.thresholds, strict=True
        )
    ]
    chosen = best_views(scene.gaussians, cameras, groups, per_word)
    for index, word in enumerate(localization.queries):
        boxes = boxes_of[word]
        for view in chosen[index]:
            b = blend(scene.gaussians, cameras, view, config=config)
            rgb = render_image(scene.gaussians, cameras, view, blended=b)
            scores = torch.from_numpy(np.nan_to_num(localization.relevancy[index], nan=0.0))
            heat = b.render(scores).reshape(b.shape).numpy()
            picture = relevancy_overlay(rgb, heat)
            pose, K = cameras.cam_from_world[view], cameras.Ks[view]
            picture = draw_boxes(picture, boxes, pose, K, origin=scene.origin)
            safe = "".join(c if c.isalnum() else "_" for c in word)[:60]
            yield f"{index:02d}_{safe}_view{view:03d}", Image.fromarray(picture)
