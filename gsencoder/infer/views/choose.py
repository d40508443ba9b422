"""The choice of views that show targets: SplatDistill sec. 3.4, "strategically sample multiple viewpoints".

Candidates are judged by what small renders show of the targets. A greedy choice then takes those that together show
them best. The utility of a set is a sum with diminishing returns: of what each view shows by itself
(`view_utility`), of how well the targets' Gaussians and their surroundings are covered, and of how spread the
directions are. The greedy choice is then within 1 − 1/e of the best one (Nemhauser, Wolsey and Fisher 1978).
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import orbit_cameras
from gsencoder.infer.views.candidates import FreeSpace, closeups, frames_on, shell_cameras, up_of
from gsencoder.infer.views.photographs import photograph_cameras, with_upright_frames
from gsencoder.infer.views.scores import ViewScores, coverage, directions, replace_with_photographs, score_views
from gsencoder.infer.views.targets import CONSTANTS, SelectedView, Target, TargetScore, ViewsConfig, ViewSet
from gsencoder.render import BlendConfig
from gsencoder.types import Cameras, Gaussians, Scene


def view_utility(scores: ViewScores) -> Float64[np.ndarray, " V"]:
    """Utility of each view for one target by itself, 0 to 1.

    Half comes from filling at least `least_share` of the picture, in proportion below it, half from filling up to half
    of `most_share`; a target that fills more than `most_share` counts less. All of it is scaled by how much of the
    target is in the picture and not hidden, by the opacity around it, and by its sharpness: Gaussians of
    `ViewConstants.half_blur` halve it.
    """
    share, least, most = scores.share, CONSTANTS.least_share, CONSTANTS.most_share
    size = np.minimum(share / least, 1) * (0.5 + 0.5 * np.minimum(share / (most / 2), 1))
    size *= np.clip((1 - share) / (1 - most), 0, 1)
    alpha = np.clip(scores.alpha / CONSTANTS.full_alpha, 0, 1)
    sharp = 1 / (1 + (scores.blur / CONSTANTS.half_blur) ** 2)
    return np.asarray(size * sharp * scores.visible * (0.5 + 0.5 * scores.inside) * alpha**2)


class CoverageObjective:
    """The utility of sets of candidates, and its greedy maximization."""

    def __init__(self, cameras: Cameras, targets: Sequence[Target], scores: Sequence[ViewScores], count: int) -> None:
        self.utilities = [view_utility(each) for each in scores]
        self._count = count
        weights = (CONSTANTS.cover_weight, CONSTANTS.context_weight, CONSTANTS.spread_weight)
        self._parts: list[Part] = []
        for target, each, value in zip(targets, scores, self.utilities, strict=True):
            # How well a view sees something counts as far as it is a good view.
            good = (value / max(float(value.max(initial=0)), CONSTANTS.min_best_utility))[:, None]
            away = directions(cameras, target)
            towards = np.clip(away @ away.T, 0, 1)
            for weight, part in zip(weights, (coverage(each.target), coverage(each.context), towards), strict=True):
                if part.shape[1]:
                    self._parts.append((weight / len(targets), part * good))
        self._coverages = [coverage(each.target) for each in scores]

    def covered(self, views: Int64[np.ndarray, " n"]) -> float | None:
        """How well views show the targets' Gaussians together; see `SelectedView`."""
        if not self._coverages:
            return None
        return float(np.mean([values[views].max(axis=0).mean() for values in self._coverages]))

    def value_of(self, views: Sequence[int] | Int64[np.ndarray, " n"]) -> float:
        """The utility of a set of views, which `greedy` maximizes."""
        chosen = list(views)
        value = float(np.mean([view_utility[chosen].sum() for view_utility in self.utilities]) / self._count)
        return value + sum(weight * float(part[chosen].max(axis=0).mean()) for weight, part in self._parts)

    def greedy(self, count: int) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """At most `count` views in the order in which they are chosen, and their gains."""
        modular = np.mean(self.utilities, axis=0) / self._count
        least = CONSTANTS.min_gain / self._count
        return greedy_order(self._parts, modular, count, relative=CONSTANTS.min_relative_gain, least=least)


Part = tuple[float, Float64[np.ndarray, "V _"]]
"""A weight, and how well each of V views covers each of several things."""


def greedy_order(
    parts: Sequence[Part], modular: Float64[np.ndarray, " V"], count: int, *, relative: float = 0, least: float = 0
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """At most `count` views in the order in which each adds most to Σ modular + Σ weight · mean over things of the best
    coverage, and what each adds. Ties go to the first view. The order ends before a view that adds no more than
    `least`, or than a share `relative` of what the first one adds; the first one is always taken."""
    best = [np.zeros(part.shape[1]) for _, part in parts]
    order: list[int] = []
    gains: list[float] = []
    for _ in range(min(count, len(modular))):
        gain = modular.copy()
        for (weight, part), level in zip(parts, best, strict=True):
            gain += weight * np.maximum(part - level, 0).mean(axis=1)
        gain[order] = -np.inf
        view = int(gain.argmax())
        if order and gain[view] <= max(relative * gains[0], least):
            break
        order.append(view)
        gains.append(float(gain[view]))
        best = [np.maximum(level, part[view]) for (_, part), level in zip(parts, best, strict=True)]
    return np.array(order, np.int64), np.array(gains)


def choose_views(
    scene: Scene, targets: Sequence[Target], config: ViewsConfig = ViewsConfig(), *, free: FreeSpace | None = None
) -> ViewSet:
    """The views that show targets best.

    Args:
        scene: Gaussians, and cameras where it has any. Frames of a scene with photographs are judged as these, and
            close-ups cut from them are candidates too.
        targets: what is looked at; all count alike. Evenly spread frames need none.
        free: the free space of the scene's Gaussians, for callers that choose more than once; None = it is made.
    """
    candidates = score_candidates(scene, targets, config, free)
    objective = CoverageObjective(candidates.cameras, targets, candidates.scores, config.count)
    if config.method == "uniform":
        order, gains = np.arange(len(candidates.cameras)), None
    else:
        order, gains = objective.greedy(config.count)
    if len(order) < config.count:
        reason = "no other shows more of what was found" if targets else "there are no more"
        message = f"views: {len(order)} of {config.count} in scene {scene.name}: {reason}"
        warnings.warn(message, SceneWarning, stacklevel=2)
    return view_set(targets, candidates, objective, order, gains)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Cameras, what they are called, which frames they are, and what they show of each target.

    Attributes:
        frames: None for cameras that were placed.
        free: the free space that they were placed in.
        blend: accuracy of the small renders.
    """

    cameras: Cameras
    names: list[str]
    frames: list[int | None]
    scores: tuple[ViewScores, ...]
    free: FreeSpace
    blend: BlendConfig


def score_candidates(
    scene: Scene, targets: Sequence[Target], config: ViewsConfig, free: FreeSpace | None = None
) -> Candidates:
    """Places candidates and scores them by small renders; see `choose_views`."""
    gaussians = scene.gaussians
    if gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    if not targets and config.method == "greedy":
        raise InputError("views: there is nothing to look at; give one target or more")
    for target in targets:
        if target.rows.min() < 0 or target.rows.max() >= len(gaussians):
            raise InputError(f"views: {target.name!r} has Gaussians beyond the {len(gaussians):,} of the splat")
    free = free or FreeSpace(gaussians)
    scene = with_upright_frames(scene)
    blend = replace(CONSTANTS.score_blend, near=min(CONSTANTS.score_blend.near, free.cell / 2))
    if config.method == "uniform":
        cameras, names, frames = _uniform(scene, gaussians, config)
    else:
        cameras, names, frames = _around_targets(scene, gaussians, targets, free, config, blend)
    scores = score_views(gaussians, cameras, targets, side=config.judged_side, config=blend)
    if scene.views is not None and scene.views.images is not None:
        is_photograph = np.array([frame is not None for frame in frames])
        scores = tuple(replace_with_photographs(each, is_photograph) for each in scores)
    return Candidates(cameras=cameras, names=names, frames=frames, scores=scores, free=free, blend=blend)


def view_set(
    targets: Sequence[Target],
    candidates: Candidates,
    objective: CoverageObjective,
    order: Int64[np.ndarray, " n"],
    gains: Float64[np.ndarray, " n"] | None,
) -> ViewSet:
    """Chosen candidates with what they show; warns of targets that none of them shows."""
    for target, each in zip(targets, candidates.scores, strict=True):
        seen = (each.visible * each.inside)[order].max(initial=0)
        if seen < CONSTANTS.min_visible:
            warnings.warn(f"views: no view shows more than {seen:.0%} of {target.name}", SceneWarning, stacklevel=3)

    def target_scores(view: int) -> tuple[TargetScore, ...]:
        return tuple(
            TargetScore(
                target=target.name,
                worth=float(utility[view]),
                **{name: float(getattr(each, name)[view]) for name in ("visible", "share", "inside", "alpha", "blur")},
            )
            for target, each, utility in zip(targets, candidates.scores, objective.utilities, strict=True)
        )

    cameras = candidates.cameras.select(order)
    clearance = candidates.free.clearance(cameras.centers)
    return ViewSet(
        cameras=cameras,
        chosen=tuple(
            SelectedView(
                name=candidates.names[view],
                frame=candidates.frames[view],
                clearance=float(clearance[position]),
                gain=None if gains is None else float(gains[position]),
                covered=objective.covered(order[: position + 1]),
                target_scores=target_scores(view),
            )
            for position, view in enumerate(order.tolist())
        ),
        judged=len(candidates.cameras),
        near=candidates.blend.near,
    )


Placed = tuple[Cameras, list[str], list[int | None]]
"""Cameras, their names, and which frames they are."""


def _uniform(scene: Scene, gaussians: Gaussians, config: ViewsConfig) -> Placed:
    """Evenly spread frames, or cameras around a splat that has none."""
    if scene.views is None or not len(scene.views):
        around = orbit_cameras(
            gaussians,
            count=config.count,
            width=config.width,
            height=config.height,
            fov_degrees=CONSTANTS.fov_degrees,
            up=scene.up,
        )
        return around, [f"orbit {number:02d}" for number in range(len(around))], [None] * len(around)
    chosen = even_indices(len(scene.views), config.count)
    cameras = _downscaled(scene.views.cameras.select(chosen), config)
    return cameras, [scene.views.names[view] for view in chosen], chosen.tolist()


def _around_targets(
    scene: Scene,
    gaussians: Gaussians,
    targets: Sequence[Target],
    free: FreeSpace,
    config: ViewsConfig,
    blend: BlendConfig,
) -> Placed:
    """Frames that show the targets, close-ups cut from them, and cameras on shells around the targets."""
    total = max(config.candidates, config.count)
    views = scene.views if scene.views is not None and len(scene.views) else None
    if config.source == "frames" and views is None:
        raise InputError(f"views: scene {scene.name} has no cameras; use choose.source=shells")
    names: list[str] = []
    frames: list[int | None] = []
    parts: list[Cameras] = []
    spaces = [free.without(target.rows) for target in targets]
    if config.source != "shells" and views is not None:
        room = total if config.source == "frames" else total // 2
        if views.images is not None and room >= 2 * len(targets):
            large = photograph_cameras(views)
            for target, space, part in zip(targets, spaces, _split_evenly(room // 2, len(targets)), strict=True):
                best = frames_on(views.cameras, gaussians, [target], part, [space])
                near, rows = closeups(large.select(best), gaussians, target, width=config.width, height=config.height)
                parts.append(near)
                names += [f"{views.names[view]} near {target.name}" for view in best[rows]]
                frames += best[rows].tolist()
        whole = frames_on(views.cameras, gaussians, targets, room - len(frames), spaces)
        parts.append(_downscaled(views.cameras.select(whole), config))
        names += [views.names[view] for view in whole]
        frames += whole.tolist()
    if config.source != "frames":
        if views is not None:
            count = max(CONSTANTS.free_space_cameras, len(targets))
            observers = frames_on(views.cameras, gaussians, targets, count, spaces)
            free = free.seen_by(views.cameras.select(observers), blend)
        up = up_of(scene)
        for target, room in zip(targets, _split_evenly(total - len(frames), len(targets)), strict=True):
            space = free.without(target.rows)
            around = shell_cameras(gaussians, target, room, space, up=up, width=config.width, height=config.height)
            if not len(around):
                warnings.warn(f"views: there is no room for a camera around {target.name}", SceneWarning, stacklevel=4)
            parts.append(around)
            names += [f"around {target.name} {number:02d}" for number in range(len(around))]
            frames += [None] * len(around)
    if not names:
        remedy = "choose.method=uniform looks at all of the splat" if views is None else "take choose.source=frames"
        raise InputError(
            f"views: there is no room for a camera around {', '.join(target.name for target in targets)} "
            f"(pictures of {config.width} x {config.height} pixels); {remedy}"
        )
    fields = ("cam_from_world", "Ks", "widths", "heights")
    cameras = Cameras(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})
    return cameras, names, frames


def _downscaled(frames: Cameras, config: ViewsConfig) -> Cameras:
    """Frames at the size of their pictures: photographs have far more pixels than anyone looks at."""
    return frames.resized(config.frame_side, enlarge=False)


def _split_evenly(total: int, parts: int) -> list[int]:
    """Whole numbers of one or more that come to a total, as equal as can be."""
    return [max(1, total // parts + (part < total % parts)) for part in range(parts)]
