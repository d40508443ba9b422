"""Which views to show of what was found: SplatDistill sec. 3.4, "strategically sample multiple viewpoints".

Candidates are judged by what small renders show of the targets; a greedy choice then takes those that together show
them best: large and whole (`worth`), from all sides (`coverage` of their Gaussians, spread of directions), with what is
around them. Each of these sums has diminishing returns, so that the greedy choice is within 1 − 1/e of the best one
(Nemhauser, Wolsey and Fisher 1978).
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.errors import InputError, SceneWarning
from gsencoder.evenly import evenly
from gsencoder.infer.free_space import FreeSpace
from gsencoder.infer.view_candidates import frames_on, shell_cameras, up_of
from gsencoder.infer.view_judge import JUDGED, Looks, coverage, directions, look
from gsencoder.infer.view_targets import Target, check_targets
from gsencoder.types import Cameras, Scene

WATCHERS = 12
"""So many of the scene's cameras tell what is empty around the targets."""


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
        if not 1 <= self.count <= self.candidates:
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
        gain: what it added to the choice; None for uniform frames.
        covered: share of the targets' Gaussians that this view and those before it see well, by `coverage`; None where
            there are no targets.
        sights: one for each target.
    """

    name: str
    frame: int | None
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


def choose_views(scene: Scene, targets: Sequence[Target], config: ViewsConfig = ViewsConfig()) -> ViewSet:
    """The views that show targets best.

    Args:
        scene: Gaussians, and cameras where it has any.
        targets: what is looked at; all count alike. Evenly spread frames need none.
        config: see there.

    Raises:
        InputError: no Gaussians; no targets; frames are asked for where there are none; no camera finds room.
    """
    if scene.gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    if targets or config.method == "greedy":
        check_targets(targets, scene.gaussians)
    cameras, names, frames = (
        _uniform(scene, config) if config.method == "uniform" else _candidates(scene, targets, config)
    )
    looks = look(scene.gaussians, cameras, targets, side=config.judged_side)
    values = Values(cameras, targets, looks, config)
    if config.method == "uniform":
        order, gains = np.arange(len(cameras)), None
    else:
        order, gains = values.greedy(config.count)
    sights = [
        tuple(
            Sight(
                target=target.name,
                worth=float(worth[view]),
                **{name: float(getattr(each, name)[view]) for name in ("visible", "share", "inside", "alpha", "blur")},
            )
            for target, each, worth in zip(targets, looks, values.worths, strict=True)
        )
        for view in order
    ]
    return ViewSet(
        cameras=cameras.select(order),
        chosen=tuple(
            Chosen(
                name=names[view],
                frame=frames[view],
                gain=None if gains is None else float(gains[place]),
                covered=values.covered(order[: place + 1]),
                sights=sights[place],
            )
            for place, view in enumerate(order)
        ),
        judged=len(cameras),
    )


def _uniform(scene: Scene, config: ViewsConfig) -> tuple[Cameras, list[str], list[int | None]]:
    if scene.views is None:
        raise InputError(f"views: scene {scene.name} has no cameras to take evenly; take method=greedy source=shells")
    chosen = evenly(len(scene.views), config.count)
    return (
        _shown(scene.views.cameras.select(chosen), config),
        [scene.views.names[view] for view in chosen],
        chosen.tolist(),
    )


def _candidates(
    scene: Scene, targets: Sequence[Target], config: ViewsConfig
) -> tuple[Cameras, list[str], list[int | None]]:
    assert scene.gaussians is not None
    if config.source == "frames" and scene.views is None:
        raise InputError(f"views: scene {scene.name} has no cameras of its own; take source=shells")
    own = scene.views.cameras if scene.views is not None and len(scene.views) else None
    names: list[str] = []
    frames: list[int | None] = []
    parts: list[Cameras] = []
    if config.source != "shells" and own is not None and scene.views is not None:
        room = config.candidates if config.source == "frames" else config.candidates // 2
        taken = frames_on(own, targets, room)
        parts.append(_shown(own.select(taken), config))
        names += [scene.views.names[view] for view in taken]
        frames += taken.tolist()
    if config.source != "frames":
        free = FreeSpace(scene.gaussians, None if own is None else _watchers(own, targets), JUDGED)
        for target, room in zip(targets, _shared_out(config.candidates - len(frames), len(targets)), strict=True):
            around = shell_cameras(
                scene.gaussians,
                target,
                room,
                free.without(target.rows),
                up=up_of(scene),
                width=config.width,
                height=config.height,
                fov_degrees=config.fov,
            )
            if not len(around):
                warnings.warn(f"views: there is no room for a camera around {target.name}", SceneWarning, stacklevel=3)
            parts.append(around)
            names += [f"around {target.name} {number:02d}" for number in range(len(around))]
            frames += [None] * len(around)
    cameras = _joined(parts)
    if not len(cameras):
        raise InputError(
            f"views: there is no room for a camera around {', '.join(target.name for target in targets)}; "
            "take source=frames"
        )
    return cameras, names, frames


def _shown(frames: Cameras, config: ViewsConfig) -> Cameras:
    """Frames at the size of their pictures: photographs have far more pixels than anyone looks at."""
    return frames.resized(config.frame_side, enlarge=False)


def _watchers(cameras: Cameras, targets: Sequence[Target]) -> Cameras:
    """The cameras that see most of each target, as many for each."""
    each = max(1, WATCHERS // len(targets))
    return cameras.select(np.unique(np.concatenate([frames_on(cameras, [target], each) for target in targets])))


def _shared_out(total: int, parts: int) -> list[int]:
    """Whole numbers of one or more that come to a total, as equal as can be."""
    return [max(1, total // parts + (part < total % parts)) for part in range(parts)]


def _joined(parts: Sequence[Cameras]) -> Cameras:
    return Cameras(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("cam_from_world", "Ks", "widths", "heights")
        }
    )


def worth(looks: Looks, config: ViewsConfig) -> Float64[np.ndarray, " V"]:
    """What each view is worth for one target by itself, 0 to 1.

    Half comes from how much of the picture the target fills, up to `most_share`, in proportion below `least_share`;
    all of it is scaled by how much of the target is in the picture and not hidden, and by the opacity around it.
    """
    share = looks.share
    size = np.minimum(share / config.least_share, 1) * (0.5 + 0.5 * np.minimum(share / (config.most_share / 2), 1))
    size *= np.clip((1 - share) / (1 - config.most_share), 0, 1)
    return np.asarray(size * looks.visible * (0.5 + 0.5 * looks.inside) * np.clip(looks.alpha / 0.9, 0, 1) ** 2)


class Values:
    """What sets of candidates are worth."""

    def __init__(
        self, cameras: Cameras, targets: Sequence[Target], looks: Sequence[Looks], config: ViewsConfig
    ) -> None:
        self.worths = [worth(each, config) for each in looks]
        self._count = config.count
        self._weights = (config.cover_weight, config.context_weight, config.spread_weight)
        self._kept = []
        for target, each, value in zip(targets, looks, self.worths, strict=True):
            # How well a view sees something counts as far as it is a good view.
            best = float(value.max(initial=0))
            good = (value / best if best > 0 else value)[:, None]
            away = directions(cameras, target)
            towards = np.clip(away @ away.T, 0, 1)
            self._kept.append((coverage(each.target) * good, coverage(each.context) * good, towards * good))
        self._raw = [coverage(each.target) for each in looks]

    def covered(self, views: Int64[np.ndarray, " n"]) -> float | None:
        """Mean share of the targets' Gaussians that are seen as well as any candidate sees them."""
        if not self._raw:
            return None
        return float(np.mean([raw[views].max(axis=0).mean() for raw in self._raw]))

    def of(self, views: Sequence[int] | Int64[np.ndarray, " n"]) -> float:
        """What a set is worth: the sum that `greedy` makes large."""
        chosen = list(views)
        value = float(np.mean([worth[chosen].sum() for worth in self.worths]) / self._count)
        for parts in self._kept:
            for weight, part in zip(self._weights, parts, strict=True):
                if part.shape[1]:
                    value += weight / len(self._kept) * float(part[chosen].max(axis=0).mean())
        return value

    def greedy(self, count: int) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Views in the order of their gains, and these; of equal ones the first."""
        modular = np.mean(self.worths, axis=0) / self._count
        best = [[np.zeros(part.shape[1]) for part in parts] for parts in self._kept]
        order: list[int] = []
        gains: list[float] = []
        for _ in range(min(count, len(modular))):
            gain = modular.copy()
            for parts, now in zip(self._kept, best, strict=True):
                for weight, part, level in zip(self._weights, parts, now, strict=True):
                    if weight and part.shape[1]:
                        gain += weight / len(self._kept) * np.maximum(part - level, 0).mean(axis=1)
            gain[order] = -np.inf
            view = int(gain.argmax())
            order.append(view)
            gains.append(float(gain[view]))
            best = [
                [np.maximum(level, part[view]) for part, level in zip(parts, now, strict=True)]
                for parts, now in zip(self._kept, best, strict=True)
            ]
        return np.array(order, np.int64), np.array(gains)
