"""RADIO through transformers: a small one with random weights, made, saved and loaded as a real one is."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from region_scenes import toy_words
from splats import front_camera

from gsencoder.core.errors import InputError
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
    assert feature_map.features.shape == (4, 6, 24)
    np.testing.assert_allclose(feature_map.grid_from_image, [[6 / 44, 0, 0], [0, 4 / 30, 0]])
    assert np.array_equal(feature_map.features, teacher.feature_map(views(picture()), 0).features)


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


def test_words_of_another_width_are_refused_before_anything_is_fused(folder: Path) -> None:
    scene = make_room(1, views=1, width=96, height=72)
    with pytest.raises(InputError, match="24"):
        build_teacher(RadioConfig(model=str(folder), size=48), scene, toy_words("mug", channels=8))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("truncated", "holds no model that transformers reads"),
        ("other", "holds a clip_text_model model|holds no model|expected radio"),
    ],
)
def test_a_folder_that_holds_no_radio_is_refused(folder: Path, tmp_path: Path, change: str, message: str) -> None:
    path = tmp_path / "model"
    shutil.copytree(folder, path)
    if change == "truncated":
        weights = next(path.glob("*.safetensors"))
        weights.write_bytes(weights.read_bytes()[:1000])
    else:
        config = json.loads((path / "config.json").read_text())
        (path / "config.json").write_text(json.dumps({**config, "model_type": "clip_text_model"}))
    with pytest.raises(InputError, match=message):
        RadioTeacher(RadioConfig(model=str(path)))


def test_a_model_that_is_not_named_and_a_size_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="teacher.model= is missing"):
        RadioTeacher(RadioConfig())
    with pytest.raises(InputError, match="size"):
        RadioConfig(size=0)


def test_a_scene_without_pictures_is_refused(folder: Path) -> None:
    teacher = RadioTeacher(RadioConfig(model=str(folder), size=48))
    with pytest.raises(InputError, match="no pictures"):
        teacher.feature_map(Views(cameras=front_camera(), names=("a",)), 0)
