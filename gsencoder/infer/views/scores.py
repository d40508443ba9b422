"""Scores of cameras by small renders: what they show of a target, occlusion included."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64

from gsencoder.core.arrays import even_indices
from gsencoder.core.threads import parallel
from gsencoder.infer.views.targets import CONSTANTS, Target
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras, Gaussians


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
        weights = np.bincount(b.col.numpy(), b.weight.numpy(), minlength=len(gaussians))
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
        member = np.zeros(len(gaussians), np.float32)
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
