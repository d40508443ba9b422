"""Selected views on disk: pictures, a contact sheet, and cameras with scores as JSON values."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.files import write_picture
from gsencoder.infer.draw.pictures import Picture
from gsencoder.infer.views.pictures import picture_kinds, view_sheet
from gsencoder.infer.views.selection import TargetScore, ViewSet
from gsencoder.types import Box, Scene
from gsencoder.types.checks import move_origin

SHEET = "sheet.png"
SUFFIX = ".png"
"""Of the pictures of views."""


def score_to_json(score: TargetScore) -> dict[str, Any]:
    """What a view shows of a target, under the keys of views.json."""
    return {
        "target": score.target,
        "visible": score.visible,
        "share": score.share,
        "inside": score.inside,
        "alpha": score.alpha,
        "blur": score.blur,
        "worth": score.utility,
    }


def views_to_json(scene: Scene, views: ViewSet) -> list[dict[str, Any]]:
    """The chosen views as JSON values, best first: names, pictures, scores, gains, and cameras in world coordinates
    with the origin added (cam_from_world and K in OpenCV's conventions)."""
    rows = []
    for number, (each, kind) in enumerate(zip(views.chosen, picture_kinds(scene, views), strict=True)):
        pose = move_origin(views.cameras.cam_from_world[number].astype(np.float64), -scene.origin)
        rows.append(
            {
                "name": each.name,
                "picture": f"view_{number:02d}{SUFFIX}",
                "kind": kind,
                "frame": each.frame,
                "clearance": each.clearance,
                "gain": each.gain,
                "covered": each.covered,
                "sights": [score_to_json(score) for score in each.target_scores],
                "cam_from_world": pose.tolist(),
                "K": views.cameras.Ks[number].tolist(),
                "width": int(views.cameras.widths[number]),
                "height": int(views.cameras.heights[number]),
            }
        )
    return rows


def write_pictures(
    folder: Path,
    scene: Scene,
    views: ViewSet,
    rows: Sequence[Mapping[str, Any]],
    pictures: Sequence[Picture],
    boxes: Sequence[Box],
) -> None:
    """Each picture under the name that its row gives it, and the sheet of all."""
    for picture, row in zip(pictures, rows, strict=True):
        write_picture(folder / row["picture"], picture)
    write_picture(folder / SHEET, view_sheet(scene, views, pictures, boxes))
