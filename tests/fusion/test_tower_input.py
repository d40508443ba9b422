"""The `transformers` teacher: its settings in its space, large pictures, and what is refused."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splats import front_camera
from vision_towers import LAYERS, SIDE, picture, save_vision_tower

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.fusion.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.types import Views

transformers = pytest.importorskip("transformers")

WIDE = picture(30, 60)
SIZE = 64
"""Twice the models' size: `WIDE` becomes 4 × 8 patches, two windows of theirs without an overlap."""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    for kind in ("clip", "dinov2", "dinov3", "sam", "llava"):
        save_vision_tower(kind, folder / kind)
    return folder


@pytest.fixture
def copied(models: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a model, to be spoiled."""

    def copy(kind: str) -> Path:
        return Path(shutil.copytree(models / kind, tmp_path / "model"))

    return copy


def views(*images: np.ndarray) -> Views:
    cameras = front_camera(images[0].shape[1], images[0].shape[0])
    return Views(cameras=cameras, names=("left.png",), images=list(images))


def teacher(folder: Path, **settings: Any) -> TransformersTeacher:
    return TransformersTeacher(TransformersConfig(model=str(folder), device="cpu", **settings))


def features(folder: Path, image: np.ndarray = WIDE, **settings: Any) -> np.ndarray:
    made = teacher(folder, **settings).feature_map(views(image), 0).features
    assert made is not None
    return made


def rewrite(path: Path, **changes: Any) -> None:
    stated = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in stated.items() if value is not None}))


def change_weights(folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    from safetensors.torch import load_file, save_file

    weights = change(load_file(folder / "model.safetensors"))
    made = {name: value.contiguous() for name, value in weights.items()}
    save_file(made, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(
    "changed",
    [
        {"size": 48},
        {"dense": "summary"},
        {"dense": "tokens"},
        {"layer": -2},
        {"layer": 1},
        {"large": "windows"},
        {"large": "windows", "overlap": 0.0},
    ],
)
def test_settings_that_change_a_map_change_its_space_and_the_settings(models: Path, changed: dict[str, Any]) -> None:
    given = {"size": SIZE, "large": "windows"} if "overlap" in changed else {"size": SIZE}
    one, other = teacher(models / "clip", **given), teacher(models / "clip", **{**given, **changed})
    maps = [each.feature_map(views(picture(60, 60)), 0).features for each in (one, other)]
    assert maps[0].shape != maps[1].shape or not np.allclose(*maps, atol=1e-3)
    assert one.space != other.space
    assert one.settings() != other.settings()


@pytest.mark.parametrize("change", [{"resample": 0}, {"image_mean": [0.5, 0.5, 0.5]}, {"do_rescale": False}])
def test_preprocessing_that_changes_a_map_changes_its_space_and_the_settings(
    models: Path, copied: Any, change: dict[str, Any]
) -> None:
    other = copied("clip")
    rewrite(other / "preprocessor_config.json", **change)
    teachers = [teacher(folder) for folder in (models / "clip", other)]
    maps = [each.feature_map(views(WIDE), 0).features for each in teachers]
    assert not np.allclose(*maps, atol=1e-3)
    assert teachers[0].space.preprocessing != teachers[1].space.preprocessing
    assert teachers[0].settings() != teachers[1].settings()


def test_what_changes_no_map_changes_no_settings(models: Path, copied: Any) -> None:
    other = copied("clip")
    rewrite(other / "preprocessor_config.json", size={"shortest_edge": 999}, do_center_crop=False)
    assert teacher(other).settings() == teacher(models / "clip", overlap=0.2).settings()


def test_other_weights_have_another_space(models: Path, tmp_path: Path) -> None:
    save_vision_tower("clip", tmp_path / "clip", seed=1)
    one, other = teacher(models / "clip"), teacher(tmp_path / "clip")
    assert one.space.name == other.space.name == "clip"
    assert one.space != other.space
    assert one.settings() != other.settings()


def test_old_and_new_files_state_the_preprocessing(models: Path, copied: Any) -> None:
    other = copied("clip")
    path = other / "preprocessor_config.json"
    stated = json.loads(path.read_text())
    # As CLIP's files were written before there was an option to rescale, and as processors of several parts write it.
    old = ("resample", "image_mean", "image_std", "do_normalize")
    path.write_text(json.dumps({name: stated[name] for name in old}))
    np.testing.assert_array_equal(features(other), features(models / "clip"))
    path.unlink()
    (other / "processor_config.json").write_text(json.dumps({"image_processor": stated}))
    np.testing.assert_array_equal(features(other), features(models / "clip"))


@pytest.mark.parametrize("kind", ["clip", "dinov2", "dinov3", "sam", "llava"])
def test_windows_over_a_picture_of_native_size_equal_the_single_pass(models: Path, kind: str) -> None:
    image = picture(50, 50)
    windows = features(models / kind, image, large="windows")
    np.testing.assert_array_equal(windows, features(models / kind, image))


@pytest.mark.parametrize("kind", ["clip", "dinov2", "dinov3", "sam"])
def test_windows_without_overlap_are_pictures_by_themselves(models: Path, kind: str) -> None:
    image = picture(SIDE, 2 * SIDE)
    windows = features(models / kind, image, size=2 * SIDE, large="windows", overlap=0.0)
    halves = [features(models / kind, half) for half in (image[:, :SIDE], image[:, SIDE:])]
    np.testing.assert_allclose(windows, np.concatenate(halves, axis=1), atol=1e-5)


def test_the_size_of_the_model_is_the_default(models: Path) -> None:
    assert features(models / "dinov2").shape == (2, 4, 16)
    assert features(models / "dinov2", size=SIZE).shape == (4, 8, 16)


@pytest.mark.parametrize("settings", [{}, {"large": "windows"}])
def test_values_that_are_not_finite_name_the_view(copied: Any, settings: dict[str, Any]) -> None:
    folder = copied("dinov2")
    # Finite weights whose outputs are not.
    huge = torch.full((16,), torch.finfo(torch.float32).max)
    change_weights(folder, lambda weights: {**weights, "layernorm.weight": huge, "layernorm.bias": huge.clone()})
    with pytest.raises(InputError, match="features of view 'left.png' are not finite"):
        features(folder, **settings)


def test_a_scene_without_pictures_is_refused(models: Path) -> None:
    with pytest.raises(InputError, match="teacher transformers: the scene has no pictures"):
        teacher(models / "dinov2").feature_map(Views(cameras=front_camera(), names=("a",)), 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": -1}, "size: expected 1 to 8192 pixels"),
        ({"overlap": 1.0}, "overlap: expected a share from 0 to 0.9"),
        ({"overlap": -0.1}, "overlap: expected a share"),
        ({"dense": "values", "layer": -2}, "layer: hidden states of a layer are dense=tokens"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TransformersConfig(**settings)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("clip", {"layer": LAYERS + 1}, r"layer: expected -4 to 3, as this CLIP tower has 3 layers, got 4"),
        ("clip", {"layer": -LAYERS - 2}, r"layer: expected -4 to 3"),
        ("dinov2", {"dense": "summary"}, "this DINOv2 tower has none; give dense=tokens"),
        ("sam", {"dense": "values"}, "this SAM tower has none"),
        ("llava", {"dense": "values"}, "this CLIP tower has none"),
        ("sam", {"size": 64}, "SAM takes pictures of up to 32 pixels, got 64; give large=windows"),
    ],
)
def test_what_a_tower_does_not_have_is_refused(models: Path, kind: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        teacher(models / kind, **settings)


def test_a_model_that_is_not_named_or_not_there_is_refused() -> None:
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
        # The code of these is in another library, whether that is installed or not.
        ({"model_type": "timm_wrapper"}, "holds no model that transformers reads: .*timm|holds a timm_wrapper model"),
        (
            {"model_type": "mine", "auto_map": {"AutoConfig": "mine.Config"}},
            "needs Python code of its own, which is never run|holds no model that transformers reads",
        ),
    ],
)
def test_models_of_other_kinds_are_refused_with_the_kinds_that_are_known(
    tmp_path: Path, config: dict[str, Any], message: str
) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=message) as raised:
        teacher(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_mean": None}, "does not state image_mean; take the file that belongs to the model"),
        ({"image_mean": None, "resample": None}, "does not state resample, image_mean"),
        ({"image_mean": [0.5, 0.5]}, "image_mean: expected three numbers, one a channel"),
        ({"image_std": [0.5, 0.5, 0.0]}, "image_std: expected three numbers above 0"),
        ({"image_std": [0.5, 0.5, float("inf")]}, "image_std: expected three numbers above 0"),
        ({"resample": 7}, "resample: expected a number from 0 to 5, got 7"),
        ({"resample": "bicubic"}, "resample: expected a number from 0 to 5"),
        ({"rescale_factor": 0}, "rescale_factor: expected a number above 0"),
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


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_a_folder_without_preprocessing_is_refused(copied: Any, text: str | None) -> None:
    path = copied("clip") / "preprocessor_config.json"
    path.unlink()
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=r"has no preprocessor_config\.json, which says how|cannot be read"):
        teacher(path.parent)


@pytest.mark.parametrize("kind", ["clip", "dinov2", "dinov3", "sam", "llava"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("missing", r"\d+ are missing"),
        ("reshaped", r"\d+ have other shapes than the configuration says"),
        ("surplus", r"\d+ belong to layers that the configuration does not have"),
    ],
)
def test_weights_that_do_not_fit_are_refused(copied: Any, kind: str, spoil: str, message: str) -> None:
    folder = copied(kind)
    last = f".{LAYERS - 1}." if kind != "sam" else f"vision_encoder.layers.{LAYERS - 1}."

    def change(weights: dict[str, Any]) -> dict[str, Any]:
        ours = [name for name in weights if last in name and "norm" in name and "language" not in name]
        assert ours
        if spoil == "missing":
            return {name: value for name, value in weights.items() if name not in ours}
        if spoil == "reshaped":
            return {name: value[:1] if name in ours else value for name, value in weights.items()}
        return {**weights, **{name.replace(last, last.replace("2", "7")): weights[name].clone() for name in ours}}

    change_weights(folder, change)
    with pytest.raises(InputError, match=f"the weights do not fit the configuration: {message}"):
        teacher(folder)


@pytest.mark.parametrize("kind", ["clip", "dinov2", "dinov3", "sam", "llava"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
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


@pytest.mark.parametrize("kind", ["dinov2", "llava"])
def test_files_of_weights_that_the_index_names_and_the_folder_lacks_are_named(copied: Any, kind: str) -> None:
    folder = copied(kind)
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


def test_of_a_vision_language_model_the_files_of_its_tower_alone_are_read(copied: Any) -> None:
    from safetensors.torch import load_file, save_file

    folder = copied("llava")
    expected = features(folder)
    weights = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    for name, part in (("model-1.safetensors", True), ("model-2.safetensors", False)):
        chosen = {key: value for key, value in weights.items() if ("vision_tower" in key) == part}
        save_file(chosen, folder / name, {"format": "pt"})
    one = teacher(folder).settings()
    save_file({"lm_head.weight": torch.zeros(3)}, folder / "model-2.safetensors", {"format": "pt"})
    np.testing.assert_array_equal(features(folder), expected)
    assert teacher(folder).settings() == one


def test_weights_beside_the_tower_are_reported_and_change_nothing(models: Path, copied: Any) -> None:
    folder = copied("dinov2")
    change_weights(folder, lambda weights: {**weights, "classifier.weight": torch.zeros(2)})
    with pytest.warns(SceneWarning, match=r"1 weights that are no part of the backbone are not used: classifier"):
        made = features(folder)
    np.testing.assert_array_equal(made, features(models / "dinov2"))


def test_the_section_of_a_processor_goes_before_a_file_of_its_own_as_in_the_library(models: Path, copied: Any) -> None:
    other = copied("clip")
    path = other / "preprocessor_config.json"
    stated = json.loads(path.read_text())
    (other / "processor_config.json").write_text(json.dumps({"image_processor": stated}))
    path.write_text(json.dumps({**stated, "image_mean": [0.1, 0.2, 0.3]}))
    np.testing.assert_array_equal(features(other), features(models / "clip"))


def test_pictures_that_are_not_normalized_have_their_values_as_they_are(copied: Any) -> None:
    plain = copied("clip")
    rewrite(plain / "preprocessor_config.json", do_normalize=False)
    first = features(plain)
    rewrite(plain / "preprocessor_config.json", do_normalize=True, image_mean=[0.0] * 3, image_std=[1.0] * 3)
    neutral = features(plain)
    np.testing.assert_array_equal(first, neutral)


def test_another_configuration_of_the_same_weights_has_another_space(models: Path, copied: Any) -> None:
    other = copied("dinov2")
    path = other / "config.json"
    stated = json.loads(path.read_text())
    path.write_text(json.dumps({**stated, "layer_norm_eps": 1e-3}))
    spaces = [TransformersTeacher(TransformersConfig(model=str(each))).space for each in (models / "dinov2", other)]
    assert spaces[0].weights != spaces[1].weights
