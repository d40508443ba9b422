"""Small RADIO models with adapter heads that tests make, in the layout of the real releases, with random weights."""

import json
from pathlib import Path
from typing import Any

SMALL = {
    "hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2, "patch_size": 8, "image_size": 32,
    "max_img_size": 64, "num_cls_tokens": 2, "num_registers": 3,
}  # fmt: skip
TEACHERS = [
    {"type": "open_clip", "name": "siglip", "model": "ViT-SO400M-14-SigLIP-384"},
    {"type": "sam", "name": "sam", "model": "vit-h"},
]
OUTPUTS = {"siglip": 16, "sam": 10}


def small_radio(
    folder: Path,
    *,
    seed: int = 0,
    version: str = "v2",
    spatial_version: str | None = None,
    inner: int = 2,
    pre_norm: bool = False,
    teachers: Any = TEACHERS,
) -> Path:
    """A folder as NVlabs' releases are: backbone and heads in one safetensors file, config.json with `args`,
    `adaptor_configs` and an `auto_map`."""
    import torch
    import transformers
    from safetensors.torch import load_file, save_file

    torch.manual_seed(seed)
    with torch.no_grad():
        model = transformers.RadioModel(transformers.RadioConfig(**SMALL))
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.2)
    model.save_pretrained(folder)
    weights = load_file(folder / "model.safetensors")
    configs = {}
    for index, (name, outputs) in enumerate(OUTPUTS.items()):
        sizes = {"input_dim": SMALL["hidden_size"], "hidden_dim": 20, "output_dim": outputs, "num_inner": inner}
        configs[name] = {"head_idx": index, "summary": sizes, "feature": sizes}
        for module, form in (("head_mlp", version), ("feat_mlp", spatial_version or version)):
            weights |= head_weights(f"radio_model.adaptors.{name}.{module}.", form, sizes, pre_norm)
    # Real releases have no LayerScale.
    weights = {key: value for key, value in weights.items() if "layer_scale" not in key}
    save_file(
        {key: value.contiguous() for key, value in weights.items()}, folder / "model.safetensors", {"format": "pt"}
    )
    args: dict[str, Any] = {"mlp_version": version, "teachers": teachers}
    if spatial_version:
        args["spatial_mlp_version"] = spatial_version
    auto_map = {"AutoConfig": "hf_model.RADIOConfig", "AutoModel": "hf_model.RADIOModel"}
    change_config(folder, args=args, adaptor_configs=configs, adaptor_names=None, auto_map=auto_map)
    (folder / "hf_model.py").write_text("raise SystemExit('the code of a model folder was run')\n")
    return folder


def head_weights(prefix: str, version: str, sizes: dict[str, int], pre_norm: bool) -> dict[str, Any]:
    """Random weights of a head, by the keys that NVlabs' modules have."""
    import torch

    width, hidden, outputs = sizes["input_dim"], sizes["hidden_dim"], sizes["output_dim"]

    def linear(key: str, inputs: int, out: int) -> dict[str, Any]:
        weight = torch.randn(out, inputs) * (2 / inputs) ** 0.5
        return {f"{prefix}{key}.weight": weight, f"{prefix}{key}.bias": torch.randn(out) * 0.1}

    def norm(key: str, channels: int) -> dict[str, Any]:
        weight = 1 + 0.1 * torch.randn(channels)
        return {f"{prefix}{key}.weight": weight, f"{prefix}{key}.bias": torch.randn(channels) * 0.1}

    if version == "v1":
        weights = linear("fc1", width, hidden) | norm("norm", hidden) | linear("fc2", hidden, outputs)
        for number in range(sizes["num_inner"]):
            weights |= linear(f"inner.{3 * number}", hidden, hidden) | norm(f"inner.{3 * number + 1}", hidden)
        return weights
    weights = linear("fc1", width, hidden) | norm("final.0", hidden) | linear("final.2", hidden, outputs)
    for number in range(sizes["num_inner"]):
        weights |= norm(f"blocks.{number}.0", hidden) | linear(f"blocks.{number}.2", hidden, hidden)
    return weights | (norm("pre_norm.0", width) if pre_norm else {})


def change_config(folder: Path, **changes: Any) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, **changes}))


def change_weights(folder: Path, change: Any) -> None:
    """Writes what `change` makes of the dictionary of all weights."""
    from safetensors.torch import load_file, save_file

    weights = {key: value.contiguous() for key, value in change(load_file(folder / "model.safetensors")).items()}
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def small_joint_model(folder: Path, channels: int = OUTPUTS["siglip"], *, kind: str = "siglip") -> Path:
    """A random SigLIP, SigLIP2 or CLIP model with a tokenizer of letters, whose vectors have `channels` channels."""
    import torch
    import transformers

    torch.manual_seed(3)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    letters = ("<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *"abcdefghijklmnopqrstuvwxyz-")
    text = {**small, "vocab_size": len(letters), "max_position_embeddings": 32, "eos_token_id": 1, "bos_token_id": 2}
    vision = {**small, "patch_size": 4}
    if kind == "clip":
        text["projection_dim"] = channels
        config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=channels)
        model: Any = transformers.CLIPModel(config)
    else:
        text["projection_size"] = channels
        if kind == "siglip2":
            vision["num_patches"] = 4
            model = transformers.Siglip2Model(transformers.Siglip2Config(text_config=text, vision_config=vision))
        else:
            model = transformers.SiglipModel(transformers.SiglipConfig(text_config=text, vision_config=vision))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.3)
    model.save_pretrained(folder)
    vocabulary = {letter: row for row, letter in enumerate(letters)}
    tokenizer = transformers.Siglip2Tokenizer(vocab=vocabulary, merges=[], model_max_length=32)
    tokenizer.save_pretrained(folder)
    return folder
