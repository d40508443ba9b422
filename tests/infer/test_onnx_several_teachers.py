"""An exported encoder with several teachers: all spaces in one graph, as torch gives them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from feature_fields import plain_features
from symbolic import symbolic_sizes

from gsencoder.core.errors import InputError
from gsencoder.infer import encode as module
from gsencoder.infer.encode import Cloud, EncodeConfig, Encoder, check_cosines, check_parity
from gsencoder.infer.onnx.export import export_onnx, random_cloud
from gsencoder.infer.onnx.runtime import OnnxNetwork
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, save_weights
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.transformer import TransformerConfig
from gsencoder.text.table import load_text_table, save_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians

# One level: the spaces are columns of what follows, and a graph of two takes twice as long to make.
SHAPE = TransformerConfig(
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
def test_an_encoder_with_several_teachers_gives_all_spaces_as_torch_does_and_nearly_in_cheaper_precisions(
    weights: Path, tmp_path: Path
) -> None:
    first = Encoder.load(str(weights)).outputs.select()
    mean = np.arange(3, dtype=np.float32) / 10
    second = OutputSpace(space=FeatureSpace(name="three", channels=3), mean=mean, scale=5.0)
    # A teacher whose vectors are learned as they are.
    third = replace(second, space=FeatureSpace(name="raw", channels=3), centered=False, scaled=False)
    outputs = OutputSpaces(by_teacher={"labels": first, "colors": second, "raw": third})
    torch.manual_seed(1)
    network = GaussianEncoder(EncoderConfig(voxel=0.05, stem=5, transformer=SHAPE), outputs.widths)
    save_weights(tmp_path / "encoder.safetensors", network, outputs, {"steps": 1})
    save_text_table(tmp_path / "words.labels.safetensors", load_text_table(weights / "words.safetensors"))
    encoder = Encoder.load(str(tmp_path))
    header = encoder.network.header
    clouds = [Cloud(f"{count}", random_cloud(count, encoder.voxel, seed=count)) for count in (1, 300, 2000)]
    with symbolic_sizes():
        lowered, half = encoder.network.lower(), encoder.network.lower(half=True)
    model = export_onnx(header, lowered)
    assert max(check_parity(model, encoder, clouds).values()) < 1e-4
    for precision in ("int8_weights", "int8_dynamic"):
        check_cosines(export_onnx(replace(header, precision=precision), lowered), model, clouds[1:], cosine=0.98)
    halved = export_onnx(replace(header, precision="float16"), half)
    assert len(halved) < 0.8 * len(model)
    assert max(check_cosines(halved, model, clouds[1:], cosine=0.99999).values()) < 1 - 1e-9
    with pytest.raises(InputError, match="the model computes in float16, not float32"):
        Encoder(OnnxNetwork(halved, device="cpu")).encode(clouds[1].gaussians, ALONE, space="colors")
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
    wrong = OutputSpaces(by_teacher=outputs.by_teacher | {"colors": replace(second, scale=5.001)})
    encoder.network.header = replace(header, outputs=wrong)
    with pytest.raises(InputError, match="onnxruntime and torch differ"):
        check_parity(model, encoder, clouds[1:])


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
    monkeypatch.setattr(module, "OnnxNetwork", lambda model, device: model)
    monkeypatch.setattr(module, "Encoder", FeaturesOf)
    cloud = Cloud("cloud", random_cloud(50, 0.05, seed=1))
    assert check_cosines(b"", b"", [cloud]) == {"cloud": pytest.approx(1)}
    with pytest.raises(InputError, match="on cloud int8_weights gives features whose mean centered cosine"):
        check_cosines(wrong.encode(), b"", [cloud])
