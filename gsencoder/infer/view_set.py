"""What is asked of a choice of views, and what comes of it."""

from dataclasses import dataclass, field
from typing import Literal

from gsencoder.errors import InputError
from gsencoder.types import Cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsConfig:
    """How views are found and chosen."""

    source: Literal["both", "frames", "shells"] = field(
        default="both", metadata={"help": "the scene's own cameras, cameras around the targets, or half of each"}
    )
    method: Literal["greedy", "uniform"] = field(
        default="greedy", metadata={"help": "the best by what they show, or evenly spread frames (the baseline)"}
    )
    count: int = field(default=8, metadata={"help": "views chosen"})
    candidates: int = field(default=32, metadata={"help": "views judged; the paper's table has 16, 32 and 64"})
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
        if self.count < 1 or self.candidates < 1:
            raise InputError(f"count, candidates: expected 1 or more, got {self.count}, {self.candidates}")
        if self.method == "greedy" and self.count > self.candidates:
            raise InputError(f"count: expected 1 to candidates={self.candidates}, got {self.count}")
        if self.width < 1 or self.height < 1 or not 1 <= self.fov <= 170:
            raise InputError(
                f"width, height, fov: expected pixels and 1 to 170 degrees, got {self.width}, {self.height}, {self.fov}"
            )
        if self.frame_side < 1:
            raise InputError(f"frame_side: expected 1 pixel or more, got {self.frame_side}")
        if not 8 <= self.judged_side <= 4096:
            raise InputError(f"judged_side: expected 8 to 4096 pixels, got {self.judged_side}")
        if not 0 < self.least_share < self.most_share < 1:
            raise InputError(
                f"least_share, most_share: expected shares that rise, got {self.least_share}, {self.most_share}"
            )
        for name in ("cover_weight", "context_weight", "spread_weight"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected zero or a positive number, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """What one view shows of one target; see `view_judge.Looks`.

    Attributes:
        target: its name.
        visible, share, inside, alpha, blur: as judged.
        worth: what these come to, 0 to 1.
    """

    target: str
    visible: float
    share: float
    inside: float
    alpha: float
    blur: float
    worth: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """Why a view was chosen.

    Attributes:
        name: of the frame, or "around mug 03".
        frame: which of the scene's views it is; None where it was placed.
        clearance: world units from the camera to the nearest surface; None where there are no targets.
        gain: what it added to the choice; None for uniform frames.
        covered: how well this view and those before it show the targets' Gaussians, by `coverage`: 1 = each as well
            as the candidate that shows it best; None where there are no targets.
        sights: one for each target.
    """

    name: str
    frame: int | None
    clearance: float | None
    gain: float | None
    covered: float | None
    sights: tuple[Sight, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewSet:
    """Views that were chosen, best first (or in the scene's order where uniform).

    Attributes:
        cameras: relative to the scene's origin.
        chosen: why, one for each.
        judged: how many candidates there were.
    """

    cameras: Cameras
    chosen: tuple[Chosen, ...]
    judged: int

    def __len__(self) -> int:
        return len(self.cameras)
