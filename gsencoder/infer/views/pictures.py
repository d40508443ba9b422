"""Selected views as pictures for a VLM, an annotated sheet for people, and features rendered in the layout of a vision
tower's output, which a VLM can take in place of its own (SplatDistill sec. 3.4)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_picture
from gsencoder.infer.draw import Picture, contact_sheet, draw_boxes, ink_on, label_font, word_color
from gsencoder.infer.views.photographs import photograph_of, with_upright_frames
from gsencoder.infer.views.targets import SelectedView, Target, ViewSet
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.images import render_image
from gsencoder.types import Box, Cameras, FeatureMap, FeatureSpace, GaussianFeatures, Gaussians, Scene
from gsencoder.types.scene import move_origin

SOLID_WEIGHT = 0.5
"""A pixel shows a target from so much weight on."""
MIN_MARKED_PIXELS = 12
"""Pixels that must show a target for it to be marked."""
MAX_MARK_COVER = 0.25
"""A disc stands on its target if it hides no more of it than that, and next to it otherwise."""
DIRECTIONS = 8
"""Ways from a target to places next to it."""


def draw_marks(
    picture: UInt8[np.ndarray, "h w 3"], blended: Blend, targets: Sequence[Target]
) -> tuple[UInt8[np.ndarray, "h w 3"], frozenset[int]]:
    """A picture with a numbered disc for each target that it shows, from 1 on in their order.

    A disc stands on the pixel of the target that is nearest to the middle of what is visible of it; where it would
    hide a small target, another disc, or leave the picture, it stands next to it, and a line leads to that pixel.

    Returns:
        The picture, and the numbers that it carries.
    """
    image = Image.fromarray(picture)
    radius = max(7, round(max(image.size) / 45))
    placed: dict[int, tuple[tuple[float, float], tuple[float, float]]] = {}
    for number, target in enumerate(targets, start=1):
        member = torch.zeros(blended.gaussians)
        member[torch.from_numpy(np.asarray(target.rows, np.int64))] = 1
        shown = blended.render(member).reshape(blended.shape).numpy() >= SOLID_WEIGHT
        if shown.sum() >= MIN_MARKED_PIXELS:
            photograph_at = [disc for _, disc in placed.values()]
            placed[number] = _mark_position(shown, radius, photograph_at)
    draw = ImageDraw.Draw(image)
    for number, (on, (x, y)) in placed.items():
        draw.line((*on, x, y), fill=(255, 255, 255), width=4)
        draw.line((*on, x, y), fill=word_color(number - 1), width=2)
    for number, (_, (x, y)) in placed.items():
        color = word_color(number - 1)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline=(255, 255, 255), width=2)
        draw.text((x, y), str(number), fill=ink_on(color), font=label_font(round(1.3 * radius)), anchor="mm")
    return np.asarray(image), frozenset(placed)


def _mark_position(
    shown: Bool[np.ndarray, "h w"], radius: int, photograph_at: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """The pixel of a target that its mark means, and where its disc stands; x and y of each."""
    pixels = np.argwhere(shown)[:, ::-1] + 0.5
    on = pixels[np.linalg.norm(pixels - pixels.mean(axis=0), axis=1).argmin()]
    size = np.array([shown.shape[1], shown.shape[0]], np.float64)
    inner = np.minimum(radius + 1.0, size / 2)
    candidates = [on] if math.pi * radius**2 <= MAX_MARK_COVER * len(pixels) else []
    half = (pixels.max(axis=0) - pixels.min(axis=0)) / 2
    middle = (pixels.max(axis=0) + pixels.min(axis=0)) / 2
    for ring in (1.5, 4.0, 6.5):
        for turn in np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS) - math.pi / 2:
            way = np.array([math.cos(turn), math.sin(turn)])
            candidates.append(middle + way * (np.minimum(half, 4 * radius) + ring * radius))
    inside = [np.clip(position, inner, size - inner) for position in candidates]
    others = np.array(photograph_at, np.float64).reshape(-1, 2)

    def faults(position: Float64[np.ndarray, "2"]) -> tuple[bool, bool]:
        near = np.linalg.norm(others - position, axis=1).min(initial=math.inf) < 2 * radius + 2
        return bool(near), bool((np.linalg.norm(pixels - position, axis=1) <= radius).mean() > MAX_MARK_COVER)

    # Of equal places the first: on the target, then nearest to it.
    x, y = min(inside, key=faults)
    return (float(on[0]), float(on[1])), (float(x), float(y))


PictureKind = Literal["photograph", "render"]
MIN_DESCRIBED_SHARE = 0.0005
"""Smaller shares of a picture are not described."""


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
    """
    if scene.gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    gaussians, scene = scene.gaussians, with_upright_frames(scene)
    config = replace(config, near=min(config.near, views.near))
    pictures: list[Picture] = []
    numbers: frozenset[int] = frozenset()
    for view, chosen in enumerate(views.chosen):
        photograph = None
        if chosen.frame is not None and scene.views is not None and scene.views.images is not None:
            photograph = photograph_of(scene.views, chosen.frame, views.cameras, view)
        if photograph is not None and not marked:
            pictures.append(photograph)
            continue
        b = blend(gaussians, views.cameras, view, config=config)
        picture = render_image(gaussians, views.cameras, view, blended=b) if photograph is None else photograph
        picture, drawn = draw_marks(picture, b, marked)
        pictures.append(picture)
        numbers |= drawn
    return pictures, numbers


def view_sheet(scene: Scene, views: ViewSet, pictures: Sequence[Picture], boxes: Sequence[Box]) -> Picture:
    """All chosen views with the boxes drawn, and what each shows above it."""
    drawn = [
        draw_boxes(picture, boxes, pose, K, origin=scene.origin)
        for picture, pose, K in zip(pictures, views.cameras.cam_from_world, views.cameras.Ks, strict=True)
    ]
    titles = [f"{number}  {describe_view(each)}" for number, each in enumerate(views.chosen)]
    return contact_sheet(drawn, titles, columns=4)


def describe_view(chosen: SelectedView) -> str:
    """Describes a view in one line."""
    shown = [score for score in chosen.target_scores if score.share >= MIN_DESCRIBED_SHARE]
    description = "; ".join(
        f"{score.target} fills {score.share:{'.0%' if score.share >= 0.01 else '.1%'}}, "
        f"{score.visible * score.inside:.0%} of it seen"
        for score in shown
    )
    return f"{chosen.name}: {description or 'nothing of what was found'}" if chosen.target_scores else chosen.name


SHEET = "sheet.png"
SUFFIX = ".png"
"""Of the pictures of views."""


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
                "sights": [asdict(score) for score in each.target_scores],
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


Fit = Literal["stretch", "crop"]
MOST_CELLS = 1 << 16


def tower_grid(width: int, height: int, grid: tuple[int, int], fit: Fit = "stretch") -> Float64[np.ndarray, "2 3"]:
    """From pixels of a picture to cells of a tower's grid, by the tower's own preprocessing.

    Args:
        width: of the picture, pixels.
        height: of the picture, pixels.
        fit: stretch = the whole picture is resized to the tower's, whatever its shape; crop = it is resized until it
            covers the tower's, and the middle is cut out. Square pictures need neither, nor the padding of towers that
            make a square by it.
    """
    lines, columns = grid
    if not (lines >= 1 and columns >= 1 and lines * columns <= MOST_CELLS):
        raise InputError(f"grid: expected rows and columns of 1 or more, at most {MOST_CELLS:,} cells, got {grid}")
    scale = np.array([columns / width, lines / height])
    if fit == "crop":
        scale[:] = scale.max()
    offset = (np.array([columns, lines]) - scale * (width, height)) / 2
    return np.array([[scale[0], 0, offset[0]], [0, scale[1], offset[1]]])


def token_blends(
    gaussians: Gaussians,
    cameras: Cameras,
    grid: tuple[int, int],
    *,
    fit: Fit = "stretch",
    config: BlendConfig = BlendConfig(),
) -> tuple[Blend, ...]:
    """The blending weights of each view, pooled to a tower's grid of rows and columns."""
    # A blend takes its grid from a map.
    space, cells = FeatureSpace(name="grid", channels=1), np.zeros((*grid, 1), np.float32)
    sizes = list(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True))
    return tuple(
        blend(
            gaussians,
            cameras,
            view,
            like=FeatureMap(grid_from_image=tower_grid(*size, grid, fit), space=space, features=cells),
            config=config,
        )
        for view, size in enumerate(sizes)
    )


def feature_tokens(blends: Sequence[Blend], features: GaussianFeatures) -> Float[Tensor, "V tokens D"]:
    """Rendered features of views as a vision tower would give them: patches in lines from the top left, D channels.

    A token is mean + Σᵢ B[p, i] (fᵢ − mean): where rays meet nothing, or Gaussians that no teacher saw, it is the mean.

    In a model of transformers these replace what the vision tower gives to the model's connector, by a forward hook on
    the tower. Where that is depends on the model: `last_hidden_state` for Idefics3 and SmolVLM, `hidden_states[-2]` for
    LLaVA, so that features must be of that layer; towers that begin with a summary token need theirs put first, and
    towers that merge patches before they give them (Qwen2-VL) need tokens on the merged grid.
    """
    if not blends or len({each.shape for each in blends}) > 1:
        raise InputError(f"tokens: expected blends on one grid, got {sorted({each.shape for each in blends})}")
    if any(each.gaussians != len(features) for each in blends):
        raise InputError(f"tokens: features of {len(features):,} Gaussians, blends of {blends[0].gaussians:,}")
    values = torch.from_numpy(features.stored())
    if features.basis is None:
        values = values - torch.from_numpy(features.mean)
    values = values * torch.from_numpy(features.seen)[:, None]
    tokens = torch.stack([each.render(values) for each in blends])
    if features.basis is not None:
        tokens = tokens @ torch.from_numpy(features.basis.components)
    return tokens + torch.from_numpy(features.mean)
