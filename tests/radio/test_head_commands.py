"""SplatDistill's way with a small random RADIO: fused, distilled, adapter heads applied after; words in, boxes out."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal, results_of
from radio_world import QUICK, SEEDS, World, run
from radios import small_joint_model

from gsencoder.app import main as cli
from gsencoder.app.heads import words_of_head
from gsencoder.app.scenes import load_query
from gsencoder.core.archive import open_archive
from gsencoder.core.errors import SceneWarning
from gsencoder.fusion.folder import load_features
from gsencoder.fusion.measured_heads import find_head, head_outputs, load_heads, save_heads
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.text.models import TransformersTextConfig
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.text.vocabulary import vocabulary_of
from gsencoder.types import GaussianFeatures

pytestmark = pytest.mark.slow

WORDS = "mug,chair,table"
EVERY_BOX = ("localize.min_probability=0", "localize.threshold.kind=relative")


def features_of(folder: Path) -> GaussianFeatures:
    (features,) = load_features(folder).features.values()
    return features


@pytest.fixture(scope="module")
def encoded(world: World, trained: Path) -> Path:
    out = world.folder / "encoded"
    run("encode", world.room(1), f"weights={trained}", *SEEDS, f"out={out}")
    return out


def test_fusing_leaves_measured_heads_and_says_what_the_basis_costs_each(fused: Path) -> None:
    heads, features, results = load_heads(fused / "heads.safetensors"), features_of(fused), results_of(fused)
    assert heads.names == ("siglip.summary", "siglip.features", "sam.features")
    assert heads.space == features.space
    assert list(results["heads"]) == list(heads.names)
    for head in heads.heads:
        assert results["heads"][head.name] == head.figures()
        assert -1 <= head.worst < head.cosine < 1
        assert head.cells == 3 * 4 * 6


def test_words_of_a_text_tower_are_compared_with_outputs_of_the_summary_head(world, fused, tmp_path):
    asked = ("head=siglip", f"query={WORDS}", *world.text, *EVERY_BOX)
    run("localize", str(fused), *asked, "pictures=1", f"out={tmp_path / 'b'}")
    results = results_of(tmp_path / "b")
    assert results["space"].startswith("radio-radio/siglip.summary · 16 channels · radio")
    assert results["boxes"]
    assert list((tmp_path / "b").glob("*.png"))
    # By hand: cosines about both means, of the words' vectors and of the head's outputs for the decoded features.
    scene, features = load_features(fused), features_of(fused)
    head = find_head(load_heads(fused / "heads.safetensors"), "siglip")
    words = vocabulary_of(TransformersTextConfig(model=str(world.siglip)))
    vectors = words.encode(["mug"])[0] - words.mean
    outputs = head_outputs(head.head, features.decode()) - head.mean
    cosines = outputs @ vectors / (np.linalg.norm(outputs, axis=1) * np.linalg.norm(vectors))
    config = TransformersTextConfig(model=str(world.siglip))
    head_scene, table = load_query(scene, fused, head="siglip", text=config)
    every_box = LocalizeConfig(min_probability=0.0, threshold=ThresholdConfig(kind="relative"))
    made = localize(head_scene, ["mug"], table, every_box)
    np.testing.assert_allclose(made.relevancy[0][features.seen], cosines[features.seen], atol=1e-4)


def test_a_text_table_of_the_width_of_a_head_is_asked(fused, tmp_path, capsys):
    for channels in (16, 12):
        vectors = np.random.default_rng(0).normal(size=(3, channels)).astype(np.float32)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        save_text_table(tmp_path / f"w{channels}.safetensors", make_text_table(["mug", "bed", "lamp"], vectors, "own"))
    arguments = ("localize", str(fused), "head=siglip", "query=mug", *EVERY_BOX, "pictures=0", f"out={tmp_path / 'b'}")
    line = refusal(capsys, *arguments, f"words={tmp_path / 'w12.safetensors'}")
    assert "gives vectors of 16 channels, and the words of 'own' have 12" in line
    run(*arguments, f"words={tmp_path / 'w16.safetensors'}")
    assert results_of(tmp_path / "b")["space"].endswith(" · own")


def test_training_stores_the_heads_of_its_loss_and_those_asked_for_besides(trained: Path) -> None:
    heads = load_heads(trained / "heads.safetensors")
    assert heads.names == ("siglip.summary", "sam.features", "siglip.features")
    assert list(results_of(trained)["heads"]) == list(heads.names)
    prepared = load_heads(trained.with_name("encoder.prepared") / "heads.safetensors")
    assert prepared.space == heads.space
    assert (trained / "log.csv").read_text().splitlines()[0].count("render") == 1


def test_encoded_features_carry_the_heads_of_the_weights(world, trained, encoded, tmp_path):
    assert (encoded / "heads.safetensors").read_bytes() == (trained / "heads.safetensors").read_bytes()
    asked = ("head=siglip", f"query={WORDS}", *world.text, *EVERY_BOX)
    run("localize", str(encoded), *asked, "pictures=0", f"out={tmp_path / 'b'}")
    assert results_of(tmp_path / "b")["boxes"]


@pytest.mark.parametrize(("source", "protocol"), [("weights", "localization"), ("fused", "naming")])
def test_outputs_of_a_head_are_evaluated(world, trained, tmp_path, source, protocol):
    of = (f"weights={trained}",) if source == "weights" else world.teacher
    limits = ("protocol.min_views=1", "protocol.min_pixels=5") if protocol == "localization" else ()
    asked = (*of, "head=siglip", *world.text, *SEEDS, f"protocol={protocol}", *limits)
    run("evaluate", world.room(1), *asked, f"out={tmp_path / 'e'}")
    results = results_of(tmp_path / "e")
    assert results["objects" if protocol == "localization" else "names"]


def test_packed_outputs_of_a_head_are_asked_with_the_words_beside_them(world, encoded, tmp_path, capsys):
    run("pack", str(encoded), "head=siglip", *world.text, f"out={tmp_path / 'p'}")
    assert features_of(tmp_path / "p").space.layer == "siglip.summary"
    assert not (tmp_path / "p" / "heads.safetensors").exists()
    run("localize", str(tmp_path / "p"), "query=apple,bed", *EVERY_BOX, "pictures=0", f"out={tmp_path / 'b'}")
    assert results_of(tmp_path / "b")["boxes"]
    assert "give head= as well" in refusal(capsys, "pack", str(encoded), *world.text, f"out={tmp_path / 'x'}")
    run("pack", str(encoded), "form=npz", f"out={tmp_path / 'q'}")
    assert load_heads(tmp_path / "q" / "heads.safetensors").names == load_heads(encoded / "heads.safetensors").names


def test_questions_are_asked_with_words_of_a_head(world: World, encoded: Path, tmp_path: Path) -> None:
    words = ("question=Where is it?", f"query={WORDS}", "dry_run=true", "choose.count=1")
    run("ask", str(encoded), "head=siglip", *world.text, *EVERY_BOX, *words, f"out={tmp_path / 'a'}")
    assert (tmp_path / "a" / "prompt.txt").is_file()


def test_tokens_are_outputs_of_the_head_for_rendered_features(world: World, encoded: Path, tmp_path: Path) -> None:
    def tokens(*words: str) -> tuple[np.ndarray, str]:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        run("views", str(encoded), *words, "grid=[4,5]", "choose.count=2", f"out={folder}")
        with open_archive(folder / "tokens.safetensors") as file:
            return file.array("tokens", "float32", ("V", "T", "D")), file.value("space", str)

    plain, _ = tokens("choose.method=uniform")
    through, space = tokens("choose.method=uniform", "head=sam")
    assert space.startswith("radio-radio/sam.features · 10 channels")
    head = find_head(load_heads(encoded / "heads.safetensors"), "sam")
    expected = head_outputs(head.head, plain.reshape(-1, plain.shape[-1])).reshape(2, 20, 10)
    np.testing.assert_allclose(through, expected, rtol=1e-4, atol=1e-4)
    arguments = ("head=siglip", "token_head=siglip.features", f"query={WORDS}", *world.text, *EVERY_BOX)
    through, space = tokens(*arguments)
    assert (through.shape, space.split(" · ")[0]) == ((2, 20, 16), "radio-radio/siglip.features")


def test_a_training_goes_on_only_with_the_heads_that_it_began_with(world, trained, tmp_path, monkeypatch, capsys):
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    prepared = f"prepared={trained.with_name('encoder.prepared')}"
    scenes = (world.room(0), world.room(1), "holdout=room_1")
    basis = "prepare.fusion.max_rank=6"
    begun = ["train", *scenes, *world.teacher, basis, *SEEDS, *QUICK[1:], prepared, f"out={tmp_path / 'run'}"]
    with monkeypatch.context() as patch:
        patch.setattr("gsencoder.app.commands.train.write_results", interrupted)
        assert cli.main([*begun, "heads=siglip", "quiet=true"]) == 130
    line = refusal(capsys, *begun, "heads=[siglip,sam]")
    assert "was made with heads=siglip (" in line
    assert "and this run asks heads=siglip,sam (" in line
    assert cli.main([*begun, "heads=siglip", "quiet=true"]) == 0
    assert load_heads(tmp_path / "run" / "heads.safetensors").names == ("siglip.summary",)
    # A head that the prepared scenes do not have yet is measured, and changes nothing else of them.
    written = {path: path.read_bytes() for path in (trained.with_name("encoder.prepared") / "scenes").iterdir()}
    again = [word for word in begun if not word.startswith("out=")]
    assert cli.main([*again, "heads=sam.summary", "prepare_only=true", f"out={tmp_path / 'other'}", "quiet=true"]) == 0
    assert "sam.summary" in load_heads(trained.with_name("encoder.prepared") / "heads.safetensors").names
    assert {path: path.read_bytes() for path in written} == written


def test_heads_of_another_backbone_are_refused(world, fused, tmp_path, capsys):
    copy = tmp_path / "fused"
    shutil.copytree(fused, copy)
    heads = load_heads(copy / "heads.safetensors")
    save_heads(copy / "heads.safetensors", replace(heads, space=replace(heads.space, weights="other")))
    arguments = ("localize", str(copy), "head=siglip", "query=mug", *world.text, f"out={tmp_path / 'x'}")
    line = refusal(capsys, *arguments)
    assert "heads take features of (radio-radio · 24 channels" in line
    assert "expected heads of the same backbone" in line
    for words in (("views", str(copy), "head=sam", "choose.method=uniform", "grid=[2,2]"), ("pack", str(copy))):
        assert "heads take features of" in refusal(capsys, *words, f"out={tmp_path / 'x'}")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("head=dino", "query=mug"), "head=dino: not among the heads at hand: siglip.summary, siglip.features, sam"),
        (("head=sam", "query=mug"), "head sam.features (vit-h): leads to no model with a text side (siglip2, siglip"),
        (("head=siglip.features", "query=mug"), "words are compared with summary heads, since outputs of feature"),
        (("query=mug",), "there is no words.safetensors next to these features"),
    ],
)
def test_a_head_that_words_cannot_be_compared_with_is_refused(world, fused, tmp_path, capsys, words, message):
    text = world.text if any(word.startswith("head=") for word in words) else ()
    assert message in refusal(capsys, "localize", str(fused), *words, *text, f"out={tmp_path / 'x'}")


def test_words_of_another_model_are_refused_and_both_are_named(world, fused, tmp_path, capsys):
    arguments = ("localize", str(fused), "head=siglip", "query=mug", f"out={tmp_path / 'x'}")
    line = refusal(capsys, *arguments)
    assert (
        "no text table of its space was given; give text=transformers text.model=FOLDER, the text side of ViT-SO400M"
        in line
    )
    wide = small_joint_model(tmp_path / "wide", channels=12)
    line = refusal(capsys, *arguments, "text=transformers", f"text.model={wide}")
    assert "(ViT-SO400M-14-SigLIP-384) gives vectors of 16 channels, and the words of 'wide' have 12" in line
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
    assert "head=siglip: no adapter heads lie next to the weights" in refusal(capsys, *evaluated)
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
