"""RADIO through transformers: a small one with random weights, made, saved and loaded as a real one is."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from region_scenes import toy_words
from splats import front_camera

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.synthetic import make_room
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.types import Views

transformers = pytest.importorskip("transformers")

SMALL = {
    "hidden_size": 24,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "patch_size": 8,
    "image_size": 32,
    "max_img_size": 64,
    "num_cls_tokens": 2,
    "num_registers": 3,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import torch

    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("models") / "small_radio"
    transformers.RadioModel(transformers.RadioConfig(**SMALL)).save_pretrained(path)
    return path


def views(image: np.ndarray) -> Views:
    return Views(cameras=front_camera(image.shape[1], image.shape[0]), names=("a",), images=[image])


def picture(height: int = 30, width: int = 44) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_a_picture_becomes_a_grid_of_patch_features(folder: Path) -> None:
    teacher = RadioTeacher(RadioConfig(model=str(folder), size=48, device="cpu"))
    feature_map = teacher.feature_map(views(picture()), 0)
    assert feature_map.features is not None
    assert feature_map.features.shape == (4, 6, 24)
    np.testing.assert_allclose(feature_map.grid_from_image, [[6 / 44, 0, 0], [0, 4 / 30, 0]])
    assert np.array_equal(feature_map.features, teacher.feature_map(views(picture()), 0).features)


def test_its_features_are_those_of_the_model_without_summary_tokens(folder: Path) -> None:
    import torch

    image = picture(16, 24)
    teacher = RadioTeacher(RadioConfig(model=str(folder), size=24, device="cpu"))
    model = transformers.AutoModel.from_pretrained(folder).eval()
    pixels = torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1)[None]
    with torch.no_grad():
        everything = model(pixel_values=pixels).last_hidden_state[0]
    features = teacher.feature_map(views(image), 0).features
    assert features is not None
    np.testing.assert_allclose(features.reshape(-1, 24), everything[-6:].numpy(), rtol=1e-4, atol=1e-5)


def test_its_space_tells_weights_apart(folder: Path, tmp_path: Path) -> None:
    import torch

    torch.manual_seed(1)
    transformers.RadioModel(transformers.RadioConfig(**SMALL)).save_pretrained(tmp_path / "small_radio")
    one, other = (RadioTeacher(RadioConfig(model=str(path), size=48)) for path in (folder, tmp_path / "small_radio"))
    assert one.space.channels == 24
    assert one.space.name == other.space.name
    assert one.space != other.space
    assert one.settings() != other.settings()
    assert RadioTeacher(RadioConfig(model=str(folder), size=64)).settings() != one.settings()


def test_weights_in_half_precision_compute_in_float32(folder: Path, tmp_path: Path) -> None:
    half = tmp_path / "half"
    transformers.RadioModel.from_pretrained(folder).bfloat16().save_pretrained(half)
    rounded = tmp_path / "rounded"
    transformers.RadioModel.from_pretrained(half, dtype="float32").save_pretrained(rounded)
    views = make_room(1, views=1, width=96, height=72).views
    assert views is not None
    maps = [
        RadioTeacher(RadioConfig(model=str(path), size=48, device="cpu")).feature_map(views, 0)
        for path in (half, rounded)
    ]
    np.testing.assert_allclose(maps[0].features, maps[1].features, atol=1e-5)


def test_words_of_another_width_are_refused_before_anything_is_fused(folder: Path) -> None:
    scene = make_room(1, views=1, width=96, height=72)
    with pytest.raises(InputError, match="24"):
        build_teacher(RadioConfig(model=str(folder), size=48), scene, toy_words("mug", channels=8))


def test_it_is_found_by_name_among_the_models(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSENCODER_MODELS", str(folder.parent))
    assert RadioTeacher(RadioConfig(model="small_radio")).space.name == "radio-small_radio"


def spoil(folder: Path, **changes: Any) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, **changes}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("missing", "no folder at"),
        ("empty", "holds no model that transformers reads"),
        ("truncated", "holds no model that transformers reads"),
        ("other", "holds a clip_text_model model|holds no model|expected radio"),
    ],
)
def test_a_folder_that_holds_no_radio_is_refused(folder: Path, tmp_path: Path, change: str, message: str) -> None:
    path = tmp_path / "model"
    if change == "empty":
        path.mkdir()
    elif change != "missing":
        shutil.copytree(folder, path)
        if change == "truncated":
            weights = next(path.glob("*.safetensors"))
            weights.write_bytes(weights.read_bytes()[:1000])
        else:
            spoil(path, model_type="clip_text_model")
    with pytest.raises(InputError, match=message):
        RadioTeacher(RadioConfig(model=str(path)))


def without(weights: dict[str, Any], part: str) -> dict[str, Any]:
    return {name: value for name, value in weights.items() if part not in name}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: {f"student.{name}": value for name, value in w.items()}, r"\d+ are missing \(embeddings\."),
        (lambda w: without(w, "blocks.1.attn.qkv"), r"6 are missing \(encoder\.layer\.1\.attention\.k_proj"),
        (lambda w: {n: v[:1] if "norm1" in n else v for n, v in w.items()}, r"4 have other shapes than the config"),
        (None, r"\d+ belong to layers that the configuration does not have \(encoder\.layer\.1\."),
    ],
)
def test_weights_that_do_not_fit_the_configuration_are_refused_and_named(
    folder: Path, tmp_path: Path, change: Any, message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    from safetensors.torch import load_file, save_file

    path = tmp_path / "model"
    shutil.copytree(folder, path)
    if change is None:
        spoil(path, num_hidden_layers=1)
    else:
        weights = load_file(path / "model.safetensors")
        changed = {name: value.contiguous() for name, value in change(weights).items()}
        save_file(changed, path / "model.safetensors", {"format": "pt"})
    with pytest.raises(InputError, match=f"{path}: the weights do not fit the configuration: {message}"):
        RadioTeacher(RadioConfig(model=str(path)))
    assert capfd.readouterr() == ("", "")


def test_weights_beside_the_backbone_are_told_and_change_nothing(folder: Path, tmp_path: Path) -> None:
    import torch
    from safetensors.torch import load_file, save_file

    path = tmp_path / "model"
    shutil.copytree(folder, path)
    weights = load_file(path / "model.safetensors")
    save_file({**weights, "adaptors.clip.weight": torch.zeros(2)}, path / "model.safetensors", {"format": "pt"})
    with pytest.warns(SceneWarning, match=r"1 weights that are no part of the backbone are not used: adaptors\.clip"):
        teacher = RadioTeacher(RadioConfig(model=str(path), size=48, device="cpu"))
    plain = RadioTeacher(RadioConfig(model=str(folder), size=48, device="cpu"))
    one, other = (each.feature_map(views(picture()), 0).features for each in (teacher, plain))
    np.testing.assert_array_equal(one, other)


def test_a_model_that_is_not_named_and_a_size_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="teacher.model= is missing"):
        RadioTeacher(RadioConfig())
    with pytest.raises(InputError, match="size"):
        RadioConfig(size=0)


def test_a_scene_without_pictures_is_refused(folder: Path) -> None:
    teacher = RadioTeacher(RadioConfig(model=str(folder), size=48))
    with pytest.raises(InputError, match="no pictures"):
        teacher.feature_map(Views(cameras=front_camera(), names=("a",)), 0)
