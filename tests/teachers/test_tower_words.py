"""Words for the `transformers` teacher: which towers they are of, and the commands from a scene to boxes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import vision_towers
from command_runs import refusal
from splats import front_camera
from text_towers import save_tokenizer
from vision_towers import save_vision_tower

from gsencoder.app import main as cli
from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_features
from gsencoder.teachers.build import words_of
from gsencoder.teachers.tower import TransformersConfig
from gsencoder.text import vocabulary as open_vocabulary
from gsencoder.text.models import TransformersTextConfig
from gsencoder.text.table import load_text_table, save_text_table
from gsencoder.text.vocabulary import vocabulary_of, words_of_table
from gsencoder.types import GaussianFeatures, Scene, Views

transformers = pytest.importorskip("transformers")

SaveJoint = Callable[..., Path]
NOUNS = ("chair", "lamp", "mug", "red box", "table")
"""In the place of the 397 everyday nouns, which tiny models embed no faster than others."""
WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "wooden", *sorted(set(" ".join(NOUNS).split())))


@pytest.fixture
def save_joint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SaveJoint:
    """Writes a joint model, whose tokenizer knows a few nouns."""
    monkeypatch.setattr(open_vocabulary, "REFERENCE_NOUNS", NOUNS)
    monkeypatch.setattr(vision_towers, "TEXT", {**vision_towers.TEXT, "vocab_size": len(WORDS)})

    def save(kind: str, name: str = "joint") -> Path:
        folder = tmp_path / name
        save_vision_tower(kind, folder)
        save_tokenizer(folder / "tokenizer.json", WORDS)
        transformers.PreTrainedTokenizerFast(
            tokenizer_file=str(folder / "tokenizer.json"), pad_token="[PAD]", unk_token="[UNK]", model_max_length=12
        ).save_pretrained(folder)
        return folder

    return save


@pytest.mark.parametrize("kind", ["clip", "siglip"])
@pytest.mark.parametrize("dense", ["auto", "summary"])
def test_one_folder_gives_both_sides_of_a_joint_space(save_joint: SaveJoint, kind: str, dense: Any) -> None:
    folder = str(save_joint(kind))
    text = TransformersTextConfig(model=folder)
    config = TransformersConfig(model=folder, dense=dense)
    words = words_of(config, text)
    teacher = config.build(Scene(name="s"), words)
    assert teacher.space.text_encoder == words.space.text_encoder
    assert teacher.space.channels == words.space.channels


def test_a_summary_of_a_picture_of_one_patch_is_the_pictures_own(save_joint: SaveJoint) -> None:
    """So the joint space is the one in which the model itself compares pictures with text."""
    folder = save_joint("siglip")
    model = transformers.SiglipModel.from_pretrained(folder).eval()
    patch = vision_towers.picture(8, 8)
    config = TransformersConfig(model=str(folder), dense="summary", size=8, device="cpu")
    teacher = config.build(Scene(name="s"), None)
    made = teacher.feature_map(Views(cameras=front_camera(8, 8), names=("a",), images=[patch]), 0).features
    pixels = torch.from_numpy(patch.astype(np.float32)).permute(2, 0, 1)[None] / 127.5 - 1
    with torch.inference_mode():
        expected = model.get_image_features(pixel_values=pixels, interpolate_pos_encoding=True).pooler_output
    np.testing.assert_allclose(made[0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dense": "tokens"}, "no text tower shares the space of hidden states"),
        ({"layer": -2}, "no text tower shares the space of hidden states"),
        ({"words": "w.safetensors"}, "both say what words are"),
    ],
)
def test_a_tower_is_refused_for_vectors_that_it_does_not_speak_for(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        words_of(TransformersConfig(model="nowhere", **settings), TransformersTextConfig(model="nowhere"))


def test_a_text_tower_is_refused_for_a_vision_tower_without_a_joint_space(save_joint, models):
    teacher = TransformersConfig(model=str(models / "llava"))
    text = TransformersTextConfig(model=str(save_joint("clip")))
    with pytest.raises(InputError, match="no text tower shares the space of tokens after the final norm of llava"):
        teacher.build(Scene(name="s"), words_of(teacher, text))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "room"
    write_room(make_room(views=4, width=64, height=48, objects=2), folder)
    return folder


def features_of(folder: Path) -> GaussianFeatures:
    (features,) = load_features(folder).features.values()
    return features


@pytest.mark.slow
def test_a_scene_is_fused_and_words_are_localized_in_it(room, save_joint, tmp_path, capsys):
    model = save_joint("clip")
    out, boxes = tmp_path / "features", tmp_path / "boxes"
    fuse = ["fuse", str(room), "teacher=transformers", f"teacher.model={model}", "teacher.size=48"]
    fuse += ["seeds.voxel=0.1", "quiet=true"]
    assert cli.main([*fuse, "text=transformers", f"text.model={model}", f"out={out}"]) == 0
    features = features_of(out)
    assert features.space.channels == vision_towers.JOINT_CHANNELS
    assert features.space.layer == "values"
    assert features.seen.any()
    # A noun of the stored table needs no tower; a phrase beside it takes the tower that is given.
    assert cli.main(["localize", str(out), "query=mug", f"out={boxes}", "pictures=0", "quiet=true"]) == 0
    results = json.loads((boxes / "summary.json").read_text())["results"]
    assert "boxes" in results
    phrase = ["localize", str(out), "query=red wooden chair", "pictures=0", f"out={tmp_path / 'phrase'}"]
    assert "text tower" in refusal(capsys, *phrase)
    assert cli.main([*phrase, "text=transformers", f"text.model={model}", "quiet=true"]) == 0
    assert cli.main([*fuse, "teacher.dense=tokens", f"out={tmp_path / 'tokens'}"]) == 0
    assert features_of(tmp_path / "tokens").space.channels == vision_towers.SHAPE["hidden_size"]


@pytest.mark.parametrize(
    ("preset", "kind", "dense", "size"),
    [
        ("clip", "clip", "values", 448),
        ("siglip2", "siglip2", "summary", 512),
        ("dinov2", "dinov2_with_registers", "tokens", 518),
        ("dinov3", "dinov3", "tokens", 768),
        ("sam", "sam", "tokens", 1024),
    ],
)
def test_presets_state_what_a_kind_gives(tmp_path: Path, preset: str, kind: str, dense: str, size: int) -> None:
    save_vision_tower(kind, tmp_path / kind)
    config = compose("fuse", FuseCommandConfig, ("s", f"teacher={preset}", f"teacher.model={tmp_path / kind}")).teacher
    assert isinstance(config, TransformersConfig)
    assert (config.dense, config.size) == (dense, size)
    config = replace(config, size=vision_towers.SIDE)
    views = Views(cameras=front_camera(30, 20), names=("a",), images=[vision_towers.picture(20, 30)])
    features = config.build(Scene(name="s"), None).feature_map(views, 0).features
    assert features.shape[:2] == (3, 4)


def test_a_tower_that_was_told_to_lower_phrases_is_found_again(save_joint, monkeypatch, tmp_path):
    folder = save_joint("siglip", "models/joint")
    monkeypatch.setenv("GSENCODER_MODELS", str(folder.parent))
    for lower in ("yes", "no"):
        words = vocabulary_of(TransformersTextConfig(model=str(folder), lower=lower))  # type: ignore[arg-type]
        save_text_table(tmp_path / f"{lower}.safetensors", words.table)
        again = words_of_table(load_text_table(tmp_path / f"{lower}.safetensors"))
        np.testing.assert_array_equal(again.encode(["wooden mug"]), words.encode(["wooden mug"]))
