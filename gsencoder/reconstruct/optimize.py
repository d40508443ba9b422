"""What is optimized, and how: a splat with logarithms of scales and logits of opacities, what holds its positions, and
the colors of each photograph. L1 + D-SSIM against photographs, a depth loss where depth was measured, pruning, and no
densification.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import defer_signals
from gsencoder.core.settings import check_limits, option
from gsencoder.core.threads import PIECES, kernel, parallel
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.geometry import colors_from_sh, normalize_quats, project_points, transform
from gsencoder.render.images import IDENTITY, apply_colors, compared_pixels, fitted_colors, ssim
from gsencoder.render.images import WINDOW as SSIM_WINDOW
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize
from gsencoder.types import Cameras, Gaussians

OPACITY_MARGIN = 1e-3
"""Opacities begin at least this far from 0 and 1, where a logit has no slope."""
MAX_SIGMAS = 3.33
"""No splat reaches further than this many standard deviations: √(2 ln 255) at an opacity of 1."""

Parameters = dict[str, Tensor]
"""means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh0 [N, 1, 3], shN [N, K − 1, 3], float32."""


def parameters_from(gaussians: Gaussians, sh_degree: int, device: torch.device | str = "cpu") -> Parameters:
    """The parameters of a splat; color coefficients that it lacks begin at zero, more are cut."""
    n, num_coefficients = len(gaussians), (sh_degree + 1) ** 2
    sh = np.zeros((n, num_coefficients, 3), np.float32)
    common = min(num_coefficients, gaussians.sh.shape[1])
    sh[:, :common] = gaussians.sh[:, :common]
    opacities = torch.from_numpy(gaussians.opacities.copy()).clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    raw = {
        "means": torch.from_numpy(gaussians.means.copy()),
        "quats": torch.from_numpy(gaussians.quats.copy()),
        "log_scales": torch.from_numpy(gaussians.scales).log(),
        "logit_opacities": torch.logit(opacities),
        "sh0": torch.from_numpy(sh[:, :1].copy()),
        "shN": torch.from_numpy(sh[:, 1:].copy()),
    }
    return {name: value.to(device) for name, value in raw.items()}


def gaussians_of(raw: Parameters) -> Gaussians:
    """The splat in physical values."""
    values = {
        "means": raw["means"],
        "quats": normalize_quats(raw["quats"]),
        "scales": raw["log_scales"].exp(),
        "opacities": raw["logit_opacities"].sigmoid(),
        "sh": torch.cat((raw["sh0"], raw["shN"]), dim=1),
    }
    return Gaussians(**{name: value.detach().cpu().numpy().copy() for name, value in values.items()})


def seen_colors(raw: Parameters, degree: int, camera_center: Float[Tensor, "3"]) -> Float[Tensor, "N 3"]:
    """Colors from a camera with coefficients up to `degree`."""
    sh = torch.cat((raw["sh0"], raw["shN"][:, : (degree + 1) ** 2 - 1]), dim=1) if degree else raw["sh0"]
    return colors_from_sh(sh, raw["means"], camera_center)


def rows_in_view(
    raw: Parameters,
    cam_from_world: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    near: float,
    eps2d: float,
) -> Int64[Tensor, " n"]:
    """Rows that may touch the image: all that do, and few others.

    A splat's half width is at most REACH·√((f·s/z)²(1 + t²) + eps2d), where s is its largest scale and t the tangent
    at which geometry.project stops following it sideways.
    """
    local = transform(cam_from_world, raw["means"])
    z = local[:, 2]
    inside: Bool[Tensor, " N"] = z > near
    largest = raw["log_scales"].amax(dim=1).exp() / z.clamp(min=near)
    focals, middles, sizes = K.diagonal()[:2], K[:2, 2], (width, height)
    for position, focal, middle, size in zip(project_points(local, K).unbind(1), focals, middles, sizes, strict=True):
        tangent = torch.maximum(middle, size - middle) / focal + 0.15 * size / focal
        reach = MAX_SIGMAS * torch.sqrt((focal * largest).square() * (1 + tangent.square()) + eps2d)
        inside &= (position + reach > 0) & (position - reach < size)
    return inside.nonzero().squeeze(1)


def camera_of(cameras: Cameras, view: int, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """cam_from_world and center of a camera as float32 tensors; its K depends on how small the photograph is."""
    center = torch.from_numpy(cameras.centers[view]).float()
    return torch.from_numpy(cameras.cam_from_world[view].copy()).to(device), center.to(device)


BETAS = (0.9, 0.999)
EPS = 1e-15


@kernel
@no_type_check
def _step(first, last, rows, grads, values, averages, squares, rate, correction, beta1, rest1, beta2, rest2, eps):
    for k in range(first, last):
        row, grad = rows[k], grads[k]
        value, average, square = values[row], averages[row], squares[row]
        for c in range(len(value)):
            g = grad[c]
            average[c] = beta1 * average[c] + rest1 * g
            square[c] = beta2 * square[c] + rest2 * g * g
            value[c] -= rate * average[c] / (np.sqrt(square[c]) * correction + eps)


class RowAdam:
    """Adam (Kingma & Ba 2015) over rows; as torch's SparseAdam, moments of rows that have no gradient do not decay.

    Attributes:
        parameters: float32 tensors of N rows each, stepped in place.
        averages: first moments by parameter.
        squares: second moments by parameter.
    """

    KINDS = ("parameters", "averages", "squares")  # Attributes that hold a tensor for each parameter

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self.parameters = dict(parameters)
        self.averages = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.squares = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.steps = 0

    @classmethod
    def restored(cls, tables: Mapping[str, Mapping[str, Tensor]], steps: int) -> "RowAdam":
        """One that goes on from the `tables` and steps of another."""
        restored = cls(tables["parameters"])
        restored.averages, restored.squares = dict(tables["averages"]), dict(tables["squares"])
        restored.steps = steps
        return restored

    def step(self, rows: Int64[Tensor, " n"], grads: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """One step of the rows that have gradients, which are distinct; `grads` are of these rows."""
        self.steps += 1
        first, second = (1 - beta**self.steps for beta in BETAS)
        for name, grad in grads.items():
            tables = (self.parameters[name], self.averages[name], self.squares[name])
            rate, correction = rates[name] / first, second**-0.5
            update = self._on_cpu if grad.device.type == "cpu" else self._plain
            update(rows, grad, *tables, rate, correction)

    @staticmethod
    def _plain(
        rows: Tensor, grad: Tensor, value: Tensor, average: Tensor, square: Tensor, rate: float, correction: float
    ) -> None:
        average[rows] = average[rows].lerp(grad, 1 - BETAS[0])
        square[rows] = square[rows].lerp(grad * grad, 1 - BETAS[1])
        value[rows] -= rate * average[rows] / (square[rows].sqrt() * correction + EPS)

    @staticmethod
    def _on_cpu(
        rows: Tensor, grad: Tensor, value: Tensor, average: Tensor, square: Tensor, rate: float, correction: float
    ) -> None:
        tables = [array.reshape(len(array), -1).numpy() for array in (grad.contiguous(), value, average, square)]
        # As numbers of the arrays' own type all arithmetic stays in it; 1 − 0.999 must be rounded once, and at the end.
        first, second = BETAS
        exact = (rate, correction, first, 1 - first, second, 1 - second, EPS)
        numbers = [tables[0].dtype.type(number) for number in exact]
        cuts = np.linspace(0, len(rows), PIECES + 1).astype(np.int64)
        arrays = (rows.numpy(), *tables, *numbers)
        parallel(lambda piece: _step(cuts[piece], cuts[piece + 1], *arrays), range(PIECES))

    def keep(self, rows: Int64[Tensor, " n"]) -> None:
        """Drops all rows but these, of parameters and moments."""
        for table in (self.parameters, self.averages, self.squares):
            for name, value in table.items():
                table[name] = value[rows].contiguous()


STEP = 0.5
"""Share of the way to the best fit that a map moves at each step of its photograph."""
SAME = 0.03
"""Photographs of which no color channel differs by more from the mean do not count as differing in exposure."""
ROUNDS = 3
"""Number of steps of each photograph after which the maps, now seven eighths of the way to the fits, are compared."""


class Exposures:
    """An affine map of colors for each fitted photograph, relative to the mean of all: a camera that sets exposure and
    white balance for every photograph shows one surface in several colors, which must not be explained by geometry or
    by colors that depend on the direction.

    The maps are not optimized by gradients, since each photograph is rendered too rarely for that: at each of its steps
    its map moves halfway to the least-squares fit. What all maps have in common, such as the loss of contrast while the
    splat is still blurred, is left to the splat: only the difference of a map from the mean of all is applied.

    Attributes:
        training: row numbers of the fitted photographs.
        maps: of these in their order, [V, 3, 4]: a matrix and an offset.
    """

    def __init__(self, training: Sequence[int], maps: Float[Tensor, "V 3 4"] | None = None) -> None:
        self.training = tuple(training)
        self._rows = {view: row for row, view in enumerate(training)}
        self.maps = IDENTITY.repeat(len(training), 1, 1) if maps is None else maps

    def moved(self, view: int, fitted: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
        """The map of a photograph, a step nearer to the one that fits; nothing changes."""
        return self.maps[self._rows[view]].lerp(fitted, STEP)

    def relative(self, view: int, moved: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
        """What is applied to a render of a photograph whose map is `moved`."""
        current = self.maps[self._rows[view]]
        return moved - (self.maps.sum(0) + moved - current) / len(self.maps) + IDENTITY

    def set(self, view: int, moved: Float[Tensor, "3 4"]) -> None:
        self.maps[self._rows[view]] = moved

    def brightness(self) -> Float[Tensor, " V"]:
        """How bright each photograph is, relative to their mean: what its map makes of a middle grey."""
        return self._channels().mean(-1)

    def differ(self) -> bool:
        """Whether photographs differ in exposure or white balance."""
        return float((self._channels() - 1).abs().max()) > SAME

    def _channels(self) -> Float[Tensor, "V 3"]:
        relative = self.maps - self.maps.mean(0) + IDENTITY
        return (0.5 * relative[..., :3].sum(-1) + relative[..., 3]) / 0.5


MIN_REACH = 1e-30
"""Smallest reach in world units: a reach of 0 would divide a learning rate of 0 by 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """Initial means of Gaussians, and how far each may move from there.

    A step of Adam moves a coordinate by its rate at most, or little more. Pulling back by rate / reach of the way after
    each step therefore leaves it within about one reach, whatever its gradients say; gradients that disagree from one
    photograph to the next move it less. It is AdamW's decay (Loshchilov & Hutter 2019), towards the seed instead of 0.

    Attributes:
        means: initial centers, world units.
        reach: distance in world units, above 0.
    """

    means: Float32[Tensor, "N 3"]
    reach: Float32[Tensor, " N"]

    def pull(self, means: Float32[Tensor, "N 3"], rows: Int64[Tensor, " n"], rate: float) -> None:
        """Moves rows of `means` back, in place, after a step at a learning rate in world units."""
        share = (rate / self.reach[rows]).clamp(max=1).unsqueeze(1)
        means[rows] = means[rows].lerp(self.means[rows], share)

    def keep(self, rows: Int64[Tensor, " n"]) -> "Anchor":
        """The anchor of some rows."""
        return Anchor(means=self.means[rows], reach=self.reach[rows])


def anchor_at(raw: Parameters, length: float) -> Anchor:
    """An anchor at the present means, with a reach of `length` times each Gaussian's largest standard deviation."""
    return Anchor(means=raw["means"].clone(), reach=(length * raw["log_scales"].amax(dim=1).exp()).clamp(min=MIN_REACH))


RATES = {
    "means": 3e-4,
    "quats": 1e-3,
    "log_scales": 2e-2,
    "logit_opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}
"""Learning rates by parameter; that of the means is times the extent of the scene."""
USUAL_STEPS = 1500
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

    steps: int = option(USUAL_STEPS, "photographs looked at, one a step", ge=0)
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
    max_gaussians: int | None = None,
) -> Int64[Tensor, " n"]:
    """Rows that are opaque enough, of sane size on every screen, and seen somewhere.

    A splat's contribution to a view is its column sum of B. Rendering is linear in the colors, so that is the
    gradient of the sum of a picture in which every color is 1.

    Args:
        views: photographs that count, at any size, gone through once.
        max_gaussians: rows that are left at most, the ones that contribute most to some view; None = no limit.

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
        height, width = photo.image.shape[:2]
        rows = rows_in_view(raw, pose, K, width, height, near=raster.near, eps2d=raster.eps2d)
        if not len(rows):
            continue
        ones = torch.ones(len(rows), 3, device=means.device, requires_grad=True)
        shape = (means[rows], raw["quats"][rows], raw["log_scales"][rows].exp(), opacities[rows])
        seen = rasterize(*shape, ones, pose, K, width, height, config=raster)
        (sums,) = torch.autograd.grad(seen.rgb[..., 0].sum(), ones)
        contributions[rows] = torch.maximum(contributions[rows], pixels * sums[:, 0])
        max_widths[rows] = torch.maximum(max_widths[rows], seen.radii / max(width, height))
    rejected = {"opacity": opacities < config.opacity, "contribution": contributions < config.contribution}
    if config.screen:
        rejected["screen"] = max_widths > config.screen
    rows_left = (~torch.stack([*rejected.values()]).any(dim=0)).nonzero().squeeze(1)
    if not len(rows_left):
        why = ", ".join(
            f"{int(rows.sum())} by {name} {getattr(config, name):g}" for name, rows in rejected.items() if rows.any()
        )
        raise InputError(f"reconstruct: pruning would leave none of {len(means)} Gaussians ({why})")
    if max_gaussians is not None and len(rows_left) > max_gaussians:
        by_contribution = contributions[rows_left].argsort(descending=True, stable=True)
        rows_left = rows_left[by_contribution[:max_gaussians]].sort().values
    return rows_left


class PhotographGradients(NamedTuple):
    """Losses and gradients of a splat against one photograph."""

    losses: dict[str, float]  # the terms of the loss; none where no Gaussian is in view
    rows: Int64[Tensor, " n"]  # of the Gaussians that may be visible
    grads: Parameters  # with respect to these rows
    colors: Float[Tensor, "3 4"] | None  # the updated color map of the photograph; None where exposures are not fitted


class Pictures(NamedTuple):
    """A render of one view in two exposures."""

    expected: Float[Tensor, "H W 3"]  # the one that the view is expected to have
    matched: Float[Tensor, "H W 3"]  # the one that fits the photograph best, which does not count against the splat


class Optimizer:
    """The state of an optimization of a splat.

    Attributes:
        adam: the parameters and their moments.
        anchor: keeps positions near their seeds; None = positions are free.
        exposures: affine color maps of the photographs; None where photographs are fitted as they are, because the
            settings say so or because their exposures do not differ.
        is_consistent: whether the state is that between two steps, so that it may be saved.
        extent: length that the learning rate of positions is multiplied by, world units.
        max_gaussians: number that pruning leaves at most; None = no limit.
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
        self.max_gaussians: int | None = None
        self.adam, self.anchor, self.step, self.is_consistent = adam, anchor, step, True
        fits_exposure = config.exposure and (step == 0 or exposures is not None)
        self.exposures = Exposures(self.training, exposures) if fits_exposure else None
        self.device = adam.parameters["means"].device
        centers = photographs.cameras.centers
        smallest = SSIM_WINDOW * max(config.shrinks)
        for view in self.training:
            width, height = photographs.cameras.widths[view], photographs.cameras.heights[view]
            if min(width, height) < smallest:
                raise InputError(
                    f"reconstruct: photograph {photographs.names[view]!r} has {width}×{height} pixels, and {smallest} "
                    f"are needed at least: {SSIM_WINDOW} for SSIM, optimize.shrinks={list(config.shrinks)} times; make "
                    "image_scale larger or shrinks smaller"
                )
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
            compared = compared_pixels(raster.alpha, photo.mask)
            fitted = fitted_colors(raster.rgb, photo.image.to(raster.rgb.device), compared)
            colors = self.exposures.moved(view, fitted)
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
        """A render of a view over black, the rows that may be visible, and their parameters, with gradients."""
        pose, center = camera_of(self.photographs.cameras, view, self.device)
        K, (height, width) = photo.K.to(self.device), photo.image.shape[:2]
        rows = self._rows(pose, photo)
        leaves = {name: value[rows].requires_grad_() for name, value in self.parameters.items()}
        shape = (leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["logit_opacities"].sigmoid())
        raster = rasterize(*shape, seen_colors(leaves, degree, center), pose, K, width, height, config=self.raster)
        return raster, rows, leaves

    def _rows(self, pose: Float[Tensor, "4 4"], photo: ScaledPhotograph) -> Int64[Tensor, " n"]:
        """Rows of the Gaussians that may be visible in a view."""
        K, raster, (height, width) = photo.K.to(self.device), self.raster, photo.image.shape[:2]
        return rows_in_view(self.parameters, pose, K, width, height, near=raster.near, eps2d=raster.eps2d)

    def contributing(self) -> Int64[Tensor, " n"]:
        """Rows that pruning would leave now."""
        views = ((view, self.photographs.at_scale(view, 2)) for view in self.training)
        return rows_to_keep(
            self.parameters,
            self.photographs.cameras,
            views,
            self.pruning,
            self.raster,
            max_gaussians=self.max_gaussians,
        )

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

    @torch.no_grad()
    def pictures(self, view: int, photo: ScaledPhotograph, colors: Float[Tensor, "3 4"]) -> Pictures:
        """Renders of a view of the current splat, in [0, 1]; `colors` is the map of the exposure that is expected."""
        raster = self._render(view, photo, self.config.sh_degree)[0]
        compared = compared_pixels(raster.alpha, photo.mask)
        fitted = fitted_colors(raster.rgb, photo.image.to(raster.rgb.device), compared)
        expected, matched = apply_colors(raster.rgb, colors), apply_colors(raster.rgb, fitted)
        return Pictures(expected.clamp(0, 1).cpu(), matched.clamp(0, 1).cpu())

    @torch.no_grad()
    def opacity(self, view: int, photo: ScaledPhotograph) -> Float[Tensor, "H W"]:
        """The share of the background that the current splat hides in a view, in [0, 1]."""
        return self._render(view, photo, 0)[0].alpha.cpu()
