"""Optimization of a splat against photographs: L1 + D-SSIM, a depth loss where depth was measured, pruning, no
densification."""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import defer_signals
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.reconstruct.anchor import Anchor
from gsencoder.reconstruct.exposure import ROUNDS, Exposures, apply_colors, compared_pixels, fitted_colors
from gsencoder.reconstruct.losses import losses_of
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.parameters import (
    Parameters,
    camera_of,
    gaussians_of,
    rows_in_view,
    seen_colors,
)
from gsencoder.reconstruct.prune import PruneConfig, rows_to_keep
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.render.images import WINDOW as SSIM_WINDOW
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize
from gsencoder.types import Gaussians


class PhotographGradients(NamedTuple):
    """Losses and gradients of a splat against one photograph.

    Attributes:
        losses: the terms of the loss by name; none where no Gaussian is in view.
        rows: rows of the Gaussians that may be visible.
        grads: gradients of the loss with respect to these rows of each parameter.
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
        step: number of steps done.
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
        prune: PruneConfig,
        raster: RasterConfig = RasterConfig(),
        anchor: Anchor | None = None,
        exposures: Tensor | None = None,
        step: int = 0,
    ) -> None:
        """Args:
        adam: the initial parameters, on the device to compute on.
        photographs: those of all views.
        training: numbers of the views that are fitted.
        config: settings.
        prune: which Gaussians are removed, and when.
        raster: accuracy of rendering.
        anchor: keeps positions near their seeds; None = positions are free.
        exposures: color maps [V, 3, 4] of a run that is continued; None = identities at step 0, no maps later.
        step: number of steps done.

        Raises:
            InputError: a photograph is too small, or no Gaussian is in view of any.
        """
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
        """The parameters by name, as `RowAdam` holds them."""
        return self.adam.parameters

    def view_at(self, step: int) -> int:
        """The view of a step: each once in a round, in an order that depends on the seed and the round alone."""
        number, position = divmod(step, len(self.training))
        order = np.random.default_rng((self.config.seed, number)).permutation(len(self.training))
        return self.training[int(order[position])]

    def advance(self) -> dict[str, float]:
        """Does one step; returns the terms of its loss.

        Raises:
            InputError: a loss or gradient is not finite; view and term are named.
        """
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
        """The gradients of the next step if its photograph were that of a view; changes nothing.

        Args:
            view: number of a fitted photograph.
            shrink: factor by which the photograph is made smaller.

        Raises:
            InputError: a loss or gradient is not finite; view and term are named.
        """
        photo = self.photographs.at_scale(view, shrink)
        raster, rows, leaves, colors = self._render_exposed(view, photo)
        if not len(rows):
            return PhotographGradients({}, rows, {}, colors)
        weights = {name: getattr(self.config, name) for name in ("ssim_weight", "depth_weight", "empty_weight")}
        losses = losses_of(raster, photo, **weights)
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

    def _render_exposed(
        self, view: int, photo: ScaledPhotograph
    ) -> tuple[Raster, Int64[Tensor, " n"], Parameters, Float[Tensor, "3 4"] | None]:
        """A view as the next step renders it, in the exposure of its photograph, and the color map of that exposure."""
        raster, rows, leaves = self._render(view, photo, self.config.degree_at(self.step))
        if self.exposures is None or not len(rows):
            return raster, rows, leaves, None
        colors = self.exposures.moved(view, self._fitted_colors(raster.rgb, raster.alpha, photo))
        rgb = apply_colors(raster.rgb, self.exposures.relative(view, colors))
        return raster._replace(rgb=rgb), rows, leaves, colors

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
        """Rows that pruning would leave now.

        Raises:
            InputError: pruning would leave no row.
        """
        views = ((view, self.photographs.at_scale(view, 2)) for view in self.training)
        return rows_to_keep(self.parameters, self.photographs.cameras, views, self.pruning, self.raster, most=self.most)

    def restricted(self, rows: Int64[Tensor, " n"]) -> "Optimizer":
        """A copy for trials that has these rows of the parameters alone."""
        other = copy(self)
        other.adam = RowAdam({name: value[rows] for name, value in self.parameters.items()})
        return other

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
    def _fitted_colors(
        rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], photo: ScaledPhotograph
    ) -> Float[Tensor, "3 4"]:
        return fitted_colors(rgb, photo.image.to(rgb.device), compared_pixels(alpha, photo.mask))

    def gaussians(self) -> Gaussians:
        """The current splat."""
        return gaussians_of(self.parameters)

    @torch.no_grad()
    def pictures(self, view: int, photo: ScaledPhotograph, colors: Float[Tensor, "3 4"]) -> Pictures:
        """Renders of a view of the current splat, in [0, 1].

        Args:
            view: number of the view.
            photo: its photograph.
            colors: the color map of the exposure that it is expected to have.
        """
        raster = self._render(view, photo, self.config.sh_degree)[0]
        fitted = self._fitted_colors(raster.rgb, raster.alpha, photo)
        return Pictures(*(apply_colors(raster.rgb, color_map).clamp(0, 1).cpu() for color_map in (colors, fitted)))

    @torch.no_grad()
    def opacity(self, view: int, photo: ScaledPhotograph) -> Float[Tensor, "H W"]:
        """The share of the background that the current splat hides in a view, in [0, 1]."""
        return self._render(view, photo, 0)[0].alpha.cpu()
