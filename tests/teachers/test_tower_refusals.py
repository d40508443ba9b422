"""Models, preprocessing and weights that the `transformers` teacher refuses."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from splats import front_camera
from vision_towers import LAYERS, change_weights, features, rewrite, teacher

from gsencoder.core.errors import InputError
from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.types import Views

pytest.importorskip("transformers")


@pytest.mark.parametrize("settings", [{}, {"large": "windows"}])
def test_values_that_are_not_finite_name_the_view(copied: Any, settings: dict[str, Any]) -> None:
    folder = copied("dinov2")
    # Finite weights whose outputs are not.
    huge = torch.full((16,), torch.finfo(torch.float32).max)
    change_weights(folder, lambda weights: {**weights, "layernorm.weight": huge, "layernorm.bias": huge.clone()})
    with pytest.raises(InputError, match="view 'left.png': 66 of 128 values are not finite"):
        features(folder, **settings)


def test_a_scene_without_pictures_is_refused(models: Path) -> None:
    with pytest.raises(InputError, match="teacher transformers: the scene has no pictures"):
        teacher(models / "dinov2").feature_map(Views(cameras=front_camera(), names=("a",)), 0)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("clip", {"layer": LAYERS + 1}, r"layer: expected -4 to 3, as this CLIP tower has 3 layers, got 4"),
        ("dinov2", {"dense": "summary"}, "this DINOv2 tower has none; give dense=tokens"),
        ("llava", {"dense": "values"}, "this CLIP tower has none"),
        ("sam", {"size": 64}, "SAM takes pictures of up to 32 pixels, got 64; give large=windows"),
    ],
)
def test_what_a_tower_does_not_have_is_refused(models: Path, kind: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        teacher(models / kind, **settings)


def test_settings_that_do_not_go_together_and_a_model_that_is_not_there_are_refused() -> None:
    with pytest.raises(InputError, match="layer: hidden states of a layer are dense=tokens"):
        TransformersConfig(dense="values", layer=-2)
    with pytest.raises(InputError, match="teacher.model= is missing: the folder of a vision model"):
        TransformersTeacher(TransformersConfig())
    with pytest.raises(InputError, match="teacher.model: no folder at nowhere"):
        TransformersTeacher(TransformersConfig(model="nowhere"))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"model_type": "bert"}, "holds a bert model; expected one of CLIP, SigLIP, .* or a vision-language model"),
        ({"model_type": "radio"}, "give teacher=radio for it"),
        ({"model_type": "qwen2_vl"}, r"holds a qwen2_vl model with a qwen2_vl\w* tower; expected one of CLIP"),
        (
            {"model_type": "mine", "auto_map": {"AutoConfig": "mine.Config"}},
            "needs Python code of its own, which is never run|holds no model that transformers reads",
        ),
    ],
)
def test_models_of_other_kinds_are_refused_with_the_kinds_that_are_known(tmp_path, config, message):
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=message) as raised:
        teacher(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_mean": None}, r".*three numbers as image_mean, .* \('image_mean'\); take the file"),
        ({"image_std": [0.5, 0.5, 0.0]}, "expected .*numbers out of range"),
        ({"resample": 9}, "expected a filter of Pillow as resample, .*9"),
        ({"rescale_factor": 0}, "expected .*numbers out of range"),
    ],
)
def test_preprocessing_that_cannot_be_used_is_refused(copied: Any, changes: dict[str, Any], message: str) -> None:
    folder = copied("clip")
    rewrite(folder / "preprocessor_config.json", **changes)
    with pytest.raises(InputError, match=f"preprocessor_config.json:? {message}"):
        teacher(folder)


def test_floats_are_resized_by_the_two_filters_that_there_are(copied: Any) -> None:
    folder = copied("dinov3")
    rewrite(folder / "preprocessor_config.json", resample=1)
    with pytest.raises(InputError, match=r"resample: expected 2 \(bilinear\) or 3 \(bicubic\), got 1"):
        teacher(folder)


@pytest.mark.parametrize("text", [None, "{"])
def test_a_folder_without_preprocessing_is_refused(copied: Any, text: str | None) -> None:
    path = copied("clip") / "preprocessor_config.json"
    path.unlink()
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=r"has no preprocessor_config\.json, which says how|cannot be read"):
        teacher(path.parent)


@pytest.mark.parametrize(("kind", "value"), [("clip", float("nan")), ("sam", float("inf")), ("llava", float("nan"))])
def test_weights_that_are_not_finite_are_refused_by_name(copied: Any, kind: str, value: float) -> None:
    folder = copied(kind)
    last = f".{LAYERS - 1}." if kind != "sam" else f"vision_encoder.layers.{LAYERS - 1}."
    broken: list[str] = []

    def change(weights: dict[str, Any]) -> dict[str, Any]:
        broken.append(
            next(name for name in weights if last in name and "norm" in name and not re.search("language|text", name))
        )
        weights[broken[0]].view(-1)[0] = value
        return weights

    change_weights(folder, change)
    with pytest.raises(InputError, match="1 weights are not finite .*; the files are damaged") as raised:
        teacher(folder)
    assert broken[0].rpartition("layer")[2] in str(raised.value)


def test_files_of_weights_that_the_index_names_and_the_folder_lacks_are_named(copied: Any) -> None:
    folder = copied("llava")
    files = {"a": "model.safetensors", "b": "model-00002-of-00002.safetensors"}
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": files}))
    with pytest.raises(InputError, match=r"1 of 2 files of weights .* are missing: model-00002-of-00002\.safetensors"):
        teacher(folder)


@pytest.mark.parametrize("kind", ["dinov2", "llava"])
def test_a_folder_without_weights_or_with_damaged_ones_is_refused(copied: Any, kind: str) -> None:
    path = copied(kind) / "model.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="holds no model that transformers reads"):
        teacher(path.parent)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(InputError, match="pointer of git-lfs"):
        teacher(path.parent)
    path.rename(path.with_name("pytorch_model.bin"))
    with pytest.raises(InputError, match="has no weights as safetensors, and files of pickles are not opened"):
        teacher(path.parent)


def test_a_clip_without_its_projection_is_damaged_and_a_vision_tower_alone_is_not(copied: Any) -> None:
    folder = copied("clip")
    change_weights(folder, lambda weights: {n: v for n, v in weights.items() if n != "visual_projection.weight"})
    with pytest.raises(InputError, match=r"1 are missing \(visual_projection\.weight\)"):
        teacher(folder)
    stated = json.loads((folder / "config.json").read_text())["vision_config"]
    (folder / "config.json").write_text(json.dumps({**stated, "model_type": "clip_vision_model"}))
    change_weights(folder, lambda weights: {n: v for n, v in weights.items() if n.startswith("vision_model.")})
    assert teacher(folder).space.layer == "tokens after the final norm"


def test_a_vision_language_model_without_its_tower_is_refused(copied: Any) -> None:
    folder = copied("llava")
    change_weights(folder, lambda weights: {n: v for n, v in weights.items() if "vision_tower" not in n})
    with pytest.raises(InputError, match=r"0 of its weights end in embeddings\.patch_embedding\.weight; expected one"):
        teacher(folder)
