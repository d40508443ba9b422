"""The encoder: its inputs, grid, curves, merging, convolution, attention, and the whole in four precisions."""

from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import torch
from stability import oracles
from stability.extremes import CHANNELS, Case
from stability.registry import routine, worst

from gsencoder.core.arrays import round_columns
from gsencoder.models.encoder import MIN_MERGE_WEIGHT, EncoderConfig, GaussianEncoder, encoder_inputs, merge
from gsencoder.models.grid import coordinate_bits, hilbert_from_morton, morton_codes
from gsencoder.models.plan import grid_coords, join_plans, neighbor_table, plan_cloud
from gsencoder.models.transformer import (
    ATTRIBUTE_CHANNELS,
    NeighborConv,
    PatchAttention,
    Pool,
    TransformerConfig,
    embed,
)
from gsencoder.types import SH_C0

Wide = oracles.Wide
CONFIG = EncoderConfig(
    transformer=TransformerConfig(
        encoder_depths=(1, 1), encoder_channels=(16, 32), decoder_depths=(1,), decoder_channels=(16,),
        head_channels=8, patch=24,
    ),
    projector=16,
)  # fmt: skip
FEW = 250
"""Gaussians of a case that the encoder and exact arithmetic are measured on."""


def few(case: Case) -> Case:
    n = len(case.gaussians)
    return case if n <= FEW else replace(case, gaussians=case.gaussians.select(np.arange(0, n, -(-n // FEW))))


@routine("encoder: grid cells", "splat")
def cells_error(case: Case) -> float:
    means, voxel = few(case).gaussians.means, case.voxel
    cells = grid_coords(torch.from_numpy(means), voxel).numpy()
    exact = [[Fraction(float(x)) / Fraction(voxel) for x in row] for row in means]
    # Where coordinates are counted from; the one point may lie on a border.
    shift = np.median([[x.__floor__() for x in row] for row in exact] - cells, axis=0).astype(int).tolist()
    outside = Fraction(0)
    for row, cell in zip(exact, cells.tolist(), strict=True):
        for x, c, s in zip(row, cell, shift, strict=True):
            outside = max(outside, (c + s) - x, x - (c + s + 1))
    return float(outside)


@routine("encoder: codes along curves", "splat")
def codes_error(case: Case) -> float:
    cells = grid_coords(torch.from_numpy(few(case).gaussians.means), case.voxel).numpy()
    cells = np.unique(cells, axis=0)
    codes = morton_codes(cells)
    wrong = np.array([oracles.interleave(tuple(cell)) for cell in cells.tolist()]) != codes
    curve = hilbert_from_morton(codes, coordinate_bits(cells))
    # One cell, one code; the eight cells of a coarser one, and no others, share all but its last digit.
    pairs = set(zip((curve >> 3).tolist(), map(tuple, (cells >> 1).tolist()), strict=True))
    whole = len(set(curve.tolist())) == len(cells)
    whole &= len(pairs) == len({code for code, _ in pairs}) == len({cell for _, cell in pairs})
    return float(wrong.mean()) if whole else 1.0


@routine("encoder: input channels", "splat")
def embed_error(case: Case) -> float:
    g, voxel = case.gaussians, Wide(case.voxel)
    arrays = (g.means, g.quats, g.scales, g.opacities, g.sh[:, 0])
    got = embed(*map(torch.from_numpy, arrays), voxel=case.voxel, attributes=tuple(ATTRIBUTE_CHANNELS))
    cells = g.means.astype(Wide) / voxel
    logs = np.clip(np.log(g.scales.astype(Wide) / voxel), -12, 12)
    rotation = oracles.rotations(g.quats)
    matrix = rotation * (logs - logs.mean(axis=1, keepdims=True))[:, None] @ rotation.swapaxes(1, 2) / 4
    root = np.sqrt(Wide(2))
    entries = [matrix[:, i, j] * (1 if i == j else root) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    offset = 2 * (cells - np.floor(cells)) - 1 - got[:, :3].numpy()
    want = [
        got[:, :3].numpy() + offset - 2 * np.rint(offset / 2),
        np.clip(2 * Wide(SH_C0) * g.sh[:, 0], -2, 2),
        2 * g.opacities.astype(Wide)[:, None] - 1,
        -np.sort(-logs, axis=1) / 4,
        np.stack(entries, axis=1),
        np.clip(cells[:, 2:] / 50 - 1, -2, 2),
        np.clip(cells[:, 2:] / 5 - 1, -1, 1),
        np.full((len(cells), 1), np.log2(voxel / Wide(0.05))),
    ]
    return worst(got, np.concatenate(want, axis=1), 1)


@routine("encoder: merging into cells", "splat", "vectors")
def merge_error(case: Case) -> float:
    means = torch.from_numpy(case.gaussians.means)
    plan = join_plans([plan_cloud(means, case.voxel, levels=1)], 24)
    values = np.resize(case.vectors, (len(means), CHANNELS))
    weights = torch.from_numpy(case.gaussians.opacities).clamp(min=MIN_MERGE_WEIGHT)
    got = merge(torch.from_numpy(values), weights, plan)
    tokens, heft = plan.token_of.numpy(), weights.numpy().astype(Wide)
    sums, total = np.zeros((len(plan.counts), CHANNELS), Wide), np.zeros(len(plan.counts), Wide)
    np.add.at(sums, tokens, values.astype(Wide) * heft[:, None])
    np.add.at(total, tokens, heft)
    largest = np.zeros((len(plan.counts), 1))
    np.maximum.at(largest[:, 0], tokens, np.abs(values).max(axis=1))
    return worst(got, sums / total[:, None], largest)


@routine("encoder: pooling to a coarser grid", "splat", "vectors")
def pool_error(case: Case) -> float:
    torch.manual_seed(0)
    layer = Pool(CHANNELS, 16)
    means = torch.from_numpy(few(case).gaussians.means)
    plan = join_plans([plan_cloud(means, case.voxel, levels=2)], 24, round_up=False)
    cells = grid_coords(means, case.voxel)[plan.members[plan.counts.cumsum(0) - plan.counts]]
    tokens = np.resize(case.vectors, (len(cells), CHANNELS))
    with torch.no_grad():
        got = layer(torch.from_numpy(tokens), plan.levels[0].children)
        wide = layer.double()
        projected = wide.project(torch.from_numpy(tokens).double())
        parents = {tuple(cell): [] for cell in (cells >> 1).tolist()}  # type: dict[tuple[int, ...], list[int]]
        for row, cell in enumerate((cells >> 1).tolist()):
            parents[tuple(cell)].append(row)
        order = [tuple((cells[children[0]] >> 1).tolist()) for children in plan.levels[0].children.tolist()]
        pooled = torch.stack([projected[parents[cell]].amax(dim=0) for cell in order])
        want = torch.nn.functional.gelu(wide.norm(pooled))
    return worst(got, want.numpy())


@routine("encoder: convolution over neighbors", "splat", "vectors")
def convolution_error(case: Case) -> float:
    torch.manual_seed(0)
    layer = NeighborConv(CHANNELS, 8)
    cells = torch.unique(grid_coords(torch.from_numpy(few(case).gaussians.means), case.voxel), dim=0)
    tokens = np.resize(case.vectors, (len(cells), CHANNELS))
    with torch.no_grad():
        got = layer(torch.from_numpy(tokens), neighbor_table(cells))
    row_of = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    steps = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    around = [[(x + i, y + j, z + k) for i, j, k in steps] for x, y, z in cells.tolist()]
    rows = np.array([[row_of.get(cell, len(cells)) for cell in line] for line in around])
    padded = np.concatenate([tokens, np.zeros_like(tokens[:1])]).astype(Wide)
    weight = layer.weight.detach().numpy().astype(Wide)
    return worst(got, padded[rows].reshape(len(cells), -1) @ weight.reshape(-1, 8))


def attention_case(case: Case, *, exported: bool) -> float:
    """One patch of 40 slots, 7 of them padding, with scores of the magnitude of the case."""
    torch.manual_seed(0)
    layer = PatchAttention(16, 2)
    generator = np.random.default_rng(0)
    tokens = generator.normal(size=(33, 16)).astype(np.float32)
    with torch.no_grad():
        layer.qkv.bias.zero_()
        q, k = (torch.from_numpy(tokens) @ layer.qkv.weight[rows].T for rows in (slice(0, 16), slice(16, 32)))
        peak = max(float((q[:, s] @ k[:, s].T).abs().max()) for s in (slice(0, 8), slice(8, 16))) / 8**0.5
        layer.qkv.weight[:32] *= (case.logits / peak) ** 0.5
    slots = torch.cat((torch.arange(33), torch.zeros(7, dtype=torch.int64)))
    mask = (torch.arange(40) < 33).view(1, 1, 1, 40)
    with torch.no_grad():
        x = torch.from_numpy(tokens)
        if exported:
            got = layer._forward_exported(x.index_select(0, slots), torch.arange(33), mask, 40)
        else:
            got = layer(x, slots, torch.arange(33), mask, 40)
    weight, wide = layer.qkv.weight.detach().numpy().astype(Wide), tokens.astype(Wide)
    q, k, v = (wide @ weight[start : start + 16].T for start in (0, 16, 32))
    heads = [oracles.softmax_mean(q[:, s] @ k[:, s].T / np.sqrt(Wide(8)), v[:, s]) for s in (slice(0, 8), slice(8, 16))]
    project = layer.project.weight.detach().numpy().astype(Wide)
    want = np.concatenate(heads, axis=1) @ project.T + layer.project.bias.detach().numpy()
    return worst(got, want, float(np.abs(want).max()) * (1 + case.logits))


@routine("encoder: attention", "logits")
def patch_attention_error(case: Case) -> float:
    return attention_case(case, exported=False)


@routine("encoder: attention as exported to ONNX", "logits")
def exported_attention_error(case: Case) -> float:
    return attention_case(case, exported=True)


@cache
def network() -> GaussianEncoder:
    torch.manual_seed(0)
    return GaussianEncoder(CONFIG, 12).eval()


@cache
def _wide_outputs(key: int) -> torch.Tensor:
    return outputs(_seen[key], network_of(torch.float64))


_seen: dict[int, Case] = {}


def network_of(dtype: torch.dtype) -> GaussianEncoder:
    made = GaussianEncoder(CONFIG, 12).eval().to(dtype)
    made.load_state_dict(network().state_dict())
    return made


def outputs(case: Case, made: GaussianEncoder, autocast: bool = False) -> torch.Tensor:
    one = few(case)
    attributes, opacities, cloud = encoder_inputs(one.gaussians, CONFIG, case.voxel)
    dtype = next(made.parameters()).dtype
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        out = made(attributes.to(dtype), opacities.to(dtype), made.join([cloud]))
    return out.double()


def encoder_error(case: Case, made: GaussianEncoder, autocast: bool = False) -> float:
    """Root mean square error, relative to the root mean square of the outputs in float64."""
    _seen[id(case)] = case
    want, got = _wide_outputs(id(case)), outputs(case, made, autocast)
    if not bool(got.isfinite().all()):
        return float("inf")
    return float((got - want).square().mean().sqrt() / want.square().mean().sqrt())


@routine("encoder in float32", "splat")
def float32_error(case: Case) -> float:
    return encoder_error(case, network_of(torch.float32))


@routine("encoder in bfloat16 (autocast)", "splat")
def bfloat16_error(case: Case) -> float:
    return encoder_error(case, network_of(torch.float32), autocast=True)


@routine("encoder with weights of float16", "splat")
def float16_error(case: Case) -> float:
    made = network_of(torch.float32)
    made.load_state_dict({name: value.half().float() for name, value in made.state_dict().items()})
    return encoder_error(case, made)


@routine("encoder with weights of int8", "splat")
def int8_weights_error(case: Case) -> float:
    made = network_of(torch.float32)
    with torch.no_grad():
        for part in made.modules():
            if isinstance(part, (torch.nn.Linear, NeighborConv)):
                shaped = part.weight.flatten(0, 1) if isinstance(part, NeighborConv) else part.weight.T
                integers, scale = round_columns(shaped.contiguous().numpy())
                back = torch.from_numpy(integers * scale)
                part.weight.copy_(back.view_as(part.weight) if isinstance(part, NeighborConv) else back.T)
    return encoder_error(case, made)
