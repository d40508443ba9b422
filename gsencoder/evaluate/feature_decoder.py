"""Text of rendered views: what a vision-language model says to features, and the best caption of a pool (M3 sec. 3.4).

X = F_dec(R̂): features of a model's own tower, rendered at any pose, take the place of those of the tower, and the
model decodes them to text.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import EXTRA, load_companion, load_pretrained, quiet_transformers

LABEL = "captions"
CONNECTORS = ("connector", "multi_modal_projector")
"""Names that models of transformers give to the module between vision tower and language model."""
MAX_TOKENS = 64


def retrieve_captions(
    cells: Float32[np.ndarray, "n D"], captions: Sequence[str], vectors: Float32[np.ndarray, "C D"], *, count: int = 1
) -> list[tuple[str, float]]:
    """The captions of a pool whose vectors fit the rendered features of a view best, with their scores, best first; of
    equal ones the first. The score is the largest cosine of a cell; vectors are compared as they are."""
    if not captions or len(captions) != len(vectors):
        raise InputError(f"{LABEL}: expected captions with a vector each, got {len(captions)} and {len(vectors)}")
    first, second = (
        each / np.linalg.norm(each, axis=1, keepdims=True)
        for each in (cells.astype(np.float64), vectors.astype(np.float64))
    )
    scores = (first @ second.T).max(axis=0)
    if not np.isfinite(scores).all():
        raise InputError(f"{LABEL}: expected finite features and vectors of captions, got NaN or Inf")
    return [(captions[row], float(scores[row])) for row in np.argsort(-scores, kind="stable")[:count]]


def generate_from_features(
    model: Any,
    inputs: Mapping[str, Tensor],
    tokens: Float[Tensor, "pictures _tokens _D"],
    *,
    max_tokens: int = MAX_TOKENS,
) -> Int64[Tensor, "B new"]:
    """What a vision-language model generates, greedily, if its tower gives these features.

    They replace what goes into the module between tower and language model (`CONNECTORS`): the hidden states of the
    patches, of the layer that the model reads, without a summary token where the model drops it. That is the last layer
    after the final norm for Idefics3, SmolVLM, PaliGemma and Gemma 3, and layer −2 for LLaVA. The tower still runs on
    the pictures of `inputs`, and what it says of them is dropped.

    Args:
        model: of transformers, such as `AutoModelForImageTextToText` loads.
        inputs: of the model's processor, for pictures of any content and of the right size.
        tokens: for each picture the tower's vectors of the patches, in lines from the top left.

    Returns:
        The ids of the generated tokens alone.
    """
    connectors = {name: each for name, each in model.named_modules() if name.rpartition(".")[2] in CONNECTORS}
    if len(connectors) != 1:
        raise InputError(
            f"{LABEL}: expected a model with one module called {' or '.join(CONNECTORS)} between its tower and its "
            f"language model, got {type(model).__name__} with {len(connectors)}"
        )
    replaced = 0

    def replace(_: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        nonlocal replaced
        if not arguments or arguments[0].shape != tokens.shape:
            expected = "none" if not arguments else str(tuple(arguments[0].shape))
            raise InputError(
                f"{LABEL}: {type(model).__name__} takes features [pictures, patches, channels] of {expected}, got "
                f"{tuple(tokens.shape)}; render them on the grid of its tower"
            )
        replaced += 1
        return (tokens.to(arguments[0].device, arguments[0].dtype), *arguments[1:])

    handle = next(iter(connectors.values())).register_forward_pre_hook(replace)
    try:
        with torch.inference_mode(), quiet_transformers():
            ids = model.generate(**inputs, max_new_tokens=max_tokens, do_sample=False, num_beams=1)
    finally:
        handle.remove()
    if replaced != 1:
        raise InputError(f"{LABEL}: {type(model).__name__} read its tower {replaced} times; expected once")
    return ids[:, inputs["input_ids"].shape[1] :]


class FeatureDecoder:
    """M3's F_dec: a vision-language model that is given rendered features in place of its tower's.

    Attributes:
        processor: that belongs to it. A picture is one square: cutting it into parts is switched off.
        side: pixels along the pictures that the tower takes.
        grid: rows and columns of its patches, for `gsencoder.infer.views.pictures.token_blends`.
    """

    def __init__(self, folder: str | Path) -> None:
        """Loads the model from a folder of transformers; nothing is fetched from anywhere."""
        try:
            import transformers
        except ImportError as error:
            raise InputError(f"{LABEL}: needs the package transformers ({EXTRA})") from error
        path = Path(folder)
        self.model = load_pretrained(transformers.AutoModelForImageTextToText, path, LABEL)
        self.processor = load_companion(transformers.AutoProcessor, path, LABEL, "processor")
        vision = getattr(self.model.config, "vision_config", None)
        side, patch = getattr(vision, "image_size", None), getattr(vision, "patch_size", None)
        if not isinstance(side, int) or not isinstance(patch, int):
            raise InputError(f"{LABEL}: {path}: expected a tower with square pictures and patches of known sizes")
        self.side, self.grid = side, (side // patch, side // patch)
        if hasattr(self.processor.image_processor, "do_image_splitting"):
            self.processor.image_processor.do_image_splitting = False

    def decode(
        self,
        tokens: Float[Tensor, "V tokens D"],
        prompt: str = "Describe this picture.",
        *,
        max_tokens: int = MAX_TOKENS,
    ) -> list[str]:
        """What the model answers to each view, greedily; `tokens` are those of
        `gsencoder.infer.views.pictures.feature_tokens` on `grid` (see `generate_from_features`)."""
        if not torch.isfinite(tokens).all():
            raise InputError(f"{LABEL}: expected finite features, got NaN or Inf")
        inputs = self.inputs(prompt)
        ids = [generate_from_features(self.model, inputs, view[None], max_tokens=max_tokens)[0] for view in tokens]
        return [str(self.processor.tokenizer.decode(each, skip_special_tokens=True)).strip() for each in ids]

    def inputs(self, prompt: str, picture: Any = None) -> dict[str, Tensor]:
        """The model's inputs for a prompt about one picture.

        Args:
            picture: a Pillow image; None = a white one of the tower's size. Pixels that are 0 after normalization, as
                gray ones nearly are, may count as no picture at all.
        """
        from PIL import Image

        picture = Image.new("RGB", (self.side, self.side), "white") if picture is None else picture
        if getattr(self.processor, "chat_template", None):
            content = [{"type": "image"}, {"type": "text", "text": prompt}]
            messages = [{"role": "user", "content": content}]
            text = self.processor.apply_chat_template(messages, add_generation_prompt=True, tokenize=False)
        else:
            text = f"{self.processor.image_token}{prompt}"
        return dict(self.processor(text=text, images=[picture], return_tensors="pt"))
