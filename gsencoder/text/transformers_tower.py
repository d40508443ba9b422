"""Text towers through transformers: CLIP, SigLIP, SigLIP2 and sentence encoders, from folders on disk."""

import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, find_file, load_pretrained, load_tokenizer, read_config
from gsencoder.text.onnx_tower import Pooling, stated_pooling
from gsencoder.text.towers import NO_TEMPLATES, check_known, check_templates, unit

WHAT = "text tower"
TOKENIZER_FILES = ("tokenizer*.json", "vocab*", "merges.txt", "*.model", "special_tokens_map.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointText:
    """How the text side of a joint image-text model is run.

    Attributes:
        loader: class of transformers.
        output: its output that lies in the joint space.
        pad: whether phrases are padded to the model's length, as in its training, rather than masked.
        lower: whether they are lower-cased and lose their punctuation, as in its training, which its tokenizer in
            transformers does not do, or not completely.
    """

    loader: str
    output: str
    pad: bool = False
    lower: bool = False


CLIP = JointText(loader="CLIPTextModelWithProjection", output="text_embeds")
SIGLIP = JointText(loader="SiglipTextModel", output="pooler_output", pad=True)
SIGLIP2 = JointText(loader="Siglip2TextModel", output="pooler_output", pad=True, lower=True)
JOINT: Mapping[str, JointText] = {
    "clip": CLIP,
    "clip_text_model": CLIP,
    "siglip": SIGLIP,
    "siglip_text_model": SIGLIP,
    "siglip2": SIGLIP2,
    "siglip2_text_model": SIGLIP2,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformersTextConfig:
    """A text tower in a folder that transformers reads."""

    name: Literal["transformers"] = "transformers"
    model: str = field(
        default="", metadata={"help": "folder of the model and its tokenizer; also looked for in GSENCODER_MODELS"}
    )
    pooling: Literal["auto"] | Pooling = field(
        default="auto",
        metadata={
            "help": "how token vectors become one: mean, cls = the first, eos = the last, output = the model does it; "
            "auto = as the kind of model or its folder says"
        },
    )
    lower: Literal["auto", "yes", "no"] = field(
        default="auto",
        metadata={"help": "lower-case phrases and remove punctuation; auto = where the kind of model was trained so"},
    )
    templates: tuple[str, ...] = field(
        default=NO_TEMPLATES,
        metadata={"help": "sentences with {} for the phrase, whose vectors are averaged"},
    )
    device: Literal["auto", "cpu", "cuda"] = field(default="auto", metadata={"help": "where it runs"})

    def __post_init__(self) -> None:
        for name, known in (("pooling", ("auto", "mean", "cls", "eos", "output")), ("lower", ("auto", "yes", "no"))):
            if getattr(self, name) not in known:
                raise InputError(f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}")
        check_templates(self.templates)


class TransformersTower:
    """A text model of transformers with its tokenizer. Phrases run one at a time.

    Attributes:
        name: of the folder.
        identity: "transformers:" and a digest of weights, configuration, tokenizer and reading.
        pooling: of token vectors; "output" where the model has an output in the joint space.
        channels: of its vectors.
        model_type: kind of the model, as its configuration states it.
        lower: whether phrases are lower-cased and lose their punctuation.
    """

    def __init__(self, config: TransformersTextConfig) -> None:
        """Loads model and tokenizer; nothing is fetched from anywhere.

        Args:
            config: which folder, and how.

        Raises:
            InputError: no such folder, files that cannot be read or do not fit each other, or an unknown pooling.
        """
        if not config.model:
            raise InputError("text.model= is missing: the folder of a text tower")
        folder = find_file(config.model, "text.model", folder=True)
        stated = read_config(folder, WHAT)
        import torch
        import transformers

        from gsencoder.core.device import choose_device

        self.name = folder.resolve().name
        self.model_type = str(stated.model_type)
        self._kind = JOINT.get(stated.model_type)
        self.pooling = _choose_pooling(folder, stated.model_type, config.pooling)
        text = getattr(stated, "text_config", stated)
        self._longest = int(getattr(text, "max_position_embeddings", 0) or 0)
        # What looks like a special token in a phrase is text.
        self._tokenizer = load_tokenizer(folder, WHAT, split_special_tokens=True)
        loader = getattr(transformers, self._kind.loader if self._kind else "AutoModel")
        model = load_pretrained(loader, folder, WHAT, other_parts="ignore" if self._kind else "warn")
        rows = model.get_input_embeddings().num_embeddings
        if len(self._tokenizer) > rows:
            raise InputError(
                f"{WHAT}: {folder}: the tokenizer has {len(self._tokenizer)} tokens and the model {rows}; expected "
                "both of one model"
            )
        self._device = choose_device(config.device)
        self._model = model.to(self._device)
        self.lower = self._kind is not None and self._kind.lower if config.lower == "auto" else config.lower == "yes"
        files = [folder / "config.json", *sorted(folder.glob("*.safetensors"))]
        files += sorted({path for pattern in TOKENIZER_FILES for path in folder.glob(pattern)})
        self.identity = f"transformers:{digest_files(*files, settings=(self.pooling, self.lower))}"
        last = torch.tensor([[len(self._tokenizer) - 1]], device=self._device)
        self.channels = len(self._pooled({"input_ids": last, "attention_mask": torch.ones_like(last)}))

    def embed(self, phrases: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each phrase.

        Raises:
            InputError: a phrase of which nothing is left, or with more tokens than the model takes.
        """
        return unit(np.stack([self._vector(phrase) for phrase in phrases]))

    def _vector(self, phrase: str) -> Float32[np.ndarray, " D"]:
        text = canonical(phrase) if self.lower else phrase
        bare = self._tokenizer(text, add_special_tokens=False)["input_ids"]
        check_known(phrase, bare, self._tokenizer.unk_token_id)
        count = len(self._tokenizer(text)["input_ids"])
        if self._longest and count > self._longest:
            raise InputError(f"query {phrase[:60]!r}…: has {count} tokens; the tower takes at most {self._longest}")
        padding = {"padding": "max_length", "max_length": self._longest} if self._kind and self._kind.pad else {}
        return self._pooled(self._tokenizer(text, return_tensors="pt", **padding).to(self._device))

    def _pooled(self, inputs: Mapping[str, Any]) -> Float32[np.ndarray, " D"]:
        import torch

        with torch.inference_mode():
            outputs = self._model(**inputs)
        if self.pooling == "output":
            name = self._kind.output if self._kind else "pooler_output"
            return np.asarray(outputs[name][0].float().cpu())
        tokens = outputs.last_hidden_state[0].float().cpu().numpy()
        present = np.flatnonzero(inputs["attention_mask"][0].cpu().numpy())
        if self.pooling == "mean":
            return tokens[present].mean(axis=0, dtype=np.float64).astype(np.float32)
        return np.asarray(tokens[present[0] if self.pooling == "cls" else present[-1]])


def canonical(phrase: str) -> str:
    """Lower case, no punctuation, single blanks: as the captions that SigLIP and SigLIP2 were trained on."""
    return " ".join(phrase.lower().translate(str.maketrans("", "", string.punctuation)).split())


def _choose_pooling(folder: Path, model_type: str, requested: str) -> str:
    if requested != "auto":
        return requested
    pooling = "output" if model_type in JOINT else stated_pooling(folder)
    if not pooling:
        raise InputError(
            f"{WHAT}: {folder}: no file says how token vectors of a {model_type} model become one "
            "(1_Pooling/config.json); give text.pooling=mean, cls or eos as the model's card says"
        )
    return pooling
