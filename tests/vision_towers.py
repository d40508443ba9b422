"""Small random vision towers of the true architectures, saved with their preprocessing as transformers reads it."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from splats import front_camera

from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.types import Views

SIDE, PATCH = 32, 8
"""Pixels along the pictures that the models are made for, and along a patch."""
LAYERS = 3
SHAPE: dict[str, Any] = {"hidden_size": 16, "num_hidden_layers": LAYERS, "num_attention_heads": 2}
SMALL = {**SHAPE, "intermediate_size": 24}
VISION = {**SMALL, "image_size": SIDE, "patch_size": PATCH}
TEXT = {**SMALL, "vocab_size": 40, "max_position_embeddings": 12, "eos_token_id": 3, "bos_token_id": 2}
LLAMA = {"model_type": "llama", **SMALL, "vocab_size": 40, "pad_token_id": 0}
JOINT_CHANNELS = 10
SAM_CHANNELS = 12


SIGLIP = {"model_type": "siglip_vision_model", "vision_use_head": False, **VISION}
GEMMA = {**SMALL, "vocab_size": 40, "num_key_value_heads": 1, "head_dim": 8}


def model(kind: str, **settings: Any) -> Any:
    """A model of the library by the first part of its classes' names; of those that speak, the whole."""
    whole = getattr(transformers, f"{kind}ForConditionalGeneration", None)
    return (whole or getattr(transformers, f"{kind}Model"))(getattr(transformers, f"{kind}Config")(**settings))


def clip() -> Any:
    joint = {"projection_dim": JOINT_CHANNELS}
    return model("CLIP", text_config={**TEXT, **joint}, vision_config={**VISION, **joint}, **joint)


def siglip2() -> Any:
    vision = {**SMALL, "num_patches": (SIDE // PATCH) ** 2, "patch_size": PATCH}
    return model("Siglip2", text_config={**TEXT, "projection_size": 16}, vision_config=vision)


def dinov2(kind: str = "Dinov2", **settings: int) -> Any:
    return model(kind, **SHAPE, image_size=SIDE, patch_size=PATCH, mlp_ratio=2, **settings)


def sam() -> Any:
    vision = {
        **SHAPE, "image_size": SIDE, "patch_size": PATCH, "window_size": 3, "global_attn_indexes": [1],
        "output_channels": SAM_CHANNELS, "mlp_dim": 24,
    }  # fmt: skip
    prompts = {"hidden_size": 16, "image_size": SIDE, "patch_size": PATCH, "image_embedding_size": SIDE // PATCH}
    masks = {"hidden_size": 16, "num_attention_heads": 2, "mlp_dim": 16}
    return model("Sam", vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=masks)


def gemma3() -> Any:
    tokens = {"mm_tokens_per_image": 4, "image_token_index": 3, "boi_token_index": 4, "eoi_token_index": 5}
    return model("Gemma3", vision_config=SIGLIP, text_config={"model_type": "gemma3_text", **GEMMA}, **tokens)


def llava() -> Any:
    vision = {"model_type": "clip_vision_model", **VISION}
    return model("Llava", vision_config=vision, text_config=LLAMA, image_token_index=3)


def idefics3(kind: str = "Idefics3") -> Any:
    return model(kind, vision_config=VISION, text_config=LLAMA, image_token_id=3, pad_token_id=0)


MAKERS: Mapping[str, Callable[[], Any]] = {
    "clip": clip,
    "siglip": lambda: model("Siglip", text_config={**TEXT, "projection_size": 16}, vision_config=VISION),
    "siglip2": siglip2,
    "dinov2": dinov2,
    "dinov2_with_registers": lambda: dinov2("Dinov2WithRegisters", num_register_tokens=3),
    "dinov3": lambda: model("DINOv3ViT", **VISION, num_register_tokens=2),
    "sam": sam,
    "llava": llava,
    "paligemma": lambda: model(
        "PaliGemma", vision_config=SIGLIP, text_config={"model_type": "gemma", **GEMMA}, image_token_index=3
    ),
    "gemma3": gemma3,
    "idefics3": idefics3,
    "smolvlm": lambda: idefics3("SmolVLM"),
}


def processor_of(kind: str) -> Any:
    """The library's own preprocessing; of DINOv3 it needs torchvision, so here it is nothing but a file."""
    square = {"height": SIDE, "width": SIDE}
    if kind in ("clip", "llava"):
        return transformers.CLIPImageProcessorPil(size={"shortest_edge": SIDE}, crop_size=square)
    if kind.startswith("dinov2"):
        mean, std = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
        return transformers.BitImageProcessorPil(
            size={"shortest_edge": SIDE}, crop_size=square, image_mean=mean, image_std=std
        )
    if kind == "siglip2":
        return transformers.Siglip2ImageProcessorPil(patch_size=PATCH, max_num_patches=(SIDE // PATCH) ** 2)
    if kind == "sam":
        return transformers.SamImageProcessorPil(size={"longest_edge": SIDE}, pad_size=square)
    if kind in ("idefics3", "smolvlm"):
        return transformers.SiglipImageProcessorPil(size=square, resample=1)
    return transformers.SiglipImageProcessorPil(size=square)


def save_preprocessing(kind: str, folder: Path) -> None:
    if kind != "dinov3":
        processor_of(kind).save_pretrained(folder)
        return
    stated = {
        "image_processor_type": "DINOv3ViTImageProcessorFast", "do_normalize": True, "do_rescale": True,
        "do_resize": True, "image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225],
        "resample": 2, "rescale_factor": 0.00392156862745098, "size": {"height": SIDE, "width": SIDE},
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(stated))


def save_vision_tower(kind: str, folder: Path, seed: int = 0) -> Any:
    """Writes a random model with its preprocessing. No weight is zero or one, as some would be before a training."""
    torch.manual_seed(seed)
    model = MAKERS[kind]().eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(std=0.3)
        model.tie_weights()
    model.save_pretrained(folder)
    save_preprocessing(kind, folder)
    return model


def tower_of(model: Any) -> Any:
    """The vision tower within a model of the library."""
    inner = getattr(model, "model", model)
    for name in ("vision_tower", "vision_model", "vision_encoder"):
        if hasattr(inner, name):
            return getattr(inner, name)
    return model


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


WIDE = picture(30, 60)


def views(*images: np.ndarray) -> Views:
    cameras = front_camera(images[0].shape[1], images[0].shape[0])
    return Views(cameras=cameras, names=("left.png",), images=list(images))


def teacher(folder: Path, **settings: Any) -> TransformersTeacher:
    return TransformersTeacher(TransformersConfig(model=str(folder), device="cpu", **settings))


def features(folder: Path, image: np.ndarray = WIDE, **settings: Any) -> np.ndarray:
    return teacher(folder, **settings).feature_map(views(image), 0).features


def rewrite(path: Path, **changes: Any) -> None:
    stated = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in stated.items() if value is not None}))


def change_weights(folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    from safetensors.torch import load_file, save_file

    weights = change(load_file(folder / "model.safetensors"))
    made = {name: value.contiguous() for name, value in weights.items()}
    save_file(made, folder / "model.safetensors", {"format": "pt"})
