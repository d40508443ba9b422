"""Settings of a selection, what a selection is, and what views tell of Gaussians."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Int32

from gsencoder.core.errors import InputError
from gsencoder.fusion.cameras import check_orbits


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig:
    """How the Gaussians of a box become those of an object. Lengths are in spacings of the scene
    (`gsencoder.data.seeding.points.scene_spacing`)."""

    grow: bool = field(
        default=True,
        metadata={"help": "grow to the whole object; false = the Gaussians of the boxes, or above threshold=, alone"},
    )
    probable: float = field(
        default=0.5,
        metadata={
            "help": "without box= those boxes of a word are taken whose probability is at least this share of the "
            "most probable one's"
        },
    )
    share: float = field(
        default=0.5,
        metadata={
            "help": "a Gaussian is taken if its feature is more than this share object and less background; smaller = "
            "more of the rims"
        },
    )
    reach: float = field(
        default=4.0, metadata={"help": "no Gaussian farther than this from those of a box is taken, in spacings"}
    )
    only: float = field(
        default=0.9,
        metadata={
            "help": "a Gaussian whose feature is partly object is taken if so much of its blending weight over the "
            "views falls on pixels that the object dominates, and lost if no more than the rest of 1 does"
        },
    )
    views: int = field(default=48, metadata={"help": "so many views, evenly spaced, are looked at; 0 = none"})
    pixels: int = field(
        default=100_000, metadata={"help": "of views with more pixels every second, third, … in both directions counts"}
    )
    orbits: int = field(default=24, metadata={"help": "cameras for a splat without views"})

    def __post_init__(self) -> None:
        if not 0 <= self.probable <= 1:
            raise InputError(f"probable: expected a share in [0, 1], got {self.probable}")
        if not 0.5 <= self.only <= 1:
            raise InputError(f"only: expected a share in [0.5, 1], got {self.only}")
        if not 0 < self.share < 1:
            raise InputError(f"share: expected a share between 0 and 1, got {self.share}")
        if not 0 <= self.reach < math.inf:
            raise InputError(f"reach: expected zero or a positive number, got {self.reach}")
        for name, least in (("views", 0), ("pixels", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        check_orbits(self.orbits)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection:
    """A label for each Gaussian of a scene: 0 = none of the words, k + 1 = word k.

    Attributes:
        words: what was asked.
        labels: of every Gaussian.
        seeds: the labels before they grew.
        views: how many views were looked at.
        placed: whether these are cameras that were placed around or inside a splat without views.
    """

    words: tuple[str, ...]
    labels: Int32[np.ndarray, " N"]
    seeds: Int32[np.ndarray, " N"]
    views: int
    placed: bool

    def rows(self, word: int) -> Int32[np.ndarray, " n"]:
        """The Gaussians of word number `word`, ascending."""
        return np.flatnonzero(self.labels == word + 1).astype(np.int32)

    @property
    def rest(self) -> Bool[np.ndarray, " N"]:
        """The Gaussians of no word."""
        return np.asarray(self.labels == 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Votes:
    """Blending weight of each Gaussian over the pixels of each label, summed over views; pixels of the whole picture.

    Attributes:
        present: as the scene is.
        removed: as it is without the Gaussians that have a label; zeros for these. The pixels keep the labels that
            they had with them.
    """

    present: Float32[np.ndarray, "N labels"]
    removed: Float32[np.ndarray, "N labels"]
