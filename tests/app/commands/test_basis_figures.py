"""`train`, `encode` and `fuse basis=` state what the encoder's basis keeps, of its own scenes and of others."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of

from gsencoder.app import main as cli
from gsencoder.data.scenes import load_scene
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.basis import project_maps
from gsencoder.fusion.folder import load_features
from gsencoder.infer.onnx.export import random_cloud
from gsencoder.models.encoder import load_weights
from gsencoder.teachers.labels import PaletteConfig, PaletteTeacher

pytestmark = pytest.mark.slow

TRAIN = (
    "teacher=palette", "prepare.fusion.max_rank=3", "holdout=room_1", "model.transformer.encoder_depths=[1]",
    "model.transformer.encoder_channels=[32]", "model.transformer.decoder_depths=[]",
    "model.transformer.decoder_channels=[]", "train.steps=2", "train.warmup=1", "sampling.gaussians=500",
    "tensorboard=false",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms, and an encoder trained on the first."""
    folder = tmp_path_factory.mktemp("basis")
    for number in range(2):
        write_room(make_room(number, objects=2, views=3, width=48, height=36), folder / f"room_{number}")
    words = [str(folder / f"room_{number}") for number in range(2)]
    with pytest.MonkeyPatch.context() as patch:
        # Few channels are fused in a basis for all that.
        patch.setattr(import_module("gsencoder.fusion.fuse"), "NARROW", 2)
        assert cli.main(["train", *words, *TRAIN, f"out={folder / 'encoder'}", "quiet=true"]) == 0
    return folder


def test_training_states_what_the_basis_keeps_of_its_scenes_and_of_held_out_ones(folder: Path) -> None:
    _, spaces, made_by = load_weights(folder / "encoder")
    outputs = spaces.select()
    figures = results_of(folder / "encoder")["basis"]
    assert made_by["basis"] == figures
    assert (figures["rank"], figures["energy_kept"]) == (3, outputs.basis.energy_kept)
    views = load_scene(folder / "room_1").views
    direct = project_maps(outputs.basis, PaletteTeacher(PaletteConfig()), views, range(len(views))).fit()
    assert {name: figures[name] for name in direct.figures()} == pytest.approx(direct.figures(), abs=1e-3)


def test_encoding_shows_the_figures_of_the_weights_or_those_of_the_scene(folder, tmp_path, capsys):
    trained = results_of(folder / "encoder")["basis"]
    encode = ["encode", str(folder / "room_0"), f"weights={folder / 'encoder'}"]
    assert cli.main([*encode, f"out={tmp_path / 'plain'}"]) == 0
    assert results_of(tmp_path / "plain")["basis"] == trained
    printed = capsys.readouterr().out.replace("\n", " ")
    assert "basis of the encoder: rank 3, keeps" in printed
    assert "in the scenes held out of the training" in printed
    assert cli.main([*encode, f"out={tmp_path / 'measured'}", "basis_views=2"]) == 0
    measured = results_of(tmp_path / "measured")["basis"]
    assert "in this scene" in capsys.readouterr().out.replace("\n", " ")
    assert measured["rank"] == 3
    assert measured["other_energy"] != trained["other_energy"]


def test_fusing_in_the_basis_of_weights_gives_features_that_compare_with_encoded_ones(folder, tmp_path):
    words = [str(folder / "room_0"), "teacher=palette", f"basis={folder / 'encoder'}", f"out={tmp_path / 'fused'}"]
    assert cli.main(["fuse", *words, "quiet=true"]) == 0
    basis = load_weights(folder / "encoder")[1].select().basis
    (features,) = load_features(tmp_path / "fused").features.values()
    fused = features.basis
    np.testing.assert_array_equal(fused.components, basis.components)
    assert 0 < results_of(tmp_path / "fused")["other_energy"] <= 1


def test_where_there_is_nothing_to_measure_one_line_says_so(folder, tmp_path, capsys):
    save_splat(tmp_path / "bare.ply", random_cloud(50, 0.02))
    out = [f"out={tmp_path / 'out'}", "data.metres_per_unit=1"]
    weights = f"weights={folder / 'encoder'}"
    for words, message in (
        (["encode", str(tmp_path / "bare.ply"), weights, "basis_views=2", *out], "the scene has no views in which"),
        (["encode", str(tmp_path / "bare.ply"), weights, "basis_views=-1", *out], "basis_views: expected 0 or more"),
        (["fuse", str(folder / "room_0"), "teacher=palette", "basis=nothing", *out], "nothing"),
    ):
        assert message in refusal(capsys, *words)
