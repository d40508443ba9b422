"""The stage of views for a vision-language model: cameras that show objects, and their pictures."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.evaluate.boxes import queryable_objects
from gsencoder.evaluate.tradeoff.fused_scene import TaughtScene, taught_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.infer.draw import Picture
from gsencoder.infer.knobs import VIEWS_KNOBS
from gsencoder.infer.localize import localize
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.scores import score_views
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet, target_of, targets_of
from gsencoder.render import BlendConfig

MAX_OBJECTS = 3
"""Objects of a scene that views are chosen of, evenly spread over those that were localized."""
JUDGED_SIDE = 480


class ChosenViews(NamedTuple):
    """Views of one object, and what they look like."""

    views: ViewSet
    pictures: list[Picture]


class ViewsScene:
    """A scene, what was localized in it, and where the objects really are."""

    def __init__(self, taught: TaughtScene) -> None:
        words = taught.need_words("views")
        scene = taught.with_fused()
        assert scene.views is not None
        # Chosen views are judged as renders, as they are when features are all that there is.
        self._scene = replace(scene, views=replace(scene.views, images=None))
        assert scene.gaussians is not None
        protocol = taught.inputs.protocol
        objects = queryable_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
        names = list(dict.fromkeys(scene_object.name for scene_object in objects if scene_object.name))
        if not names:
            raise InputError(f"tradeoff: scene {scene.name} has no object to choose views of")
        boxes = localize(scene, names, words, taught.inputs.localize)
        pairs: list[tuple[Target, Target]] = []
        means = scene.gaussians.means + scene.origin
        for target in targets_of(scene.gaussians, boxes):
            same = [scene_object for scene_object in objects if scene_object.name == target.name]
            away = [
                np.linalg.norm((scene_object.aabb_min + scene_object.aabb_max) / 2 - scene.origin - target.center)
                for scene_object in same
            ]
            nearest = same[int(np.argmin(away))]
            rows = np.flatnonzero(((means >= nearest.aabb_min) & (means <= nearest.aabb_max)).all(axis=1))
            if len(rows):
                pairs.append((target, target_of(target.name, scene.gaussians, rows)))
        if not pairs:
            raise InputError(f"tradeoff: no object of scene {scene.name} was localized, so that it has no views")
        self._pairs = [pairs[index] for index in even_indices(len(pairs), MAX_OBJECTS)]

    def run(self, settings: ViewsConfig) -> list[ChosenViews]:
        selections = []
        for target, _ in self._pairs:
            views = choose_views(self._scene, [target], settings)
            selections.append(ChosenViews(views, view_pictures(self._scene, views)[0]))
        return selections

    def judge(self, product: list[ChosenViews], settings: ViewsConfig) -> Judged:  # noqa: ARG002
        assert self._scene.gaussians is not None
        share = visible = 0.0
        for (_, truth), each in zip(self._pairs, product, strict=True):
            near = replace(BlendConfig(), near=min(BlendConfig().near, each.views.near))
            (box_scores,) = score_views(
                self._scene.gaussians, each.views.cameras, [truth], side=JUDGED_SIDE, config=near
            )
            share += float(box_scores.share.mean())
            visible += float((box_scores.visible * box_scores.inside).mean())
        count = len(product)
        scores = {
            "object_share": Score(share, count),
            "visible": Score(visible, count),
            "views": Score(float(sum(len(each.views) for each in product)), count),
        }
        return Judged(scores=scores, bytes=sum(png_bytes(picture) for each in product for picture in each.pictures))


def png_bytes(picture: Picture) -> int:
    """Bytes of a picture as it is sent to a model."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG")
    return len(stream.getvalue())


def views_stage(inputs: Inputs) -> Stage:
    """Views of objects that are localized in features that `inputs` say how to fuse."""

    @contextmanager
    def opened(path: Path) -> Iterator[ViewsScene]:
        with taught_scene(path, inputs) as taught:
            yield ViewsScene(taught)

    return Stage(name="views", knobs=VIEWS_KNOBS, base=inputs.views, open=opened, accuracy="visible")
