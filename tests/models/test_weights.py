"""Weights on disk: what is read is what was written, and anything else is refused with a reason."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from archives import header_of, rewrite
from training_scenes import SMALL

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer.encode import Encoder
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs, load_weights, save_weights, start_from
from gsencoder.models.output_space import DEFAULT_WEIGHTS, SHIPPED_WEIGHTS, OutputSpace, OutputSpaces, find_weights
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import FeatureBasis, FeatureSpace, Gaussians

SPACE = FeatureSpace(name="s", channels=6, teacher="labels", text_encoder="t")


def outputs(basis: bool) -> OutputSpaces:
    rng = np.random.default_rng(0)
    mean = rng.normal(size=6).astype(np.float32)
    components = np.linalg.qr(rng.normal(size=(6, 6)))[0][:4].astype(np.float32)
    own = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE) if basis else None
    return OutputSpaces(by_teacher={"labels": OutputSpace(space=SPACE, mean=mean, scale=0.7, basis=own)})


def encoder(space: OutputSpaces) -> GaussianEncoder:
    torch.manual_seed(1)
    return GaussianEncoder(SMALL, space.widths)


@pytest.mark.parametrize("basis", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_what_is_read_is_what_was_written(basis: bool, dtype: str, tmp_path: Path) -> None:
    space, path = outputs(basis), tmp_path / "e.safetensors"
    written = encoder(space)
    save_weights(path, written, space, {"steps": 3}, dtype=dtype)  # type: ignore[arg-type]
    read, spaces, made_by = load_weights(path)
    assert made_by == {"steps": 3}
    assert read.config == SMALL
    assert not read.training
    assert list(spaces) == ["labels"]
    assert spaces["labels"].space == SPACE
    assert spaces["labels"].scale == space["labels"].scale
    np.testing.assert_array_equal(spaces["labels"].mean, space["labels"].mean)
    assert (spaces["labels"].basis is None) == (not basis)
    tolerance = 0.0 if dtype == "float32" else 1e-3
    for name, value in written.state_dict().items():
        torch.testing.assert_close(read.state_dict()[name], value, rtol=tolerance, atol=tolerance)
        assert read.state_dict()[name].dtype == torch.float32


def test_parameters_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    broken = encoder(outputs(False))
    with torch.no_grad():
        broken.head_norm.bias[0] = float("nan")
    with pytest.raises(InputError, match="parameter head_norm.bias is not finite"):
        save_weights(tmp_path / "e.safetensors", broken, outputs(False), {})
    assert list(tmp_path.iterdir()) == []


def with_header(path: Path, change: dict) -> None:
    rewrite(path, header={**header_of(path), **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder": {"voxel": 0.1, "depth": 3}}, "configuration does not fit this version"),
        ({"encoder": None}, "expected encoder"),
        ({"scale": 0.0}, "scale"),
        ({"dtype": "int8"}, "expected parameters of float32 or float16"),
        ({"space": {"name": "x"}}, "feature space"),
    ],
)
def test_a_header_that_says_something_else_is_refused(change: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    save_weights(path, encoder(outputs(True)), outputs(True), {})
    with_header(path, change)
    with pytest.raises(InputError, match=message):
        load_weights(path)


def test_parameters_of_another_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    save_weights(path, encoder(outputs(True)), outputs(True), {})
    config = header_of(path)["encoder"]
    config["transformer"]["encoder_channels"] = [16, 48]
    with_header(path, {"encoder": config})
    with pytest.raises(InputError, match=r"expected encoder\.\S+ float32\["):
        load_weights(path)


@pytest.mark.parametrize("cut", [0, 7, 100, 5000])
def test_a_truncated_file_is_refused(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    save_weights(path, encoder(outputs(False)), outputs(False), {})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match="damaged"):
        load_weights(path)


def test_several_teachers_of_equal_width_keep_their_projectors_and_bases(tmp_path: Path) -> None:
    first = outputs(basis=True)["labels"]
    space = replace(SPACE, name="other")
    basis = replace(first.basis, components=first.basis.components[::-1].copy(), energy_kept=0.7, space=space)
    spaces = OutputSpaces(by_teacher={"labels": first, "other": replace(first, space=space, scale=0.2, basis=basis)})
    written = encoder(spaces)
    save_weights(tmp_path / "e.safetensors", written, spaces, {})
    read, spaces_read, _ = load_weights(tmp_path / "e.safetensors")
    assert list(spaces_read) == list(spaces)
    for name, value in written.state_dict().items():
        torch.testing.assert_close(read.state_dict()[name], value, rtol=0, atol=0)
    for name, own in spaces.by_teacher.items():
        assert spaces_read[name].basis.energy_kept == own.basis.energy_kept
        np.testing.assert_array_equal(spaces_read[name].basis.components, own.basis.components)


def test_a_name_of_shipped_weights_that_is_a_folder_too_is_refused_and_both_have_an_unmistakable_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = SHIPPED_WEIGHTS / "house" / "encoder.safetensors"
    for name in ("house", "shipped:house"):
        assert find_weights(name) == shipped
    for name in ("", "shipped:rooms", "rooms"):
        assert find_weights(name) == SHIPPED_WEIGHTS / DEFAULT_WEIGHTS / "encoder.safetensors"
    # Whether or not the folder of that name has an encoder.
    for make in (
        Path("house").mkdir,
        lambda: save_weights(Path("house/encoder.safetensors"), encoder(outputs(True)), outputs(True), {}),
    ):
        make()
        with pytest.raises(InputError, match=r"weights: house is the name of an .*; give shipped:house or \./house"):
            find_weights("house")
        assert find_weights("shipped:house") == shipped
    assert find_weights("./house") == Path("house/encoder.safetensors")
    Path("rooms").mkdir()
    assert find_weights("") == SHIPPED_WEIGHTS / DEFAULT_WEIGHTS / "encoder.safetensors"


def test_words_of_another_encoder_beside_the_weights_are_refused(tmp_path: Path) -> None:
    for name in ("encoder.safetensors", "words.safetensors"):
        shutil.copyfile(SHIPPED_WEIGHTS / "rooms" / name, tmp_path / name)
    assert Encoder.load(str(tmp_path)).words is not None
    save_text_table(tmp_path / "words.safetensors", make_text_table(["mug"], np.eye(1, 512, dtype=np.float32), "clip"))
    with pytest.raises(
        InputError, match=r"words next to the encoder are of .* \(512 channels\), and its space labels has 384"
    ):
        Encoder.load(str(tmp_path))


def predicted(network: GaussianEncoder, spaces: OutputSpaces) -> np.ndarray:
    """Features [N, 6] of the labels that an encoder gives some Gaussians."""
    attributes, opacities, plan = encoder_inputs(line_of_gaussians(), SMALL, SMALL.voxel)
    with torch.no_grad():
        standard = network.eval()(attributes, opacities, network.join([plan])).numpy()[:, spaces.columns["labels"]]
    return spaces["labels"].features(spaces["labels"].restore(standard)).decode()


def line_of_gaussians() -> Gaussians:
    rng = np.random.default_rng(3)
    return Gaussians(
        means=rng.uniform(0, 1, (50, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (50, 1)),
        scales=np.full((50, 3), 0.02, np.float32),
        opacities=np.full(50, 0.9, np.float32),
        sh=rng.normal(size=(50, 1, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("projector", [0, 8])
@pytest.mark.parametrize("basis", [False, True])
def test_an_encoder_that_starts_from_weights_predicts_their_features_in_units_of_its_own(
    projector: int, basis: bool, tmp_path: Path
) -> None:
    config = replace(SMALL, projector=projector)
    side = OutputSpace(space=replace(SPACE, name="sides", channels=3), mean=np.ones(3, np.float32), scale=2.0)
    theirs = outputs(basis)
    torch.manual_seed(1)
    trained = GaussianEncoder(config, theirs.widths)
    save_weights(tmp_path / "e.safetensors", trained, theirs, {})
    labels = OutputSpace(space=SPACE, mean=np.arange(6, dtype=np.float32), scale=0.3)
    ours = OutputSpaces(by_teacher={"sides": side, "labels": labels})
    torch.manual_seed(2)
    started = GaussianEncoder(replace(config, transformer=replace(SMALL.transformer, drop_path=0.5)), ours.widths)
    before = [each.clone() for each in started.head_parameters(ours, "sides")]
    with pytest.warns(SceneWarning, match="has no features of sides, whose projector starts at random"):
        start_from(started, ours, tmp_path / "e.safetensors")
    expected = predicted(trained, theirs)
    assert expected.std(axis=0).max() > 0.01
    np.testing.assert_allclose(predicted(started, ours), expected, atol=1e-5)
    for parameter, value in zip(started.head_parameters(ours, "sides"), before, strict=True):
        torch.testing.assert_close(parameter, value, rtol=0, atol=0)


def test_an_encoder_does_not_start_from_weights_of_another_network(tmp_path: Path) -> None:
    save_weights(tmp_path / "e.safetensors", encoder(outputs(False)), outputs(False), {})
    other = GaussianEncoder(replace(SMALL, voxel=0.05), outputs(False).widths)
    with pytest.raises(InputError, match=r"made with model.voxel=0.1, and this run asks model.voxel=0.05; give the"):
        start_from(other, outputs(False), tmp_path / "e.safetensors")


def test_an_encoder_that_knows_the_size_of_its_cells_starts_on_others(tmp_path: Path) -> None:
    config = replace(SMALL, inputs=("color", "cell"))
    trained = GaussianEncoder(config, outputs(False).widths)
    save_weights(tmp_path / "e.safetensors", trained, outputs(False), {})
    started = GaussianEncoder(replace(config, voxel=0.05), outputs(False).widths)
    start_from(started, outputs(False), tmp_path / "e.safetensors")
    for name, value in trained.state_dict().items():
        torch.testing.assert_close(started.state_dict()[name], value)
