"""`fuse encoder=`, and `encode` of splats of which nothing says what is up."""

from pathlib import Path

import pytest
from command_runs import refusal, results_of
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room

pytestmark = pytest.mark.slow
DOUBT = "the encoder expects 0% of its names in this scene to be right, fewer than half"


def test_exact_labels_are_not_replaced_by_names_of_an_encoder(tmp_path: Path, capsys) -> None:
    write_room(make_room(0, objects=2, views=3, width=48, height=36), tmp_path / "room")
    out = f"out={tmp_path / 'features'}"
    message = refusal(capsys, "fuse", str(tmp_path / "room"), "encoder=rooms", "text=minilm", out)
    assert "the labels of" in message
    assert "teacher=mosaic text=minilm" in message
    assert not (tmp_path / "features").exists()


def test_features_by_both_say_what_the_encoder_expects(tmp_path: Path, capsys) -> None:
    save_splat(tmp_path / "noise.ply", random_gaussians(2000))
    words = ["fuse", str(tmp_path / "noise.ply"), "encoder=rooms", "orbits=2", f"out={tmp_path / 'features'}"]
    assert cli.main([*words, "quiet=true"]) == 0
    assert DOUBT in capsys.readouterr().err
    assert results_of(tmp_path / "features")["expected_share"] < 0.005


def test_a_splat_of_which_nothing_says_what_is_up_is_taken_as_it_is_and_that_is_printed(tmp_path: Path, capsys) -> None:
    save_splat(tmp_path / "noise.ply", random_gaussians(2000))
    assert cli.main(["encode", str(tmp_path / "noise.ply"), f"out={tmp_path / 'encoded'}"]) == 0
    printed = capsys.readouterr()
    assert "up of noise: not known, and taken to be z (data.up= states it)" in printed.out
    assert f"{DOUBT}: it looks like nothing that the encoder was trained on, unless another direction is up" in (
        printed.err
    )
