"""Adam on rows: against torch's own, and only where it was asked to step."""

import numpy as np
import pytest
import torch

from gsencoder.reconstruct.parameters import BETAS, EPS, RowAdam


def parameters(rows: int = 50) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {"means": torch.randn(rows, 3), "logits": torch.randn(rows), "sh": torch.randn(rows, 4, 3)}


def test_with_all_rows_it_is_adam() -> None:
    ours = RowAdam({name: value.clone() for name, value in parameters().items()})
    theirs = {name: value.clone().requires_grad_() for name, value in parameters().items()}
    rates = {"means": 1e-2, "logits": 1e-1, "sh": 1e-3}
    groups = [{"params": [value], "lr": rates[name]} for name, value in theirs.items()]
    adam = torch.optim.Adam(groups, betas=BETAS, eps=EPS)
    for _ in range(20):
        grads = {name: torch.randn_like(value) for name, value in theirs.items()}
        ours.step(torch.arange(50), grads, rates)
        for name, value in theirs.items():
            value.grad = grads[name].clone()
        adam.step()
    for name, value in theirs.items():
        torch.testing.assert_close(ours.parameters[name], value.detach(), rtol=1e-5, atol=1e-6)


def test_rows_without_a_gradient_stay_as_they_are() -> None:
    adam = RowAdam(parameters())
    before = {name: value.clone() for name, value in adam.parameters.items()}
    rows = torch.tensor([3, 7, 20])
    adam.step(rows, {name: torch.ones_like(value[rows]) for name, value in before.items()}, dict.fromkeys(before, 0.1))
    for name, value in adam.parameters.items():
        changed = (value != before[name]).flatten(1).any(dim=1) if value.ndim > 1 else value != before[name]
        assert changed.nonzero().squeeze(1).tolist() == rows.tolist()
        for moments in (adam.averages, adam.squares):
            assert moments[name].flatten(1).any(dim=1).sum() == 3 if value.ndim > 1 else True


def test_kernel_and_plain_twin_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, plain = RowAdam(parameters()), RowAdam(parameters())
    made = np.random.default_rng(0)
    for _ in range(10):
        rows = torch.from_numpy(np.sort(made.permutation(50)[:20]))
        grads = {name: torch.randn_like(value[rows]) for name, value in fast.parameters.items()}
        rates = dict.fromkeys(grads, 1e-2)
        fast.step(rows, grads, rates)
        with monkeypatch.context() as patched:
            patched.setattr(RowAdam, "_on_cpu", staticmethod(RowAdam._plain))
            plain.step(rows, grads, rates)
    for name, value in fast.parameters.items():
        torch.testing.assert_close(value, plain.parameters[name], rtol=1e-5, atol=1e-6)


def test_kept_rows_keep_their_moments() -> None:
    adam = RowAdam(parameters())
    rows = torch.arange(50)
    adam.step(
        rows,
        {name: torch.randn_like(value) for name, value in adam.parameters.items()},
        dict.fromkeys(adam.parameters, 0.1),
    )
    before = {name: value.clone() for name, value in adam.averages.items()}
    adam.keep(torch.tensor([1, 4]))
    for name, value in adam.averages.items():
        assert len(adam.parameters[name]) == len(value) == 2
        assert torch.equal(value, before[name][[1, 4]])


def test_gradients_of_nothing_and_of_everything_stay_finite() -> None:
    for size in (0.0, 1e-30, 1e18):
        adam = RowAdam({"x": torch.ones(3, 2)})
        for _ in range(5):
            adam.step(torch.arange(3), {"x": torch.full((3, 2), size)}, {"x": 0.1})
        assert torch.isfinite(adam.parameters["x"]).all()
