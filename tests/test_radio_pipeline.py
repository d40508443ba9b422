"""SplatDistill's way with a small random RADIO: fused, distilled, adapter heads applied after; words in, boxes out."""

import math
import shutil
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_runs import refusal, results_of
from radios import change_weights, small_joint_model, small_radio
from symbolic import symbolic_sizes

from gsencoder.app import cli
from gsencoder.app.commands.query_words import queried_scene
from gsencoder.app.commands.through_head import words_of_head
from gsencoder.core.errors import SceneWarning
from gsencoder.core.files.archive import open_archive
from gsencoder.data.synthetic.room import make_room
from gsencoder.data.synthetic.write import write_room
from gsencoder.fusion.heads.measure import head_outputs
from gsencoder.fusion.heads.store import find_head, load_heads, save_heads
from gsencoder.fusion.store.folder import load_features
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.infer.localize.threshold import ThresholdConfig
from gsencoder.text.build import vocabulary_of
from gsencoder.text.reference_nouns import REFERENCE_NOUNS
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.text.transformers_tower import TransformersTextConfig
from gsencoder.types import GaussianFeatures

pytestmark = pytest.mark.slow

WORDS = "mug,chair,table"
SEEDS = ("seeds.voxel=0.06",)
QUICK = (
    "quiet=true",
    "tensorboard=false",
    # One level: heads follow the encoder, and a graph of two takes twice as long to export.
    "model.transformer.encoder_depths=[1]",
    "model.transformer.encoder_channels=[32]",
    "model.transformer.decoder_depths=[]",
    "model.transformer.decoder_channels=[]",
    "model.transformer.patch=64",
    "train.steps=3",
    "train.warmup=1",
    "train.log_every=1",
    "sampling.views=1",
    "sampling.gaussians=1000",
    "sampling.smallest=200",
)
EVERY_BOX = ("localize.min_probability=0", "localize.threshold.kind=quantile", "localize.threshold.quantile=0.9")


class World:
    """The folders of the tests, and the words of command lines that name them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.radio = small_radio(folder / "radio")
        self.siglip = small_joint_model(folder / "siglip")
        for number in range(2):
            write_room(make_room(number, objects=3, views=3, width=96, height=72), folder / f"room_{number}")

    @property
    def teacher(self) -> tuple[str, ...]:
        return ("teacher=radio", f"teacher.model={self.radio}", "teacher.size=48", "teacher.device=cpu")

    @property
    def text(self) -> tuple[str, ...]:
        return ("text=transformers", f"text.model={self.siglip}")

    def room(self, number: int) -> str:
        return str(self.folder / f"room_{number}")


def run(*words: str) -> None:
    assert cli.main([*words, "quiet=true"]) == 0


def features_of(folder: Path) -> GaussianFeatures:
    (features,) = load_features(folder).features.values()
    return features


@pytest.fixture(scope="module", autouse=True)
def few_nouns() -> Iterator[None]:
    """Towers embed twenty reference nouns instead of four hundred."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsencoder.text.open_vocabulary.REFERENCE_NOUNS", REFERENCE_NOUNS[:20])
        yield


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def fused(world: World) -> Path:
    out = world.folder / "fused"
    basis = ("fusion.narrow=8", "fusion.max_rank=6")
    heads = "teacher.heads=[siglip, siglip.features,sam]"
    run("fuse", world.room(0), *world.teacher, heads, *basis, *SEEDS, f"out={out}")
    return out


@pytest.fixture(scope="module")
def trained(world: World) -> Path:
    out = world.folder / "encoder"
    basis = ("prepare.fusion.narrow=8", "prepare.fusion.max_rank=6")
    heads = ("heads=[siglip,sam]", "teacher.heads=siglip.features")
    scenes = (world.room(0), world.room(1), "holdout=room_1")
    assert cli.main(["train", *scenes, *world.teacher, *heads, *basis, *SEEDS, *QUICK, f"out={out}"]) == 0
    return out


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
        assert -1 <= head.fit.worst < head.fit.cosine < 1
        assert head.fit.cells == 3 * 4 * 6


def test_words_of_a_text_tower_are_compared_with_outputs_of_the_summary_head(
    world: World, fused: Path, tmp_path: Path
) -> None:
    run(
        "localize",
        str(fused),
        "head=siglip",
        f"query={WORDS}",
        *world.text,
        *EVERY_BOX,
        "pictures=1",
        f"out={tmp_path / 'b'}",
    )
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
    asked, table = queried_scene(scene, fused, head="siglip", text=config)
    made = localize(
        asked,
        ["mug"],
        table,
        LocalizeConfig(min_probability=0.0, threshold=ThresholdConfig(kind="quantile", quantile=0.9)),
    )
    np.testing.assert_allclose(made.relevancy[0][features.seen], cosines[features.seen], atol=1e-4)


def test_a_text_table_of_the_width_of_a_head_is_asked(
    fused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for channels in (16, 12):
        vectors = np.random.default_rng(0).normal(size=(3, channels)).astype(np.float32)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        save_text_table(tmp_path / f"w{channels}.safetensors", make_text_table(["mug", "bed", "lamp"], vectors, "own"))
    asked = ("localize", str(fused), "head=siglip", "query=mug", *EVERY_BOX, "pictures=0", f"out={tmp_path / 'b'}")
    line = refusal(capsys, *asked, f"words={tmp_path / 'w12.safetensors'}")
    assert "gives vectors of 16 channels, and the words of 'own' have 12" in line
    run(*asked, f"words={tmp_path / 'w16.safetensors'}")
    assert results_of(tmp_path / "b")["space"].endswith(" · own")


def test_training_stores_the_heads_of_its_loss_and_those_asked_for_besides(trained: Path) -> None:
    heads = load_heads(trained / "heads.safetensors")
    assert heads.names == ("siglip.summary", "sam.features", "siglip.features")
    assert list(results_of(trained)["heads"]) == list(heads.names)
    prepared = load_heads(trained.with_name("encoder.prepared") / "heads.safetensors")
    assert prepared.space == heads.space
    assert (trained / "log.csv").read_text().splitlines()[0].count("render") == 1


def test_encoded_features_carry_the_heads_of_the_weights(
    world: World, trained: Path, encoded: Path, tmp_path: Path
) -> None:
    assert (encoded / "heads.safetensors").read_bytes() == (trained / "heads.safetensors").read_bytes()
    run(
        "localize",
        str(encoded),
        "head=siglip",
        f"query={WORDS}",
        *world.text,
        *EVERY_BOX,
        "pictures=0",
        f"out={tmp_path / 'b'}",
    )
    assert results_of(tmp_path / "b")["boxes"]


@pytest.mark.parametrize(("source", "protocol"), [("weights", "localization"), ("fused", "naming")])
def test_outputs_of_a_head_are_evaluated(
    world: World, trained: Path, tmp_path: Path, source: str, protocol: str
) -> None:
    of = (f"weights={trained}",) if source == "weights" else world.teacher
    limits = ("protocol.min_views=1", "protocol.min_pixels=5") if protocol == "localization" else ()
    run(
        "evaluate",
        world.room(1),
        *of,
        "head=siglip",
        *world.text,
        *SEEDS,
        f"protocol={protocol}",
        *limits,
        f"out={tmp_path / 'e'}",
    )
    results = results_of(tmp_path / "e")
    assert results["objects" if protocol == "localization" else "names"]


def test_packed_outputs_of_a_head_are_asked_with_the_words_beside_them(
    world: World, encoded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    asked = ("head=siglip", "token_head=siglip.features", f"query={WORDS}", *world.text, *EVERY_BOX)
    through, space = tokens(*asked)
    assert (through.shape, space.split(" · ")[0]) == ((2, 20, 16), "radio-radio/siglip.features")


def test_a_training_goes_on_only_with_the_heads_that_it_began_with(
    world: World, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    basis = ("prepare.fusion.narrow=8", "prepare.fusion.max_rank=6")
    prepared = f"prepared={trained.with_name('encoder.prepared')}"
    scenes = (world.room(0), world.room(1), "holdout=room_1")
    begun = ["train", *scenes, *world.teacher, *basis, *SEEDS, *QUICK[1:], prepared, f"out={tmp_path / 'run'}"]
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


def test_an_exported_encoder_carries_its_heads(world: World, trained: Path, encoded: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    graph = tmp_path / "encoder.onnx"
    with symbolic_sizes():
        run("export", f"weights={trained}", "sizes=1,500", f"out={graph}")
    assert (
        load_heads(tmp_path / "encoder.onnx.heads.safetensors").names == load_heads(trained / "heads.safetensors").names
    )
    run("encode", world.room(1), f"weights={graph}", *SEEDS, f"out={tmp_path / 'encoded'}")
    assert (tmp_path / "encoded" / "heads.safetensors").read_bytes() == (encoded / "heads.safetensors").read_bytes()


def test_heads_of_another_backbone_are_refused(
    world: World, fused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "fused"
    shutil.copytree(fused, copy)
    other = small_radio(tmp_path / "radio", seed=5)
    teacher = [word.replace(str(world.radio), str(other)) for word in world.teacher]
    out = f"out={tmp_path / 'other'}"
    run("fuse", world.room(0), *teacher, "teacher.heads=siglip", *SEEDS, out)
    shutil.copyfile(tmp_path / "other" / "heads.safetensors", copy / "heads.safetensors")
    asked = ("localize", str(copy), "head=siglip", "query=mug", *world.text, f"out={tmp_path / 'x'}")
    line = refusal(capsys, *asked)
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
def test_a_head_that_words_cannot_be_compared_with_is_refused(
    world: World, fused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: Sequence[str], message: str
) -> None:
    text = world.text if any(word.startswith("head=") for word in words) else ()
    assert message in refusal(capsys, "localize", str(fused), *words, *text, f"out={tmp_path / 'x'}")


def test_words_of_another_model_are_refused_and_both_are_named(
    world: World, fused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("localize", str(fused), "head=siglip", "query=mug", f"out={tmp_path / 'x'}")
    assert (
        "no words lead into its space; give text=transformers text.model=FOLDER, the text side of ViT-SO400M-14-Sig"
        in (refusal(capsys, *asked))
    )
    wide = small_joint_model(tmp_path / "wide", channels=12)
    line = refusal(capsys, *asked, "text=transformers", f"text.model={wide}")
    assert (
        "head siglip.summary (ViT-SO400M-14-SigLIP-384) gives vectors of 16 channels, and the words of 'wide' have 12"
        in line
    )
    clip = small_joint_model(tmp_path / "clip", kind="clip")
    line = refusal(capsys, *asked, "text=transformers", f"text.model={clip}")
    assert "leads to a siglip model, and the words of 'clip' are those of a clip model" in line
    later = small_joint_model(tmp_path / "later", kind="siglip2")
    line = refusal(capsys, *asked, "text=transformers", f"text.model={later}")
    assert "leads to a siglip model, and the words of 'later' are those of a siglip2 model" in line


def test_features_without_heads_and_heads_without_features_are_refused(
    world: World, fused: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "fused"
    shutil.copytree(fused, copy)
    (copy / "heads.safetensors").unlink()
    asked = ("localize", str(copy), "head=siglip", "query=mug", *world.text, f"out={tmp_path / 'x'}")
    assert "head=siglip: there is no heads.safetensors in" in refusal(capsys, *asked)
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
        (
            ("heads=old/heads.safetensors",),
            "heads=old/heads.safetensors: expected names of the teacher's adapter heads",
        ),
        (("heads=dino_v2",), "dino_v2: there is no such adapter; config.json has sam, siglip"),
        (("heads=[siglip,siglip.summary]",), "heads: siglip, siglip.summary names a head twice"),
    ],
)
def test_heads_that_a_training_cannot_use_are_refused(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: Sequence[str], message: str
) -> None:
    teacher = () if any(word.startswith("teacher=") for word in words) else world.teacher
    out = f"out={tmp_path / 'run'}"
    assert message in refusal(capsys, "train", world.room(0), *teacher, *words, *SEEDS, *QUICK[1:], out)


def test_maps_that_are_not_finite_are_refused_before_heads_see_them(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(weights: dict[str, torch.Tensor], value: float) -> dict[str, torch.Tensor]:
        key = "radio_model.model.blocks.0.norm1.weight"
        return {**weights, key: torch.full_like(weights[key], value)}

    # Weights that are not finite, and finite ones whose outputs are not.
    cases = ((math.nan, "1 weights are not finite"), (torch.finfo(torch.float32).max, "features of view"))
    for value, message in cases:
        spoiled = tmp_path / message.replace(" ", "_")
        shutil.copytree(world.radio, spoiled)
        change_weights(spoiled, partial(change, value=value))
        teacher = [word.replace(str(world.radio), str(spoiled)) for word in world.teacher]
        line = refusal(capsys, "fuse", world.room(0), *teacher, "teacher.heads=siglip", *SEEDS, f"out={tmp_path / 'x'}")
        assert message in line


def test_a_siglip2_head_with_a_tower_that_keeps_capital_letters_warns(fused: Path, tmp_path: Path) -> None:
    folder = str(small_joint_model(tmp_path / "siglip2", kind="siglip2"))
    head = replace(find_head(load_heads(fused / "heads.safetensors"), "siglip").head, text="siglip2")
    with pytest.warns(SceneWarning, match="give text.lower=yes"):
        words_of_head(head, "", TransformersTextConfig(model=folder, lower="no"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        words_of_head(head, "", TransformersTextConfig(model=folder))
