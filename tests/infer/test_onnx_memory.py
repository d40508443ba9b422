"""A memory's attention as an ONNX graph gives what numpy gives, for any number of queries."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from memory_samples import make_memory
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import save_memories
from gsencoder.memory import attention as module
from gsencoder.memory.attention import export_memory
from gsencoder.types import FeatureSpace, Scene


@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
def test_the_graph_gives_the_features_of_queries(scoring: str) -> None:
    memory = make_memory(scoring)  # type: ignore[arg-type]
    graph = export_memory(memory)
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    for count in (1, 2, 7, 200):
        queries = memory.queries[1 : 1 + count]
        (features,) = session.run(["features"], {"queries": queries})
        np.testing.assert_allclose(features, memory.attend(queries), rtol=1e-3, atol=1e-4)
    zero = np.zeros((3, memory.channels), np.float32)
    (features,) = session.run(["features"], {"queries": zero})
    np.testing.assert_allclose(features, memory.attend(zero), rtol=1e-3, atol=1e-4)
    (entry,) = [each.value for each in onnx.load_from_string(graph).metadata_props if each.key == "gsencoder"]
    about = json.loads(entry)
    assert about["space"]["name"] == "s"
    assert (about["kind"], about["channels"], about["threshold"]) == ("memory", 6, 0.9)
    assert (about["coverage"], about["cosine"]) == (1.0, 0.95)
    assert {each.domain for each in onnx.load_from_string(graph).opset_import} == {""}


def test_a_graph_that_differs_is_refused_also_where_no_gaussian_has_a_query(monkeypatch):
    memory, made, export = make_memory(), [], torch.onnx.export
    unseen = replace(memory, queries=np.zeros_like(memory.queries), weights=np.zeros_like(memory.weights))

    def once(*words: Any, **settings: Any) -> Any:
        """Both have the same graph, which takes a second to make."""
        if not made:
            made.append(export(*words, **settings))
        return made[0]

    monkeypatch.setattr(torch.onnx, "export", once)
    monkeypatch.setattr(module, "TOLERANCE", 0.0)
    for each in (memory, unseen):
        with pytest.raises(InputError, match="the graph differs from numpy by"):
            export_memory(each)


def test_the_command_writes_the_memory_of_one_space(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = make_memory()
    other = replace(one, bank=replace(one.bank, space=FeatureSpace(name="t", channels=24)))
    scene = Scene(name="room", gaussians=random_gaussians(200))
    save_memories(tmp_path / "memory", scene, {"first": one, "second": other})
    words = ["export", f"memory={tmp_path / 'memory'}"]
    assert cli.main([*words, f"out={tmp_path / 'm.onnx'}"]) == 2
    assert "space: there are features of first, second; name one of them" in capsys.readouterr().err
    assert cli.main([*words, "space=second", f"out={tmp_path / 'm.onnx'}"]) == 0
    assert "features of 24 channels from queries of 6" in capsys.readouterr().out
    session = onnxruntime.InferenceSession(str(tmp_path / "m.onnx"), providers=["CPUExecutionProvider"])
    (features,) = session.run(None, {"queries": one.queries[:5]})
    np.testing.assert_allclose(features, one.attend(one.queries[:5]), rtol=1e-2, atol=1e-2)
    assert cli.main([*words, "weights=rooms", f"out={tmp_path / 'n.onnx'}"]) == 2
    assert "memory, weights: expected one of the two" in capsys.readouterr().err
    assert not (tmp_path / "n.onnx").exists()
