"""The Gaussian encoder: a network from raw Gaussian attributes to one feature per Gaussian (SplatDistill sec. 3.3),
and its weights on disk: a safetensors file with parameters, configuration of the network and output spaces."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import check_limits, first_difference, option
from gsencoder.models.grid import SceneCurves
from gsencoder.models.output_space import OutputSpaces, find_weights, output_spaces_parts, read_output_spaces
from gsencoder.models.plan import CloudPlan, KernelSize, Plan, join_plans, plan_cloud
from gsencoder.models.transformer import (
    ATTRIBUTE_CHANNELS,
    Attribute,
    NeighborConv,
    PointTransformer,
    TransformerConfig,
    embed,
    input_channels,
)
from gsencoder.types import Gaussians

MIN_MERGE_WEIGHT = 1e-3
"""Smallest weight of a Gaussian within its token, so that a token of invisible Gaussians has a mean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderConfig:
    """Inputs, token grid and network of an encoder."""

    voxel: float = option(0.02, "edge length of the token grid's cells, metres", gt=0)
    coarser: tuple[float, ...] = option(
        (), "further token grids on which a splat is encoded, whose outputs are averaged, as multiples of voxel", gt=1
    )
    inputs: tuple[Attribute, ...] = option(
        ("offset", "color", "opacity", "scale", "rotation"), "Gaussian attributes that the encoder sees"
    )
    stem: KernelSize = option(3, "edge of the first convolution's neighborhood in cells: 3, or 5 as in PTv3")
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    projector: int = option(
        128,
        "hidden channels of the MLP (linear, GELU, linear) that gives the outputs of each teacher; 0 = one "
        "linear layer for all",
        ge=0,
        le=1 << 16,
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if self.stem not in (3, 5):
            raise InputError(f"stem: expected 3 or 5 cells, got {self.stem}")
        unknown = [name for name in self.inputs if name not in ATTRIBUTE_CHANNELS]
        if not self.inputs or unknown or len(set(self.inputs)) < len(self.inputs):
            raise InputError(
                f"inputs: expected one or more of {', '.join(ATTRIBUTE_CHANNELS)}, each once, "
                f"got {', '.join(self.inputs)}"
            )


class GaussianEncoder(nn.Module):
    """Merges Gaussians into tokens, runs the point transformer, and gives each Gaussian the feature of its token."""

    def __init__(self, config: EncoderConfig, channels: int | Sequence[int]) -> None:
        """The columns of the output, of each teacher, are the rank R of a basis, or all D channels of the space."""
        super().__init__()
        widths = [channels] if isinstance(channels, int) else list(channels)
        self.config, self.channels = config, sum(widths)
        width, out = config.transformer.encoder_channels[0], config.transformer.channels_out
        self.stem = NeighborConv(input_channels(config.inputs), width, config.stem)
        self.stem_norm = nn.LayerNorm(width)
        self.transformer = PointTransformer(config.transformer)
        self.head_norm = nn.LayerNorm(out)
        self.head = Projectors(out, widths, config.projector) if config.projector else nn.Linear(out, sum(widths))

    def join(self, clouds: list[CloudPlan]) -> Plan:
        """Joins plans of clouds to that of a batch; see `plan.join_plans`."""
        return join_plans(clouds, self.config.transformer.patch)

    def forward(
        self, attributes: Float[Tensor, "N A"], opacities: Float[Tensor, " N"], plan: Plan
    ) -> Float[Tensor, "M channels"]:
        """Predicts features in standard units (see `OutputSpace`), in float32 or wider even under autocast, for the
        Gaussians that `plan.token_of` lists. `opacities` are weights of the Gaussians within their tokens."""
        tokens = merge(attributes, opacities.clamp(min=MIN_MERGE_WEIGHT), plan)
        if not torch.compiler.is_exporting():
            # Levels may end in unused tokens.
            tokens = functional.pad(tokens, (0, 0, 0, len(plan.levels[0].neighbors) - len(tokens)))
        # Tokens are merged in float32, also for an encoder in half precision.
        tokens = tokens.to(self.head_norm.weight.dtype)
        neighbors = plan.levels[0].neighbors if plan.stem_neighbors is None else plan.stem_neighbors
        x = functional.gelu(self.stem_norm(self.stem(tokens, neighbors)))
        x = self.transformer(x, plan)
        if not torch.compiler.is_exporting() and len(plan.token_of) < len(plan.counts):
            return self._output_features(x.index_select(0, plan.token_of))
        return self._output_features(x).index_select(0, plan.token_of)

    def _output_features(self, x: Float[Tensor, "T C"]) -> Float[Tensor, "T channels"]:
        """The last norm and the projectors (or the linear layer), in float32 under autocast: in bfloat16 the outputs
        would be rounded to 8 bits."""
        if torch.is_autocast_enabled(x.device.type):
            with torch.autocast(x.device.type, enabled=False):
                features: Tensor = self.head(self.head_norm(x.to(self.head_norm.weight.dtype)))
        else:
            features = self.head(self.head_norm(x))
        return features.to(torch.promote_types(features.dtype, torch.float32))

    def head_parameters(self, outputs: OutputSpaces, teacher: str) -> tuple[Tensor, ...]:
        """Weights and biases of the layers that give a teacher's columns, the last layer's at the end."""
        if isinstance(self.head, Projectors):
            return tuple(self.head.of_teacher[list(outputs).index(teacher)].parameters())
        return self.head.weight[outputs.columns[teacher]], self.head.bias[outputs.columns[teacher]]


class Projectors(nn.Module):
    """A projector for each teacher: two layers from the transformer's channels to the teacher's columns.

    One linear layer from C channels gives outputs of rank C, which several teachers would have to share.
    """

    def __init__(self, channels: int, widths: Sequence[int], hidden: int) -> None:
        super().__init__()
        self.of_teacher = nn.ModuleList(
            nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, width)) for width in widths
        )

    def forward(self, x: Float[Tensor, "T C"]) -> Float[Tensor, "T channels"]:
        return torch.cat([projector(x) for projector in self.of_teacher], dim=1)


def merge(attributes: Float[Tensor, "N A"], weights: Float[Tensor, " N"], plan: Plan) -> Float[Tensor, "T A"]:
    """Merges Gaussians into tokens: the mean of each token's members with weights > 0, summed in a fixed order."""
    weighted = torch.cat((attributes * weights.unsqueeze(1), weights.unsqueeze(1)), dim=1)
    if torch.compiler.is_exporting():
        # ONNX has no segment reduction, and scatter-add of onnxruntime loses terms when two threads add to one row.
        ends = plan.counts.cumsum(0)
        running = functional.pad(weighted.index_select(0, plan.members).double().cumsum(0), (0, 0, 1, 0))
        sums = running.index_select(0, ends) - running.index_select(0, ends - plan.counts)
        sums = sums.to(weighted.dtype)
        return sums[:, :-1] / sums[:, -1:]
    if len(plan.counts) == len(attributes):
        return attributes.index_select(0, plan.members)
    sums = torch.segment_reduce(weighted.index_select(0, plan.members), "sum", lengths=plan.counts)
    return sums[:, :-1] / sums[:, -1:]


def encoder_inputs(
    gaussians: Gaussians,
    config: EncoderConfig,
    voxel: float,
    device: str | torch.device = "cpu",
    *,
    scene_curves: SceneCurves | None = None,
) -> tuple[Float[Tensor, "N A"], Float[Tensor, " N"], CloudPlan]:
    """The inputs of an encoder for one cloud: attributes, opacities and plan.

    Args:
        voxel: edge length of the token grid's cells in units of the cloud, metres.
        scene_curves: patch boundaries of the full scene if the cloud is a part of one; None = it is the full scene.
    """

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    means, opacities = tensor(gaussians.means), tensor(gaussians.opacities)
    attributes = embed(
        means,
        tensor(gaussians.quats),
        tensor(gaussians.scales),
        opacities,
        tensor(gaussians.sh[:, 0]),
        voxel=voxel,
        attributes=config.inputs,
    )
    network = config.transformer
    plan = plan_cloud(
        means, voxel, levels=network.levels, orders=network.orders, scene_curves=scene_curves, stem=config.stem
    )
    return attributes, opacities, plan


def save_weights(
    path: Path,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    made_by: Mapping[str, Any],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes parameters as `dtype`, configuration and output spaces, with settings and results of the training as JSON
    values."""
    arrays, header = output_spaces_parts(outputs)
    for name, value in encoder.state_dict().items():
        with np.errstate(over="ignore"):
            stored = value.detach().cpu().numpy().astype(dtype)
        if not np.isfinite(stored).all():
            remedy = f" in {dtype}; use store=float32 or a lower learning rate" if torch.isfinite(value).all() else ""
            raise InputError(f"save_weights: parameter {name} is not finite{remedy}")
        arrays[f"encoder.{name}"] = stored
    header |= {"encoder": asdict(encoder.config), "dtype": dtype, "made_by": dict(made_by)}
    write_archive(path, arrays, header)


def load_weights(source: str | Path, option: str = "weights") -> tuple[GaussianEncoder, OutputSpaces, dict[str, Any]]:
    """Loads an encoder in evaluation mode, its output spaces, and settings and results of its training; see
    `find_weights` for the arguments."""
    with open_archive(find_weights(str(source), option)) as file:
        outputs = read_output_spaces(file)
        dtype = file.value("dtype", str)
        if dtype not in ("float32", "float16"):
            raise InputError(f"expected parameters of float32 or float16, got {dtype[:20]!r}")
        config = _read_config(file.value("encoder", dict))
        with torch.device("meta"):
            encoder = GaussianEncoder(config, outputs.widths)
        state = {
            name: torch.from_numpy(file.array(f"encoder.{name}", dtype, tuple(value.shape)).astype(np.float32))
            for name, value in encoder.state_dict().items()
        }
        made_by: dict[str, Any] = file.value("made_by", dict)
    encoder.load_state_dict(state, assign=True)
    return encoder.eval(), outputs, made_by


@torch.no_grad()
def start_from(encoder: GaussianEncoder, outputs: OutputSpaces, source: str | Path) -> None:
    """Gives an encoder the parameters of trained weights. Its last layers are converted to its own output spaces, whose
    means, scales and bases may be others, so that it predicts the same features; a teacher that the weights do not
    predict keeps its projector, with a warning."""
    trained, spaces = load_start(encoder.config, source)
    state = {name: value for name, value in trained.state_dict().items() if not name.startswith("head.")}
    encoder.load_state_dict(state, strict=False)
    for teacher, target in outputs.by_teacher.items():
        name = next((each for each in spaces if spaces[each].space == target.space), None)
        if name is None:
            message = f"init: {source} has no features of {teacher}, whose projector starts at random"
            warnings.warn(message, SceneWarning, stacklevel=2)
            continue
        *hidden, weight, bias = trained.head_parameters(spaces, name)
        # The conversion is affine, so that those of 0, of the bias and of each column give it.
        rows = torch.cat((torch.zeros_like(bias)[None], bias[None], weight.T)).numpy()
        converted = torch.from_numpy(target.project(spaces[name].features(spaces[name].restore(rows)).decode()))
        values = (*hidden, (converted[2:] - converted[0]).T, converted[1])
        for parameter, value in zip(encoder.head_parameters(outputs, teacher), values, strict=True):
            parameter.copy_(value)


def load_start(config: EncoderConfig, source: str | Path) -> tuple[GaussianEncoder, OutputSpaces]:
    """Reads weights to start from, and checks that they are of a network with these settings."""
    trained, spaces, _ = load_weights(source, "init")
    theirs, ours = (
        asdict(
            replace(
                each,
                # A network that knows the size of its cells may start on others.
                voxel=1.0 if "cell" in each.inputs else each.voxel,
                coarser=(),
                transformer=replace(each.transformer, drop_path=0.0),
            )
        )
        for each in (trained.config, config)
    )
    if theirs != ours:
        difference = first_difference({"model": theirs}, {"model": ours})
        raise InputError(f"init: {source} was made with {difference}; give the settings that it was made with")
    return trained, spaces


def _read_config(values: dict[str, Any]) -> EncoderConfig:
    import dacite

    try:
        return dacite.from_dict(EncoderConfig, values, dacite.Config(strict=True, cast=[tuple]))
    except (dacite.DaciteError, TypeError) as error:
        raise InputError(f"the encoder's configuration does not fit this version of gsencoder: {error}") from error
