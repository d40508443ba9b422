"""Dense classifiers of transformers: semantic heads (SegFormer, UperNet, DPT, …) and heads of masks and classes
(Mask2Former, OneFormer, EoMT), each with its own preprocessing."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsencoder.core.pretrained import (
    digest_files,
    load_companion,
    load_pretrained,
    load_tokenizer,
    quiet_transformers,
    read_config,
)
from gsencoder.core.process import Device

WHAT = "teacher segmenter"
MASK_HEADS = ("mask2former", "oneformer", "maskformer", "eomt", "eomt_dinov3")
"""Kinds of models that give a class and a mask for each of many queries."""


class TransformersSegmenter:
    """See `gsencoder.fusion.teachers.segmenter.Segmenter`."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere.

        Args:
            folder: of the model.
            device: where the model runs.

        Raises:
            InputError: transformers is missing, or the folder holds no segmenter with its preprocessing.
        """
        config = read_config(folder, WHAT)
        import transformers

        from gsencoder.core.device import choose_device

        self._kind = config.model_type
        universal = self._kind in MASK_HEADS
        loader = "AutoModelForUniversalSegmentation" if universal else "AutoModelForSemanticSegmentation"
        model = load_pretrained(getattr(transformers, loader), folder, WHAT)
        if self._kind == "oneformer":
            self._processor = _oneformer_processor(folder, config.task_seq_len)
        else:
            self._processor = load_companion(transformers.AutoImageProcessor, folder, WHAT, "preprocessing")
        self._device = choose_device(device)
        self._model = model.to(self._device)
        self.name = folder.resolve().name
        names = getattr(config, "id2label", None) or {}
        unnamed = all(str(name).startswith("LABEL_") for name in names.values())
        self.classes = () if unnamed else tuple(str(names[number]) for number in sorted(names))
        self.preprocessing = "the model's own"
        files = [*folder.glob("*.safetensors"), *folder.glob("*.json"), *folder.glob("*.txt")]
        self.digest = digest_files(*sorted(files))

    def outputs(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        num_classes: int,  # noqa: ARG002
    ) -> tuple[Float32[np.ndarray, "h w C"], bool, Float64[np.ndarray, "2 3"]]:
        """Class scores of one picture: logits of a semantic head, probabilities of a head of masks."""
        import torch

        task = {"task_inputs": ["semantic"]} if self._kind == "oneformer" else {}
        with quiet_transformers():
            inputs = self._processor(images=image, return_tensors="pt", **task)
        input_size = inputs["pixel_values"].shape[-2:]
        filled = _filled(inputs.get("pixel_mask"), input_size)
        with torch.inference_mode():
            outputs = self._model(**{name: value.to(self._device) for name, value in inputs.items()})
            are_probabilities = self._kind in MASK_HEADS
            if are_probabilities:
                scores = _semantic_map(outputs.class_queries_logits[0], outputs.masks_queries_logits[0])
            else:
                scores = outputs.logits[0]
        values = scores.permute(1, 2, 0).float().cpu().numpy()
        # Padding at the right and below is part of the grid, and no part of the picture.
        rows, columns = (side * used / size for side, used, size in zip(values.shape, filled, input_size, strict=False))
        affine = np.array([[columns / image.shape[1], 0.0, 0.0], [0.0, rows / image.shape[0], 0.0]])
        return np.ascontiguousarray(values), are_probabilities, affine


def _oneformer_processor(folder: Path, task_tokens: int) -> Any:
    """OneFormer's preprocessing, which also tokenizes its task.

    Its files name a list of classes that lies in another repository and serves training alone; without this override
    transformers would fetch it.
    """
    from transformers import AutoImageProcessor, OneFormerProcessor

    images = load_companion(AutoImageProcessor, folder, WHAT, "preprocessing", class_info_file=None)
    return OneFormerProcessor(images, load_tokenizer(folder, WHAT), task_seq_length=task_tokens)


def _semantic_map(classes: Any, masks: Any) -> Any:
    """Σ over queries of the probability of a class, times that of the mask, [C, h, w]; cells that several queries claim
    are brought down to a sum of 1."""
    import torch

    probabilities = classes.float().softmax(dim=-1)[..., :-1]
    scores = torch.einsum("qc,qhw->chw", probabilities, masks.float().sigmoid())
    return scores / scores.sum(dim=0, keepdim=True).clamp(min=1)


def _filled(pixel_mask: Any, input_size: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns that the picture fills."""
    if pixel_mask is None:
        return input_size[0], input_size[1]
    mask = pixel_mask[0].bool()
    return int(mask.any(dim=1).sum()), int(mask.any(dim=0).sum())
