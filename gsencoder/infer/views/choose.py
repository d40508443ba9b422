"""The choice of views that show targets: SplatDistill sec. 3.4, "strategically sample multiple viewpoints".

Candidates are judged by what small renders show of the targets; a greedy choice then takes those that together show
them best: large and whole, from all sides, with what is around them (`view_worth`).

The utility of views, by themselves and as a set.

The utility of a set is a sum with diminishing returns: of what each view shows by itself (`view_utility`), of how well
the targets' Gaussians and their surroundings are covered, and of how spread the directions are. The greedy choice is
then within 1 − 1/e of the best one (Nemhauser, Wolsey and Fisher 1978).
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import orbit_cameras
from gsencoder.infer.views.candidates import FreeSpace, closeups, frames_on, shell_cameras, up_of
from gsencoder.infer.views.photographs import photograph_cameras, with_upright_frames
from gsencoder.infer.views.scores import ViewScores, coverage, directions, replace_with_photographs, score_views
from gsencoder.infer.views.targets import (
    CONSTANTS,
    SelectedView,
    Target,
    TargetScore,
    ViewsConfig,
    ViewSet,
    check_targets,
)
from gsencoder.render import BlendConfig
from gsencoder.types import Cameras, Gaussians, Scene


def view_utility(scores: ViewScores, config: ViewsConfig) -> Float64[np.ndarray, " V"]:
    """Utility of each view for one target by itself, 0 to 1.

    Half comes from filling at least `least_share` of the picture, in proportion below it, half from filling up to half
    of `most_share`; a target that fills more than `most_share` counts less. All of it is scaled by how much of the
    target is in the picture and not hidden, by the opacity around it, and by its sharpness: Gaussians of
    `ViewConstants.half_blur` halve it.
    """
    share = scores.share
    size = np.minimum(share / config.least_share, 1) * (0.5 + 0.5 * np.minimum(share / (config.most_share / 2), 1))
    size *= np.clip((1 - share) / (1 - config.most_share), 0, 1)
    alpha = np.clip(scores.alpha / CONSTANTS.full_alpha, 0, 1)
    sharp = 1 / (1 + (scores.blur / CONSTANTS.half_blur) ** 2)
    return np.asarray(size * sharp * scores.visible * (0.5 + 0.5 * scores.inside) * alpha**2)


class CoverageObjective:
    """The utility of sets of candidates, and its greedy maximization."""

    def __init__(
        self, cameras: Cameras, targets: Sequence[Target], scores: Sequence[ViewScores], config: ViewsConfig
    ) -> None:
        self.utilities = [view_utility(each, config) for each in scores]
        self._count = config.count
        self._weights = (config.cover_weight, config.context_weight, config.spread_weight)
        self._terms = []
        for target, each, value in zip(targets, scores, self.utilities, strict=True):
            # How well a view sees something counts as far as it is a good view.
            good = (value / max(float(value.max(initial=0)), CONSTANTS.min_best_utility))[:, None]
            away = directions(cameras, target)
            towards = np.clip(away @ away.T, 0, 1)
            self._terms.append((coverage(each.target) * good, coverage(each.context) * good, towards * good))
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
        for parts in self._terms:
            for weight, part in zip(self._weights, parts, strict=True):
                if part.shape[1]:
                    value += weight / len(self._terms) * float(part[chosen].max(axis=0).mean())
        return value

    def greedy(self, count: int) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Views in the order in which they are chosen, and their gains; ties go to the first candidate. Views that add
        nothing are left out, except the first."""
        modular = np.mean(self.utilities, axis=0) / self._count
        best = [[np.zeros(part.shape[1]) for part in parts] for parts in self._terms]
        order: list[int] = []
        gains: list[float] = []
        for _ in range(min(count, len(modular))):
            gain = modular.copy()
            for parts, now in zip(self._terms, best, strict=True):
                for weight, part, level in zip(self._weights, parts, now, strict=True):
                    if weight and part.shape[1]:
                        gain += weight / len(self._terms) * np.maximum(part - level, 0).mean(axis=1)
            gain[order] = -np.inf
            view = int(gain.argmax())
            if order and gain[view] <= max(CONSTANTS.min_relative_gain * gains[0], CONSTANTS.min_gain / self._count):
                break
            order.append(view)
            gains.append(float(gain[view]))
            best = [
                [np.maximum(level, part[view]) for part, level in zip(parts, now, strict=True)]
                for parts, now in zip(self._terms, best, strict=True)
            ]
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
    gaussians = checked_gaussians(scene, targets, config)
    free = free or FreeSpace(gaussians)
    return chosen_views(scene, targets, judge_candidates(scene, gaussians, targets, free, config), free, config)


def checked_gaussians(scene: Scene, targets: Sequence[Target], config: ViewsConfig) -> Gaussians:
    """The Gaussians of a scene in which views can be chosen."""
    if scene.gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    if targets or config.method == "greedy":
        check_targets(targets, scene.gaussians)
    return scene.gaussians


class Picked(NamedTuple):
    """Candidates that are shown whatever their utility: which, in order, and what each adds to those before it."""

    order: Int64[np.ndarray, " n"]
    gains: Float64[np.ndarray, " n"]


class Judged(NamedTuple):
    """Candidates, and what they show of each target."""

    candidates: "_Candidates"
    scores: tuple[ViewScores, ...]
    blend: BlendConfig


def judge_candidates(
    scene: Scene, gaussians: Gaussians, targets: Sequence[Target], free: FreeSpace, config: ViewsConfig
) -> Judged:
    """Places candidates and judges them by small renders; arguments and errors are those of `choose_views`."""
    scene = with_upright_frames(scene)
    judged = replace(CONSTANTS.score_blend, near=min(CONSTANTS.score_blend.near, free.cell / 2))
    if config.method == "uniform":
        candidates = _uniform(scene, gaussians, config)
    else:
        candidates = _candidates(scene, gaussians, targets, free, config, judged)
    scores = score_views(gaussians, candidates.cameras, targets, side=config.judged_side, config=judged)
    if scene.views is not None and scene.views.images is not None:
        is_photograph = np.array([frame is not None for frame in candidates.frames])
        scores = tuple(replace_with_photographs(each, is_photograph) for each in scores)
    return Judged(candidates, scores, judged)


def chosen_views(
    scene: Scene,
    targets: Sequence[Target],
    judgment: Judged,
    free: FreeSpace,
    config: ViewsConfig,
    *,
    picked: Picked | None = None,
) -> ViewSet:
    """The candidates that show targets best together, or those that were picked; see `choose_views`."""
    candidates, scores, judged = judgment
    cameras = candidates.cameras
    values = CoverageObjective(cameras, targets, scores, config)
    gains: Float64[np.ndarray, " n"] | None
    if picked is not None:
        order, gains = picked
    elif config.method == "uniform":
        order, gains = np.arange(len(cameras)), None
    else:
        order, gains = values.greedy(config.count)
    _warn_about(scene, targets, scores, order, config.count if picked is None else len(order))
    target_scores = [
        tuple(
            TargetScore(
                target=target.name,
                utility=float(utility[view]),
                **{name: float(getattr(each, name)[view]) for name in ("visible", "share", "inside", "alpha", "blur")},
            )
            for target, each, utility in zip(targets, scores, values.utilities, strict=True)
        )
        for view in order
    ]
    room = free.clearance(cameras.centers[order])
    return ViewSet(
        cameras=cameras.select(order),
        chosen=tuple(
            SelectedView(
                name=candidates.names[view],
                frame=candidates.frames[view],
                clearance=float(room[position]),
                gain=None if gains is None else float(gains[position]),
                covered=values.covered(order[: position + 1]),
                target_scores=target_scores[position],
            )
            for position, view in enumerate(order)
        ),
        judged=len(cameras),
        near=judged.near,
    )


def _warn_about(
    scene: Scene,
    targets: Sequence[Target],
    scores: Sequence[ViewScores],
    order: Int64[np.ndarray, " n"],
    count: int,
) -> None:
    """Warns of what a user would not expect."""
    if len(order) < count:
        reason = "no other shows more of what was found" if targets else "there are no more"
        warnings.warn(f"views: {len(order)} of {count} in scene {scene.name}: {reason}", SceneWarning, stacklevel=3)
    for target, each in zip(targets, scores, strict=True):
        seen = (each.visible * each.inside)[order].max(initial=0)
        if seen < CONSTANTS.min_visible:
            warnings.warn(f"views: no view shows more than {seen:.0%} of {target.name}", SceneWarning, stacklevel=3)


class _Candidates(NamedTuple):
    """Candidates: where they are, what they are called, and which frames they are."""

    cameras: Cameras
    names: list[str]
    frames: list[int | None]


def _uniform(scene: Scene, gaussians: Gaussians, config: ViewsConfig) -> _Candidates:
    """Evenly spread frames, or cameras around a splat that has none."""
    if scene.views is None or not len(scene.views):
        around = orbit_cameras(
            gaussians,
            count=config.count,
            width=config.width,
            height=config.height,
            fov_degrees=config.fov,
            up=scene.up,
        )
        return _Candidates(around, [f"orbit {number:02d}" for number in range(len(around))], [None] * len(around))
    chosen = even_indices(len(scene.views), config.count)
    names = [scene.views.names[view] for view in chosen]
    return _Candidates(_downscaled(scene.views.cameras.select(chosen), config), names, [int(view) for view in chosen])


def _candidates(
    scene: Scene,
    gaussians: Gaussians,
    targets: Sequence[Target],
    free: FreeSpace,
    config: ViewsConfig,
    judged: BlendConfig,
) -> _Candidates:
    number = max(config.candidates, config.count)
    scene_cameras = scene.views.cameras if scene.views is not None and len(scene.views) else None
    if config.source == "frames" and scene_cameras is None:
        raise InputError(f"views: scene {scene.name} has no cameras; use choose.source=shells")
    names: list[str] = []
    frames: list[int | None] = []
    parts: list[Cameras] = []
    spaces = [free.without(target.rows) for target in targets]
    if config.source != "shells" and scene_cameras is not None and scene.views is not None:
        room = number if config.source == "frames" else number // 2
        if scene.views.images is not None and room >= 2 * len(targets):
            large = photograph_cameras(scene.views)
            for target, space, part in zip(targets, spaces, _split_evenly(room // 2, len(targets)), strict=True):
                best = frames_on(scene_cameras, gaussians, [target], part, [space])
                near, rows = closeups(large.select(best), gaussians, target, width=config.width, height=config.height)
                parts.append(near)
                names += [f"{scene.views.names[view]} near {target.name}" for view in best[rows]]
                frames += best[rows].tolist()
        photograph_at = frames_on(scene_cameras, gaussians, targets, room - len(frames), spaces)
        parts.append(_downscaled(scene_cameras.select(photograph_at), config))
        names += [scene.views.names[view] for view in photograph_at]
        frames += photograph_at.tolist()
    if config.source != "frames":
        if scene_cameras is not None:
            observers = frames_on(
                scene_cameras, gaussians, targets, max(CONSTANTS.free_space_cameras, len(targets)), spaces
            )
            free = free.seen_by(scene_cameras.select(observers), judged)
        for target, room in zip(targets, _split_evenly(number - len(frames), len(targets)), strict=True):
            around = shell_cameras(
                gaussians,
                target,
                room,
                free.without(target.rows),
                up=up_of(scene),
                width=config.width,
                height=config.height,
                fov_degrees=config.fov,
                between=(config.least_share, config.most_share),
            )
            if not len(around):
                warnings.warn(f"views: there is no room for a camera around {target.name}", SceneWarning, stacklevel=3)
            parts.append(around)
            names += [f"around {target.name} {number:02d}" for number in range(len(around))]
            frames += [None] * len(around)
    cameras = _concatenate(parts)
    if not len(cameras):
        raise InputError(
            f"views: there is no room for a camera around {', '.join(target.name for target in targets)} "
            f"(pictures of {config.width} x {config.height} pixels, {config.fov:g} degrees); "
            + (
                "choose.method=uniform looks at all of the splat"
                if scene_cameras is None
                else "take choose.source=frames"
            )
        )
    return _Candidates(cameras, names, frames)


def _downscaled(frames: Cameras, config: ViewsConfig) -> Cameras:
    """Frames at the size of their pictures: photographs have far more pixels than anyone looks at."""
    return frames.resized(config.frame_side, enlarge=False)


def _split_evenly(total: int, parts: int) -> list[int]:
    """Whole numbers of one or more that come to a total, as equal as can be."""
    return [max(1, total // parts + (part < total % parts)) for part in range(parts)]


def _concatenate(parts: Sequence[Cameras]) -> Cameras:
    return Cameras(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("cam_from_world", "Ks", "widths", "heights")
        }
    )
