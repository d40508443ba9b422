"""The maps of the `transformers` teacher are those of the library: its own model class on its own preprocessing."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splats import front_camera
from vision_towers import LAYERS, MAKERS, PATCH, SIDE, picture, processor_of, save_vision_tower, tower_of

from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher, VisionTower, tower_in
from gsencoder.types import FeatureMap, Views

transformers = pytest.importorskip("transformers")

Save = Callable[[str], tuple[Path, Any]]
SQUARE = (picture(40, 40), SIDE, (4, 4))
"""A picture, the size that is asked for, and rows and columns of its map."""
WIDE = (picture(30, 44), 48, (4, 6))
SMALL_WIDE = (picture(30, 40), SIDE, (3, 4))
JOINT = ("clip", "siglip", "siglip2")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Save:
    models: dict[str, tuple[Path, Any]] = {}

    def save(kind: str) -> tuple[Path, Any]:
        if kind not in models:
            folder = tmp_path_factory.mktemp("models") / kind
            models[kind] = (folder, save_vision_tower(kind, folder))
        return models[kind]

    return save


def map_of(folder: Path, image: np.ndarray, **settings: Any) -> FeatureMap:
    teacher = TransformersTeacher(TransformersConfig(model=str(folder), device="cpu", **settings))
    views = Views(cameras=front_camera(image.shape[1], image.shape[0]), names=("a",), images=[image])
    return teacher.feature_map(views, 0)


def features_of(folder: Path, image: np.ndarray, **settings: Any) -> np.ndarray:
    return map_of(folder, image, **settings).features


def inputs_of(kind: str, image: np.ndarray, grid: tuple[int, int]) -> dict[str, torch.Tensor]:
    """What the library's preprocessing gives: by itself for a square picture, else resized to the grid's shape."""
    height, width = grid[0] * PATCH, grid[1] * PATCH
    if kind == "dinov3":
        values = torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] / 255
        values = torch.nn.functional.interpolate(values, (height, width), mode="bilinear", antialias=True)
        mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[:, None, :, None, None]
        return {"pixel_values": (values - mean) / std}
    processor = processor_of(kind)
    if kind == "siglip2":
        processor.max_num_patches = 30  # more than there are: the library fills up, and masks what is filled
        processor.do_resize = grid[0] == grid[1]
        if not processor.do_resize:
            image = np.asarray(transformers.image_transforms.to_pil_image(image).resize((width, height), 2))
        else:
            processor.max_num_patches = grid[0] * grid[1]
        return dict(processor(images=image, return_tensors="pt"))
    options: dict[str, Any] = {}
    if image.shape[0] != image.shape[1] and kind != "sam":
        options = {"size": {"height": height, "width": width}, "do_center_crop": False}
    return {"pixel_values": processor(images=image, return_tensors="pt", **options)["pixel_values"]}


def options_of(kind: str) -> dict[str, Any]:
    return {"interpolate_pos_encoding": True} if kind in ("clip", "siglip", "llava", "paligemma", "gemma3") else {}


def direct(kind: str, model: Any, image: np.ndarray, grid: tuple[int, int], layer: int | None = None) -> np.ndarray:
    """Hidden states of patches by the library."""
    tower, (rows, columns) = tower_of(model), grid
    inputs = inputs_of(kind, image, grid)
    with torch.inference_mode():
        outputs = tower(**inputs, **options_of(kind), output_hidden_states=True)
        if layer is not None:
            tokens = outputs.hidden_states[layer]
        elif kind in ("clip", "llava"):
            tokens = tower.post_layernorm(outputs.last_hidden_state)
        else:
            tokens = outputs.last_hidden_state
    if kind == "sam":
        cells = tokens[0] if layer is not None else tokens[0].permute(1, 2, 0)
        return np.asarray(cells[:rows, :columns])
    first = {"clip": 1, "llava": 1, "dinov2": 1, "dinov2_with_registers": 4, "dinov3": 3}.get(kind, 0)
    return np.asarray(tokens[0, first : first + rows * columns].reshape(rows, columns, -1))


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("wide", [False, True])
def test_hidden_states_equal_a_direct_call_of_the_library(saved: Save, kind: str, wide: bool) -> None:
    folder, model = saved(kind)
    image, size, grid = (SMALL_WIDE if kind == "sam" else WIDE) if wide else SQUARE
    made = map_of(folder, image, dense="tokens", size=size if wide else 0)
    assert made.features.shape[:2] == grid
    np.testing.assert_allclose(made.features, direct(kind, model, image, grid), atol=1e-5)
    height, width = image.shape[:2]
    np.testing.assert_allclose(made.grid_from_image, [[grid[1] / width, 0, 0], [0, grid[0] / height, 0]])


@pytest.mark.parametrize("kind", MAKERS)
def test_hidden_states_of_a_layer_are_counted_as_the_library_counts_them(saved: Save, kind: str) -> None:
    folder, model = saved(kind)
    image, _, grid = SQUARE
    states = [features_of(folder, image, layer=layer) for layer in (-2, LAYERS - 1, -1)]
    np.testing.assert_allclose(states[0], direct(kind, model, image, grid, layer=-2), atol=1e-5)
    np.testing.assert_allclose(states[2], direct(kind, model, image, grid, layer=-1), atol=1e-5)
    np.testing.assert_array_equal(states[0], states[1])
    assert not np.allclose(states[0], states[2], atol=1e-2)


def last_layer_input(tower: Any, inputs: dict[str, torch.Tensor], kind: str) -> torch.Tensor:
    """By a hook, and not by the hidden states that the library lists."""
    seen: list[torch.Tensor] = []
    hook = tower.encoder.layers[-1].register_forward_pre_hook(
        lambda _, args, kwargs: seen.append(args[0] if args else kwargs["hidden_states"]), with_kwargs=True
    )
    tower(**inputs, **options_of(kind))
    hook.remove()
    return seen[0]


def head_of(kind: str, model: Any, token: torch.Tensor) -> torch.Tensor:
    """The head that the library applies to the summary of a picture, on one normed token."""
    return model.visual_projection(token) if kind == "clip" else model.vision_model.head(token[None, None])[0]


@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize("wide", [False, True])
def test_the_summary_head_is_applied_to_each_patch_alone(saved: Save, kind: str, wide: bool) -> None:
    folder, model = saved(kind)
    image, size, grid = WIDE if wide else SQUARE
    tokens = torch.from_numpy(direct(kind, model, image, grid)).flatten(0, 1)
    with torch.inference_mode():
        expected = torch.stack([head_of(kind, model, token) for token in tokens])
    made = features_of(folder, image, dense="summary", size=size if wide else 0)
    np.testing.assert_allclose(made.reshape(len(expected), -1), expected, atol=1e-5)


@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize("wide", [False, True])
def test_values_are_what_the_last_attention_gives_a_patch_that_sees_itself_alone(saved, kind, wide):
    folder, model = saved(kind)
    image, size, grid = WIDE if wide else SQUARE
    tower = model.vision_model
    with torch.inference_mode():
        last = tower.encoder.layers[-1]
        entering = last_layer_input(tower, inputs_of(kind, image, grid), kind)[0]
        patches = entering[1:] if kind == "clip" else entering[: grid[0] * grid[1]]
        expected = []
        for patch in patches:
            alone, _ = last.self_attn(last.layer_norm1(patch[None, None]), attention_mask=None)
            expected.append(head_of(kind, model, tower.post_layernorm(alone[0, 0])))
    made = features_of(folder, image, dense="values", size=size if wide else 0)
    np.testing.assert_allclose(made.reshape(len(expected), -1), torch.stack(expected), atol=1e-5)


@pytest.mark.parametrize(("kind", "decided"), [("clip", "values"), ("siglip", "summary"), ("siglip2", "summary")])
def test_text_aligned_towers_give_the_joint_space_unless_told_otherwise(saved: Save, kind: str, decided: str) -> None:
    folder, _ = saved(kind)
    made, stated = map_of(folder, SQUARE[0]), map_of(folder, SQUARE[0], dense=decided)
    assert made.space == stated.space
    assert made.space.layer == decided
    np.testing.assert_array_equal(made.features, stated.features)


@pytest.mark.parametrize("kind", ["dinov2", "sam", "llava", "paligemma"])
def test_towers_without_a_head_give_tokens(saved: Save, kind: str) -> None:
    assert map_of(saved(kind)[0], SQUARE[0]).space.layer == "tokens after the final norm"


@pytest.mark.parametrize(
    ("kind", "loader"),
    [
        ("clip", "CLIPVisionModelWithProjection"),
        ("siglip", "SiglipVisionModel"),
        ("siglip2", "Siglip2VisionModel"),
        ("sam", "SamVisionModel"),
    ],
)
def test_a_folder_of_the_vision_tower_alone_gives_the_same_map(saved, kind, loader, tmp_path):
    folder, _ = saved(kind)
    getattr(transformers, loader).from_pretrained(folder).save_pretrained(tmp_path)
    (tmp_path / "preprocessor_config.json").write_bytes((folder / "preprocessor_config.json").read_bytes())
    np.testing.assert_array_equal(features_of(tmp_path, SQUARE[0]), features_of(folder, SQUARE[0]))


def test_weights_in_half_precision_compute_in_float32(saved: Save, tmp_path: Path) -> None:
    folder, _ = saved("dinov2")
    half = transformers.Dinov2Model.from_pretrained(folder).to(torch.bfloat16)
    half.save_pretrained(tmp_path)
    (tmp_path / "preprocessor_config.json").write_bytes((folder / "preprocessor_config.json").read_bytes())
    expected = direct("dinov2", half.float(), SQUARE[0], SQUARE[2])
    np.testing.assert_allclose(features_of(tmp_path, SQUARE[0]), expected, atol=1e-5)


def test_the_layout_of_published_llava_weights_is_read(saved: Save, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder, _ = saved("llava")
    for path in folder.iterdir():
        if path.suffix == ".json":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    weights = load_file(folder / "model.safetensors")
    old = {name.replace("vision_tower.", "vision_tower.vision_model."): value for name, value in weights.items()}
    save_file(old, tmp_path / "model.safetensors", {"format": "pt"})
    np.testing.assert_array_equal(features_of(tmp_path, SQUARE[0]), features_of(folder, SQUARE[0]))


@pytest.mark.parametrize("kind", ["clip", "siglip2", "dinov3", "sam"])
def test_a_tower_in_bfloat16_stays_near_the_one_in_float32(saved: Save, kind: str) -> None:
    """As on a GPU, where it runs under autocast."""
    folder, _ = saved(kind)
    network = VisionTower(folder, tower_in(folder), "auto", None)
    pixels = torch.randn(1, 3, SIDE, SIDE - PATCH, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        exact = network(pixels)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network(pixels)
    assert exact.dtype == rounded.dtype == torch.float32
    assert 0 < (rounded - exact).norm() / exact.norm() < 0.05
