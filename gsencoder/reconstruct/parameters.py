"""What is optimized: a splat with logarithms of scales and logits of opacities, what holds its positions, the colors of
each photograph; and their checkpoint."""

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, error_hint
from gsencoder.core.settings import first_difference
from gsencoder.core.threads import PIECES, kernel, parallel
from gsencoder.geometry import colors_from_sh, normalize_quats, project_points, transform
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

    KINDS = ("parameters", "averages", "squares")

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

    def tables(self) -> dict[str, dict[str, Tensor]]:
        """Parameters and moments."""
        return dict(zip(self.KINDS, (self.parameters, self.averages, self.squares), strict=True))

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
        for table in self.tables().values():
            for name, value in table.items():
                table[name] = value[rows].contiguous()


RIDGE = 1e-3
"""Pull toward the identity, as a variance of colors in [0, 1]: what a picture does not vary in is not fitted."""
STEP = 0.5
"""Share of the way to the best fit that a map moves at each step of its photograph."""
OPAQUE = 0.5
"""Pixels of a render below this alpha show the background, and tell nothing."""
SAME = 0.03
"""Photographs of which no color channel differs by more from the mean do not count as differing in exposure."""
ROUNDS = 3
"""Number of steps of each photograph after which the maps, now seven eighths of the way to the fits, are judged."""

IDENTITY = torch.eye(3, 4)


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


def fitted_colors(
    render: Float[Tensor, "H W 3"], image: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """The affine map A·c + b of the render's colors that is nearest to the photograph's in a mask, by ridge regression:
    A in the first three columns and b in the last, on the CPU; the identity where the mask is empty."""
    weights = mask.unsqueeze(-1).to(render.dtype)
    inputs = torch.cat((render, torch.ones_like(render[..., :1])), dim=-1) * weights
    rows, residuals = inputs.flatten(0, 1), ((image - render) * weights).flatten(0, 1)
    count = float(mask.sum().clamp(min=1))
    gram, moments = ((rows.T @ other).double().cpu() / count for other in (rows, residuals))
    change = torch.linalg.solve(gram + RIDGE * torch.eye(4, dtype=torch.float64), moments)
    return IDENTITY + change.T.float()


def apply_colors(colors: Float[Tensor, "H W 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "H W 3"]:
    """A·c + b for each pixel."""
    affine = affine.to(colors)
    return colors @ affine[:, :3].T + affine[:, 3]


def compared_pixels(alpha: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"]:
    """Pixels whose colors are compared: what the splat covers and the mask leaves."""
    covered = alpha > OPAQUE
    return covered if mask is None else covered & mask.to(covered.device)


CHECKPOINT_FILE = "reconstruction.safetensors"
IMAGE_SCALE = "image_scale"
"""The setting that says by which factor a budget made the photographs smaller."""
PLAN = "plan"
"""The fact that holds the plan."""
ANCHOR_SHAPES: dict[str, tuple[int | str, ...]] = {"means": ("N", 3), "reach": ("N",)}
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


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """A reconstruction between two steps. The first is of step 0: seeds are sought once.

    Attributes:
        adam: parameters and moments.
        anchor: what holds positions near their seeds, if anything does.
        exposures: an affine map of colors for each fitted photograph, if they are fitted; None at step 0, and
            where photographs do not differ in exposure.
        facts: how it began, as JSON values: number and source of the seeds, what was added to points, and the plan.
    """

    adam: RowAdam
    anchor: Anchor | None
    exposures: Float[Tensor, "V 3 4"] | None = None
    step: int
    seconds: float
    facts: Mapping[str, Any]


def save_state(path: Path, state: State, settings: Mapping[str, Any]) -> None:
    """Writes the state; `settings` are what a run must have in common to go on from here, as JSON values."""
    arrays = {
        f"{kind}.{name}": value.detach().cpu().numpy()
        for kind, table in state.adam.tables().items()
        for name, value in table.items()
    }
    if state.anchor is not None:
        arrays |= {f"anchor.{name}": getattr(state.anchor, name).cpu().numpy() for name in ANCHOR_SHAPES}
    if state.exposures is not None:
        arrays["exposure.maps"] = state.exposures.numpy()
    header = {
        "step": state.step,
        "adam_steps": state.adam.steps,
        "seconds": state.seconds,
        "facts": dict(state.facts),
        "settings": dict(settings),
    }
    write_archive(path, arrays, header)


def image_scale_of(path: Path) -> float | None:
    """The factor by which an unfinished run makes photographs smaller; None where there is no such run, or its
    checkpoint does not say so or is damaged, which `load_state` says."""
    if not os.path.lexists(path):
        return None
    with suppress(InputError), open_archive(path) as file:
        scale = file.value("settings", dict).get(IMAGE_SCALE)
        return scale if isinstance(scale, float) and 0 < scale <= 1 else None
    return None


def load_state(path: Path, settings: Mapping[str, Any], *, sh_degree: int, device: torch.device | str = "cpu") -> State:
    """The state that a run has left; the colors are of `sh_degree`, or of the degree of the plan in its facts.

    Raises:
        InputError: damaged, or of a run with other settings; the first that differs is named.
    """
    with error_hint(f"give resume=false to start again, or remove {path}"), open_archive(path) as file:
        earlier = file.value("settings", dict)
        if earlier != settings:
            raise InputError(f"{path}: was made with {first_difference(earlier, settings)}")
        step, adam_steps = file.value("step", int), file.value("adam_steps", int)
        seconds, facts = float(file.value("seconds", float, int)), file.value("facts", dict)
        if not (0 <= adam_steps <= step and 0 <= seconds < math.inf):
            raise InputError(f"a state that no run was in (step {step})")
        degree = facts.get(PLAN, {}).get("sh_degree", sh_degree)
        if degree not in range(sh_degree + 1):
            raise InputError(f"colors of a degree that no run has ({degree!r})")
        shapes: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": ()}
        shapes |= {"sh0": (1, 3), "shN": ((degree + 1) ** 2 - 1, 3)}
        tables = {
            kind: {
                name: torch.from_numpy(file.array(f"{kind}.{name}", "float32", ("N", *shape)).copy()).to(device)
                for name, shape in shapes.items()
            }
            for kind in RowAdam.KINDS
        }
        anchor = None
        if "anchor.means" in file:
            arrays = {name: file.array(f"anchor.{name}", "float32", shape) for name, shape in ANCHOR_SHAPES.items()}
            anchor = Anchor(**{name: torch.from_numpy(value.copy()).to(device) for name, value in arrays.items()})
        exposures = None
        if "exposure.maps" in file:
            exposures = torch.from_numpy(file.array("exposure.maps", "float32", ("V", 3, 4)).copy())
    adam = RowAdam.restored(tables, adam_steps)
    return State(adam=adam, anchor=anchor, exposures=exposures, step=step, seconds=seconds, facts=facts)
