"""Gaussians on an anchor stay near their seeds whatever pulls at them, and keep it through pruning and resuming."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from walls import wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.optimize import RATES, OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import Anchor, RowAdam, State, anchor_at, load_state, parameters_from, save_state

ALL = OptimizeConfig(steps=30, sh_degree=0, shrinks=(2, 1), shares=(0.5, 0.5))
PRUNED = PruneConfig(at=(0.3,))


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RATES, "means", 0.03)


def held(length: float, config: OptimizeConfig = ALL) -> Optimizer:
    adam = RowAdam(parameters_from(seed_from_depth(wall_views(depth=True), voxel=0.06), 0))
    adam.parameters["logit_opacities"][::7] = -9
    anchor = anchor_at(adam.parameters, length) if length else None
    return Optimizer(adam, Photographs(wall_views(depth=True)), [0, 1, 3], config, prune=PRUNED, anchor=anchor)


def strayed(one: Optimizer, anchor: Anchor) -> torch.Tensor:
    return (one.parameters["means"] - anchor.means).norm(dim=1) / anchor.reach


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.parametrize("rate", [1e-3, 1e-2, 10.0])
@pytest.mark.parametrize("reach", [1e-6, 0.3])
@pytest.mark.slow
def test_what_pulls_forever_moves_no_further_than_the_reach(rate: float, reach: float) -> None:
    means = torch.zeros(3, 3)
    adam = RowAdam({"means": means})
    anchor = Anchor(means=torch.zeros(3, 3), reach=torch.full((3,), reach))
    rows = torch.tensor([0, 2])
    grads = {"means": torch.tensor([[1.0, 0, 0], [0, -1e6, 0]])}
    # Four times the steps that a pull takes to come within 1/e of its end.
    for _ in range(int(4 * max(5.0, reach / rate))):
        adam.step(rows, grads, {"means": rate})
        anchor.pull(means, rows, rate)
    assert (means[rows].norm(dim=1) <= 1.001 * reach).all()
    if rate < reach:
        assert means[0, 0] < -0.9 * reach
        assert means[2, 1] > 0.9 * reach
    assert not means[1].any()


def test_only_rows_in_view_are_pulled() -> None:
    anchor = Anchor(means=torch.zeros(3, 3), reach=torch.ones(3))
    means = torch.full((3, 3), 4.0)
    anchor.pull(means, torch.tensor([1]), 0.25)
    assert means[:, 0].tolist() == [4.0, 3.0, 4.0]


@pytest.mark.slow
def test_a_fitted_splat_stays_within_its_anchor_and_strays_without() -> None:
    free, bound = held(0), held(0.3)
    anchor = anchor_at(free.parameters, 0.3)
    kept = replace(PRUNED, at=())
    free.pruning = bound.pruning = kept
    for _ in range(30):
        free.advance()
        bound.advance()
    assert strayed(free, anchor).max() > 3
    # Adam's first steps on a row may be a little longer than the rate, and three coordinates each have their own.
    assert strayed(bound, anchor).max() < 3**0.5
    assert strayed(bound, anchor).max() > 0.1


@pytest.mark.slow
def test_a_anchor_is_pruned_with_its_gaussians_and_taken_up_with_them(tmp_path: Path) -> None:
    whole, cut = held(0.3), held(0.3)
    for _ in range(20):
        whole.advance()
    for _ in range(12):
        cut.advance()
    assert cut.anchor is not None
    assert len(cut.parameters["means"]) == len(cut.anchor.means) < len(held(0.3).parameters["means"])
    assert strayed(cut, cut.anchor).max() < 3**0.5
    exposures = None if cut.exposures is None else cut.exposures.maps
    state = State(adam=cut.adam, anchor=cut.anchor, exposures=exposures, step=12, seconds=0.0, facts={})
    save_state(tmp_path / "state", state, {})
    read_state = load_state(tmp_path / "state", {}, sh_degree=0)
    held_back = {"anchor": read_state.anchor, "exposures": read_state.exposures}
    again = Optimizer(read_state.adam, cut.photographs, cut.training, ALL, prune=PRUNED, step=12, **held_back)
    for _ in range(8):
        again.advance()
    for name, value in whole.parameters.items():
        assert torch.equal(value, again.parameters[name]), name
