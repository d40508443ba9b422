"""Adapter heads of RADIO: names, layers, and their files.

Names of adapter heads: an adapter NAME has a summary head and a feature head.

NAME.summary and NAME.features say which. NAME alone is the head that is meant most often: the summary head of adapters
whose model has a text side (CLIP, SigLIP, SigLIP2), since its outputs are compared with words, else the feature head.

RADIO's adapter heads, read from the safetensors of its Hugging Face folder; no code of the folder is run.

transformers loads the backbone alone. The heads lie beside it, under `radio_model.adaptors.NAME.head_mlp` (summary) and
`.feat_mlp` (features), and `config.json` states their sizes in `adaptor_configs` and their form in `args.mlp_version`
and `args.spatial_mlp_version`.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.archive import Archive
from gsencoder.core.errors import InputError, about, listed
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import check_fetched, weight_files

WHAT = "teacher radio"
ADAPTERS = "radio_model.adaptors."
"""The prefix of the keys of adapter heads in files of weights."""

LAYER_TYPES: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "linear": (nn.Linear, ("weight", "bias")),
    "layernorm": (nn.LayerNorm, ("weight", "bias")),
    "gelu": (nn.GELU, ()),
    "relu": (nn.ReLU, ()),
}
"""The layer types that a head may have, with the names of their parameters."""


class Residual(nn.Sequential):
    """A residual block: x + f(x), where f applies the layers in sequence."""

    def forward(self, x: Float[Tensor, "n C"]) -> Float[Tensor, "n C"]:
        out: Tensor = x + super().forward(x)
        return out


def describe_layers(layers: nn.Sequential, name: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    """The names of the layers' types, residual blocks as nested lists.

    Args:
        layers: linear layers, layer norms, GELU, ReLU, or `Residual` blocks of these.
        name: prefix of the arrays.
        arrays: the parameters are added here, as NAME.NUMBER.PARAMETER.

    Raises:
        InputError: a layer of another type.
    """
    layer_types: list[Any] = []
    for number, layer in enumerate(layers):
        key = f"{name}.{number}"
        if isinstance(layer, Residual):
            layer_types.append(describe_layers(layer, key, arrays))
            continue
        layer_type = next((layer_type for layer_type, (cls, _) in LAYER_TYPES.items() if type(layer) is cls), None)
        if layer_type is None:
            raise InputError(f"heads: {key}: expected {', '.join(LAYER_TYPES)} or Residual, got {type(layer).__name__}")
        layer_types.append(layer_type)
        for parameter in LAYER_TYPES[layer_type][1]:
            arrays[f"{key}.{parameter}"] = getattr(layer, parameter).detach().float().numpy()
    return layer_types


def read_layers(file: Archive, layer_types: Sequence[Any], name: str, width: int) -> tuple[nn.Sequential, int]:
    """Reads layers that `describe_layers` described.

    Args:
        file: the archive.
        layer_types: what `describe_layers` returned.
        name: prefix of the arrays.
        width: number of channels of the first layer's input.

    Returns:
        The layers, and the number of channels of their outputs.

    Raises:
        InputError: an unknown type of layer, or parameters that are missing or do not fit each other.
    """
    layers: list[nn.Module] = []
    for number, layer_type in enumerate(layer_types):
        key = f"{name}.{number}"
        if isinstance(layer_type, list):
            inner, out = read_layers(file, layer_type, key, width)
            if out != width:
                raise InputError(f"{key}: expected a residual block with {width} output channels, got {out}")
            layers.append(Residual(*inner))
        elif layer_type == "linear":
            weight = file.array(f"{key}.weight", "float32", (key, width))
            linear = nn.Linear(width, len(weight))
            width = len(weight)
            bias = file.array(f"{key}.bias", "float32", (width,))
            linear.weight.data, linear.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
            layers.append(linear)
        elif layer_type == "layernorm":
            norm = nn.LayerNorm(width)
            for parameter in LAYER_TYPES[layer_type][1]:
                value = file.array(f"{key}.{parameter}", "float32", (width,))
                getattr(norm, parameter).data = torch.from_numpy(value.copy())
            layers.append(norm)
        elif isinstance(layer_type, str) and layer_type in LAYER_TYPES:
            layers.append(LAYER_TYPES[layer_type][0]())
        else:
            raise InputError(
                f"{key}: expected {', '.join(LAYER_TYPES)} or a list of these, got {str(layer_type)[:20]!r}"
            )
    return nn.Sequential(*layers), width


Part = Literal["summary", "features"]
PARTS: tuple[Part, Part] = ("summary", "features")
TEXT_KINDS = ("siglip2", "siglip", "clip")
"""Kinds of models with a text side, the more special ones first."""


def text_kind(*descriptions: str) -> str:
    """The kind of model with a text side that a description names, such as "open_clip ViT-SO400M-14-SigLIP-384"; empty
    if none does. The first description that names one decides."""
    for description in descriptions:
        for kind in TEXT_KINDS:
            if kind in description.lower():
                return kind
    return ""


def split_name(name: str, adapters: Iterable[str]) -> tuple[str, Part | None]:
    """The adapter that a head's name stands for, and its part if the name says which.

    Args:
        name: NAME, NAME.summary or NAME.features.
        adapters: names of adapters, one of which may itself end in a part's name.
    """
    adapter, _, last = name.rpartition(".")
    for part in PARTS:
        if last == part and adapter and name not in adapters:
            return adapter, part
    return name, None


def default_part(kind: str) -> Part:
    """The part that an adapter's name alone stands for, by the kind of its model with a text side."""
    return "summary" if kind else "features"


NORMALIZER = "radio_model.feature_normalizer."
MODULES: Mapping[Part, str] = {"summary": "head_mlp", "features": "feat_mlp"}
SECTIONS: Mapping[Part, str] = {"summary": "summary", "features": "feature"}
"""Names of a head's part in the keys of the weights, and in the configuration."""
SIZES = ("input_dim", "hidden_dim", "output_dim", "num_inner")
VERSIONS = ("v1", "v2")
MAX_SIZE = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Head:
    """An adapter head.

    Attributes:
        name: ADAPTER.summary or ADAPTER.features.
        body: its layers, from features [n, D] of the backbone to vectors [n, E].
        text: the kind of model with a text side to whose space the adapter leads (clip, siglip, siglip2); else empty.
        model: the model to whose space it leads, as the configuration states it; else empty.
    """

    name: str
    body: nn.Sequential
    text: str = ""
    model: str = ""

    @property
    def part(self) -> str:
        """The part of the adapter: summary or features."""
        return self.name.rpartition(".")[2]

    @property
    def channels(self) -> int:
        """E: the number of channels of its outputs."""
        return next(layer.out_features for layer in reversed(self.body) if isinstance(layer, nn.Linear))

    def describe(self) -> str:
        """The head and the model to whose space it leads, for messages."""
        kind = self.model or self.text
        return f"{self.name} ({kind})" if kind else self.name


def read_radio_heads(folder: Path, names: Sequence[str], channels: int) -> list[Head]:
    """Reads adapter heads of a RADIO model, each once.

    Args:
        folder: with config.json and safetensors.
        names: of heads: NAME, NAME.summary or NAME.features.
        channels: D of the backbone.

    Raises:
        InputError: no such head, no file of weights, weights that are missing or surplus or of another shape, a head of
            another backbone, or a form of head that is not known.
    """
    files = weight_files(folder, WHAT)
    with about(f"heads of {folder}"):
        config = _read_config(folder)
        heads: dict[str, Head] = {}
        with _open_weights(files) as weights:
            for name in names:
                head = _read_head(weights, config, name, channels)
                heads[head.name] = head
        return list(heads.values())


def _read_config(folder: Path) -> dict[str, Any]:
    try:
        config = json.loads(read_foreign_text(folder / "config.json"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"config.json cannot be read: {error}") from error
    if not isinstance(config, dict) or not isinstance(config.get("adaptor_configs"), dict):
        raise InputError("config.json has no adaptor_configs: the folder was written without adapter heads")
    return config


class _Weights:
    """The tensors of all safetensors files of a folder, by key."""

    def __init__(self, files: Mapping[str, Any]) -> None:
        """Args:
        files: for each key the open file that holds it.
        """
        self.files = files

    def under(self, prefix: str) -> dict[str, tuple[int, ...]]:
        """The shapes of the tensors whose keys begin with `prefix`, by the rest of the key."""
        return {
            key[len(prefix) :]: tuple(file.get_slice(key).get_shape())
            for key, file in self.files.items()
            if key.startswith(prefix)
        }

    def read(self, key: str) -> Float[Tensor, "..."]:
        """A tensor as float32.

        Raises:
            InputError: values that are not finite.
        """
        value: Tensor = self.files[key].get_tensor(key).float()
        if not torch.isfinite(value).all():
            raise InputError(f"{key} has values that are not finite; fetch the file again")
        return value


@contextmanager
def _open_weights(paths: Sequence[Path]) -> Iterator[_Weights]:
    from safetensors import SafetensorError, safe_open

    with ExitStack() as stack:
        files: dict[str, Any] = {}
        for path in paths:
            check_fetched(path)
            try:
                file = stack.enter_context(safe_open(path, framework="pt"))
            except (SafetensorError, OSError) as error:
                raise InputError(f"{path.name}: no safetensors file: {' '.join(str(error).split())[:160]}") from error
            for key in file.keys():  # noqa: SIM118 - not a mapping
                if key in files:
                    raise InputError(f"{key} is in two files; expected the files of one model")
                files[key] = file
        yield _Weights(files)


def _read_head(weights: _Weights, config: Mapping[str, Any], name: str, channels: int) -> Head:
    adapters: dict[str, Any] = config["adaptor_configs"]
    adapter, part = split_name(name, adapters)
    if adapter not in adapters:
        raise InputError(f"{name}: there is no such adapter; config.json has {listed(sorted(adapters)) or 'none'}")
    if weights.under(NORMALIZER):
        raise InputError(
            f"{name}: the folder has a feature normalizer, which transformers does not apply; heads would be given "
            "other features than they were trained on"
        )
    args = config.get("args")
    args = args if isinstance(args, dict) else {}
    teacher = _teacher_of(args, adapters[adapter], adapter)
    stated = " ".join(str(teacher.get(key, "")) for key in ("type", "model")).strip()
    kind = text_kind(stated, adapter)
    part = part or default_part(kind)
    full = f"{adapter}.{part}"
    with about(full):
        version = _version(args, part)
        sizes = _sizes(adapters[adapter], part)
        if sizes["input_dim"] != channels:
            raise InputError(
                f"takes {sizes['input_dim']} channels and the backbone has {channels}: a head of another backbone"
            )
        prefix = f"{ADAPTERS}{adapter}.{MODULES[part]}."
        body = _read_body(weights, prefix, version, sizes)
    return Head(name=full, body=body.requires_grad_(False).eval(), text=kind, model=str(teacher.get("model", "")))


def _teacher_of(args: Mapping[str, Any], adapter: Any, name: str) -> Mapping[str, Any]:
    """What `args.teachers` states of the model to whose space an adapter leads: the entry of its `head_idx`, or the one
    of its name; empty where nothing is stated."""
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
    """The form of a head: v1 or v2.

    Raises:
        InputError: another one, or none is stated.
    """
    option = "mlp_version"
    if part == "features" and args.get("spatial_mlp_version"):
        option = "spatial_mlp_version"
    version = args.get(option)
    if version == "attn":
        raise InputError(f"is an attention head (args.{option}=attn), which is not supported; expected v1 or v2")
    if version not in VERSIONS:
        raise InputError(f"is a head of an unknown form (args.{option}={str(version)[:20]}); expected v1 or v2")
    return str(version)


def _sizes(adapter: Any, part: Part) -> dict[str, int]:
    """The sizes of a head, as the configuration states them.

    Raises:
        InputError: they are missing or no sizes, or the head gives several vectors for each of its input.
    """
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


def _read_body(weights: _Weights, prefix: str, version: str, sizes: Mapping[str, int]) -> nn.Sequential:
    """Builds the layers of a head and reads their parameters.

    Raises:
        InputError: the file has other keys or shapes than the head needs.
    """
    stored = weights.under(prefix)
    if any("parametrizations" in key for key in stored):
        raise InputError(
            "its weights are in spectral reparametrization, which is not supported; expected plain ones (fc1.weight)"
        )
    if not stored:
        raise InputError(f"config.json states it, but no weights begin with {prefix}")
    body, modules = _build(version, sizes, pre_norm="pre_norm.0.weight" in stored)
    expected = {
        f"{key}.{name}": tuple(value.shape)
        for key, module in modules.items()
        for name, value in module.named_parameters()
    }
    for names, problem in (
        (sorted(set(expected) - set(stored)), "missing"),
        (sorted(set(stored) - set(expected)), f"not part of a head of form {version}"),
    ):
        if names:
            keys = [f"{prefix}{name}" for name in names]
            raise InputError(f"{len(names)} of its weights are {problem}: {listed(keys, 3)}")
    for name, shape in expected.items():
        if stored[name] != shape:
            raise InputError(
                f"{prefix}{name} is {list(stored[name])}, and config.json states {list(shape)}; expected both of one "
                "model"
            )
    for key, module in modules.items():
        for name, _ in list(module.named_parameters()):
            setattr(module, name, nn.Parameter(weights.read(f"{prefix}{key}.{name}")))
    return body


def _build(version: str, sizes: Mapping[str, int], *, pre_norm: bool) -> tuple[nn.Sequential, dict[str, nn.Module]]:
    """The layers of a head without parameters, and those that have some by their key."""
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
