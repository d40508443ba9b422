"""The `radio` teacher: RADIO's backbone features through transformers, and its adapter heads (SplatDistill sec. 3.2).

An adapter NAME has a summary head and a feature head: NAME.summary and NAME.features say which. NAME alone is the head
that is meant most often: the summary head of adapters whose model has a text side (CLIP, SigLIP, SigLIP2), since its
outputs are compared with words, else the feature head.

transformers loads the backbone alone. The heads lie in the same files, under `radio_model.adaptors.NAME.head_mlp`
(summary) and `.feat_mlp` (features); `config.json` states their sizes in `adaptor_configs` and their form in
`args.mlp_version` and `args.spatial_mlp_version`.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, error_prefix, listed
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import digest_files, find_file, load_pretrained, read_config, read_weights, weight_names
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.teachers.base import (
    Head,
    Part,
    Residual,
    Teacher,
    TeacherSettings,
    check_channels,
    default_part,
    split_name,
    text_encoder_of,
    text_kind,
)
from gsencoder.teachers.pictures import Preprocessing, TorchTeacher
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureSpace, Scene

LABEL = "teacher radio"
ADAPTERS = "radio_model.adaptors."
"""The prefix of the keys of adapter heads in files of weights."""
PICKLED = (".tar", ".pth", ".pt", ".bin", ".ckpt")
"""Endings of files that are opened by unpickling them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioConfig(TeacherSettings):
    """Which RADIO, and how pictures are given to it."""

    has_heads = True

    name: Literal["radio"] = "radio"
    model: str = option("", "folder of a RADIO model for transformers; also looked for in GSENCODER_MODELS")
    size: int = option(768, "longer side of the resized picture in pixels", ge=1, le=2048)
    words: str = option("", "text table of the teacher's space; empty if none")
    heads: tuple[str, ...] = option(
        (),
        "adapter heads that are stored with the features, such as siglip or sam: NAME.summary, "
        "NAME.features, or NAME for the one that is meant most often",
        names=True,
    )
    device: Device = option("auto", "where the backbone runs")

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        teacher = RadioTeacher(self, text_encoder=text_encoder_of(words))
        check_channels(teacher.space, words)
        return teacher

    @property
    def stored_heads(self) -> tuple[str, ...]:
        return self.heads

    def read_heads(self, names: Sequence[str], option: str = "heads") -> list[Head]:  # noqa: ARG002
        if not names:
            return []
        folder = radio_folder(self)
        return read_radio_heads(folder, names, check_radio(folder))

    def refuse_text(self) -> str:
        return (
            "text=: no text tower speaks for the features of RADIO's backbone; leave out text= here, and give it "
            "where an adapter head is asked: localize head=siglip text=…"
        )


class RadioNetwork(nn.Module):
    """The patch features of RADIO's backbone."""

    def __init__(self, folder: Path) -> None:
        from transformers import AutoModel

        super().__init__()
        self._model = load_pretrained(AutoModel, folder, LABEL, ignored=(ADAPTERS,))
        self.patch, self.channels = int(self._model.config.patch_size), int(self._model.config.hidden_size)

    def forward(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """One vector a patch, float32, of a picture in [0, 1]."""
        rows, columns = pixels.shape[2] // self.patch, pixels.shape[3] // self.patch
        features: Tensor = self._model(pixel_values=pixels).features[0]
        return features.float().reshape(rows, columns, -1)


class RadioTeacher(TorchTeacher):
    """The backbone's patch features as they are: adapter heads lead from them into other spaces."""

    subject = LABEL
    preprocessing = Preprocessing()

    def __init__(self, config: RadioConfig, *, text_encoder: str = "") -> None:
        """Loads the model from its folder; nothing is fetched from anywhere."""
        folder = radio_folder(config)
        check_radio(folder)
        self.device, self.size = choose_device(config.device).type, config.size
        self.network = network = RadioNetwork(folder).to(self.device)
        self.space = FeatureSpace(
            name=f"radio-{folder.resolve().name}",
            channels=network.channels,
            teacher="radio",
            weights=digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("config.json")])),
            layer="features",
            preprocessing=f"resized to {config.size} px in multiples of {network.patch}",
            text_encoder=text_encoder,
        )


def radio_folder(config: RadioConfig) -> Path:
    """The folder of a RADIO model; InputError where none is named, or a file is."""
    if not config.model:
        raise InputError("teacher.model= is missing: the folder of a RADIO model")
    if config.model.lower().endswith(PICKLED) or Path(config.model).is_file():
        raise InputError(
            f"{LABEL}: teacher.model={config.model} is a file, and files of pickles, such as .pth.tar, are never "
            "opened; give the folder of the Hugging Face release, with config.json and safetensors"
        )
    return find_file(config.model, "teacher.model", folder=True)


def check_radio(folder: Path) -> int:
    """Checks that a folder states that it holds a RADIO model; returns the channels of its backbone."""
    model_config = read_config(folder, LABEL)
    if model_config.model_type != "radio":
        raise InputError(f"{LABEL}: {folder} holds a {model_config.model_type} model, expected radio")
    return int(model_config.hidden_size)


NORMALIZER = "radio_model.feature_normalizer."
MODULES: Mapping[Part, str] = {"summary": "head_mlp", "features": "feat_mlp"}
SECTIONS: Mapping[Part, str] = {"summary": "summary", "features": "feature"}
"""Names of a head's part in the keys of the weights, and in the configuration."""
SIZES = ("input_dim", "hidden_dim", "output_dim", "num_inner")
VERSIONS = ("v1", "v2")
MAX_SIZE = 1 << 16


def read_radio_heads(folder: Path, names: Sequence[str], channels: int) -> list[Head]:
    """Reads adapter heads of a RADIO model, each once; no code of the folder is run.

    Args:
        folder: with config.json and safetensors.
        names: of heads: NAME, NAME.summary or NAME.features.
        channels: D of the backbone.
    """
    files = weight_names(folder, LABEL)
    with error_prefix(f"heads of {folder}"):
        config = _read_config(folder)
        heads = [_read_head(folder, files, config, name, channels) for name in names]
    return list({head.name: head for head in heads}.values())


def _read_config(folder: Path) -> dict[str, Any]:
    try:
        config = json.loads(read_foreign_text(folder / "config.json"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"config.json cannot be read: {error}") from error
    if not isinstance(config, dict) or not isinstance(config.get("adaptor_configs"), dict):
        raise InputError("config.json has no adaptor_configs: the folder was written without adapter heads")
    return config


def _read_head(folder: Path, files: Mapping[str, Path], config: Mapping[str, Any], name: str, channels: int) -> Head:
    adapters: dict[str, Any] = config["adaptor_configs"]
    adapter, part = split_name(name, adapters)
    if adapter not in adapters:
        raise InputError(f"{name}: there is no such adapter; config.json has {listed(sorted(adapters)) or 'none'}")
    if any(key.startswith(NORMALIZER) for key in files):
        raise InputError(
            f"{name}: the folder has a feature normalizer, which transformers does not apply; heads would be given "
            "other features than they were trained on"
        )
    args = config.get("args")
    args = args if isinstance(args, dict) else {}
    teacher = _teacher_of(args, adapters[adapter], adapter)
    type_and_model = " ".join(str(teacher.get(key, "")) for key in ("type", "model")).strip()
    kind = text_kind(type_and_model, adapter)
    part = part or default_part(kind)
    full = f"{adapter}.{part}"
    with error_prefix(full):
        version = _version(args, part)
        sizes = _sizes(adapters[adapter], part)
        if sizes["input_dim"] != channels:
            raise InputError(
                f"takes {sizes['input_dim']} channels and the backbone has {channels}: a head of another backbone"
            )
        prefix = f"{ADAPTERS}{adapter}.{MODULES[part]}."
        body = _make_body(read_weights(files, prefix, folder, LABEL), prefix, version, sizes)
    return Head(name=full, body=body.requires_grad_(False).eval(), text=kind, model=str(teacher.get("model", "")))


def _teacher_of(args: Mapping[str, Any], adapter: Any, name: str) -> Mapping[str, Any]:
    """What `args.teachers` states of the model to whose space an adapter leads: the entry of its `head_idx`, or the one
    of its name; empty where it names none."""
    teachers = args.get("teachers")
    entries = [entry for entry in teachers if isinstance(entry, dict)] if isinstance(teachers, list) else []
    for entry in entries:
        if entry.get("name") == name:
            return entry
    index = adapter.get("head_idx") if isinstance(adapter, dict) else None
    if type(index) is int and 0 <= index < len(entries) and "name" not in entries[index]:
        return entries[index]
    return {}


def _version(args: Mapping[str, Any], part: Part) -> str:
    """The form of a head: v1 or v2."""
    option = "mlp_version"
    if part == "features" and args.get("spatial_mlp_version"):
        option = "spatial_mlp_version"
    version = args.get(option)
    if version not in VERSIONS:
        raise InputError(
            f"is a head of form {str(version)[:20]} (args.{option}), which is not supported; expected v1 or v2"
        )
    return str(version)


def _sizes(adapter: Any, part: Part) -> dict[str, int]:
    """The sizes of a head, as the configuration states them."""
    section = adapter.get(SECTIONS[part]) if isinstance(adapter, dict) else None
    section = section if isinstance(section, dict) else {}
    sizes = {name: section.get(name) for name in SIZES}
    for name, value in sizes.items():
        if type(value) is not int or not (name == "num_inner" or value) or not 0 <= value <= MAX_SIZE:
            raise InputError(f"config.json: expected {SECTIONS[part]}.{name} of adaptor_configs, got {str(value)[:20]}")
    factor = section.get("upsample_factor")
    if factor not in (None, 1):
        raise InputError(f"is an upsampling head (upsample_factor={str(factor)[:20]}), which is not supported")
    return {name: int(value) for name, value in sizes.items() if value is not None}


def _make_body(stored: Mapping[str, Tensor], prefix: str, version: str, sizes: Mapping[str, int]) -> nn.Sequential:
    """The layers of a head with their parameters, which must be exactly those of its form."""
    if any("parametrizations" in key for key in stored):
        raise InputError(
            "its weights are in spectral reparametrization, which is not supported; expected plain ones (fc1.weight)"
        )
    if not stored:
        raise InputError(f"config.json states it, but no weights begin with {prefix}")
    body, modules = _build(version, sizes, pre_norm="pre_norm.0.weight" in stored)
    expected = {
        (f"{key}.{name}", value.shape) for key, module in modules.items() for name, value in module.named_parameters()
    }
    if wrong := expected ^ {(name, value.shape) for name, value in stored.items()}:
        keys = sorted({f"{prefix}{name}" for name, _ in wrong})
        raise InputError(
            f"{len(keys)} of its weights are missing, too many, or of other shapes than config.json states for a head "
            f"of form {version}: {listed(keys, 3)}"
        )
    for name, value in stored.items():
        if not torch.isfinite(value).all():
            raise InputError(f"{prefix}{name} has values that are not finite; fetch the file again")
    for key, module in modules.items():
        state = {name: stored[f"{key}.{name}"].float() for name, _ in module.named_parameters()}
        module.load_state_dict(state, assign=True)
    return body


def _build(version: str, sizes: Mapping[str, int], *, pre_norm: bool) -> tuple[nn.Sequential, dict[str, nn.Module]]:
    """The layers of a head without parameters, and by their keys the layers that have some."""
    modules: dict[str, nn.Module] = {}
    width, hidden, outputs, inner = (sizes[name] for name in SIZES)

    def linear(key: str, inputs: int, out: int) -> nn.Module:
        return modules.setdefault(key, nn.Linear(inputs, out))

    def norm(key: str, channels: int) -> nn.Module:
        return modules.setdefault(key, nn.LayerNorm(channels))

    with torch.device("meta"):
        if version == "v1":
            layers = [linear("fc1", width, hidden), norm("norm", hidden), nn.ReLU()]
            for number in range(inner):
                first = 3 * number
                layers += [linear(f"inner.{first}", hidden, hidden), norm(f"inner.{first + 1}", hidden), nn.ReLU()]
            return nn.Sequential(*layers, linear("fc2", hidden, outputs)), modules
        layers = [norm("pre_norm.0", width), nn.GELU()] if pre_norm else []
        layers.append(linear("fc1", width, hidden))
        for number in range(inner):
            key = f"blocks.{number}"
            layers.append(Residual(norm(f"{key}.0", hidden), nn.GELU(), linear(f"{key}.2", hidden, hidden)))
        layers += [norm("final.0", hidden), nn.GELU(), linear("final.2", hidden, outputs)]
    return nn.Sequential(*layers), modules
