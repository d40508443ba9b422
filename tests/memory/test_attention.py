"""Gaussian memory attention: torch beside numpy beside the equation in float64, and the ends of the range."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from memory_samples import make_memory
from scipy.special import softmax

from gsencoder.core.errors import InputError
from gsencoder.memory import attention as attention_module
from gsencoder.memory.attention import MemoryAttention
from gsencoder.types import FeatureBasis, FeatureSpace, QueryMemory
from gsencoder.types import features as memory_types
from gsencoder.types.features import Scoring

SCORINGS: list[Scoring] = ["centered", "cosine", "dot"]


def equation(memory: QueryMemory, queries: np.ndarray) -> np.ndarray:
    """Softmax(Q W PSCᵀ) PSC in float64, with the vectors in full."""
    projected, keys = queries.astype(np.float64) @ memory.projection, memory.bank.components.astype(np.float64)
    if memory.scoring == "centered":
        keys = keys - memory.mean
    if memory.scoring != "dot":
        keys = keys / np.linalg.norm(keys, axis=1, keepdims=True)
        projected = projected / np.linalg.norm(projected, axis=1, keepdims=True)
    scores = projected @ keys.T / memory.temperature
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True) @ memory.bank.components)


def module_of(memory: QueryMemory, **values: torch.Tensor) -> MemoryAttention:
    settings = {"mean": memory.mean, "scoring": memory.scoring, "temperature": memory.temperature}
    return MemoryAttention(memory.bank, torch.from_numpy(memory.projection), **settings, **values)


@pytest.mark.parametrize("scoring", SCORINGS)
def test_torch_and_numpy_give_what_the_equation_gives(scoring: Scoring) -> None:
    memory = make_memory(scoring)
    expected = equation(memory, memory.queries[memory.weights > 0])
    queries = memory.queries[memory.weights > 0]
    np.testing.assert_allclose(memory.attend(queries), expected, rtol=2e-4, atol=2e-5)
    np.testing.assert_allclose(memory.attention(queries).sum(axis=1), 1, rtol=1e-6)
    module = module_of(memory)
    np.testing.assert_allclose(module(torch.from_numpy(queries)).detach().numpy(), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("scoring", SCORINGS)
def test_gradients_are_those_of_the_equation(scoring: Scoring) -> None:
    memory = make_memory(scoring, components=20, gaussians=9)
    module = module_of(memory).double()
    queries = torch.from_numpy(memory.queries[1:6]).double().requires_grad_()

    def plain(queries: torch.Tensor, projection: torch.Tensor) -> torch.Tensor:
        projected, keys = queries @ projection, torch.from_numpy(memory.bank.components).double()
        values = keys
        if scoring == "centered":
            keys = keys - torch.from_numpy(memory.mean)
        if scoring != "dot":
            keys, projected = (torch.nn.functional.normalize(each, dim=1) for each in (keys, projected))
        return torch.softmax(projected @ keys.T / memory.temperature, dim=1) @ values

    weight = torch.from_numpy(np.random.default_rng(0).normal(size=(5, 24)))
    ours = torch.autograd.grad((module(queries) * weight).sum(), [queries, module.projection])
    expected = torch.autograd.grad((plain(queries, module.projection) * weight).sum(), [queries, module.projection])
    for one, other in zip(ours, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_blocks_of_queries_give_what_all_at_once_give(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = make_memory()
    # In double precision, where the order of sums over blocks does not matter.
    module, queries = module_of(memory).double(), torch.from_numpy(memory.queries).double()
    whole, whole_numpy = module(queries).detach(), memory.attend(memory.queries)
    leaf = queries.clone().requires_grad_()
    expected = torch.autograd.grad(module(leaf).square().sum(), [leaf, module.projection])
    monkeypatch.setattr(attention_module, "BLOCK_SCORES", 70 * 13)
    monkeypatch.setattr(memory_types, "BLOCK_SCORES", 70 * 13)
    with torch.no_grad():
        torch.testing.assert_close(module(queries), whole)
        sizes, attend = list[int](), module._attend
        monkeypatch.setattr(module, "_attend", lambda part: sizes.append(len(part)) or attend(part))
        module(queries)
        assert sum(sizes) == len(queries) > max(sizes) == 13
        # One query at a time where a block is smaller than the bank.
        monkeypatch.setattr(attention_module, "BLOCK_SCORES", 9)
        sizes.clear()
        module(queries)
        assert sizes == [1] * len(queries)
        monkeypatch.setattr(attention_module, "BLOCK_SCORES", 70 * 13)
    queries.requires_grad_()
    (in_blocks := module(queries)).square().sum().backward()
    torch.testing.assert_close(in_blocks.detach(), whole)
    torch.testing.assert_close(queries.grad, expected[0])
    torch.testing.assert_close(module.projection.grad, expected[1])
    np.testing.assert_allclose(memory.attend(memory.queries), whole_numpy, rtol=1e-6, atol=1e-7)
    assert memory.attend(memory.queries[:0]).shape == (0, 24)


@pytest.mark.parametrize("scoring", SCORINGS)
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e15])
def test_queries_of_any_length_give_finite_features_and_gradients(scoring: Scoring, length: float) -> None:
    memory = make_memory(scoring)
    module = module_of(memory)
    queries = (torch.from_numpy(memory.queries[1:50]) * length).requires_grad_()
    features = module(queries)
    features.square().sum().backward()
    for values in (features, queries.grad, module.projection.grad):
        assert torch.isfinite(values).all()
    assert np.isfinite(memory.attend(queries.detach().numpy())).all()


@pytest.mark.parametrize("scoring", ["centered", "cosine"])
def test_the_length_of_a_query_does_not_matter_with_cosines(scoring: Scoring) -> None:
    memory = make_memory(scoring)
    queries = memory.queries[1:7]
    for length in (1e-3, 7.0, 1e8, 1e25):
        np.testing.assert_allclose(memory.attend(queries * np.float32(length)), memory.attend(queries), rtol=1e-4)


@pytest.mark.parametrize("size", [1e-8, 1e6])
def test_components_of_any_size_are_told_apart(size: float) -> None:
    memory = make_memory("cosine")
    bank = replace(memory.bank, components=(memory.bank.components * size).astype(np.float32))
    scaled = replace(memory, bank=bank)
    queries = memory.queries[1:7]
    np.testing.assert_allclose(scaled.attend(queries), size * memory.attend(queries), rtol=1e-4)
    assert np.isfinite(module_of(scaled)(torch.from_numpy(queries)).detach().numpy()).all()


@pytest.mark.parametrize("scoring", SCORINGS)
def test_a_component_without_a_direction_takes_part_with_a_score_of_zero(scoring: Scoring) -> None:
    memory = make_memory(scoring)
    components = memory.bank.components.copy()
    components[3] = memory.bank.mean
    memory = replace(memory, bank=replace(memory.bank, components=components))
    queries = memory.queries[1:7]
    projected = queries.astype(np.float64) @ memory.projection
    keys = components.astype(np.float64) - memory.bank.mean
    if scoring != "dot":
        keys /= np.maximum(np.linalg.norm(keys, axis=1, keepdims=True), 1e-9)
        projected /= np.linalg.norm(projected, axis=1, keepdims=True)
    expected = softmax(projected @ keys.T / memory.temperature, axis=1)
    np.testing.assert_allclose(memory.attention(queries), expected, rtol=1e-3, atol=1e-5)
    features = module_of(memory)(torch.from_numpy(queries)).detach().numpy()
    np.testing.assert_allclose(features, expected @ components, rtol=1e-3, atol=1e-4)


def test_other_values_than_the_components_are_averaged_with_the_same_weights() -> None:
    memory = make_memory()
    values = np.random.default_rng(1).normal(size=(70, 5)).astype(np.float32)
    queries = memory.queries[1:7]
    expected = memory.attention(queries) @ values
    np.testing.assert_allclose(memory.attend(queries, values), expected, rtol=1e-4, atol=1e-5)
    module = module_of(memory, values=torch.from_numpy(values))
    np.testing.assert_allclose(module(torch.from_numpy(queries)).detach().numpy(), expected, rtol=1e-3, atol=1e-4)
    # Keys and values come from the bank: a checkpoint holds what is trained.
    assert list(module.state_dict()) == ["projection"]


def test_a_bank_that_was_made_without_centering_is_compared_about_the_mean_of_the_space() -> None:
    memory = make_memory("centered")
    raw = replace(memory, bank=replace(memory.bank, mean=np.zeros_like(memory.bank.mean)))
    seen = raw.queries[raw.weights > 0]
    attended = module_of(raw)(torch.from_numpy(seen)).detach().numpy()
    np.testing.assert_allclose(attended, raw.attend(seen), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(attended, memory.attend(seen), rtol=1e-3, atol=1e-4)


def test_features_of_gaussians_are_those_of_their_queries_in_channels_and_in_a_basis() -> None:
    memory = make_memory()
    features = memory.features()
    np.testing.assert_array_equal(features.features[memory.weights == 0], 0)
    np.testing.assert_array_equal(features.weights, memory.weights)
    seen = memory.weights > 0
    expected = equation(memory, memory.queries[seen])
    np.testing.assert_allclose(features.decode(seen), expected, rtol=2e-4, atol=2e-5)
    components = np.linalg.qr(np.random.default_rng(0).normal(size=(24, 24)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=memory.mean, components=components, energy_kept=1.0, space=memory.space)
    np.testing.assert_allclose(replace(memory, basis=basis).features().decode(seen), expected, rtol=1e-3, atol=1e-4)


def test_a_memory_whose_parts_do_not_fit_is_refused(no_jaxtyping: None) -> None:
    memory = make_memory()
    other = FeatureSpace(name="other", channels=24)
    basis = FeatureBasis(mean=memory.mean, components=np.eye(24, dtype=np.float32), energy_kept=1.0, space=other)
    for changes in (
        {"queries": memory.queries[:, :4]},
        {"queries": np.where(memory.queries > 2, np.nan, memory.queries)},
        {"weights": memory.weights[:-1]},
        {"weights": -memory.weights},
        {"projection": memory.projection[:, :-1]},
        {"temperature": 0.0},
        {"temperature": float("nan")},
        {"basis": basis},
    ):
        with pytest.raises(InputError, match=r"QueryMemory\."):
            replace(memory, **changes)
    changed: list[dict[str, Any]] = [
        {"components": memory.bank.components[:0], "sources": memory.bank.sources[:0]},
        {"components": memory.bank.components * np.float32(np.inf)},
        {"sources": memory.bank.sources[:-1]},
        {"grid_from_image": memory.bank.grid_from_image[:-1]},
        {"grid_from_image": -memory.bank.grid_from_image},
        {"grid_from_image": memory.bank.grid_from_image[:, :, [1, 0, 2]]},
        {"grid_from_image": memory.bank.grid_from_image * np.nan},
        *({"threshold": value} for value in (0.0, 1.1)),
        *({"coverage": value} for value in (-0.1, 1.1, np.nan)),
        *({"cosine": value} for value in (-1.1, 1.1, np.nan)),
        {"space": FeatureSpace(name="s", channels=23)},
    ]
    for changes in changed:
        with pytest.raises(InputError, match=r"MemoryBank\."):
            replace(memory.bank, **changes)
    # The ends of the ranges are allowed.
    replace(memory.bank, coverage=0.0, cosine=-1.0)
    replace(memory.bank, coverage=1.0, cosine=1.0, threshold=1.0)
