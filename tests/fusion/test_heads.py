"""Adapter heads: measured, applied to features and tokens, written and read, and files that are refused."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import CellSample
from gsencoder.fusion.measured_heads import (
    HeadSet,
    MeasuredHead,
    choose_heads,
    find_head,
    has_head,
    head_features,
    head_space,
    head_tokens,
    heads_digest,
    load_heads,
    measure_heads,
    save_heads,
)
from gsencoder.models.output_space import copy_heads, find_heads
from gsencoder.teachers.base import Head, Residual
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures

SPACE = FeatureSpace(name="radio", channels=6, teacher="radio", weights="abcd", preprocessing="resized")


def body(channels: int = 4) -> nn.Sequential:
    torch.manual_seed(channels)
    block = Residual(nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 8))
    layers = nn.Sequential(nn.Linear(6, 8), block, nn.LayerNorm(8), nn.ReLU(), nn.Linear(8, channels))
    for parameter in layers.parameters():
        nn.init.normal_(parameter)
    return layers


def measured(name: str = "siglip.summary", channels: int = 4, text: str = "siglip") -> MeasuredHead:
    mean = np.arange(channels, dtype=np.float32)
    head = Head(name=name, body=body(channels), text=text, model="M")
    return MeasuredHead(head=head, mean=mean, scale=2.0, cells=3, cosine=0.5, worst=0.25)


def head_set() -> HeadSet:
    return HeadSet(space=SPACE, heads=(measured(), measured("sam.features", 5, ""), measured("siglip.features", 3)))


def test_heads_that_are_read_are_those_that_were_written(tmp_path: Path) -> None:
    heads = head_set()
    save_heads(tmp_path / "h", heads)
    read = load_heads(tmp_path / "h")
    assert read.space == SPACE
    assert read.names == ("siglip.summary", "sam.features", "siglip.features")
    x = torch.randn(7, 6)
    for one, other in zip(heads.heads, read.heads, strict=True):
        torch.testing.assert_close(one.head.body(x), other.head.body(x))
        assert (one.head.text, one.head.model, one.figures()) == (other.head.text, other.head.model, other.figures())
        np.testing.assert_array_equal(one.mean, other.mean)
    assert heads_digest(read) == heads_digest(heads)
    moved = replace(heads, heads=(replace(heads.heads[0], scale=3.0), *heads.heads[1:]))
    assert heads_digest(moved) != heads_digest(heads)
    of_other_mean = replace(heads.heads[0], mean=heads.heads[0].mean + 1)
    assert heads_digest(replace(heads, heads=(of_other_mean, *heads.heads[1:]))) != heads_digest(heads)
    body = copy.deepcopy(heads.heads[0].head.body)
    with torch.no_grad():
        next(body.parameters()).add_(1)
    of_other_weights = replace(heads.heads[0], head=replace(heads.heads[0].head, body=body))
    assert heads_digest(replace(heads, heads=(of_other_weights, *heads.heads[1:]))) != heads_digest(heads)
    assert heads_digest(replace(heads, space=replace(SPACE, weights="other"))) != heads_digest(heads)


GOOD = {"name": "a.summary", "text": "", "model": "", "layers": ["linear"], "cells": 1}
GOOD |= dict.fromkeys(("scale", "cosine", "worst"), 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layers": []}, "expected heads with name, text"),
        ({"name": "a"}, r"expected a head called NAME\.summary or NAME\.features"),
        ({"scale": float("inf")}, "expected heads with name, text"),
        ({"layers": ["tanh"]}, r"a\.summary\.0: expected linear, layernorm"),
        ({"layers": [["linear"]]}, r"a\.summary\.0\.0\.weight"),
        ({}, r"expected a\.summary\.0\.weight float32\[.*6\], got float32\[4, 9\]"),
    ],
)
def test_a_file_that_holds_no_heads_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    arrays = {"a.summary.0.weight": np.zeros((4, 9), np.float32), "a.summary.0.bias": np.zeros(4, np.float32)}
    space = {name: getattr(SPACE, name) for name in SPACE.__dataclass_fields__}
    write_archive(tmp_path / "h", arrays, {"space": space, "heads": [{**GOOD, **change}]})
    with pytest.raises(InputError, match=message) as error:
        load_heads(tmp_path / "h")
    assert str(error.value).startswith(str(tmp_path / "h"))


def test_a_file_that_names_no_space_or_a_head_twice_is_refused(tmp_path: Path) -> None:
    write_archive(tmp_path / "h", {"x": np.zeros(1, np.float32)}, {"heads": [], "space": {"name": "s"}})
    with pytest.raises(InputError, match="expected a feature space with name, channels"):
        load_heads(tmp_path / "h")
    save_heads(tmp_path / "h", HeadSet(space=SPACE, heads=(measured(), measured())))
    with pytest.raises(InputError, match="expected heads of different names"):
        load_heads(tmp_path / "h")


@pytest.mark.parametrize("name", ["sam.summary", "dino", ""])
def test_a_head_that_is_not_there_is_refused_and_the_others_are_named(name: str) -> None:
    assert not has_head(head_set(), name)
    listed = r"siglip\.summary, sam\.features, siglip\.features"
    with pytest.raises(InputError, match=rf"head={name}: not among the heads at hand: {listed}"):
        find_head(head_set(), name)


def test_heads_are_chosen_in_the_order_of_their_names_each_once() -> None:
    assert find_head(head_set(), "siglip.features").name == "siglip.features"
    assert has_head(head_set(), "siglip")
    assert choose_heads(head_set(), ["sam", "siglip", "siglip.summary"]).names == ("sam.features", "siglip.summary")


def test_the_file_of_heads_lies_beside_weights_and_graphs_and_is_copied_for_its_space_only(tmp_path: Path) -> None:
    save_heads(tmp_path / "heads.safetensors", head_set())
    assert find_heads(tmp_path / "encoder.safetensors") == tmp_path / "heads.safetensors"
    assert find_heads(tmp_path / "e.onnx") is None
    copy_heads(tmp_path / "heads.safetensors", tmp_path / "e.onnx.heads.safetensors", [SPACE])
    assert find_heads(tmp_path / "e.onnx") == tmp_path / "e.onnx.heads.safetensors"
    assert load_heads(tmp_path / "e.onnx.heads.safetensors").names == head_set().names
    with pytest.raises(InputError, match="heads take features of"):
        copy_heads(tmp_path / "heads.safetensors", tmp_path / "x", [replace(SPACE, channels=7)])
    data = bytearray((tmp_path / "heads.safetensors").read_bytes())
    data[-3] ^= 1
    (tmp_path / "heads.safetensors").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        copy_heads(tmp_path / "heads.safetensors", tmp_path / "x", [SPACE])
    assert not (tmp_path / "x").exists()


def feature_map(values: np.ndarray) -> FeatureMap:
    return FeatureMap(features=values, grid_from_image=np.array([[1.0, 0, 0], [0, 1.0, 0]]), space=SPACE)


def test_a_sample_holds_evenly_spaced_cells_that_have_a_vector() -> None:
    values = np.arange(10 * 10 * 6, dtype=np.float32).reshape(10, 10, 6)
    values[0, 0] = np.nan
    sample = CellSample(maps=2, limit=20)
    sample.add(feature_map(values))
    np.testing.assert_array_equal(sample.vectors(), values.reshape(-1, 6)[1::10])
    with pytest.raises(InputError, match="no view has a cell with a vector"):
        CellSample(0).vectors()
    empty = CellSample(1)
    for _ in range(2):
        with pytest.raises(InputError, match="no view has a cell with a vector"):
            empty.vectors()
        empty.add(feature_map(np.full((2, 2, 6), np.nan, np.float32)))


def a_basis(rank: int) -> FeatureBasis:
    rng = np.random.default_rng(0)
    components = np.linalg.qr(rng.normal(size=(6, 6)))[0][:rank].astype(np.float32)
    return FeatureBasis(mean=rng.normal(size=6).astype(np.float32), components=components, energy_kept=0.9, space=SPACE)


@pytest.mark.parametrize("rank", [0, 3, 6])
def test_mean_scale_and_what_a_basis_costs_equal_those_computed_by_hand(rank: int) -> None:
    vectors = np.random.default_rng(1).normal(size=(200, 6)).astype(np.float32)
    head, basis = measured().head, a_basis(rank) if rank else None
    (one,) = measure_heads([head], vectors, SPACE, basis).heads
    full = head.body(torch.from_numpy(vectors)).detach().double().numpy()
    mean = full.mean(axis=0)
    np.testing.assert_allclose(one.mean, mean, atol=1e-5)
    assert one.scale == pytest.approx(np.sqrt(((full - mean) ** 2).sum(axis=1).mean()), rel=1e-5)
    projected = vectors
    if basis is not None:
        projected = ((vectors - basis.mean) @ basis.components.T) @ basis.components + basis.mean
    outputs_of_basis = head.body(torch.from_numpy(projected)).detach().double().numpy()
    lengths = np.linalg.norm(full - mean, axis=1) * np.linalg.norm(outputs_of_basis - mean, axis=1)
    cosines = ((full - mean) * (outputs_of_basis - mean)).sum(axis=1) / lengths
    assert one.cosine == pytest.approx(cosines.mean(), abs=1e-5)
    assert one.worst == pytest.approx(np.quantile(cosines, 0.05), abs=1e-5)
    assert (one.cosine > 0.9999) == (rank != 3)


def test_outputs_that_are_all_equal_or_not_finite_are_refused() -> None:
    vectors = np.random.default_rng(1).normal(size=(20, 6)).astype(np.float32)
    constant = nn.Sequential(nn.Linear(6, 4))
    nn.init.zeros_(constant[0].weight)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"heads: a\.summary gives the same vector for all 20 cells"):
        measure_heads([Head(name="a.summary", body=constant)], vectors, SPACE, None)
    nn.init.constant_(constant[0].weight, 1e38)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"heads: outputs of a\.summary are not finite"):
        measure_heads([Head(name="a.summary", body=constant)], vectors * 100, SPACE, None)


def fields(n: int = 300, rank: int = 3) -> GaussianFeatures:
    """Features of which many rows are equal, and some were never seen."""
    rng = np.random.default_rng(2)
    distinct = rng.normal(size=(11, rank or 6)).astype(np.float32)
    values, weights = distinct[rng.integers(0, 11, n)], rng.uniform(0.1, 1, n).astype(np.float32)
    values[::7], weights[::7] = 0, 0
    basis = a_basis(rank) if rank else None
    mean = basis.mean if basis is not None else np.ones(6, np.float32)
    return GaussianFeatures(features=values, weights=weights, mean=mean, space=SPACE, basis=basis)


@pytest.mark.parametrize("rank", [0, 3])
def test_features_through_a_head_are_its_outputs_for_the_decoded_vectors(rank: int) -> None:
    features, head = fields(rank=rank), measured()
    made = head_features(features, head, SPACE, text_encoder="tower")
    with torch.no_grad():
        expected = head.head.body(torch.from_numpy(features.decode())).numpy()
    seen = features.seen
    np.testing.assert_allclose(made.features[seen], expected[seen], rtol=1e-5, atol=1e-5)
    assert not made.features[~seen].any()
    np.testing.assert_array_equal(made.weights, features.weights)
    np.testing.assert_array_equal(made.mean, head.mean)
    names = {"name": "radio/siglip.summary", "layer": "siglip.summary", "text_encoder": "tower"}
    assert made.space == replace(SPACE, channels=4, **names)


def test_tokens_go_through_a_head_one_by_one() -> None:
    tokens, head = torch.randn(2, 5, 6), measured()
    made = head_tokens(tokens, head)
    for view, rows in enumerate(made):
        torch.testing.assert_close(rows, head.head.body(tokens[view]).detach(), rtol=1e-4, atol=1e-4)
    assert head_space(SPACE, head).text_encoder == ""
