"""The parameters that are optimized: a splat with logarithms of scales and logits of opacities."""

from collections.abc import Mapping
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsencoder.core.threads import PIECES, kernel, parallel
from gsencoder.geometry import colors_from_sh, normalize_quats, project_points, transform
from gsencoder.types import Cameras, Gaussians

OPACITY_MARGIN = 1e-3
"""Opacities begin at least so far from 0 and 1, where a logit has no slope."""
MAX_SIGMAS = 3.33
"""No splat reaches further than so many standard deviations: √(2 ln 255) at an opacity of 1."""

Parameters = dict[str, Tensor]
"""means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh0 [N, 1, 3], shN [N, K − 1, 3], float32."""


def shapes_of(sh_degree: int) -> dict[str, tuple[int, ...]]:
    """The size of one row of each parameter."""
    rest = (sh_degree + 1) ** 2 - 1
    return {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "logit_opacities": (),
        "sh0": (1, 3),
        "shN": (rest, 3),
    }


def parameters_from(gaussians: Gaussians, sh_degree: int, device: torch.device | str = "cpu") -> Parameters:
    """The parameters of a splat; color coefficients above those that it has begin at zero, more are cut."""
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
        averages: first moments by parameter.
        squares: second moments by parameter.
        steps: steps that were taken.
    """

    KINDS = ("parameters", "averages", "squares")

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        """Args:
        parameters: float32 tensors of N rows each, stepped in place.
        """
        self.parameters = dict(parameters)
        self.averages = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.squares = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.steps = 0

    @classmethod
    def restored(cls, tables: Mapping[str, Mapping[str, Tensor]], steps: int) -> "RowAdam":
        """One that stands where `tables` of another, and its steps, were taken."""
        restored = cls(tables["parameters"])
        restored.averages, restored.squares = dict(tables["averages"]), dict(tables["squares"])
        restored.steps = steps
        return restored

    def tables(self) -> dict[str, dict[str, Tensor]]:
        """Parameters and moments."""
        return dict(zip(self.KINDS, (self.parameters, self.averages, self.squares), strict=True))

    def step(self, rows: Int64[Tensor, " n"], grads: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """One step.

        Args:
            rows: which rows have gradients; distinct.
            grads: of those rows, by parameter.
            rates: learning rate by parameter.
        """
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
