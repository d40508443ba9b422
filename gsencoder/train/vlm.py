"""A vision-language model of transformers under low-rank adapters of peft: loaded, wrapped and written.

Rendered features in the place of what a vision tower gives: which models take them, on which grid, and how.

Features replace the tower's output by a forward hook on the tower, before the model's connector (SplatDistill sec. 3.4
does so with VILA). The tower itself runs on the pictures as always, and what it gave is dropped; summary tokens that a
tower puts first stay its own.

- Idefics3, SmolVLM: `last_hidden_state`. Pictures are not split; their processor stretches them to a square.
- LLaVA with a CLIP tower: `hidden_states[vision_feature_layer]`. Its processor cuts out the middle square.
"""

import os
import re
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.core.files import is_full_disk
from gsencoder.core.pretrained import (
    digest_files,
    load_companion,
    load_pretrained,
    quiet_transformers,
    read_config,
    weight_files,
)
from gsencoder.core.settings import CheckedConfig, option

LABEL = "tune"
SERVED_FOLDER = "served"


@dataclass(frozen=True, slots=True, kw_only=True)
class AdapterConfig(CheckedConfig):
    """Low-rank adapters (LoRA, Hu et al. 2021) of all linear layers of the language model: W x becomes W x + (alpha /
    rank) · B A x."""

    rank: int = option(16, "rank of A and B", ge=1, le=4096)
    alpha: float = option(32.0, "scale of the adapters, divided by the rank", gt=0)
    dropout: float = option(0.05, "share of an adapter's inputs that is dropped in training", ge=0, lt=1)


def check_peft() -> None:
    """Refuses to go on without peft."""
    try:
        import peft  # noqa: F401
    except ImportError as error:
        raise InputError(f"{LABEL}: needs the package peft (pip install 'gsencoder[tune]')") from error


@contextmanager
def quiet_peft() -> Iterator[None]:
    """Without bars, tables, and the warning that peft asks models of transformers by an old name."""
    with quiet_transformers(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`is_gradient_checkpointing`", FutureWarning)
        yield


def load_processor(folder: Path) -> tuple[Any, Any]:
    """Configuration and processor of a vision-language model, without its weights."""
    config = read_config(folder, LABEL)
    from transformers import AutoProcessor
    from transformers.models.auto.modeling_auto import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING

    if type(config) not in MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING or not hasattr(config, "vision_config"):
        raise InputError(
            f"{LABEL}: {folder}: a model of the kind {config.model_type} takes no pictures with its text; expected a "
            "vision-language model, such as SmolVLM, LLaVA or Qwen2-VL"
        )
    weight_files(folder, LABEL)
    processor = load_companion(AutoProcessor, folder, LABEL, "processor")
    if getattr(processor, "image_processor", None) is None or getattr(processor, "tokenizer", None) is None:
        raise InputError(
            f"{LABEL}: {folder}: has no processor of pictures and text; expected processor_config.json or "
            "preprocessor_config.json, and a tokenizer, next to the model"
        )
    if not getattr(processor, "chat_template", None):
        raise InputError(
            f"{LABEL}: {folder}: its processor has no chat template, by which `ask` and servers put pictures and "
            "questions together; expected chat_template.jinja next to the model"
        )
    asked = [{"role": "user", "content": [{"type": "image"}, {"type": "text", "text": "question"}]}]
    try:
        processor.apply_chat_template(asked, add_generation_prompt=True, tokenize=False)
    except Exception as error:  # templates raise whatever they like
        message = " ".join(str(error).split())[:160]
        raise InputError(
            f"{LABEL}: {folder}: its chat template cannot be used: {message}; expected that of the model, in "
            "chat_template.jinja"
        ) from error
    return config, processor


def model_digest(folder: Path) -> str:
    """A fingerprint of a model's configuration and weights."""
    return digest_files(folder / "config.json", *weight_files(folder, LABEL))


def load_adapted(
    folder: Path, config: AdapterConfig, *, base: Literal["float32", "bfloat16"] = "float32", seed: int = 0
) -> Any:
    """The model of a folder, in the type `base`, with new adapters, whose parameters alone are trained: a
    `peft.PeftModel`. As B = 0, it answers as the model."""
    check_peft()
    import peft
    from transformers import AutoModelForImageTextToText

    # Its path is written into the adapters.
    model = load_pretrained(AutoModelForImageTextToText, folder.resolve(), LABEL)
    model.to(getattr(torch, base))
    tower, head = model.get_encoder("image"), model.get_output_embeddings()
    in_tower = set(tower.modules()) if tower is not model else set()
    layers = {each for each in model.get_decoder().modules() if isinstance(each, nn.Linear)} - in_tower - {head}
    torch.manual_seed(seed)
    lora = peft.LoraConfig(
        r=config.rank,
        lora_alpha=config.alpha,
        lora_dropout=config.dropout,
        target_modules=[name for name, module in model.named_modules() if module in layers],
    )
    with quiet_peft():
        return peft.get_peft_model(model, lora)


def save_adapters(folder: Path, adapted: Any, processor: Any) -> None:
    """Writes adapters as peft does, and the processor, without which servers load no model. A full disk stays an
    OSError, which the output folder reports."""
    try:
        for each in adapted.peft_config.values():
            # A set of peft, whose order changes from run to run.
            each.target_modules = sorted(each.target_modules)
        with quiet_peft():
            adapted.save_pretrained(str(folder))
            processor.save_pretrained(str(folder))
    except OSError as error:
        if is_full_disk(error):
            raise
        # Not every error of a write says which file it was.
        raise InputError(f"{error.filename or folder}: cannot write: {error.strerror or error}") from error
    except Exception as error:
        # Safetensors and tokenizers raise classes of their own for errors of the system.
        reason = re.search(r"[^:]*\(os error \d+\)", str(error))
        if reason is None:
            raise
        raise InputError(f"{folder}: cannot write: {reason[0].strip()}") from error
    # A card with blanks to fill in, which peft writes.
    (folder / "README.md").unlink(missing_ok=True)


def link_served(folder: Path, model: Path) -> None:
    """Makes the folder `served`: links to the files of the model and to the adapters in `folder`, which transformers
    and its server take for one model with an adapter in it. `transformers serve` reads a configuration where the
    adapters are, and peft's folder has none."""
    served = folder / SERVED_FOLDER
    adapters = [each for each in sorted(folder.iterdir()) if each.is_file() and each.name.startswith("adapter_")]
    served.mkdir()
    for path in sorted(model.resolve().iterdir()):
        pickled = path.suffix in (".bin", ".pt", ".pth", ".ckpt", ".pkl", ".h5", ".msgpack")
        if path.is_file() and not path.name.startswith(("adapter_", ".")) and not pickled:
            _link(path, served / path.name)
    for path in adapters:
        _link(Path(os.pardir) / path.name, served / path.name)


def _link(target: Path, link: Path) -> None:
    try:
        link.symlink_to(target)
    except OSError:
        # Some systems have no links for everybody.
        shutil.copyfile(link.parent / target, link)


SPLIT = "do_image_splitting"
STRETCHED, CROPPED = ("idefics3", "smolvlm"), ("llava",)


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerLayout:
    """The output of a vision tower that features take the place of: rows and columns of patches, how pictures become
    square (see `gsencoder.infer.views.pictures.tower_grid`), the layer of the hidden states (None = the last, after the
    final norm), and the tokens before those of patches."""

    model: str
    grid: tuple[int, int]
    channels: int
    fit: Literal["stretch", "crop"]
    layer: int | None = None
    skipped: int = 0


def tower_layout(config: Any, processor: Any) -> TowerLayout:
    """What the tower of a model gives for a picture, by configuration and processor."""
    kind, pictures = config.model_type, processor.image_processor
    if kind not in (*STRETCHED, *CROPPED):
        raise InputError(
            f"tokens: rendered features are given to {', '.join((*STRETCHED, *CROPPED))}, and not to {kind}; leave "
            "tokens= out"
        )
    tower = config.vision_config
    if kind in STRETCHED:
        side = int(pictures.max_image_size["longest_edge"])
        cells = side // int(tower.patch_size)
        return TowerLayout(model=kind, grid=(cells, cells), channels=int(tower.hidden_size), fit="stretch")
    layer, crop = config.vision_feature_layer, pictures.crop_size
    edge = (pictures.size or {}).get("shortest_edge")
    side = int(tower.image_size)
    if tower.model_type != "clip_vision_model" or not isinstance(layer, int):
        raise InputError(
            f"tokens: of LLaVA one layer of a CLIP tower is replaced, and this one has {tower.model_type} with "
            f"vision_feature_layer={layer}; leave tokens= out"
        )
    if not pictures.do_center_crop or {crop["height"], crop["width"], edge} != {side}:
        raise InputError(
            f"tokens: expected a processor that resizes the shorter edge to {side} pixels and cuts out the middle, got "
            f"shortest_edge={edge}, crop_size={crop}; leave tokens= out"
        )
    cells = side // int(tower.patch_size)
    return TowerLayout(
        model=kind,
        grid=(cells, cells),
        channels=int(tower.hidden_size),
        fit="crop",
        layer=layer,
        # With the strategy "default" the model drops the first token afterwards, and with "full" it takes it.
        skipped=1,
    )


class TokenHook:
    """Puts `tokens` of the pictures of the next call in the place of a tower's output; where they are None, it
    stays."""

    def __init__(self, tower: nn.Module, layout: TowerLayout) -> None:
        self.tokens: Float[Tensor, "n P D"] | None = None
        self._layout = layout
        tower.register_forward_hook(self._replace)

    def _replace(self, tower: nn.Module, inputs: Any, output: Any) -> Any:  # noqa: ARG002
        if self.tokens is None:
            return output
        layout, states = self._layout, output.hidden_states
        old = output.last_hidden_state if layout.layer is None else states[layout.layer]
        expected = (old.shape[0], old.shape[1] - layout.skipped, old.shape[2])
        if tuple(self.tokens.shape) != expected:
            raise InputError(
                f"tokens: the tower of this {layout.model} gave {expected[0]} pictures of {expected[1]} patches with "
                f"{expected[2]} channels, and there are tokens {list(self.tokens.shape)}"
            )
        new = self.tokens.to(old)
        if layout.layer is None:
            output.last_hidden_state = new
            return output
        from torch import cat

        replaced = list(states)
        replaced[layout.layer] = cat((old[:, : layout.skipped], new), dim=1)
        output.hidden_states = tuple(replaced)
        return output
