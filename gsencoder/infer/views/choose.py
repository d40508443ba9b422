"""The choice of views that show targets: SplatDistill sec. 3.4, "strategically sample multiple viewpoints".

Candidates are judged by what small renders show of the targets. A greedy choice then takes those that together show
them best. The utility of a set is a sum with diminishing returns: of what each view shows by itself
(`view_utility`), of how well the targets' Gaussians and their surroundings are covered, and of how spread the
directions are. The greedy choice is then within 1 − 1/e of the best one (Nemhauser, Wolsey and Fisher 1978).
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.threads import parallel
from gsencoder.infer.views.candidates import FreeSpace, target_candidates, uniform_candidates
from gsencoder.infer.views.photographs import with_upright_frames
from gsencoder.infer.views.targets import CONSTANTS, SelectedView, Target, TargetScore, ViewsConfig, ViewSet
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras, Gaussians, Scene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewScores:
    """What each of V cameras sees of one target.

    Attributes:
        visible: blending weight of the target as a share of what it has when rendered alone, over the pixels where
            it is at least half as opaque then as anywhere; 0 where it is outside.
        share: of the picture that the target fills, by weight.
        inside: share of the target's Gaussians whose means lie in the picture.
        alpha: mean opacity of the render over the target and around it.
        blur: standard deviation of the Gaussians that make up the target in the picture, on average, as a share of
            the picture's longer side.
        target: the weight of each Gaussian of the target (a sample) in small pixels.
        context: the same of Gaussians around it.
    """

    visible: Float64[np.ndarray, " V"]
    share: Float64[np.ndarray, " V"]
    inside: Float64[np.ndarray, " V"]
    alpha: Float64[np.ndarray, " V"]
    blur: Float64[np.ndarray, " V"]
    target: Float32[np.ndarray, "V n"]
    context: Float32[np.ndarray, "V m"]


def score_views(
    gaussians: Gaussians,
    cameras: Cameras,
    targets: Sequence[Target],
    *,
    side: int = 160,
    config: BlendConfig = CONSTANTS.score_blend,
) -> tuple[ViewScores, ...]:
    """Judges cameras by small renders, one for each, in which every Gaussian hides what is behind it.

    Args:
        side: longer side of the renders, pixels.
    """
    if not targets:
        return ()
    small = cameras.resized(side)
    probes = [_TargetProbe(gaussians, target) for target in targets]

    def one(view: int) -> list[_TargetInView]:
        b = blend(gaussians, small, view, config=config)
        # Pixels that each Gaussian fills.
        weights = np.bincount(b.col.numpy(), b.weight.numpy(), minlength=len(b.depths))
        return [each.seen(b, weights, small, view, config) for each in probes]

    # Small views are rendered faster with one thread for each view than with all threads for one.
    per_view = parallel(one, range(len(cameras)))
    names, scores = _TargetInView._fields, []
    for seen in zip(*per_view, strict=True):
        columns = dict(zip(names, map(np.array, zip(*seen, strict=True)), strict=True))
        scores.append(ViewScores(**columns))
    return tuple(scores)


def replace_with_photographs(scores: ViewScores, photograph_at: Bool[np.ndarray, " V"]) -> ViewScores:
    """Scores of cameras of which some are shown as photographs, which count as sharp and solid."""
    return replace(
        scores, alpha=np.where(photograph_at, 1.0, scores.alpha), blur=np.where(photograph_at, 0.0, scores.blur)
    )


class _TargetInView(NamedTuple):
    """What one camera sees of one target; see `ViewScores`."""

    visible: float
    share: float
    inside: float
    alpha: float
    blur: float
    target: Float32[np.ndarray, " n"]
    context: Float32[np.ndarray, " m"]


class _TargetProbe:
    """A target, with the arrays that scoring needs for every camera."""

    def __init__(self, gaussians: Gaussians, target: Target) -> None:
        self._rows = target.rows
        self._alone = gaussians.select(target.rows)
        member = np.zeros_like(gaussians.opacities)
        member[target.rows] = 1
        self._member = torch.from_numpy(member)
        near = np.linalg.norm(gaussians.means - target.center, axis=1) <= CONSTANTS.context_radii * target.radius
        around = np.flatnonzero(near & (member == 0))
        self._samples = tuple(
            rows[even_indices(len(rows), CONSTANTS.coverage_sample)] for rows in (target.rows, around)
        )
        # The size of a flat Gaussian is that of its disc.
        self._sizes = np.sqrt(np.sort(self._alone.scales, axis=1)[:, 1:].prod(axis=1, dtype=np.float64))

    def seen(
        self, b: Blend, weights: Float64[np.ndarray, " N"], small: Cameras, view: int, config: BlendConfig
    ) -> _TargetInView:
        """What a camera sees of it."""
        alone = blend(self._alone, small, view, config=config).alpha
        shown = b.render(self._member)
        # What is half transparent at a target's rim belongs to what is behind it, too.
        solid = alone >= CONSTANTS.solid_share * float(alone.max())
        total = float(alone[solid].sum())
        blended = weights[self._rows]
        depths = b.depths.numpy()[self._rows].astype(np.float64)
        pixels = float(small.Ks[view, 0, 0]) * self._sizes / np.maximum(depths, config.near)
        target, context = (weights[rows].astype(np.float32) for rows in self._samples)
        inside = small.in_image(*small.project(self._alone.means.astype(np.float64), view), view)
        return _TargetInView(
            visible=min(float(shown[solid].sum()) / total, 1.0) if total > CONSTANTS.min_weight else 0.0,
            share=float(shown.mean()),
            inside=float(inside.mean()),
            alpha=_around(alone.reshape(b.shape), b.alpha.reshape(b.shape)),
            blur=float(blended @ pixels / blended.sum()) / max(b.shape) if blended.sum() > 0 else 0.0,
            target=target,
            context=context,
        )


def _around(alone: torch.Tensor, alpha: torch.Tensor) -> float:
    """Mean alpha in the rectangle around what shows the target, with a frame; 0 where nothing shows it."""
    spans = []
    for axis in (1, 0):
        covered = np.flatnonzero((alone > CONSTANTS.min_weight).any(dim=axis).numpy())
        if not len(covered):
            return 0.0
        margin = int(np.ceil(CONSTANTS.frame_margin * (covered[-1] - covered[0] + 1)))
        spans.append(slice(max(int(covered[0]) - margin, 0), int(covered[-1]) + 1 + margin))
    return float(alpha[spans[0], spans[1]].mean())


def coverage(seen: Float32[np.ndarray, "V n"]) -> Float64[np.ndarray, "V n"]:
    """How well each camera sees each Gaussian: its weight as a share of the largest that any camera gives it."""
    best = seen.max(axis=0, initial=0)
    return np.asarray(seen / np.where(best > 0, best, 1), np.float64)


def directions(cameras: Cameras, target: Target) -> Float64[np.ndarray, "V 3"]:
    """Unit vectors from a target to each camera."""
    offsets = cameras.centers - target.center
    return np.asarray(offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12))


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
    """Cameras, what they are called, which frames they are (None for those that were placed in the free space), and
    what they show of each target."""

    cameras: Cameras
    names: list[str]
    frames: list[int | None]
    scores: tuple[ViewScores, ...]
    free: FreeSpace


def score_candidates(
    scene: Scene, targets: Sequence[Target], config: ViewsConfig, free: FreeSpace | None = None
) -> Candidates:
    """Places candidates and scores them by small renders; see `choose_views`."""
    gaussians = scene.gaussians
    if gaussians is None:
        raise InputError(f"views: scene {scene.name} has no Gaussians")
    if not targets and config.method == "greedy":
        raise InputError("views: there is nothing to look at; give one target or more")
    scene = with_upright_frames(scene)
    if scene.views is not None and not len(scene.views):
        scene = replace(scene, views=None)
    free = free or FreeSpace(gaussians)
    if config.method == "uniform":
        cameras, names, frames = uniform_candidates(scene, gaussians, config)
    else:
        cameras, names, frames = target_candidates(scene, gaussians, targets, free, config)
    scores = score_views(gaussians, cameras, targets, side=config.judged_side, config=free.blend)
    if scene.views is not None and scene.views.images is not None:
        is_photograph = np.array([frame is not None for frame in frames])
        scores = tuple(replace_with_photographs(each, is_photograph) for each in scores)
    return Candidates(cameras=cameras, names=names, frames=frames, scores=scores, free=free)


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
        near=candidates.free.blend.near,
    )
