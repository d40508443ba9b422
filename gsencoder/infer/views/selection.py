"""Settings and result of a choice of views."""

from dataclasses import dataclass, field
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras

MAX_CANDIDATES = 4096
MAX_PIXELS = 8192
MAX_WEIGHT = 1e6
MAX_FOV = 120.0
"""Gaussians are projected as if the picture were flat around each; degrees up to which that looks right."""
JUDGED_SIDES = (40, 1024)
"""Smaller pictures show small targets too large, because no Gaussian is drawn smaller than a pixel; larger ones cost
gigabytes and tell no more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsConfig:
    """How views are found and chosen."""

    source: Literal["both", "frames", "shells"] = field(
        default="both", metadata={"help": "the scene's own cameras, cameras around the targets, or up to half of each"}
    )
    method: Literal["greedy", "uniform"] = field(
        default="greedy", metadata={"help": "the best by what they show, or evenly spread frames (the baseline)"}
    )
    count: int = field(default=8, metadata={"help": "views chosen"})
    candidates: int = field(
        default=32,
        metadata={
            "help": "views judged (at least count, and one for each target); the paper's table has 16, 32 and 64"
        },
    )
    width: int = field(default=640, metadata={"help": "of the pictures around targets, pixels"})
    height: int = field(default=480, metadata={"help": "of the pictures around targets, pixels"})
    fov: float = field(default=60.0, metadata={"help": "their horizontal field of view, degrees"})
    frame_side: int = field(
        default=1024, metadata={"help": "frames are shown no larger than this, longer side, pixels"}
    )
    judged_side: int = field(default=160, metadata={"help": "longer side of the renders that candidates are judged by"})
    least_share: float = field(default=0.05, metadata={"help": "a target should fill this much of the picture …"})
    most_share: float = field(default=0.6, metadata={"help": "… and no more than this"})
    cover_weight: float = field(default=0.3, metadata={"help": "what seeing all of a target is worth"})
    context_weight: float = field(default=0.1, metadata={"help": "what seeing its surroundings is worth"})
    spread_weight: float = field(default=0.2, metadata={"help": "what seeing it from many directions is worth"})

    def __post_init__(self) -> None:
        for name in ("count", "candidates"):
            if not 1 <= getattr(self, name) <= MAX_CANDIDATES:
                raise InputError(f"{name}: expected 1 to {MAX_CANDIDATES}, got {getattr(self, name)}")
        if self.method == "uniform" and self.source == "shells":
            raise InputError("source: expected frames or both with method=uniform, which spreads frames evenly")
        for name in ("width", "height", "frame_side"):
            if not 1 <= getattr(self, name) <= MAX_PIXELS:
                raise InputError(f"{name}: expected 1 to {MAX_PIXELS} pixels, got {getattr(self, name)}")
        if not 1 <= self.fov <= MAX_FOV:
            raise InputError(f"fov: expected 1 to {MAX_FOV:g} degrees, got {self.fov}")
        if not JUDGED_SIDES[0] <= self.judged_side <= JUDGED_SIDES[1]:
            raise InputError(
                f"judged_side: expected {JUDGED_SIDES[0]} to {JUDGED_SIDES[1]} pixels, got {self.judged_side}"
            )
        if not 0 < self.least_share < self.most_share < 1:
            raise InputError(
                f"least_share, most_share: expected shares that rise between 0 and 1, got {self.least_share}, "
                f"{self.most_share}"
            )
        for name in ("cover_weight", "context_weight", "spread_weight"):
            if not 0 <= getattr(self, name) <= MAX_WEIGHT:
                raise InputError(f"{name}: expected 0 to {MAX_WEIGHT:g}, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetScore:
    """What one view shows of one target; see `ViewScores`.

    Attributes:
        target: its name.
        visible, share, inside, alpha, blur: as in `ViewScores`; alpha 1 and blur 0 where a photograph is shown.
        utility: of the view for this target alone, 0 to 1.
    """

    target: str
    visible: float
    share: float
    inside: float
    alpha: float
    blur: float
    utility: float


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
        target_scores: one for each target.
    """

    name: str
    frame: int | None
    clearance: float
    gain: float | None
    covered: float | None
    target_scores: tuple[TargetScore, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewSet:
    """Views that were chosen, best first (or in the scene's order where uniform).

    Attributes:
        cameras: relative to the scene's origin.
        chosen: why, one for each.
        judged: how many candidates there were.
        near: near plane for their renders, world units: scenes of small units are not cut open.
    """

    cameras: Cameras
    chosen: tuple[SelectedView, ...]
    judged: int
    near: float

    def __len__(self) -> int:
        return len(self.cameras)
