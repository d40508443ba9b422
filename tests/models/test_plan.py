"""Plans: tokens, levels, patches, and what putting clouds side by side must not change."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsencoder.core.device import to_device
from gsencoder.models.grid import cut_scene_curves
from gsencoder.models.plan import ORDERS, Level, Plan, _round_up_size, join_plans, plan_cloud

VOXEL = 0.1


def cloud(count: int, seed: int = 0, extent: float = 2.0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, extent, (count, 3)).astype(np.float32))


def make_plan(means: torch.Tensor, voxel: float, *, levels: int, patch: int) -> Plan:
    """The plan of one cloud on its own, of as many tokens as there are."""
    return join_plans([plan_cloud(means, voxel, levels=levels)], patch, round_up=False)


def check(plan: Plan, gaussians: int) -> None:
    """What every plan must keep to."""
    assert plan.token_of.shape == (gaussians,)
    assert sorted(plan.members.tolist()) == list(range(gaussians))
    assert plan.counts.sum() == gaussians
    assert torch.equal(plan.token_of[plan.members], torch.repeat_interleave(plan.counts))
    for level in plan.levels:
        tokens = len(level.neighbors)
        for gather, scatter in zip(level.gather_index, level.scatter_index, strict=True):
            assert gather.numel() % level.patch_width == 0
            assert int(gather.max()) < tokens
            assert int(scatter.max()) < gather.numel()


@given(st.integers(1, 300), st.integers(1, 4), st.integers(1, 40), st.booleans(), st.integers(0, 5))
@settings(max_examples=60)
def test_every_plan_holds_together(count: int, levels: int, patch: int, round_up: bool, seed: int) -> None:
    plan = join_plans([plan_cloud(cloud(count, seed), VOXEL, levels=levels)], patch, round_up=round_up)
    check(plan, count)
    real = len(plan.counts)
    for number, level in enumerate(plan.levels):
        for order, (gather, scatter) in enumerate(zip(level.gather_index, level.scatter_index, strict=True)):
            # Each token stands in exactly one place that attention looks at, and finds itself there.
            assert torch.equal(gather[scatter[:real]], torch.arange(real))
            used = torch.ones_like(gather, dtype=torch.bool) if level.attn_mask is None else level.attn_mask[order]
            patches = -(-real // patch)
            assert int(used.reshape(-1, level.patch_width)[:patches].sum()) == real
        if number + 1 < levels:
            coarser = len(torch.unique(level.parents[:real]))
            assert torch.equal(torch.unique(level.parents[:real]), torch.arange(coarser))
            for parent in range(coarser):
                own = set(torch.nonzero(level.parents[:real] == parent).flatten().tolist())
                assert set(level.children[parent].tolist()) == own
            real = coarser


def test_tokens_are_the_occupied_cells() -> None:
    points = cloud(500)
    plan = make_plan(points, VOXEL, levels=2, patch=32)
    cells = torch.floor(points.double() / VOXEL)
    assert len(plan.counts) == len(torch.unique(cells, dim=0))
    for token in range(0, len(plan.counts), 37):
        assert len(torch.unique(cells[plan.token_of == token], dim=0)) == 1


def test_patches_of_a_cloud_differ_by_one_token_at_most() -> None:
    plan = make_plan(cloud(1000), VOXEL, levels=1, patch=64)
    level = plan.levels[0]
    sizes = level.attn_mask.reshape(-1, level.patch_width).sum(dim=1)
    assert sizes.max() - sizes.min() <= 1
    assert level.patch_width <= 64


def test_patches_are_compact_in_space() -> None:
    """Along a curve, tokens of a patch lie closer together than tokens taken at random."""
    points = cloud(4000)
    plan = make_plan(points, 0.05, levels=1, patch=64)
    level = plan.levels[0]
    first = plan.members[plan.counts.cumsum(0) - plan.counts]
    centers = points[first]
    for order in range(len(ORDERS)):
        placed = centers[level.gather_index[order]].view(-1, level.patch_width, 3)
        assert placed.std(dim=1).mean() < 0.5 * centers.std(dim=0).mean()


def patch_of(level: Level, order: int, tokens: int) -> torch.Tensor:
    """The patch of each token."""
    return level.scatter_index[order, :tokens] // level.patch_width


@given(st.integers(30, 400), st.integers(1, 3), st.integers(2, 40), st.integers(0, 5))
@settings(max_examples=40)
def test_tokens_of_a_part_share_a_patch_exactly_where_they_do_in_the_whole(count, levels, patch, seed):
    points = cloud(count, seed)
    part = torch.nonzero(points[:, 0] > 0.7).flatten()
    if not len(part):
        return
    curves = cut_scene_curves(points.numpy(), VOXEL, levels=levels, orders=ORDERS, patch=patch)
    whole = join_plans([plan_cloud(points, VOXEL, levels=levels)], patch)
    plan = join_plans([plan_cloud(points[part], VOXEL, levels=levels, scene_curves=curves)], patch)
    theirs, ours = whole.token_of[part], plan.token_of
    for there, here in zip(whole.levels, plan.levels, strict=True):
        assert here.patch_width <= patch
        for order in range(4):
            a = patch_of(there, order, int(theirs.max()) + 1)[theirs]
            b = patch_of(here, order, int(ours.max()) + 1)[ours]
            # The same pairs, whatever the patches are called.
            pairs = torch.unique(torch.stack((a, b)), dim=1)
            assert len(torch.unique(pairs[0])) == len(torch.unique(pairs[1])) == pairs.shape[1]
        if len(there.parents):
            theirs, ours = there.parents[theirs], here.parents[ours]


def test_clouds_side_by_side_have_the_plans_that_they_have_alone() -> None:
    a, b = cloud(300, 1), cloud(120, 2)
    together = join_plans([plan_cloud(part, VOXEL, levels=3) for part in (a, b)], 32, round_up=False)
    alone = [make_plan(part, VOXEL, levels=3, patch=32) for part in (a, b)]
    check(together, 420)
    assert torch.equal(together.counts, torch.cat([one.counts for one in alone]))
    for level, (first, second) in enumerate(zip(alone[0].levels, alone[1].levels, strict=True)):
        joined, n = together.levels[level], len(first.neighbors)
        total = n + len(second.neighbors)
        assert torch.equal(joined.neighbors[:n], torch.where(first.neighbors == n, total, first.neighbors).int())
        moved = torch.where(second.neighbors == len(second.neighbors), total, second.neighbors + n)
        assert torch.equal(joined.neighbors[n:], moved.int())
        # No patch holds tokens of both.
        for gather in joined.gather_index:
            sides = (gather.view(-1, joined.patch_width) < n).float().mean(dim=1)
            assert ((sides == 0) | (sides == 1)).all()


def test_sizes_are_rounded_up_by_an_eighth_at_most_and_to_few() -> None:
    counts = range(64, 5000)
    rounded = [_round_up_size(count) for count in counts]
    assert all(count <= size <= 1.125 * count for count, size in zip(counts, rounded, strict=True))
    for power in (64, 256, 1024):
        # Sixteenths of the next power of two; none is rounded further.
        octave = {size for count, size in zip(counts, rounded, strict=True) if power <= count < 2 * power}
        assert len(octave) <= 9
        assert {_round_up_size(size) for size in octave} == octave
    assert [_round_up_size(count) for count in (0, 1, 8, 9)] == [0, 8, 8, 16]


@pytest.mark.parametrize("count", [1, 2, 7])
def test_clouds_that_fit_into_one_cell_are_one_token(count: int) -> None:
    plan = make_plan(torch.zeros(count, 3) + 0.01, VOXEL, levels=4, patch=16)
    check(plan, count)
    assert plan.counts.tolist() == [count]
    assert all(len(level.neighbors) == 1 for level in plan.levels)


def test_a_cloud_of_nothing_has_a_plan() -> None:
    plan = make_plan(torch.zeros(0, 3), VOXEL, levels=3, patch=16)
    assert len(plan.counts) == 0
    assert all(len(level.neighbors) == 0 for level in plan.levels)


def test_a_plan_moves_to_a_device_whole() -> None:
    plan = to_device(make_plan(cloud(50), VOXEL, levels=2, patch=16), torch.device("meta"))
    for level in plan.levels:
        assert all(part.device.type == "meta" for part in level if isinstance(part, torch.Tensor))
    assert plan.token_of.device.type == "meta"
