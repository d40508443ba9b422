"""Exports in cheaper precisions: integer arithmetic held against the same in numpy, and features against float32's."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import helper

from gsencoder.app import main as cli
from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat
from gsencoder.infer.encode import Cloud, EncodeConfig, Encoder, check_cosines
from gsencoder.infer.onnx.export import OPSET, OURS, PRODUCT_LIMIT, export_onnx, in_standard_operators, random_cloud
from gsencoder.infer.onnx.runtime import OnnxNetwork
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.plan import neighbor_table
from gsencoder.models.transformer import convolve_reference

pytestmark = pytest.mark.slow

CLOUD = Cloud("a sheet", random_cloud(3000, 0.05))
ANY = EncodeConfig(chunk=0, device="cpu")


@pytest.fixture(scope="module")
def exact(exported: Path) -> bytes:
    return (exported / "encoder.onnx").read_bytes()


@pytest.fixture(scope="module")
def build(exported: Path, lowered: Any) -> Callable[[Any], bytes]:
    """The export in a precision, each made once."""
    header = TorchNetwork.load(str(exported)).header
    return cache(lambda precision: export_onnx(replace(header, precision=precision), lowered))


@pytest.mark.parametrize(("precision", "least"), [("int8_weights", 0.999), ("int8_dynamic", 0.99)])
def test_a_cheaper_precision_is_smaller_and_close(build, exact, precision, least):
    model = build(precision)
    assert len(model) < 0.65 * len(exact)
    runtime = Encoder(OnnxNetwork(model, device="cpu"))
    assert runtime.network.header.precision == precision
    (cosine,) = check_cosines(model, exact, [CLOUD], cosine=least).values()
    assert cosine < 1 - 1e-9
    full = Encoder(OnnxNetwork(exact, device="cpu"))
    np.testing.assert_allclose(runtime.words.embeddings, full.words.embeddings, atol=0.02)
    for count in (1, 2, 40):
        cloud = random_cloud(count, 0.05)
        features = runtime.encode(cloud, ANY).features
        assert np.abs(features - full.encode(cloud, ANY).features).max() < 0.5
    with pytest.raises(InputError, match=f"the model computes in {precision}, not float32"):
        runtime.encode(CLOUD.gaussians, EncodeConfig(precision="float32"))
    loaded = onnx.load_from_string(model)
    assert {each.domain for each in loaded.opset_import} == {""}
    onnx.checker.check_model(loaded)


def test_weights_in_int8_are_the_rounded_weights_in_torch(build: Callable[[Any], bytes], exported: Path) -> None:
    rounded = TorchNetwork.load(str(exported))
    with torch.no_grad():
        for value in rounded.module.parameters():
            if value.ndim == 1:
                continue
            columns = value.flatten(0, 1) if value.ndim == 3 else value.T
            # Queries, keys and values have scales of their own, as all columns do.
            whole, scale = round_columns(columns.numpy())
            near = torch.from_numpy(whole * scale)
            value.copy_(near.view_as(value) if value.ndim == 3 else near.T)
    ours = Encoder(OnnxNetwork(build("int8_weights"), device="cpu")).encode(CLOUD.gaussians, ANY)
    theirs = Encoder(rounded).encode(CLOUD.gaussians, EncodeConfig(chunk=0, precision="float32", device="cpu"))
    assert np.abs(ours.features - theirs.features).max() < 1e-4 * np.abs(theirs.features).max()


def operator(name: str, values: dict[str, np.ndarray]) -> np.ndarray:
    """One of our operators under onnxruntime."""
    kinds = {each: helper.np_dtype_to_tensor_dtype(value.dtype) for each, value in values.items()}
    inputs = [helper.make_tensor_value_info(each, kinds[each], value.shape) for each, value in values.items()]
    output = helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["rows", "columns"])
    node = helper.make_node(name, list(values), ["y"], domain=OURS.domain)
    graph = helper.make_graph([node], "one", inputs, [output])
    opsets = [helper.make_opsetid("", OPSET), helper.make_opsetid(OURS.domain, OURS.version)]
    model = in_standard_operators(helper.make_model(graph, opset_imports=opsets, ir_version=10))
    session = onnxruntime.InferenceSession(model.SerializeToString())
    (result,) = session.run(None, values)
    return np.asarray(result)


@pytest.mark.parametrize("rows", [1, 1024, 1025])
def test_a_convolution_of_integers_is_that_of_what_they_stand_for(rows: int) -> None:
    rng = np.random.default_rng(rows)
    cells = np.unique(rng.integers(0, 14, (2 * rows, 3)), axis=0)[:rows]
    neighbors = neighbor_table(torch.from_numpy(cells)).numpy()
    x = rng.integers(0, 256, (len(cells), 5)).astype(np.uint8)
    weight = rng.integers(-PRODUCT_LIMIT, PRODUCT_LIMIT + 1, (27 * 5, 7)).astype(np.int8)
    step, zero, scale = np.float32(0.02), np.uint8(113), rng.uniform(0.001, 0.1, 7).astype(np.float32)
    values = {"x": x, "step": np.array(step), "zero": np.array(zero)}
    output = operator("convolve_int8", values | {"n": neighbors, "weight": weight, "scale": scale})
    stands = torch.from_numpy(step.astype(np.float64) * (x.astype(np.float64) - zero))
    matrix = torch.from_numpy((weight * scale.astype(np.float64)).reshape(27, 5, 7))
    expected = convolve_reference(stands, torch.from_numpy(neighbors), matrix).numpy()
    np.testing.assert_allclose(output, expected, rtol=1e-5, atol=1e-4)
    output = operator("convolve", {"x": stands.numpy().astype(np.float32), "n": neighbors, "w": matrix.float().numpy()})
    np.testing.assert_allclose(output, expected, rtol=1e-3, atol=1e-3)


def test_a_linear_layer_of_integers_is_that_of_what_they_stand_for() -> None:
    rng = np.random.default_rng(0)
    x = rng.integers(0, 256, (40, 64)).astype(np.uint8)
    weight = rng.integers(-PRODUCT_LIMIT, PRODUCT_LIMIT + 1, (64, 9)).astype(np.int8)
    scale, bias = rng.uniform(0.001, 0.1, 9).astype(np.float32), rng.normal(size=9).astype(np.float32)
    values = {"x": x, "step": np.array(0.5, np.float32), "zero": np.array(7, np.uint8)}
    values |= {"w": weight, "s": scale, "b": bias}
    expected = 0.5 * (x.astype(float) - 7) @ (weight * scale.astype(float)) + bias
    np.testing.assert_allclose(operator("linear_int8", values), expected, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("most", [1, 63, 127])
def test_rounded_columns_are_within_half_a_step(most: int) -> None:
    rng = np.random.default_rng(0)
    matrix = (rng.normal(size=(50, 6)) * [1, 1e-8, 1e6, 0, 1, 1e-30]).astype(np.float32)
    whole, scale = round_columns(matrix, most)
    assert np.abs(whole).max() == most
    assert (np.abs(whole * scale - matrix) <= 0.5001 * scale).all()
    assert not whole[:, 3].any()
    assert (scale > 0).all()


def test_the_command_judges_what_it_writes(exported, lowered, tmp_path, monkeypatch, capsys):
    save_splat(tmp_path / "room.ply", CLOUD.gaussians)
    out = tmp_path / "small.onnx"
    words = [str(tmp_path / "room.ply"), f"weights={exported}", f"out={out}", "sizes=[1]", "precision=int8_dynamic"]
    monkeypatch.setattr(TorchNetwork, "lower", lambda _: lowered)
    with monkeypatch.context() as stricter:
        check = partial(check_cosines, cosine=0.999999)
        stricter.setattr("gsencoder.app.commands.export.check_cosines", check)
        assert cli.main(["export", *words]) == 2
    assert "on room int8_dynamic gives features whose mean centered cosine" in capsys.readouterr().err
    assert not out.exists()
    assert cli.main(["export", *words]) == 0
    results = json.loads(Path(f"{out}.summary.json").read_text())["results"]
    assert results["precision"] == "int8_dynamic"
    assert results["bytes"] == out.stat().st_size < results["bytes_float32"]
    assert list(results["cosines"]) == ["room"]
    assert results["cosines"]["room"] > 0.99
    assert cli.main(["encode", str(tmp_path / "room.ply"), f"weights={out}", f"out={tmp_path / 'features'}"]) == 0
