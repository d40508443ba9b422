"""Questions and answers as the tokens that a vision-language model is trained on.

The prompt goes through the model's processor and chat template, as a server puts it together; the answer follows, and
the token that ends the model's turn. Labels are the answer's tokens alone, so that the prompt carries no loss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from gsencoder.core.errors import InputError
from gsencoder.data.prompts import PromptStore, StoredPrompt

IGNORED = -100
"""The label of tokens without a loss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TuningPair:
    """A question as it is asked, and right answers.

    Attributes:
        name: of the question, for messages.
        prompt: in a store.
        answers: one or more; an epoch takes one of them.
    """

    name: str
    prompt: StoredPrompt
    answers: tuple[str, ...]


class TuningSample(NamedTuple):
    """A pair as tensors.

    Attributes:
        name: of the question.
        inputs: of the model, with one row each; what has the shape of `input_ids` reaches to the answer's end.
        labels: the answer's tokens; `IGNORED` in the prompt.
        tokens: rendered features of its pictures; None where the model looks at the pictures.
    """

    name: str
    inputs: dict[str, Tensor]
    labels: Int64[Tensor, "T"]
    tokens: Float[Tensor, "V P D"] | None


class TuningBatch(NamedTuple):
    """Samples, padded on the right.

    Attributes:
        names: of the questions.
        inputs: of the model.
        labels: int64[B, T], `IGNORED` in prompts and padding.
        tokens: [pictures, P, D] of all samples in their order; None without.
    """

    names: tuple[str, ...]
    inputs: dict[str, Tensor]
    labels: Tensor
    tokens: Tensor | None

    def to(self, device: torch.device) -> "TuningBatch":
        """The batch with its tensors on a device."""
        return TuningBatch(
            names=self.names,
            inputs={name: value.to(device, non_blocking=True) for name, value in self.inputs.items()},
            labels=self.labels.to(device, non_blocking=True),
            tokens=None if self.tokens is None else self.tokens.to(device, non_blocking=True),
        )


def chat(text: str, pictures: Sequence[Any], answer: str | None = None) -> list[dict[str, Any]]:
    """The messages of a prompt, pictures before words as `ask` sends them, and those of an answer."""
    content = [*({"type": "image", "image": each} for each in pictures), {"type": "text", "text": text}]
    messages: list[dict[str, Any]] = [{"role": "user", "content": content}]
    if answer is not None:
        messages.append({"role": "assistant", "content": [{"type": "text", "text": answer}]})
    return messages


def answer_frame(processor: Any) -> tuple[str, str]:
    """What stands before and after an answer in the model's turn: blanks, and the token that ends it.

    Raises:
        InputError: neither the chat template nor the tokenizer says what ends an answer.
    """
    tokenizer, probe = processor.tokenizer, "answer"
    prompt = processor.apply_chat_template(chat("question", []), add_generation_prompt=True, tokenize=False)
    dialog = processor.apply_chat_template(chat("question", [], probe), add_generation_prompt=False, tokenize=False)
    before, after = "", ""
    if dialog.startswith(prompt) and probe in (rest := dialog[len(prompt) :]):
        before, _, after = rest.partition(probe)
    if before.strip():
        before = ""
    for token in sorted(tokenizer.all_special_tokens, key=len, reverse=True):
        if after.startswith(token):
            return before, token
    if not tokenizer.eos_token:
        raise InputError(
            "tune: the model's chat template and tokenizer have no token that ends an answer; expected eos_token in "
            "tokenizer_config.json"
        )
    return before, tokenizer.eos_token


class PairSamples(Dataset[TuningSample]):
    """Pairs by number of the sample; each epoch goes through all in a new order, and takes one answer of each."""

    def __init__(
        self, pairs: Sequence[TuningPair], store: PromptStore, processor: Any, *, longest: int | None, seed: int
    ) -> None:
        """Args:
        pairs: one or more.
        store: of their prompts.
        processor: of the model.
        longest: tokens that the model takes; None = unknown.
        seed: of orders and answers.

        Raises:
            InputError: the model has no token that ends an answer.
        """
        self.pairs, self._store, self._processor = tuple(pairs), store, processor
        self._longest, self._seed = longest, seed
        self._frame = answer_frame(processor)

    def __getitem__(self, number: int) -> TuningSample | InputError:  # type: ignore[override]
        """Sample `number`, or its error as a value."""
        epoch, position = divmod(number, len(self.pairs))
        chosen = int(np.random.default_rng([self._seed, 0, epoch]).permutation(len(self.pairs))[position])
        pair = self.pairs[chosen]
        answer = pair.answers[int(np.random.default_rng([self._seed, 1, number]).integers(len(pair.answers)))]
        try:
            return self.sample(pair, answer)
        except InputError as error:
            return error

    def sample(self, pair: TuningPair, answer: str) -> TuningSample:
        """A pair as tensors.

        Raises:
            InputError: pictures are gone, the processor refuses them, or there are more tokens than the model takes.
        """
        prompt = pair.prompt
        pictures = [Image.fromarray(self._store.picture(name)) for name in prompt.pictures]
        try:
            inputs = dict(
                self._processor.apply_chat_template(
                    chat(prompt.text, pictures),
                    add_generation_prompt=True,
                    tokenize=True,
                    return_dict=True,
                    return_tensors="pt",
                )
            )
        except Exception as error:  # processors and templates raise whatever they like
            message = " ".join(str(error).split())[:160]
            raise InputError(f"{pair.name}: the model's processor refuses the prompt: {message}") from error
        before, end = self._frame
        target = self._processor.tokenizer(before + answer.strip() + end, add_special_tokens=False)["input_ids"]
        ids, added = inputs["input_ids"], torch.tensor(target)[None]
        total = ids.shape[1] + len(target)
        if self._longest is not None and total > self._longest:
            raise InputError(
                f"{pair.name}: {total:,} tokens with {len(pictures)} pictures, and the model takes {self._longest:,}; "
                "give a smaller choose.count="
            )
        for name, value in inputs.items():
            if value.shape == ids.shape:
                tail = added if name == "input_ids" else torch.full_like(added, int(name == "attention_mask"))
                inputs[name] = torch.cat((value, tail.to(value.dtype)), dim=1)
        labels = torch.cat((torch.full((ids.shape[1],), IGNORED), added[0]))
        tokens = torch.from_numpy(self._store.tokens(prompt.tokens).astype(np.float32)) if prompt.tokens else None
        return TuningSample(name=pair.name, inputs=inputs, labels=labels, tokens=tokens)


def join_pairs(samples: Sequence[TuningSample | InputError], *, padding: int) -> TuningBatch | InputError:
    """Joins samples to a batch; if one of them is an error, returns the first error instead.

    Args:
        samples: one or more.
        padding: id of the token that fills up shorter samples; they are masked and without a loss.
    """
    good = []
    for sample in samples:
        if isinstance(sample, InputError):
            return sample
        good.append(sample)
    fills: Mapping[str, int] = {"input_ids": padding}
    inputs = {name: _stacked([each.inputs[name] for each in good], fills.get(name, 0)) for name in good[0].inputs}
    tokens = [each.tokens for each in good if each.tokens is not None]
    return TuningBatch(
        names=tuple(each.name for each in good),
        inputs=inputs,
        labels=_stacked([each.labels[None] for each in good], IGNORED),
        tokens=torch.cat(tokens) if tokens else None,
    )


def _stacked(values: Sequence[Tensor], fill: int) -> Tensor:
    """Rows of several tensors, whose other axes are filled up at their ends to the longest."""
    sizes = [max(value.shape[axis] for value in values) for axis in range(1, values[0].ndim)]
    padded = []
    for value in values:
        missing = [size - have for size, have in zip(sizes, value.shape[1:], strict=True)]
        pads = [pad for size in reversed(missing) for pad in (0, size)]
        padded.append(torch.nn.functional.pad(value, pads, value=fill) if any(missing) else value)
    return torch.cat(padded)
