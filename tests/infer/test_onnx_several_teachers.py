"""An exported encoder with several teachers: all spaces in one graph, as torch gives them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from feature_fields import plain_features
from symbolic import symbolic_sizes

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import field_error
from gsencoder.infer import encode
from gsencoder.infer.encode import Cloud, EncodeConfig, Encoder, check_cosines, check_parity
from gsencoder.infer.onnx.export import export_onnx, random_cloud
from gsencoder.infer.onnx.runtime import OnnxNetwork
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpaces
from gsencoder.models.transformer import TransformerConfig
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians

# One level: a graph of two takes twice as long to make.
SHALLOW = TransformerConfig(
    encoder_depths=(1,),
    encoder_channels=(16,),
    decoder_depths=(),
    decoder_channels=(),
    head_channels=8,
    patch=24,
    orders=("hilbert",),
)
ALONE = EncodeConfig(chunk=0, precision="float32", device="cpu")


@pytest.mark.slow
def test_an_encoder_with_several_teachers_gives_all_spaces_as_torch_does_and_nearly_in_integers(
    several: Path, lowered_several: Any
) -> None:
    encoder = Encoder.load(str(several))
    header = encoder.network.header
    clouds = [Cloud(f"{count}", random_cloud(count, encoder.voxel, seed=count)) for count in (1, 300, 2000)]
    model = export_onnx(header, lowered_several)
    assert max(check_parity(model, encoder, clouds).values()) < 1e-4
    for precision in ("int8_weights", "int8_dynamic"):
        cheaper = export_onnx(replace(header, precision=precision), lowered_several)
        check_cosines(cheaper, model, clouds[1:], cosine=0.98)
    runtime = Encoder(OnnxNetwork(model, device="cpu"))
    assert set(runtime.spaces) == {"labels", "colors", "raw"}
    assert set(runtime.tables) == {"labels"}
    cloud = clouds[1].gaussians
    together = runtime.encode_spaces(cloud, ALONE)
    for name, features in together.items():
        np.testing.assert_array_equal(runtime.encode(cloud, ALONE, space=name).features, features.features)
    with pytest.raises(InputError, match="there are features of labels, colors, raw; name one of them"):
        runtime.encode(cloud, ALONE)
    # A wrong block of columns in the graph is not hidden by the larger numbers of another space.
    spaces = header.outputs.by_teacher
    wrong = OutputSpaces(by_teacher=spaces | {"colors": replace(spaces["colors"], scale=5.001)})
    encoder.network.header = replace(header, outputs=wrong)
    with pytest.raises(InputError, match="onnxruntime and torch differ"):
        check_parity(model, encoder, clouds[1:])


@pytest.mark.slow
def test_a_graph_in_float16_gives_nearly_what_torch_gives_in_float32(several: Path) -> None:
    outputs = Encoder.load(str(several)).outputs
    torch.manual_seed(1)
    config = EncoderConfig(voxel=0.05, coarser=(2.0,), inputs=("offset", "color", "cell"), transformer=SHALLOW)
    module = GaussianEncoder(config, outputs.widths)
    encoder = Encoder(TorchNetwork(module, outputs))
    with symbolic_sizes():
        graph = encoder.network.lower(half=True)
    types = {each.name: each.data_type for each in graph.graph.initializer if each.name.startswith("encoder.")}
    assert set(types.values()) == {onnx.TensorProto.FLOAT16}
    runtime = Encoder(
        OnnxNetwork(export_onnx(replace(encoder.network.header, precision="float16"), graph), device="cpu")
    )
    for count in (300, 2000):
        cloud = random_cloud(count, encoder.voxel, seed=count)
        ours, theirs = runtime.encode_spaces(cloud), encoder.encode_spaces(cloud, ALONE)
        cosines = [1 - field_error(ours[name], theirs[name]).centered for name in outputs]
        assert 0.99999 <= min(cosines) < 1 - 1e-9
    with pytest.raises(InputError, match="the model computes in float16, not float32"):
        runtime.encode(cloud, ALONE, space="colors")


class FeaturesOf:
    """Stands in for a runtime: features of two spaces, of which one may be others than in float32."""

    network = SimpleNamespace(header=SimpleNamespace(precision="int8_weights"))

    def __init__(self, model: bytes) -> None:
        self.wrong = model.decode()

    def encode_spaces(self, gaussians: Gaussians, *_: object, **__: object) -> dict[str, GaussianFeatures]:
        rows = np.random.default_rng(0).normal(size=(2, len(gaussians), 3)).astype(np.float32)
        spaces = {name: FeatureSpace(name=name, channels=3) for name in ("first", "second")}
        return {name: plain_features(rows[int(name == self.wrong)], space) for name, space in spaces.items()}


@pytest.mark.parametrize("wrong", ["first", "second"])
def test_a_cheaper_precision_is_refused_if_any_space_is_too_far_from_float32(wrong, monkeypatch):
    monkeypatch.setattr(encode, "OnnxNetwork", lambda model, device: model)
    monkeypatch.setattr(encode, "Encoder", FeaturesOf)
    cloud = Cloud("cloud", random_cloud(50, 0.05, seed=1))
    assert check_cosines(b"", b"", [cloud]) == {"cloud": pytest.approx(1)}
    with pytest.raises(InputError, match="on cloud int8_weights gives features whose mean centered cosine"):
        check_cosines(wrong.encode(), b"", [cloud])
