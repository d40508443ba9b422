"""Selected views as pictures: plain ones for a VLM, and an annotated sheet for people."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.infer.draw.pictures import Picture, contact_sheet, draw_boxes
from gsencoder.infer.views.marks import draw_marks
from gsencoder.infer.views.photographs import photograph_of, with_upright_frames
from gsencoder.infer.views.selection import SelectedView, ViewSet
from gsencoder.infer.views.targets import Target
from gsencoder.render import BlendConfig, blend
from gsencoder.render.images import render_image
from gsencoder.types import Box, Scene

PictureKind = Literal["photograph", "render"]
MIN_DESCRIBED_SHARE = 0.0005
"""Smaller shares of a picture are not told."""


def picture_kinds(scene: Scene, views: ViewSet) -> tuple[PictureKind, ...]:
    """What shows each chosen view: the photograph, where it is a frame of a scene that has photographs, or a render."""
    photograph_at = scene.views is not None and scene.views.images is not None
    return tuple("photograph" if photograph_at and each.frame is not None else "render" for each in views.chosen)


def view_pictures(
    scene: Scene, views: ViewSet, marked: Sequence[Target] = (), *, config: BlendConfig = BlendConfig()
) -> tuple[list[Picture], frozenset[int]]:
    """What each chosen camera shows, by `picture_kinds`, and the numbers of the marks that any of the pictures carries.

    Args:
        scene: with Gaussians, and with photographs where frames are to be shown as these.
        views: as chosen.
        marked: targets that carry numbers.
        config: accuracy of the renders.

    Raises:
        InputError: a scene without Gaussians.
    """
    if scene.gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    gaussians, scene = scene.gaussians, with_upright_frames(scene)
    config = replace(config, near=min(config.near, views.near))
    pictures: list[Picture] = []
    numbers: frozenset[int] = frozenset()
    for view, kind in enumerate(picture_kinds(scene, views)):
        photograph = _photograph(scene, views, view) if kind == "photograph" else None
        if photograph is not None and not marked:
            pictures.append(photograph)
            continue
        b = blend(gaussians, views.cameras, view, config=config)
        picture = render_image(gaussians, views.cameras, view, blended=b) if photograph is None else photograph
        picture, drawn = draw_marks(picture, b, marked)
        pictures.append(picture)
        numbers |= drawn
    return pictures, numbers


def _photograph(scene: Scene, views: ViewSet, view: int) -> Picture:
    frame = views.chosen[view].frame
    assert scene.views is not None
    assert frame is not None
    return photograph_of(scene.views, frame, views.cameras, view)


def view_sheet(
    scene: Scene, views: ViewSet, pictures: Sequence[Picture], boxes: Sequence[Box], *, columns: int = 4
) -> Picture:
    """All chosen views with the boxes drawn, and what each shows above it.

    Args:
        scene: where the boxes are.
        views: as chosen.
        pictures: of `view_pictures`.
        boxes: to draw.
        columns: of the sheet.
    """
    drawn = [
        draw_boxes(picture, boxes, pose, K, origin=scene.origin)
        for picture, pose, K in zip(pictures, views.cameras.cam_from_world, views.cameras.Ks, strict=True)
    ]
    titles = [f"{number}  {describe_view(each)}" for number, each in enumerate(views.chosen)]
    return contact_sheet(drawn, titles, columns=columns)


def describe_view(chosen: SelectedView) -> str:
    """Describes a view in one line."""
    shown = [sight for sight in chosen.target_scores if sight.share >= MIN_DESCRIBED_SHARE]
    description = "; ".join(
        f"{sight.target} fills {sight.share:{'.0%' if sight.share >= 0.01 else '.1%'}}, "
        f"{sight.visible * sight.inside:.0%} of it seen"
        for sight in shown
    )
    return f"{chosen.name}: {description or 'nothing of what was found'}" if chosen.target_scores else chosen.name
