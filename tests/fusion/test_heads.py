"""Adapter heads on disk: written and read, named, copied beside weights, and files that are refused."""

import copy
import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from measured_heads import SPACE, measured

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import copy_heads, heads_beside
from gsencoder.fusion.measured_heads import (
    HeadSet,
    choose_heads,
    find_head,
    has_head,
    heads_digest,
    load_heads,
    save_heads,
)


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


GOOD = {
    "name": "a.summary",
    "text": "",
    "model": "",
    "layers": ["linear"],
    "scale": 1.0,
    "cells": 1,
    "cosine": 1.0,
    "worst": 1.0,
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layers": []}, "expected heads with name, text"),
        ({"name": 3}, "expected heads with name, text"),
        ({"name": "a"}, r"expected a head called NAME\.summary or NAME\.features"),
        ({"text": "dino"}, r"expected a head called NAME\.summary or NAME\.features"),
        ({"scale": 0.0}, "expected heads with name, text"),
        ({"scale": float("inf")}, "expected heads with name, text"),
        ({"cells": "many"}, "expected heads with name, text"),
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


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("siglip", "siglip.summary"),
        ("siglip.summary", "siglip.summary"),
        ("siglip.features", "siglip.features"),
        ("sam", "sam.features"),
    ],
)
def test_a_name_finds_its_head(name: str, expected: str) -> None:
    assert find_head(head_set(), name).name == expected
    assert has_head(head_set(), name)


@pytest.mark.parametrize("name", ["sam.summary", "dino", "siglip.tokens", ""])
def test_a_head_that_is_not_there_is_refused_and_the_others_are_named(name: str) -> None:
    assert not has_head(head_set(), name)
    listed = r"siglip\.summary, sam\.features, siglip\.features"
    with pytest.raises(InputError, match=rf"head={name}: not among the heads at hand: {listed}"):
        find_head(head_set(), name)


def test_heads_are_chosen_in_the_order_of_their_names_each_once() -> None:
    assert choose_heads(head_set(), ["sam", "siglip", "siglip.summary"]).names == ("sam.features", "siglip.summary")


def test_the_file_of_heads_lies_beside_weights_and_graphs_and_is_copied_for_its_space_only(tmp_path: Path) -> None:
    save_heads(tmp_path / "heads.safetensors", head_set())
    assert heads_beside(tmp_path / "encoder.safetensors") == tmp_path / "heads.safetensors"
    assert heads_beside(tmp_path / "e.onnx") is None
    copy_heads(tmp_path / "heads.safetensors", tmp_path / "e.onnx.heads.safetensors", [SPACE])
    assert heads_beside(tmp_path / "e.onnx") == tmp_path / "e.onnx.heads.safetensors"
    assert load_heads(tmp_path / "e.onnx.heads.safetensors").names == head_set().names
    with pytest.raises(InputError, match="heads take features of"):
        copy_heads(tmp_path / "heads.safetensors", tmp_path / "x", [replace(SPACE, channels=7)])
    data = bytearray((tmp_path / "heads.safetensors").read_bytes())
    data[-3] ^= 1
    (tmp_path / "heads.safetensors").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        copy_heads(tmp_path / "heads.safetensors", tmp_path / "x", [SPACE])
    assert not (tmp_path / "x").exists()


def test_earlier_heads_beside_a_graph_stand_until_their_copy_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_heads(tmp_path / "heads.safetensors", head_set())
    target = tmp_path / "e.onnx.heads.safetensors"
    target.write_bytes(b"earlier")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"e\.onnx\.heads\.safetensors: no space left"):
        copy_heads(tmp_path / "heads.safetensors", target, [SPACE])
    assert target.read_bytes() == b"earlier"
