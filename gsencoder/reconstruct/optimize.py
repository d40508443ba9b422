"""Optimization of a splat against photographs: L1 + D-SSIM, a depth loss where depth was measured, pruning, and no
densification.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import defer_signals
from gsencoder.core.settings import check_limits, option
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.reconstruct.parameters import (
    ROUNDS,
    Anchor,
    Exposures,
    Parameters,
    RowAdam,
    State,
    apply_colors,
    camera_of,
    compared_pixels,
    fitted_colors,
    gaussians_of,
    rows_in_view,
    seen_colors,
)
from gsencoder.render.images import WINDOW as SSIM_WINDOW
from gsencoder.render.images import ssim
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize
from gsencoder.types import Cameras, Gaussians

RATES = {
    "means": 3e-4,
    "quats": 1e-3,
    "log_scales": 2e-2,
    "logit_opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}
"""Learning rates by parameter; that of the means is times the extent of the scene."""
FINAL_MEANS_RATE = 0.01
"""Share of the rate of the means that is left at the end."""
SH_EVERY = 0.2
"""Share of the steps after which the degree of colors rises by one."""
SSIM_WEIGHT, DEPTH_WEIGHT = 0.2, 0.5
"""Of 1 − SSIM, where the rest of 1 is L1's; of the relative error of depth, where a sensor measured it."""


EMPTY_WEIGHT = 0.5
"""Of the opacity where transparency, or a background of one color, says that nothing is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizeConfig:
    """Settings of the optimization of a splat."""

    steps: int = option(1500, "photographs looked at, one a step", ge=0)
    sh_degree: int = option(2, "how colors may depend on the direction, 0 to 3", ge=0, le=3)
    shrinks: tuple[int, ...] = option(
        (2, 1), "factors by which photographs are made smaller, one stage after the other", ge=1
    )
    shares: tuple[float, ...] = option((0.3, 0.7), "share of the steps of each of these stages")
    anchor_sigmas: float = option(
        0.4,
        "Gaussians that begin on a measured surface (depth, mesh, tsdf) stay within about this many of their "
        "first standard deviations of there; 0 = they go where they like",
        ge=0,
        le=1e6,
    )
    exposure: bool = option(
        True,
        "fit an affine map of colors to each photograph, for exposure and white balance that differ; "
        "false = photographs are fitted as they are",
    )
    seed: int = option(0, "of the order in which photographs are looked at", ge=0, lt=2**63)

    def __post_init__(self) -> None:
        check_limits(self)
        if len(self.shrinks) != len(self.shares) or not self.shrinks:
            raise InputError(f"shrinks and shares: expected as many of each, got {self.shrinks} and {self.shares}")
        if not min(self.shares) >= 0 or not math.isclose(sum(self.shares), 1, abs_tol=1e-6):
            raise InputError(f"shares: expected numbers that add up to 1, got {self.shares}")

    def shrink_at(self, step: int) -> int:
        """Factor by which the photographs of a step are made smaller."""
        ends = np.cumsum(self.shares) * self.steps
        return self.shrinks[min(int(np.searchsorted(ends, step, side="right")), len(self.shrinks) - 1)]

    def degree_at(self, step: int) -> int:
        """Degree of the color coefficients that a step uses."""
        return min(self.sh_degree, int(step / max(1.0, SH_EVERY * self.steps)))

    def rates_at(self, step: int, extent: float) -> dict[str, float]:
        """Learning rates of a step; that of the positions falls exponentially."""
        return RATES | {"means": RATES["means"] * extent * FINAL_MEANS_RATE ** (step / max(1, self.steps))}


def losses_of(
    raster: Raster,
    photo: ScaledPhotograph,
    *,
    ssim_weight: float = SSIM_WEIGHT,
    depth_weight: float = DEPTH_WEIGHT,
    empty_weight: float = EMPTY_WEIGHT,
) -> dict[str, Float[Tensor, ""]]:
    """(1 − λ)·L1 + λ·(1 − SSIM) over the pixels of the mask, the relative error of depth where it is known, and the
    opacity where the photograph shows that nothing is there, per pixel of the mask. `ssim_weight` is λ.

    Returns:
        The weighted terms by name; a term of weight 0 is left out, except L1.
    """
    image = photo.image.to(raster.rgb.device)
    rgb = raster.rgb
    losses = {}
    if photo.mask is not None:
        # What is masked is made equal: it gives no gradient, and no edge to windows that reach over it.
        mask = photo.mask.to(rgb.device)
        image = torch.where(mask.unsqueeze(-1), image, rgb.detach())
        share = mask.float().mean().clamp(min=1e-6)
    else:
        share = torch.ones((), device=rgb.device)
    losses["l1"] = (1 - ssim_weight) * (rgb - image).abs().mean() / share
    if ssim_weight:
        losses["ssim"] = ssim_weight * (1 - ssim(rgb, image)) / share
    if empty_weight and photo.empty is not None:
        # The mask alone would let anything float there: what is masked has no gradient.
        empty = photo.empty.to(rgb.device)
        losses["empty"] = empty_weight * torch.where(empty, raster.alpha, 0).mean() / share
    if depth_weight and photo.depth is not None:
        depth = photo.depth.to(rgb.device)
        measured = (depth > 0) & (raster.alpha.detach() > 0.5)
        if photo.mask is not None:
            measured &= photo.mask.to(rgb.device)
        expected = raster.depth / raster.alpha.clamp(min=1e-3)
        error = ((expected - depth).abs() / depth.clamp(min=1e-6)).clamp(max=1)
        losses["depth"] = depth_weight * torch.where(measured, error, 0).mean()
    return losses


@dataclass(frozen=True, slots=True, kw_only=True)
class PruneConfig:
    """What is taken out, and when.

    Attributes:
        at: shares of the steps after which is pruned.
        screen: wider than this many times the picture's longer side in some view; 0 = any.
        contribution: less than this many pixels' worth in every photograph, at its full size.
    """

    at: tuple[float, ...] = (0.3, 0.6, 0.9)
    opacity: float = 0.005
    screen: float = 1.0
    contribution: float = 0.1

    def due(self, step: int, schedule: OptimizeConfig) -> bool:
        """Whether the splat is pruned after `step` steps; small shares are of the first step."""
        return step in {max(1, round(share * schedule.steps)) for share in self.at}


def rows_to_keep(
    raw: Parameters,
    cameras: Cameras,
    views: Iterable[tuple[int, ScaledPhotograph]],
    config: PruneConfig,
    raster: RasterConfig,
    *,
    most: int | None = None,
) -> Int64[Tensor, " n"]:
    """Rows that are opaque enough, of sane size on every screen, and seen somewhere.

    A splat's contribution to a view is its column sum of B. Rendering is linear in the colors, so that is the
    gradient of the sum of a picture in which every color is 1.

    Args:
        views: photographs that count, at any size, gone through once.
        most: the most rows that are left, the ones that contribute most to some view; None = no limit.

    Raises:
        InputError: nothing would be left.
    """
    means = raw["means"]
    opacities = raw["logit_opacities"].sigmoid()
    contributions, max_widths = torch.zeros_like(opacities), torch.zeros_like(opacities)
    for view, photo in views:
        pose, _ = camera_of(cameras, view, means.device)
        K = photo.K.to(means.device)
        pixels = float(cameras.Ks[view, 0, 0] / photo.K[0, 0]) ** 2
        rows = rows_in_view(raw, pose, K, photo.width, photo.height, near=raster.near, eps2d=raster.eps2d)
        if not len(rows):
            continue
        ones = torch.ones(len(rows), 3, device=means.device, requires_grad=True)
        shape = (means[rows], raw["quats"][rows], raw["log_scales"][rows].exp(), opacities[rows])
        seen = rasterize(*shape, ones, pose, K, photo.width, photo.height, config=raster)
        (sums,) = torch.autograd.grad(seen.rgb[..., 0].sum(), ones)
        contributions[rows] = torch.maximum(contributions[rows], pixels * sums[:, 0])
        max_widths[rows] = torch.maximum(max_widths[rows], seen.radii / max(photo.width, photo.height))
    rejected = {"opacity": opacities < config.opacity, "contribution": contributions < config.contribution}
    if config.screen:
        rejected["screen"] = max_widths > config.screen
    rows_left = (~torch.stack([*rejected.values()]).any(dim=0)).nonzero().squeeze(1)
    if not len(rows_left):
        why = ", ".join(
            f"{int(rows.sum())} by {name} {getattr(config, name):g}" for name, rows in rejected.items() if rows.any()
        )
        raise InputError(f"reconstruct: pruning would leave none of {len(means)} Gaussians ({why})")
    if most is not None and len(rows_left) > most:
        by_contribution = contributions[rows_left].argsort(descending=True, stable=True)
        rows_left = rows_left[by_contribution[:most]].sort().values
    return rows_left


class PhotographGradients(NamedTuple):
    """Losses and gradients of a splat against one photograph.

    Attributes:
        losses: the terms of the loss; none where no Gaussian is in view.
        rows: of the Gaussians that may be visible.
        grads: with respect to these rows of each parameter.
        colors: the updated affine color map of the photograph; None where exposures are not fitted.
    """

    losses: dict[str, float]
    rows: Int64[Tensor, " n"]
    grads: Parameters
    colors: Float[Tensor, "3 4"] | None


class Pictures(NamedTuple):
    """A render of one view in two exposures.

    Attributes:
        expected: with the exposure that the view is expected to have.
        matched: with the exposure that fits the photograph best, so that a difference in exposure does not count
            against the splat.
    """

    expected: Float[Tensor, "H W 3"]
    matched: Float[Tensor, "H W 3"]


class Optimizer:
    """The state of an optimization of a splat.

    Attributes:
        adam: the parameters and their moments.
        anchor: keeps positions near their seeds; None = positions are free.
        exposures: affine color maps of the photographs; None where photographs are fitted as they are, because the
            settings say so or because their exposures do not differ.
        is_consistent: whether the state is that between two steps, so that it may be saved.
        extent: length that the learning rate of positions is multiplied by, world units.
        most: number of Gaussians that pruning leaves at most; None = no limit.
    """

    def __init__(
        self,
        adam: RowAdam,
        photographs: Photographs,
        training: Sequence[int],
        config: OptimizeConfig,
        *,
        prune: PruneConfig = PruneConfig(),
        raster: RasterConfig = RasterConfig(),
        anchor: Anchor | None = None,
        exposures: Tensor | None = None,
        step: int = 0,
    ) -> None:
        """`exposures` are color maps [V, 3, 4] of a run that is continued; None = identities at step 0, later none."""
        self.photographs, self.training, self.config = photographs, tuple(training), config
        self.pruning, self.raster = prune, raster
        self.most: int | None = None
        self.adam, self.anchor, self.step, self.is_consistent = adam, anchor, step, True
        fits_exposure = config.exposure and (step == 0 or exposures is not None)
        self.exposures = Exposures(self.training, exposures) if fits_exposure else None
        self.device = adam.parameters["means"].device
        centers = photographs.cameras.centers
        self._check_sizes()
        poses = {view: camera_of(photographs.cameras, view, self.device)[0] for view in self.training}
        if not any(len(self._rows(pose, photographs.at_scale(view, 2))) for view, pose in poses.items()):
            raise InputError(
                f"reconstruct: none of {len(self.parameters['means'])} Gaussians is in view of any of "
                f"{len(self.training)} photographs; are the splat and the poses of one world, and is raster.near small "
                "enough?"
            )
        # The 0.9 quantile, since a single camera far away must not make the steps of all positions too large.
        distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
        self.extent = 1.1 * float(np.quantile(distances, 0.9)) or 1.0

    @property
    def parameters(self) -> Parameters:
        return self.adam.parameters

    def view_at(self, step: int) -> int:
        """The view of a step: each once in a round, in an order that depends on the seed and the round alone."""
        number, position = divmod(step, len(self.training))
        order = np.random.default_rng((self.config.seed, number)).permutation(len(self.training))
        return self.training[int(order[position])]

    def advance(self) -> dict[str, float]:
        """Does one step; returns the terms of its loss."""
        view = self.view_at(self.step)
        terms, rows, grads, colors = self.gradients(view, self.config.shrink_at(self.step))
        # A run cannot be resumed from a state in the middle of a step.
        with defer_signals():
            self.is_consistent = False
            if len(rows):
                rates = self.config.rates_at(self.step, self.extent)
                self.adam.step(rows, grads, rates)
                if self.anchor is not None:
                    self.anchor.pull(self.parameters["means"], rows, rates["means"])
                if self.exposures is not None and colors is not None:
                    self.exposures.set(view, colors)
            self.step += 1
            rounds, rest = divmod(self.step, len(self.training))
            if self.exposures is not None and rounds >= ROUNDS and not rest and not self.exposures.differ():
                # Where all exposures are equal, color maps would explain what depends on the viewing direction, which
                # belongs to the splat.
                self.exposures = None
            if self.pruning.due(self.step, self.config):
                self.prune()
            self.is_consistent = True
        return terms

    def gradients(self, view: int, shrink: int) -> PhotographGradients:
        """The gradients of the next step if its photograph were that of a view, made smaller by a factor; changes
        nothing.

        Raises:
            InputError: a loss or gradient is not finite; view and term are named.
        """
        photo, colors = self.photographs.at_scale(view, shrink), None
        raster, rows, leaves = self._render(view, photo, self.config.degree_at(self.step))
        if not len(rows):
            return PhotographGradients({}, rows, {}, None)
        if self.exposures is not None:
            colors = self.exposures.moved(view, self._fitted_colors(raster, photo))
            raster = raster._replace(rgb=apply_colors(raster.rgb, self.exposures.relative(view, colors)))
        losses = losses_of(raster, photo, empty_weight=EMPTY_WEIGHT)
        total = torch.stack([*losses.values()]).sum()
        total.backward()
        grads = {name: value.grad for name, value in leaves.items() if value.grad is not None}
        self._check_finite(view, losses, grads)
        return PhotographGradients({name: float(value.detach()) for name, value in losses.items()}, rows, grads, colors)

    def _render(
        self, view: int, photo: ScaledPhotograph, degree: int
    ) -> tuple[Raster, Int64[Tensor, " n"], Parameters]:
        """A render of a view over black, the rows that may be visible in it, and these rows of the parameters, which
        receive gradients."""
        pose, center = camera_of(self.photographs.cameras, view, self.device)
        K, size = photo.K.to(self.device), (photo.width, photo.height)
        rows = self._rows(pose, photo)
        leaves = {name: value[rows].requires_grad_() for name, value in self.parameters.items()}
        shape = (leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["logit_opacities"].sigmoid())
        raster = rasterize(*shape, seen_colors(leaves, degree, center), pose, K, *size, config=self.raster)
        return raster, rows, leaves

    def _rows(self, pose: Float[Tensor, "4 4"], photo: ScaledPhotograph) -> Int64[Tensor, " n"]:
        """Rows of the Gaussians that may be visible in a view."""
        K, raster = photo.K.to(self.device), self.raster
        return rows_in_view(self.parameters, pose, K, photo.width, photo.height, near=raster.near, eps2d=raster.eps2d)

    def _check_sizes(self) -> None:
        smallest = SSIM_WINDOW * max(self.config.shrinks)
        for view in self.training:
            width, height = (
                int(sides[view]) for sides in (self.photographs.cameras.widths, self.photographs.cameras.heights)
            )
            if min(width, height) < smallest:
                raise InputError(
                    f"reconstruct: photograph {self.photographs.names[view]!r} has {width}×{height} pixels, "
                    f"and {smallest} are needed at least: {SSIM_WINDOW} for SSIM, optimize.shrinks="
                    f"{list(self.config.shrinks)} times; make image_scale larger or shrinks smaller"
                )

    def contributing(self) -> Int64[Tensor, " n"]:
        """Rows that pruning would leave now."""
        views = ((view, self.photographs.at_scale(view, 2)) for view in self.training)
        return rows_to_keep(self.parameters, self.photographs.cameras, views, self.pruning, self.raster, most=self.most)

    def prune(self) -> None:
        """Removes the Gaussians that contribute nothing."""
        rows = self.contributing()
        self.adam.keep(rows)
        if self.anchor is not None:
            self.anchor = self.anchor.keep(rows)

    def _check_finite(self, view: int, losses: Mapping[str, Tensor], grads: Mapping[str, Tensor]) -> None:
        tensors = {f"the loss {name}": value for name, value in losses.items()}
        tensors |= {f"the gradient of {name}": value for name, value in grads.items()}
        for name, value in tensors.items():
            if not bool(torch.isfinite(value.detach().sum())) and not bool(torch.isfinite(value).all()):
                raise InputError(
                    f"reconstruct: {name} is not finite at step {self.step}, photograph "
                    f"{self.photographs.names[view]!r}; lower the learning rates, or look at this photograph"
                )

    def rows_seen(self, view: int) -> int:
        """Number of Gaussians that may be visible in a view."""
        pose, _ = camera_of(self.photographs.cameras, view, self.device)
        return len(self._rows(pose, self.photographs.at_scale(view)))

    @staticmethod
    @torch.no_grad()
    def _fitted_colors(raster: Raster, photo: ScaledPhotograph) -> Float[Tensor, "3 4"]:
        image = photo.image.to(raster.rgb.device)
        return fitted_colors(raster.rgb, image, compared_pixels(raster.alpha, photo.mask))

    def state(self, seconds: float, facts: Mapping[str, Any]) -> State:
        """The state between two steps."""
        return State(
            adam=self.adam,
            anchor=self.anchor,
            exposures=None if self.exposures is None or not self.step else self.exposures.maps,
            step=self.step,
            seconds=seconds,
            facts=facts,
        )

    def gaussians(self) -> Gaussians:
        """The current splat."""
        return gaussians_of(self.parameters)

    @torch.no_grad()
    def pictures(self, view: int, photo: ScaledPhotograph, colors: Float[Tensor, "3 4"]) -> Pictures:
        """Renders of a view of the current splat, in [0, 1]; `colors` is the map of the exposure that is expected."""
        raster = self._render(view, photo, self.config.sh_degree)[0]
        fitted = self._fitted_colors(raster, photo)
        return Pictures(*(apply_colors(raster.rgb, color_map).clamp(0, 1).cpu() for color_map in (colors, fitted)))

    @torch.no_grad()
    def opacity(self, view: int, photo: ScaledPhotograph) -> Float[Tensor, "H W"]:
        """The share of the background that the current splat hides in a view, in [0, 1]."""
        return self._render(view, photo, 0)[0].alpha.cpu()
