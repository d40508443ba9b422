"""Heads, words and maps that commands refuse because they do not belong together."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from command_runs import refusal
from radio_world import QUICK, SEEDS, run
from radios import small_joint_model, small_radio

from gsencoder.app.heads import words_of_head
from gsencoder.core.errors import SceneWarning
from gsencoder.fusion.measured_heads import find_head, load_heads, save_heads
from gsencoder.text.models import TransformersTextConfig

pytestmark = pytest.mark.slow


def test_heads_of_another_backbone_are_refused(world, fused, tmp_path, capsys):
    copy = tmp_path / "fused"
    shutil.copytree(fused, copy)
    other = small_radio(tmp_path / "radio", seed=5)
    teacher = [word.replace(str(world.radio), str(other)) for word in world.teacher]
    out = f"out={tmp_path / 'other'}"
    run("fuse", world.room(0), *teacher, "teacher.heads=siglip", *SEEDS, out)
    shutil.copyfile(tmp_path / "other" / "heads.safetensors", copy / "heads.safetensors")
    arguments = ("localize", str(copy), "head=siglip", "query=mug", *world.text, f"out={tmp_path / 'x'}")
    line = refusal(capsys, *arguments)
    assert "heads take features of (radio-radio · 24 channels" in line
    assert "expected heads of the same backbone" in line
    line = refusal(
        capsys, "views", str(copy), "head=sam", "choose.method=uniform", "grid=[2,2]", f"out={tmp_path / 'x'}"
    )
    assert "heads take features of" in line
    assert "heads take features of" in refusal(capsys, "pack", str(copy), f"out={tmp_path / 'x'}")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("head=dino", "query=mug"), "head=dino: not among the heads at hand: siglip.summary, siglip.features, sam"),
        (
            ("head=sam", "query=mug"),
            "head sam.features (vit-h): leads to no model with a text side (siglip2, siglip, clip)",
        ),
        (
            ("head=siglip.features", "query=mug"),
            "words are compared with summary heads, since outputs of feature heads are not aligned",
        ),
        (("query=mug",), "there is no words.safetensors beside these features"),
    ],
)
def test_a_head_that_words_cannot_be_compared_with_is_refused(world, fused, tmp_path, capsys, words, message):
    text = world.text if any(word.startswith("head=") for word in words) else ()
    assert message in refusal(capsys, "localize", str(fused), *words, *text, f"out={tmp_path / 'x'}")


def test_words_of_another_model_are_refused_and_both_are_named(world, fused, tmp_path, capsys):
    arguments = ("localize", str(fused), "head=siglip", "query=mug", f"out={tmp_path / 'x'}")
    assert (
        "no words lead into its space; give text=transformers text.model=FOLDER, the text side of ViT-SO400M-14-Sig"
        in (refusal(capsys, *arguments))
    )
    wide = small_joint_model(tmp_path / "wide", channels=12)
    line = refusal(capsys, *arguments, "text=transformers", f"text.model={wide}")
    assert (
        "head siglip.summary (ViT-SO400M-14-SigLIP-384) gives vectors of 16 channels, and the words of 'wide' have 12"
        in line
    )
    clip = small_joint_model(tmp_path / "clip", kind="clip")
    line = refusal(capsys, *arguments, "text=transformers", f"text.model={clip}")
    assert "leads to a siglip model, and the words of 'clip' are those of a clip model" in line


def test_features_without_heads_and_heads_without_features_are_refused(world, fused, trained, tmp_path, capsys):
    copy = tmp_path / "fused"
    shutil.copytree(fused, copy)
    (copy / "heads.safetensors").unlink()
    arguments = ("localize", str(copy), "head=siglip", "query=mug", *world.text, f"out={tmp_path / 'x'}")
    assert "head=siglip: there is no heads.safetensors in" in refusal(capsys, *arguments)
    weights = tmp_path / "encoder"
    shutil.copytree(trained, weights)
    (weights / "heads.safetensors").unlink()
    evaluated = ("evaluate", world.room(1), f"weights={weights}", "head=siglip", *world.text, f"out={tmp_path / 'x'}")
    assert "head=siglip: no adapter heads lie beside the weights" in refusal(capsys, *evaluated)
    shutil.copyfile(fused / "heads.safetensors", weights / "heads.safetensors")
    heads = load_heads(weights / "heads.safetensors")
    save_heads(weights / "heads.safetensors", replace(heads, space=replace(heads.space, weights="other")))
    line = refusal(capsys, "encode", world.room(1), f"weights={weights}", *SEEDS, f"out={tmp_path / 'x'}")
    assert "heads take features of" in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("heads=siglip", "teacher=palette"), "heads=siglip: teacher=palette has no adapter heads"),
        (("heads=[siglip,siglip.summary]",), "heads: siglip, siglip.summary names a head twice"),
    ],
)
def test_heads_that_a_training_cannot_use_are_refused(world, tmp_path, capsys, words, message):
    teacher = () if any(word.startswith("teacher=") for word in words) else world.teacher
    out = f"out={tmp_path / 'run'}"
    assert message in refusal(capsys, "train", world.room(0), *teacher, *words, *SEEDS, *QUICK[1:], out)


def test_a_siglip2_head_with_a_tower_that_keeps_capital_letters_warns(fused: Path, tmp_path: Path) -> None:
    folder = str(small_joint_model(tmp_path / "siglip2", kind="siglip2"))
    head = replace(find_head(load_heads(fused / "heads.safetensors"), "siglip").head, text="siglip2")
    with pytest.warns(SceneWarning, match="give text.lower=yes"):
        words_of_head(head, "", TransformersTextConfig(model=folder, lower="no"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        words_of_head(head, "", TransformersTextConfig(model=folder))
