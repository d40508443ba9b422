"""Optimization of a splat against photographs: L1 + D-SSIM, a depth loss where depth was measured, pruning, no
densification."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.signals import defer_signals
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.reconstruct.anchor import Anchor
from gsencoder.reconstruct.exposure import ROUNDS, Exposures, apply_colors, fitted_colors, known_pixels
from gsencoder.reconstruct.losses import losses_of
from gsencoder.reconstruct.parameters import (
    Parameters,
    camera_of,
    gaussians_of,
    rows_in_view,
    seen_colors,
)
from gsencoder.reconstruct.prune import PruneConfig, rows_to_keep
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.render.image_metrics import WINDOW as SSIM_WINDOW
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize
from gsencoder.types import Gaussians

MAX_RATE = 10.0
"""Adam's steps are about as large as the rate, and an e-fold of a scale is 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizeConfig:
    """How long, how fast and against what a splat is fitted."""

    steps: int = field(default=1500, metadata={"help": "photographs looked at, one a step"})
    sh_degree: int = field(default=2, metadata={"help": "how colors may depend on the direction, 0 to 3"})
    sh_every: float = field(default=0.2, metadata={"help": "share of the steps after which the degree rises by one"})
    shrinks: tuple[int, ...] = field(
        default=(2, 1), metadata={"help": "photographs are made smaller so many times, one stage after the other"}
    )
    shares: tuple[float, ...] = field(
        default=(0.3, 0.7), metadata={"help": "share of the steps of each of these stages"}
    )
    ssim_weight: float = field(default=0.2, metadata={"help": "of 1 − SSIM; the rest of 1 is L1's"})
    depth_weight: float = field(
        default=0.5, metadata={"help": "of the relative error of depth, where a sensor measured it"}
    )
    empty_weight: float = field(
        default=0.5,
        metadata={
            "help": "of the opacity where transparency, or a background of one color, says that nothing is there"
        },
    )
    means_rate: float = field(default=3e-4, metadata={"help": "learning rate of positions, times the scene's size"})
    means_final: float = field(default=0.01, metadata={"help": "share of that rate which is left at the end"})
    leash: float = field(
        default=0.4,
        metadata={
            "help": "Gaussians that begin on a measured surface (depth, mesh, tsdf) stay within about so many of their "
            "first standard deviations of there; 0 = they go where they like"
        },
    )
    scales_rate: float = field(default=2e-2, metadata={"help": "learning rate of the logarithms of scales"})
    quats_rate: float = field(default=1e-3, metadata={"help": "learning rate of rotations"})
    opacities_rate: float = field(default=5e-2, metadata={"help": "learning rate of the logits of opacities"})
    colors_rate: float = field(default=2.5e-3, metadata={"help": "learning rate of colors; a 20th for directions"})
    exposure: bool = field(
        default=True,
        metadata={
            "help": "fit an affine map of colors to each photograph, for exposure and white balance that differ; "
            "false = photographs are fitted as they are"
        },
    )
    seed: int = field(default=0, metadata={"help": "of the order in which photographs are looked at"})

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise InputError(f"steps: expected 0 or more, got {self.steps}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if len(self.shrinks) != len(self.shares) or not self.shrinks:
            raise InputError(f"shrinks and shares: expected as many of each, got {self.shrinks} and {self.shares}")
        if min(self.shrinks) < 1:
            raise InputError(f"shrinks: expected whole numbers from 1, got {self.shrinks}")
        if not min(self.shares) >= 0 or not math.isclose(sum(self.shares), 1, abs_tol=1e-6):
            raise InputError(f"shares: expected numbers that add up to 1, got {self.shares}")
        if not 0 <= self.ssim_weight <= 1:
            raise InputError(f"ssim_weight: expected a number from 0 to 1, got {self.ssim_weight}")
        if not 0 < self.means_final <= 1:
            raise InputError(f"means_final: expected a share above 0, up to 1, got {self.means_final}")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"seed: expected 0 or more, got {self.seed}")
        limits = {"sh_every": 1.0, "depth_weight": 100.0, "empty_weight": 100.0, "leash": 1e6}
        limits |= dict.fromkeys((field.name for field in fields(self) if field.name.endswith("_rate")), MAX_RATE)
        for name, limit in limits.items():
            if not 0 <= getattr(self, name) <= limit:
                raise InputError(f"{name}: expected a number from 0 to {limit:g}, got {getattr(self, name)}")

    def shrink_at(self, step: int) -> int:
        """How many times smaller the photographs of a step are."""
        ends = np.cumsum(self.shares) * self.steps
        return self.shrinks[min(int(np.searchsorted(ends, step, side="right")), len(self.shrinks) - 1)]

    def degree_at(self, step: int) -> int:
        """Degree of the color coefficients that a step uses."""
        return min(self.sh_degree, int(step / max(1.0, self.sh_every * self.steps)))

    def rates_at(self, step: int, extent: float) -> dict[str, float]:
        """Learning rates of a step; that of the positions falls exponentially."""
        return {
            "means": self.means_rate * extent * self.means_final ** (step / max(1, self.steps)),
            "quats": self.quats_rate,
            "log_scales": self.scales_rate,
            "logit_opacities": self.opacities_rate,
            "sh0": self.colors_rate,
            "shN": self.colors_rate / 20,
        }


class Slopes(NamedTuple):
    """What one look at a photograph says.

    Attributes:
        losses: the terms of the loss by name; none where nothing is in view.
        rows: Gaussians that may show.
        grads: of the loss by these rows of each parameter.
        colors: the map of colors that the photograph has after the look; None where there are none.
    """

    losses: dict[str, float]
    rows: Int64[Tensor, " n"]
    grads: Parameters
    colors: Float[Tensor, "3 4"] | None


class Pictures(NamedTuple):
    """A render of one view in two exposures.

    Attributes:
        expected: that of the map given.
        matched: the one that fits the photograph best, which is no fault of the splat.
    """

    expected: Float[Tensor, "H W 3"]
    matched: Float[Tensor, "H W 3"]


class Optimizer:
    """A splat on its way.

    Attributes:
        adam: holds the parameters, and their moments.
        anchor: what holds positions near their seeds, if anything does.
        exposures: affine colors of the photographs; None where they are fitted as they are, by wish or because they
            turned out not to differ.
        step: steps that are done.
        is_consistent: whether the state is one between two steps.
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
        adam: the parameters to begin with, on the device where to compute.
        photographs: of all views.
        training: which of them are fitted.
        config: see there.
        prune: what is taken out, and when.
        raster: accuracy of rendering.
        anchor: what holds positions near their seeds; None = nothing.
        exposures: maps [V, 3, 4] of a run that is continued; None = identities at step 0, and none later.
        step: steps that are done.

        Raises:
            InputError: a photograph that is too small, or nothing in view of any.
        """
        self.photographs, self.training, self.config = photographs, tuple(training), config
        self.pruning, self.raster = prune, raster
        self.adam, self.anchor, self.step, self.is_consistent = adam, anchor, step, True
        differ = config.exposure and (step == 0 or exposures is not None)
        self.exposures = Exposures(self.training, exposures) if differ else None
        self.device = adam.parameters["means"].device
        centers = photographs.cameras.centers
        self._check_sizes()
        poses = {view: camera_of(photographs.cameras, view, self.device)[0] for view in self.training}
        if not any(len(self._rows(pose, photographs.at_scale(view, 2))) for view, pose in poses.items()):
            raise InputError(
                f"reconstruct: none of {len(self.raw['means'])} Gaussians is in view of any of {len(self.training)} "
                "photographs; are the splat and the poses of one world, and is raster.near small enough?"
            )
        # Nine cameras in ten: one that is astray must not make everybody's steps too large.
        away = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
        self.extent = 1.1 * float(np.quantile(away, 0.9)) or 1.0

    @property
    def raw(self) -> Parameters:
        return self.adam.parameters

    def view_at(self, step: int) -> int:
        """Each view once in a round, in an order that depends on the seed and the round alone."""
        turn, position = divmod(step, len(self.training))
        order = np.random.default_rng((self.config.seed, turn)).permutation(len(self.training))
        return self.training[int(order[position])]

    def advance(self) -> dict[str, float]:
        """One step; the terms of the loss.

        Raises:
            InputError: a loss or gradient that is not finite; view and term are named.
        """
        view = self.view_at(self.step)
        terms, rows, grads, colors = self.slopes(view, self.config.shrink_at(self.step))
        # A step that is cut in two could not be gone on with.
        with defer_signals():
            self.is_consistent = False
            if len(rows):
                rates = self.config.rates_at(self.step, self.extent)
                self.adam.step(rows, grads, rates)
                if self.anchor is not None:
                    self.anchor.pull(self.raw["means"], rows, rates["means"])
                if self.exposures is not None and colors is not None:
                    self.exposures.set(view, colors)
            self.step += 1
            rounds, rest = divmod(self.step, len(self.training))
            if self.exposures is not None and rounds >= ROUNDS and not rest and not self.exposures.differ():
                # Where all have one exposure, maps would take from the splat what depends on the direction.
                self.exposures = None
            if self.pruning.due(self.step, self.config.steps):
                self.prune()
            self.is_consistent = True
        return terms

    def slopes(self, view: int, shrink: int) -> Slopes:
        """What the next step would follow if it looked at a view; nothing changes.

        Args:
            view: number of a fitted photograph.
            shrink: how many times smaller it is looked at.

        Raises:
            InputError: a loss or gradient that is not finite; view and term are named.
        """
        photo = self.photographs.at_scale(view, shrink)
        raster, rows, seen, colors = self._exposed(view, photo)
        if not len(rows):
            return Slopes({}, rows, {}, colors)
        weights = {name: getattr(self.config, name) for name in ("ssim_weight", "depth_weight", "empty_weight")}
        losses = losses_of(raster, photo, **weights)
        total = torch.stack([*losses.values()]).sum()
        total.backward()
        grads = {name: value.grad for name, value in seen.items() if value.grad is not None}
        self._check(view, losses, grads)
        return Slopes({name: float(value.detach()) for name, value in losses.items()}, rows, grads, colors)

    def _look(self, view: int, photo: ScaledPhotograph, degree: int) -> tuple[Raster, Int64[Tensor, " n"], Parameters]:
        """A view over black, the rows that may show in it, and these rows as leaves that gradients go to."""
        pose, center = camera_of(self.photographs.cameras, view, self.device)
        K, size = photo.K.to(self.device), (photo.width, photo.height)
        rows = self._rows(pose, photo)
        seen = {name: value[rows].requires_grad_() for name, value in self.raw.items()}
        shape = (seen["means"], seen["quats"], seen["log_scales"].exp(), seen["logit_opacities"].sigmoid())
        raster = rasterize(*shape, seen_colors(seen, degree, center), pose, K, *size, config=self.raster)
        return raster, rows, seen

    def _exposed(
        self, view: int, photo: ScaledPhotograph
    ) -> tuple[Raster, Int64[Tensor, " n"], Parameters, Float[Tensor, "3 4"] | None]:
        """A view as the next step renders it, with the exposure of its photograph, and the map that this gave."""
        raster, rows, seen = self._look(view, photo, self.config.degree_at(self.step))
        if self.exposures is None or not len(rows):
            return raster, rows, seen, None
        colors = self.exposures.moved(view, self._fitted_colors(raster.rgb, raster.alpha, photo))
        rgb = apply_colors(raster.rgb, self.exposures.relative(view, colors))
        return raster._replace(rgb=rgb), rows, seen, colors

    def _rows(self, pose: Float[Tensor, "4 4"], photo: ScaledPhotograph) -> Int64[Tensor, " n"]:
        knobs = {"near": self.raster.near, "eps2d": self.raster.eps2d}
        return rows_in_view(self.raw, pose, photo.K.to(self.device), photo.width, photo.height, **knobs)

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
            InputError: none.
        """
        views = ((view, self.photographs.at_scale(view, 2)) for view in self.training)
        return rows_to_keep(self.raw, self.photographs.cameras, views, self.pruning, self.raster)

    def restricted(self, rows: Int64[Tensor, " n"]) -> "Optimizer":
        """One of the same photographs that has these rows alone, for trials."""
        other = copy(self)
        other.adam = RowAdam({name: value[rows] for name, value in self.raw.items()})
        return other

    def prune(self) -> None:
        """Takes out what does not contribute."""
        rows = self.contributing()
        self.adam.keep(rows)
        if self.anchor is not None:
            self.anchor = self.anchor.keep(rows)

    def _check(self, view: int, losses: Mapping[str, Tensor], grads: Mapping[str, Tensor]) -> None:
        named = {f"the loss {name}": value for name, value in losses.items()}
        named |= {f"the gradient of {name}": value for name, value in grads.items()}
        for name, value in named.items():
            if not bool(torch.isfinite(value.detach().sum())) and not bool(torch.isfinite(value).all()):
                raise InputError(
                    f"reconstruct: {name} is not finite at step {self.step}, photograph "
                    f"{self.photographs.names[view]!r}; lower the learning rates, or look at this photograph"
                )

    def rows_seen(self, view: int) -> int:
        """Number of Gaussians that may show in a view."""
        pose, _ = camera_of(self.photographs.cameras, view, self.device)
        return len(self._rows(pose, self.photographs.at_scale(view)))

    @staticmethod
    @torch.no_grad()
    def _fitted_colors(
        rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], photo: ScaledPhotograph
    ) -> Float[Tensor, "3 4"]:
        return fitted_colors(rgb, photo.image.to(rgb.device), known_pixels(alpha, photo.mask))

    def gaussians(self) -> Gaussians:
        """The splat as it is now."""
        return gaussians_of(self.raw)

    @torch.no_grad()
    def pictures(self, view: int, photo: ScaledPhotograph, colors: Float[Tensor, "3 4"]) -> Pictures:
        """A view as it is now, in [0, 1].

        Args:
            view: number of the view.
            photo: its photograph.
            colors: the map of colors that it is expected to have.
        """
        raster = self._look(view, photo, self.config.sh_degree)[0]
        fitted = self._fitted_colors(raster.rgb, raster.alpha, photo)
        return Pictures(*(apply_colors(raster.rgb, one).clamp(0, 1).cpu() for one in (colors, fitted)))

    @torch.no_grad()
    def opacity(self, view: int, photo: ScaledPhotograph) -> Float[Tensor, "H W"]:
        """How much of the background a view as it is now hides, in [0, 1]."""
        return self._look(view, photo, 0)[0].alpha.cpu()
