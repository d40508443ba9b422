"""Text towers: ONNX files, which run without torch, and models of transformers."""

import json
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import check_foreign, read_foreign_text
from gsencoder.core.pretrained import (
    ANY,
    SENTENCE_ENCODER,
    digest_files,
    find_file,
    load_pretrained,
    load_tokenizer,
    open_session,
    read_config,
    sentence_encoder_graph,
)
from gsencoder.core.settings import option
from gsencoder.text.table import NO_TEMPLATES, check_known, check_templates, unit

Pooling = Literal["mean", "cls", "eos", "output"]
GRAPHS = ("model.onnx", "onnx/model.onnx", "text_model.onnx")
POOLED_OUTPUTS = ("sentence_embedding", "text_embeds", "text_features")
"""Outputs that are one vector a phrase already, in the space that is compared; a pooler's output is not."""
TOKEN_OUTPUTS = ("last_hidden_state", "token_embeddings")
KNOWN_INPUTS = ("input_ids", "attention_mask", "token_type_ids", "position_ids")


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerOptions:
    """How a text tower makes one vector of a phrase."""

    pooling: Literal["auto"] | Pooling = option(
        "auto",
        "how token vectors become one: mean, cls = the first, eos = the last, output = the model does it; "
        "auto = as the kind of model or its folder says",
    )
    templates: tuple[str, ...] = option(NO_TEMPLATES, "sentences with {} for the phrase, whose vectors are averaged")

    def __post_init__(self) -> None:
        check_templates(self.templates)


def pool_tokens(tokens: np.ndarray, pooling: str) -> Float32[np.ndarray, " D"]:
    """One of the vectors [T, D] of the tokens of a phrase: their mean, the first (cls) or the last (eos)."""
    if pooling == "mean":
        return tokens.mean(axis=0, dtype=np.float64).astype(np.float32)
    return tokens[0 if pooling == "cls" else -1].astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxTextConfig(TowerOptions):
    """A text tower in a folder with an ONNX graph and `tokenizer.json`."""

    name: Literal["onnx"] = "onnx"
    model: str = option(
        "", "folder with model.onnx and tokenizer.json; also looked for in GSENCODER_MODELS; minilm_l6 is installed"
    )


class OnnxTower:
    """A tokenizer and an ONNX graph. Phrases run one at a time and without padding: a graph with dynamic int8 scales
    gives a phrase another vector in a batch, or with padding behind it. Attributes are those of `TextTower`."""

    lower = False

    def __init__(self, config: OnnxTextConfig) -> None:
        """Reads the folder, and runs the tokenizer's last token through the graph."""
        if not config.model:
            raise InputError("text.model= is missing: the folder of a text tower (model.onnx and tokenizer.json)")
        folder = find_file(config.model, "text.model", folder=True)
        graph = next((folder / name for name in GRAPHS if (folder / name).is_file()), None)
        if folder == SENTENCE_ENCODER:
            graph = sentence_encoder_graph()
        tokenizer = folder / "tokenizer.json"
        if graph is None or not tokenizer.is_file():
            missing = "tokenizer.json" if graph is not None else "model.onnx"
            raise InputError(f"{folder}: {missing} is missing; expected a text tower as optimum exports it")
        self.name, self._folder = folder.resolve().name, folder
        self._tokenizer = _load_tokenizer(tokenizer)
        self._session = open_session(graph, "text tower")
        self._inputs = {tensor.name: tensor.shape for tensor in self._session.get_inputs()}
        unknown = sorted(set(self._inputs) - set(KNOWN_INPUTS))
        if "input_ids" not in self._inputs or unknown:
            raise InputError(
                f"{graph}: takes {', '.join(self._inputs)}; expected a text model that takes input_ids, and of "
                f"{', '.join(KNOWN_INPUTS[1:])} at most"
            )
        self.pooling, self._output = self._choose_pooling(config.pooling)
        self._set_length()
        files = [graph, *sorted(graph.parent.glob(f"{graph.name}_data*")), tokenizer]
        self.identity = f"onnx:{digest_files(*files, settings=(self.pooling, self._output))}"
        self.channels = len(self._probe())

    def embed(self, phrases: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each phrase."""
        return unit(np.stack([self._pool(*self._run(self._tokens(phrase))) for phrase in phrases]))

    def _tokens(self, phrase: str) -> Int64[np.ndarray, " T"]:
        try:
            encoded = self._tokenizer.encode(phrase)
        except Exception as error:  # tokenizers raises plain Exceptions
            message = " ".join(str(error).split())[:120]
            raise InputError(f"{self._folder}: tokenizer.json cannot read {phrase[:60]!r}: {message}") from error
        inside = [token for token, special in zip(encoded.ids, encoded.special_tokens_mask, strict=True) if not special]
        check_known(phrase, inside, self._unknown)
        if self._longest and len(encoded.ids) > self._longest:
            raise InputError(
                f"query {phrase[:60]!r}…: has {len(encoded.ids)} tokens; the tower takes at most {self._longest}"
            )
        return np.array(encoded.ids, np.int64)

    def _run(self, tokens: Int64[np.ndarray, " T"]) -> tuple[np.ndarray, int]:
        """The output for one phrase, and how many of its tokens are no padding."""
        count, length = len(tokens), max(self._fixed, len(tokens))
        padded = np.full(length, self._padding, np.int64)
        padded[:count] = tokens
        feed = {
            "input_ids": padded[None],
            "attention_mask": (np.arange(length) < count).astype(np.int64)[None],
            "token_type_ids": np.zeros((1, length), np.int64),
            "position_ids": np.arange(length)[None],
        }
        try:
            output = self._session.run([self._output], {name: feed[name] for name in self._inputs})[0]
        except Exception as error:  # onnxruntime raises its own classes, which share only this base
            message = " ".join(str(error).split())[:160]
            raise InputError(
                f"the graph does not run on tokens of tokenizer.json ({message}); expected both of one model"
            ) from error
        return np.asarray(output), count

    def _pool(self, output: np.ndarray, count: int) -> Float32[np.ndarray, " D"]:
        axes = 2 if self.pooling == "output" else 3
        if output.ndim != axes or len(output) != 1:
            expected = "[1, channels]" if axes == 2 else "[1, tokens, channels]"
            raise InputError(
                f"its output {self._output!r} has shape {list(output.shape)}, expected {expected} for pooling="
                f"{self.pooling}"
            )
        if self.pooling == "output":
            return output[0].astype(np.float32)
        return pool_tokens(output[0, :count], self.pooling)

    def _choose_pooling(self, requested: str) -> tuple[str, str]:
        """The pooling, and the output that it takes."""
        outputs = [tensor.name for tensor in self._session.get_outputs()]
        pooled = next((name for name in POOLED_OUTPUTS if name in outputs), None)
        tokens = next((name for name in TOKEN_OUTPUTS if name in outputs), outputs[0])
        if requested == "auto" and pooled is not None:
            return "output", pooled
        pooling = declared_pooling(self._folder) if requested == "auto" else requested
        if pooling == "output":
            return "output", pooled or outputs[0]
        if pooling in ("mean", "cls", "eos"):
            return pooling, tokens
        raise InputError(
            f"{self._folder}: no file says how token vectors become one (1_Pooling/config.json, or an output "
            f"{' or '.join(POOLED_OUTPUTS)}); give text.pooling=mean, cls or eos as the model's card says"
        )

    def _set_length(self) -> None:
        """Lengths: what a graph of fixed size, or one without a mask that its tokenizer pads for, must be given."""
        length = self._inputs["input_ids"][-1]
        self._fixed = length if isinstance(length, int) else 0
        padding, truncation = self._tokenizer.padding or {}, self._tokenizer.truncation or {}
        self._padding = int(padding.get("pad_id") or 0)
        if not self._fixed and "attention_mask" not in self._inputs:
            self._fixed = int(padding.get("length") or 0)
        settings = _read_json(self._folder / "tokenizer_config.json").get("model_max_length")
        positions = _read_json(self._folder / "config.json").get("max_position_embeddings")
        limits = [self._fixed, truncation.get("max_length"), settings, positions]
        self._longest = min((limit for limit in limits if isinstance(limit, int) and 0 < limit < 1 << 20), default=0)
        # What looks like a special token in a phrase is text.
        self._tokenizer.encode_special_tokens = True
        # Neither in silence: a phrase that is cut is another phrase.
        self._tokenizer.no_truncation()
        self._tokenizer.no_padding()
        self._unknown = _unknown_token(self._tokenizer)

    def _probe(self) -> Float32[np.ndarray, " D"]:
        """The vector of the tokenizer's last token, which a graph with fewer rows in its embedding does not have."""
        last = self._tokenizer.get_vocab_size(with_added_tokens=True) - 1
        try:
            return self._pool(*self._run(np.array([last], np.int64)))
        except InputError as error:
            raise InputError(f"{self._folder}: {error}") from error


def _load_tokenizer(path: Path) -> Any:
    try:
        from tokenizers import Tokenizer
    except ImportError as error:
        raise InputError("text towers need the package tokenizers (pip install tokenizers)") from error
    with readable(path):
        check_foreign(path)
    try:
        return Tokenizer.from_file(str(path))
    except Exception as error:  # tokenizers raises plain Exceptions
        raise InputError(f"{path}: is no tokenizer: {' '.join(str(error).split())[:120]}") from error


def declared_pooling(folder: Path) -> str:
    """The pooling that sentence-transformers' files state, or nothing."""
    for module in _read_json(folder / "modules.json", list):
        kind = str(module.get("type", "")).rpartition(".")[2] if isinstance(module, dict) else ""
        if kind not in ("Transformer", "Pooling", "Normalize"):
            raise InputError(
                f"{folder}: modules.json lists {kind[:40]!r}, which is not supported; export it into the "
                "graph, as an output sentence_embedding"
            )
    pooling = _read_json(folder / "1_Pooling" / "config.json")
    names = {"pooling_mode_mean_tokens": "mean", "pooling_mode_cls_token": "cls", "pooling_mode_lasttoken": "eos"}
    modes = [key for key, value in pooling.items() if key.startswith("pooling_mode") and value is True]
    if not modes:
        return ""
    if len(modes) > 1 or modes[0] not in names:
        raise InputError(
            f"{folder}: 1_Pooling/config.json asks for {', '.join(modes)}; expected one of {', '.join(names)}"
        )
    return names[modes[0]]


def _unknown_token(tokenizer: Any) -> int | None:
    """The number of the token for what the tokenizer does not know, where it has one."""
    state = json.loads(tokenizer.to_str()).get("model") or {}
    token = state.get("unk_token")
    return tokenizer.token_to_id(token) if isinstance(token, str) else None


def _read_json(path: Path, kind: type = dict) -> Any:
    """A JSON file of the folder; empty where there is none."""
    if not path.is_file():
        return kind()
    try:
        value = json.loads(read_foreign_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {str(error)[:80]}") from error
    if not isinstance(value, kind):
        raise InputError(f"{path}: expected a JSON {'object' if kind is dict else 'list'}")
    return value


LABEL = "text tower"
TOKENIZER_FILES = ("tokenizer*.json", "vocab*", "merges.txt", "*.model", "special_tokens_map.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointText:
    """How the text side of a joint image-text model is run.

    Attributes:
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
class TransformersTextConfig(TowerOptions):
    """A text tower in a folder that transformers reads."""

    name: Literal["transformers"] = "transformers"
    model: str = option("", "folder of the model and its tokenizer; also looked for in GSENCODER_MODELS")
    lower: Literal["auto", "yes", "no"] = option(
        "auto", "lower-case phrases and remove punctuation; auto = where the kind of model was trained so"
    )
    device: Literal["auto", "cpu", "cuda"] = option("auto", "where it runs")


class TransformersTower:
    """A text model of transformers with its tokenizer. Phrases run singly. Attributes are those of `TextTower`."""

    def __init__(self, config: TransformersTextConfig) -> None:
        """Loads model and tokenizer; nothing is fetched from anywhere."""
        if not config.model:
            raise InputError("text.model= is missing: the folder of a text tower")
        folder = find_file(config.model, "text.model", folder=True)
        model_config = read_config(folder, LABEL)
        import torch
        import transformers

        from gsencoder.core.device import choose_device

        self.name = folder.resolve().name
        self.model_type = str(model_config.model_type)
        self._kind = JOINT.get(model_config.model_type)
        self.pooling = _choose_pooling(folder, model_config.model_type, config.pooling)
        text = getattr(model_config, "text_config", model_config)
        self._longest = int(getattr(text, "max_position_embeddings", 0) or 0)
        # What looks like a special token in a phrase is text.
        self._tokenizer = load_tokenizer(folder, LABEL, split_special_tokens=True)
        loader = getattr(transformers, self._kind.loader if self._kind else "AutoModel")
        model = load_pretrained(loader, folder, LABEL, ignored=ANY if self._kind else ())
        rows = model.get_input_embeddings().num_embeddings
        if len(self._tokenizer) > rows:
            raise InputError(
                f"{LABEL}: {folder}: the tokenizer has {len(self._tokenizer)} tokens and the model {rows}; expected "
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
        """A unit vector for each phrase."""
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
        return pool_tokens(tokens[inputs["attention_mask"][0].cpu().numpy() > 0], self.pooling)


def canonical(phrase: str) -> str:
    """Lower case, no punctuation, single blanks: as the captions that SigLIP and SigLIP2 were trained on."""
    return " ".join(phrase.lower().translate(str.maketrans("", "", string.punctuation)).split())


def _choose_pooling(folder: Path, model_type: str, requested: str) -> str:
    if requested != "auto":
        return requested
    pooling = "output" if model_type in JOINT else declared_pooling(folder)
    if not pooling:
        raise InputError(
            f"{LABEL}: {folder}: no file says how token vectors of a {model_type} model become one "
            "(1_Pooling/config.json); give text.pooling=mean, cls or eos as the model's card says"
        )
    return pooling
