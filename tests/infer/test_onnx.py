"""The exported encoder against the one that it was made from, and files that are no such encoder."""

import base64
import json
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from rooms import merged

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.encode import TOLERANCE, Cloud, EncodeConfig, Encoder, check_parity
from gsencoder.infer.onnx.export import random_cloud, search
from gsencoder.infer.onnx.runtime import (
    KEY,
    SUM,
    EncoderHeader,
    OnnxNetwork,
    from_metadata,
    inputs_of,
    to_metadata,
    with_sum,
)
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.types import Gaussians

pytestmark = pytest.mark.slow

WORDS = ("mug", "plant", "chair")
ALONE = EncodeConfig(chunk=0, precision="float32", device="cpu")


@pytest.fixture(scope="module")
def both(exported: Path) -> tuple[Encoder, Encoder]:
    return Encoder.load(str(exported)), Encoder.load(str(exported / "encoder.onnx"), "cpu")


def apart(one: Encoder, other: Encoder, cloud: Gaussians, config: EncodeConfig = ALONE, unit: float = 1.0) -> float:
    """The largest difference, as a share of the largest feature."""
    ours, theirs = (each.encode(cloud, config, metres_per_unit=unit).features for each in (one, other))
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def moved(cloud: Gaussians, means: np.ndarray) -> Gaussians:
    return replace(cloud, means=np.array(np.broadcast_to(means, (len(cloud), 3)), np.float32))


@pytest.mark.parametrize("count", [1, 2, 25, 1000])
def test_the_exported_encoder_gives_what_torch_gives(both: tuple[Encoder, Encoder], count: int) -> None:
    cloud = random_cloud(count, 0.05, seed=count)
    assert apart(*both, cloud) < TOLERANCE
    assert apart(*both, cloud, unit=0.3048) < TOLERANCE
    assert apart(*both, moved(cloud, np.array([7.0, -3.0, 0.1]))) < TOLERANCE
    within = np.random.default_rng(0).uniform(0.05, 0.0999, (count, 3))
    assert apart(*both, moved(cloud, within)) < TOLERANCE


@pytest.mark.parametrize("far", [1e-30, 1e3])
def test_clouds_of_all_extents_agree(both: tuple[Encoder, Encoder], far: float) -> None:
    cloud = random_cloud(500, 0.05)
    assert apart(*both, moved(cloud, cloud.means * np.float32(far))) < TOLERANCE


def test_borders_of_cells_are_where_torch_has_them(both: tuple[Encoder, Encoder]) -> None:
    cloud = random_cloud(3000, 0.05)
    on_borders = np.round(cloud.means / 0.05).astype(np.float32) * np.float32(0.05)
    assert apart(*both, moved(cloud, on_borders)) < TOLERANCE
    assert apart(*both, moved(cloud, on_borders / np.float32(0.3048)), unit=0.3048) < TOLERANCE


def test_parts_are_cut_as_torch_cuts_them(both: tuple[Encoder, Encoder]) -> None:
    cloud = random_cloud(1500, 0.05)
    config = EncodeConfig(chunk=200, halo=0.2, precision="float32", device="cpu")
    ours, parts = (each.encode(cloud, config).features for each in both)
    assert np.abs(ours - parts).max() / np.abs(parts).max() < TOLERANCE
    assert not np.array_equal(both[1].encode(cloud, ALONE).features, parts)


@pytest.mark.parametrize("chunk", [0, 900])
def test_rooms_that_are_far_apart_have_the_bits_that_each_has_alone(both: tuple[Encoder, Encoder], chunk: int) -> None:
    near, far = random_cloud(1500, 0.05), random_cloud(1200, 0.05, seed=1)
    far = moved(far, far.means + np.float32([100, 0, 0]))
    rooms = merged(near, far)
    config = EncodeConfig(chunk=chunk, halo=0.2, precision="float32", device="cpu")
    for encoder in both:
        alone = [encoder.encode(room, config).features for room in (near, far)]
        np.testing.assert_array_equal(encoder.encode(rooms, config).features, np.concatenate(alone))


def test_a_rerun_gives_the_same_bits_on_any_number_of_threads(exported: Path) -> None:
    cloud = random_cloud(4000, 0.05)
    networks = [OnnxNetwork(exported / "encoder.onnx", threads=threads) for threads in (1, 2)]
    one, two, again = (Encoder(network).encode(cloud, ALONE).features for network in (*networks, networks[1]))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(two, again)


def test_the_graph_alone_takes_five_arrays_of_a_splat_in_metres(exported: Path, both: tuple[Encoder, Encoder]) -> None:
    cloud = random_cloud(100, 0.05)
    session = onnxruntime.InferenceSession(exported / "encoder.onnx")
    names = [each.name for each in session.get_inputs()]
    assert names == ["means", "quats", "scales", "opacities", "sh_dc"]
    (features,) = session.run(None, inputs_of(cloud))
    np.testing.assert_array_equal(features, both[1].encode(cloud, ALONE).features)
    model = onnx.load(exported / "encoder.onnx")
    assert {each.domain for each in model.opset_import} == {""}
    assert {each.domain for each in model.graph.node} == {""}
    onnx.checker.check_model(model)


def test_the_file_says_what_its_features_mean(both: tuple[Encoder, Encoder]) -> None:
    theirs, ours = both
    header = ours.network.header
    written, read = theirs.outputs.select(), header.outputs.select()
    assert read.space == written.space
    np.testing.assert_array_equal(read.basis.components, written.basis.components)
    np.testing.assert_array_equal(read.mean, written.mean)
    assert header.made_by == {"steps": 3}
    assert to_metadata(from_metadata(to_metadata(header))) == to_metadata(header)
    assert ours.words.names == WORDS
    assert ours.words.trained == theirs.words.trained == WORDS[:2]
    np.testing.assert_allclose(ours.words.encode(WORDS), theirs.words.encode(WORDS), atol=1e-3)
    assert ours.voxel == theirs.voxel == 0.05


def changed(header: EncoderHeader, key: str, value: object) -> dict[str, str]:
    entries = to_metadata(header)
    values = json.loads(entries[KEY])
    values[key] = value
    return entries | {KEY: json.dumps(values)}


def deflated(raw: bytes) -> str:
    return base64.b64encode(zlib.compress(raw)).decode()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda header: {}, "no encoder that `gsencoder export` wrote"),
        (lambda header: {KEY: '{"version": 1, "kind": "memory"}'}, "is the attention of a memory, .* an encoder"),
        (lambda header: {KEY: "{"}, "is damaged"),
        (lambda header: changed(header, "version", 1), "format version 1, and this gsencoder reads 2"),
        (lambda header: changed(header, "voxel", -1), "positive voxel"),
        (lambda header: changed(header, "orders", ["spiral"]), "expected orders among"),
        (lambda header: changed(header, "space", {"name": "x"}), "damaged"),
        (lambda header: changed(header, "arrays", {"mean": {"dtype": "object", "shape": [6]}}), "float16 or int8"),
        (lambda header: changed(header, "arrays", {"mean": {"dtype": "float32", "shape": [7]}}), "28 bytes of mean"),
        (lambda header: to_metadata(header) | {f"{KEY}.mean": "no base64!"}, "damaged"),
        (lambda header: to_metadata(header) | {f"{KEY}.mean": deflated(b"\0\0\xc0\x7f" * 6)}, "not finite"),
        (lambda header: to_metadata(header) | {f"{KEY}.mean": deflated(b"\0" * 10**7)}, "24 bytes of mean, got more"),
        (lambda header: changed(header, "arrays", {"mean": {"dtype": "int8", "shape": [2**62, 4]}}), "claims .* bytes"),
        (lambda header: changed(header, "precision", "int4"), "expected a precision among float32"),
    ],
)
@pytest.mark.usefixtures("no_jaxtyping")
def test_a_damaged_header_is_refused(both, damage, message):
    with pytest.raises(InputError, match=message):
        from_metadata(damage(both[1].network.header))


def test_files_that_are_no_encoder_are_refused(exported: Path, tmp_path: Path) -> None:
    whole = (exported / "encoder.onnx").read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.onnx").write_bytes(whole[:size])
        with pytest.raises(InputError, match="cut.onnx: is no model that onnxruntime reads, or damaged"):
            Encoder.load(str(tmp_path / "cut.onnx"))
    with pytest.raises(InputError, match="no file at"):
        Encoder.load(str(tmp_path / "none.onnx"))
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "g", [value], [value])
    graph.output[0].name = "y"
    other = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=9)
    onnx.save(other, tmp_path / "other.onnx")
    with pytest.raises(InputError, match="other.onnx: is no encoder that `gsencoder export` wrote"):
        Encoder.load(str(tmp_path / "other.onnx"))
    for entry in (each for each in onnx.load(exported / "encoder.onnx").metadata_props if each.key != SUM):
        other.metadata_props.add(key=entry.key, value=entry.value)
    onnx.save(other, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"expected inputs corner: tensor\(float\).*, got x: tensor\(float\)"):
        Encoder.load(str(tmp_path / "other.onnx"))


def test_a_changed_file_is_refused_unless_it_says_so(exported: Path, tmp_path: Path) -> None:
    file = tmp_path / "changed.onnx"
    whole = (exported / "encoder.onnx").read_bytes()
    for offset in np.linspace(0, len(whole) - 1, 20).astype(int):
        damaged = bytearray(whole)
        damaged[offset] ^= 64
        file.write_bytes(damaged)
        with pytest.raises(InputError, match="changed.onnx"):
            Encoder.load(str(file))
    model = onnx.load(exported / "encoder.onnx")
    (entry,) = (each for each in model.metadata_props if each.key == KEY)
    entry.value = entry.value.replace('"patch": 24', '"patch": 25')
    onnx.save(model, file)
    with pytest.raises(InputError, match="do not have the sum"):
        Encoder.load(str(file))
    (entry,) = (each for each in model.metadata_props if each.key == SUM)
    model.metadata_props.remove(entry)
    onnx.save(model, file)
    with pytest.warns(SceneWarning, match="another program changed it"):
        Encoder.load(str(file))


def test_what_cannot_be_encoded_is_refused_on_both_sides_alike(both: tuple[Encoder, Encoder]) -> None:
    cloud = random_cloud(10, 0.05)
    wide = moved(cloud, np.linspace(0, 2.0**20, 10)[:, None] * np.ones(3))
    for encoder in both:
        with pytest.raises(InputError, match="the splat has no Gaussians"):
            encoder.encode(cloud.select(np.arange(0)))
        with pytest.raises(InputError, match="the limit is 2²⁰"):
            encoder.encode(wide)
    with pytest.raises(InputError, match="computes in float32, not bfloat16; export another"):
        both[1].encode(cloud, EncodeConfig(precision="bfloat16"))


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.parametrize("count", [1, 2, 3, 1023, 1024, 1025])
def test_the_search_counts_what_is_below(count: int) -> None:
    keys = np.sort(np.random.default_rng(count).integers(0, 2**62, count))
    wanted = np.unique(np.concatenate((keys[:50], keys[-50:] + 1, keys[:50] - 1, [0, 2**62])))
    left, right = np.split(np.asarray(search(keys, np.tile(wanted, 2), np.repeat([0, 1], len(wanted)))), 2)
    np.testing.assert_array_equal(left, np.searchsorted(keys, wanted, "left"))
    np.testing.assert_array_equal(right, np.searchsorted(keys, wanted, "right"))


def test_an_export_that_does_not_agree_is_told(exported: Path, both: tuple[Encoder, Encoder]) -> None:
    model = onnx.load(exported / "encoder.onnx")
    head = next(each for each in model.graph.initializer if each.name.endswith("head.of_teacher.0.2.bias"))
    head.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(head) + np.float32(0.01), head.name))
    with pytest.raises(InputError, match="on a sheet onnxruntime and torch differ by .* no file was written"):
        check_parity(with_sum(model.SerializeToString()), both[0], [Cloud("a sheet", random_cloud(50, 0.05))])


def test_without_the_packages_of_an_export_it_says_which(both: tuple[Encoder, Encoder]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "onnxscript", None)
        patch.delitem(sys.modules, "gsencoder.infer.onnx.export")
        with pytest.raises(InputError, match=r"needs the package onnxscript: pip install 'gsencoder\[export\]'"):
            both[0].network.lower()


def test_one_class_loads_what_torch_and_what_onnxruntime_runs_and_exports(exported, tmp_path, lowered, monkeypatch):
    monkeypatch.setattr(TorchNetwork, "lower", lambda _: lowered)
    encoder = Encoder.load(str(exported))
    encoder.export(tmp_path / "again.onnx")
    exported = Encoder.load(str(tmp_path / "again.onnx"), "cpu")
    assert isinstance(encoder.network, TorchNetwork)
    assert isinstance(exported.network, OnnxNetwork)
    cloud = random_cloud(50, encoder.voxel)
    assert apart(exported, encoder, cloud) <= TOLERANCE
    with pytest.raises(InputError, match="an ONNX file already"):
        exported.export(tmp_path / "third.onnx")
