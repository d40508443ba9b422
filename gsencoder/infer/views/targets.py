"""Targets of a choice of views: the Gaussians of boxes."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64, Integer

from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option
from gsencoder.render import BlendConfig
from gsencoder.types import Box, Cameras, Gaussians, Localization


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewConstants:
    """Constants of how candidates are placed, scored and chosen.

    The distances of shell cameras were chosen on the rooms train_000 and train_001 of the house scenes, the others by
    hand. What the choice reaches with them is measured on eight other rooms (docs/results/views.md).
    """

    # Targets
    least_share: float = 0.05  # A target should fill this much of the picture …
    most_share: float = 0.6  # … and no more than this
    # Smallest radius of a target, in median scales of its Gaussians: a single Gaussian is as large as it is drawn.
    point_radius_scales: float = 2.0

    # Free space
    min_obstacle_opacity: float = 0.3  # Gaussians of less opacity are no obstacle
    # Cameras of the scene whose depth maps tell what is empty; at least one for each target.
    free_space_cameras: int = 12
    free_space_side: int = 96  # Longer side of these depth maps, pixels
    min_depth_alpha: float = 0.5  # Rays of less opacity have met nothing that they could have looked up to
    # Edge of the cells in which rays are followed, in spacings of the splat: surfaces have no holes in such cells.
    cell_spacings: float = 2.0
    spacing_sample: int = 5000  # Gaussians by whose neighbors the spacing is estimated
    grid_cells: int = 1 << 20  # Cells along each side of the grid: three coordinates fit into 60 bits of an int64
    max_ray_cells: int = 512  # Cells through which a ray is followed at most
    clearance_neighbors: int = 8  # Patches whose surfaces are compared for the distance to the nearest one
    surface_sigmas: float = 2.0  # Standard deviations from a Gaussian's center to its surface
    max_uncut_edges: float = 2.0  # Gaussians of at most this many edges are not cut into patches
    # Patches that one Gaussian is cut into at most; a larger one gets larger patches.
    max_patches_per_gaussian: int = 4096
    # Patches that a splat is cut into at most, as far as one for each Gaussian allows (memory).
    max_patches: int = 1 << 21

    # The scene's own frames, ranked by rays before any render
    frame_rays: int = 12  # Rays from a target to each frame
    frame_batch: int = 32  # Frames whose rays are followed together (memory)
    blocked_frame_weight: float = 0.02  # Weight of a frame all of whose rays are blocked: rays may err
    # Half of the frames are spread over the recording; they are taken from this many times as many …
    spread_frames: int = 4
    # … that show at least this share of what the best frame shows: the best of a film are neighbors.
    min_spread_share: float = 0.25
    min_frame_depth: float = 1e-9  # Depth at which a target around the camera is taken to lie, world units

    # Cameras on shells around a target
    fov_degrees: float = 60.0  # Their horizontal field of view
    # Directions tried for each camera: many are blocked, or look at holes where nobody has been …
    tried_directions: int = 8
    min_tried_directions: int = 64  # … but never fewer than this
    # Shares of the picture that the target fills, by turns from direction to direction …
    fill_shares: tuple[float, ...] = (0.30, 0.18, 0.10)
    # … kept by this factor above `least_share` and below `most_share`: outlines are counted in cells.
    fill_margin: float = 1.5
    max_fill_share: float = 0.5  # A camera comes no nearer than where the target fills this share
    thin_fill_share: float = 0.08  # A long and thin target may leave the picture until it fills this share
    framed_share: float = 0.9  # A target that fits into the picture stays within this share of its width and height
    # Distance to surfaces, as a share of the distance to the target, or of the target's radius where that is less.
    clearance_share: float = 0.2
    outline_cells: int = 16  # Cells along a target's radius in which its outline is counted
    outline_sample: int = 1000  # Gaussians of a target that make its outline
    background_radii: float = 1.5  # Radii from its center at which rays test what is behind a target

    # Close-ups from photographs
    closeup_sample: int = 1000  # Gaussians of a target that tell where it is in a frame
    min_closeup_inside: float = 0.5  # Share of these that must be in the frame
    # Narrowest window in pixels of the photograph: a smaller one would be enlarged to a blur.
    min_closeup_width: int = 160
    # Windows of more than this share of a frame's width or height are left out: the frame itself shows as much.
    max_closeup_share: float = 0.75

    # Scores by small renders
    # Accuracy of the small renders: rays end where a fiftieth of their light is left.
    score_blend: BlendConfig = field(default_factory=lambda: BlendConfig(stop_transmittance=0.02, min_weight=1e-3))
    context_radii: float = 2.0  # Radius of the ball that is a target's context, in radii of the target
    coverage_sample: int = 2000  # Gaussians of a target, and of its context, on which coverage is computed
    min_weight: float = 0.05  # Blending weight from which on a pixel shows a target
    solid_share: float = 0.5
    """Visibility is counted over pixels at least this opaque by the target alone, as a share of the most opaque one:
    a thin rim is shared with what is behind it."""
    # Margin around a target on every side, as a share of its size: for its opacity score, and in close-ups.
    frame_margin: float = 0.5

    # Budgets of error and of megabytes
    # A Gaussian reaches no farther than this many standard deviations in a picture, and is left out of none by it.
    window_sigmas: float = 6.0
    error_safety: float = 1.2  # Factor on what small renders leave unseen …
    unsure_gaussians: float = 2.0  # … and Gaussians of each target that count as unseen on top of it
    # Pictures are made no smaller by a budget, longer side, pixels: the input of the smallest common vision towers.
    least_picture_side: int = 224

    # Utility of a view and of a set of views
    cover_weight: float = 0.3  # What seeing all of a target is worth
    context_weight: float = 0.1  # What seeing its surroundings is worth
    spread_weight: float = 0.2  # What seeing it from many directions is worth
    half_blur: float = 0.04
    """Standard deviation of the target's Gaussians, as a share of the picture's longer side, that halves a view's
    utility."""
    full_alpha: float = 0.9  # Mean opacity around a target from which on it does not lower the utility
    # Views are compared with the best one of a target, or with this where the best one is worse.
    min_best_utility: float = 0.1
    # The choice ends when the next view adds less than this share of what the first one added …
    min_relative_gain: float = 0.004
    min_gain: float = 1e-4  # … or less than a view of this utility by itself: not a pixel of the target
    min_visible: float = 0.1  # A warning says which targets no chosen view shows to this share


CONSTANTS = ViewConstants()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """Something to look at: Gaussians, and the ball that holds their means, relative to the scene's origin."""

    name: str
    rows: Integer[np.ndarray, " n"]
    center: Float64[np.ndarray, "3"]
    radius: float


def target_of(name: str, gaussians: Gaussians, rows: Integer[np.ndarray, " n"]) -> Target:
    """A target of some Gaussians."""
    if not len(rows):
        raise InputError(f"views: {name!r} has no Gaussians to look at")
    means = gaussians.means[rows].astype(np.float64)
    center = (means.min(axis=0) + means.max(axis=0)) / 2
    # A single Gaussian is as large as it is drawn.
    least = CONSTANTS.point_radius_scales * float(np.median(gaussians.scales[rows].max(axis=1)))
    radius = max(float(np.linalg.norm(means - center, axis=1).max()), least)
    return Target(name=name, rows=np.asarray(rows), center=center, radius=radius)


def best_boxes(localization: Localization, per_word: int) -> tuple[Box, ...]:
    """The first boxes of each word, best first."""
    return tuple(box for box in localization.boxes if box.rank < per_word)


def targets_of(gaussians: Gaussians, localization: Localization, per_word: int = 1) -> tuple[Target, ...]:
    """The best boxes of each word as targets; words without a box give none."""
    boxes = best_boxes(localization, per_word)
    names = [box.query if box.rank == 0 else f"{box.query} {box.rank + 1}" for box in boxes]
    return tuple(target_of(name, gaussians, box.rows) for name, box in zip(names, boxes, strict=True))


MAX_CANDIDATES = 4096
MAX_PIXELS = 8192


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsConfig:
    """How views are found and chosen."""

    source: Literal["both", "frames", "shells"] = option(
        "both", "the scene's own cameras, cameras around the targets, or up to half of each"
    )
    method: Literal["greedy", "uniform"] = option(
        "greedy", "the best by what they show, or evenly spread frames (the baseline)"
    )
    count: int = option(8, "views chosen", ge=1, le=MAX_CANDIDATES)
    candidates: int = option(
        32,
        "views judged (at least count, and one for each target); the paper's table has 16, 32 and 64",
        ge=1,
        le=MAX_CANDIDATES,
    )
    width: int = option(640, "of the pictures around targets, pixels", ge=1, le=MAX_PIXELS)
    height: int = option(480, "of the pictures around targets, pixels", ge=1, le=MAX_PIXELS)
    frame_side: int = option(1024, "frames are shown no larger than this, longer side, pixels", ge=1, le=MAX_PIXELS)
    # Smaller renders show small targets too large, as no Gaussian is drawn smaller than a pixel.
    judged_side: int = option(160, "longer side of the renders that candidates are judged by", ge=40, le=1024)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.method == "uniform" and self.source == "shells":
            raise InputError("source: expected frames or both with method=uniform, which spreads frames evenly")


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetScore:
    """What one view shows of one target: see `ViewScores`; alpha 1 and blur 0 where a photograph is shown. Its worth is
    its utility for this target alone, 0 to 1."""

    target: str
    visible: float
    share: float
    inside: float
    alpha: float
    blur: float
    worth: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectedView:
    """Why a view was chosen.

    Attributes:
        name: of the frame, "IMG_2.jpg near mug" for a close-up, or "around mug 03".
        frame: which of the scene's views it is or is cut from; None where it was placed.
        clearance: world units from the camera to the nearest surface.
        gain: what it added to the choice, with a budget of error by how much it lowered that; None for uniform frames.
        covered: how well this view and those before it show the targets' Gaussians, by `coverage`: 1 = each as well
            as the candidate that shows it best; None where there are no targets.
    """

    name: str
    frame: int | None
    clearance: float
    gain: float | None
    covered: float | None
    target_scores: tuple[TargetScore, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewSet:
    """Views that were chosen, best first (or in the scene's order where uniform), relative to the scene's origin.

    Attributes:
        near: near plane for their renders, world units: scenes of small units are not cut open.
    """

    cameras: Cameras
    chosen: tuple[SelectedView, ...]
    judged: int
    near: float

    def __len__(self) -> int:
        return len(self.cameras)
