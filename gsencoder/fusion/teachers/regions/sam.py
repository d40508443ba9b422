"""Masks of a SAM or SAM2 model of transformers, prompted with a grid of points (Kirillov et al., Segment Anything).

For each point the model gives three masks with the IoU that it predicts of each. Masks stay whose predicted IoU and
whose stability are large enough; of two that overlap too much the one with the larger predicted IoU stays. What still
overlaps, as a mug and the table under it, is painted with the smaller mask on top.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, find_file, load_companion, load_pretrained, read_config
from gsencoder.fusion.teachers import MissingInput
from gsencoder.fusion.teachers.regions.config import RegionsConfig
from gsencoder.fusion.teachers.resize import normalized
from gsencoder.fusion.teachers.tower_preprocessing import read_preprocessing
from gsencoder.types import Views

WHAT = "teacher regions"
SAM, SAM2 = ("sam",), ("sam2", "sam2_video")
POINTS_AT_ONCE = 32
STABILITY_OFFSET = 1.0
"""Logits above and below 0 at which the masks are compared whose IoU is the stability."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Proposal:
    """A mask that a model proposes.

    Attributes:
        top: first row of its box.
        left: first column.
        pixels: the mask inside of its box.
        area: number of its pixels.
        score: the IoU that the model predicts of it.
    """

    top: int
    left: int
    pixels: Bool[np.ndarray, "h w"]
    area: int
    score: float

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        height, width = self.pixels.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Input:
    """A picture as the model takes it: its tensor, and the rows and columns of it that the picture fills."""

    tensor: Any
    rows: int
    columns: int


class SamMasks:
    """Masks that a model of a folder makes; see `gsencoder.fusion.teachers.regions.masks.RegionMasks`."""

    needs_images = True
    cheap = False

    def __init__(self, config: RegionsConfig) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere.

        Args:
            config: the folder, and which masks stay.

        Raises:
            InputError: transformers is missing, or the folder holds no SAM with its preprocessing.
        """
        if not config.sam:
            raise InputError("teacher.sam= is missing: the folder of a SAM model, for masks=sam")
        folder = find_file(config.sam, "teacher.sam", folder=True)
        kind = read_config(folder, WHAT).model_type
        if kind not in (*SAM, *SAM2):
            raise InputError(f"{WHAT}: {folder} holds a {kind} model, expected sam or sam2")
        import transformers

        from gsencoder.core.device import choose_device

        self.config, self._is_first = config, kind in SAM
        loader = transformers.SamModel if self._is_first else transformers.Sam2Model
        # The published SAM2 is a model of videos, whose memory is no part of one of pictures.
        model = load_pretrained(loader, folder, WHAT, other_parts="warn" if self._is_first else "ignore")
        if self._is_first:
            self._processor = load_companion(transformers.AutoImageProcessor, folder, WHAT, "preprocessing")
        else:
            self._side = int(model.config.prompt_encoder_config.image_size)
            # The preprocessing of SAM2 in transformers needs torchvision: a squeeze to a square, and these colors.
            self._colors = read_preprocessing(folder, WHAT)
        self._device = choose_device(config.device)
        self._model = model.to(self._device)
        self._digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("*.json")]))

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The masks of a photograph, numbered from 1 from the largest to the smallest.

        Raises:
            InputError: no pictures, or outputs that are not finite.
        """
        if views.images is None:
            raise MissingInput(f"{WHAT}: masks=sam: the scene has no pictures")
        image = views.images[view]
        try:
            staying = suppress(self.proposals(image), self.config.max_overlap)
        except (InputError, RuntimeError) as error:
            message = " ".join(str(error).split())[:200]
            advice = "" if isinstance(error, InputError) else "; expected a configuration and weights of one SAM model"
            raise InputError(f"{WHAT}: view {views.names[view]!r}: {message}{advice}") from error
        return paint(staying, image.shape[:2])

    def proposals(self, image: UInt8[np.ndarray, "H W 3"]) -> Iterator[Proposal]:
        """All masks of the points of the grid whose predicted IoU, stability and size are large enough, best first.

        Masks are made at the resolution of the photograph one at a time, so that memory does not grow with it.

        Raises:
            InputError: outputs that are not finite.
        """
        from gsencoder.core.device import enough_memory

        prepared = self._prepare(image)
        size = image.shape[0], image.shape[1]
        for score, logits in sorted(self._candidates(prepared), key=lambda candidate: -candidate[0]):
            with enough_memory(WHAT, "teacher.points="):
                proposal = self._proposal(self._logits_of_picture(logits, prepared, size), score)
            if proposal is not None:
                yield proposal

    def _candidates(self, prepared: _Input) -> list[tuple[float, Any]]:
        """The masks whose predicted IoU is large enough, as that IoU and logits of the model's own resolution."""
        import torch

        from gsencoder.core.device import enough_memory

        points = grid_points(self.config.points) * np.array([prepared.columns, prepared.rows], np.float32)
        candidates: list[tuple[float, Any]] = []
        with torch.inference_mode(), enough_memory(WHAT, "teacher.points="):
            embeddings = self._model.get_image_embeddings(prepared.tensor)
            for start in range(0, len(points), POINTS_AT_ONCE):
                chunk = torch.from_numpy(points[start : start + POINTS_AT_ONCE]).to(self._device)
                outputs = self._model(
                    image_embeddings=embeddings,
                    input_points=chunk[None, :, None],
                    input_labels=torch.ones((1, len(chunk), 1), dtype=torch.long, device=self._device),
                    multimask_output=True,
                )
                scores, masks = outputs.iou_scores[0].flatten().float(), outputs.pred_masks[0].flatten(0, 1).float()
                if not (torch.isfinite(scores).all() and torch.isfinite(masks).all()):
                    raise InputError("masks or scores of SAM are not finite; check the weights")
                good = torch.nonzero(scores >= self.config.min_iou)[:, 0]
                # Indexing copies, so that the other masks of the chunk are freed.
                candidates += zip(scores[good].tolist(), masks[good], strict=True)
        return candidates

    def _prepare(self, image: UInt8[np.ndarray, "H W 3"]) -> _Input:
        import torch

        if self._is_first:
            inputs = self._processor(images=Image.fromarray(image), return_tensors="pt")
            rows, columns = inputs["reshaped_input_sizes"][0].tolist()
            return _Input(tensor=inputs["pixel_values"].to(self._device), rows=rows, columns=columns)
        side = self._side
        squeezed = np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BILINEAR))
        colors = self._colors
        values = normalized(squeezed, 1 / colors.factor, colors.mean, colors.std).transpose(2, 0, 1)[None]
        return _Input(tensor=torch.from_numpy(np.ascontiguousarray(values)).to(self._device), rows=side, columns=side)

    def _logits_of_picture(self, logits: Any, prepared: _Input, size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
        """The logits of a mask at the resolution of the picture, without the padding of the input."""
        from torch.nn.functional import interpolate

        values = logits[None, None]
        if self._is_first:
            values = interpolate(values, tuple(prepared.tensor.shape[-2:]), mode="bilinear", align_corners=False)
            values = values[..., : prepared.rows, : prepared.columns]
        return np.asarray(interpolate(values, size, mode="bilinear", align_corners=False)[0, 0].cpu())

    def _proposal(self, logits: Float32[np.ndarray, "H W"], score: float) -> Proposal | None:
        mask = logits > 0
        area = int(mask.sum())
        if area < self.config.min_area or stability(logits) < self.config.min_stability:
            return None
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        pixels = mask[top : rows[-1] + 1, left : columns[-1] + 1].copy()
        return Proposal(top=top, left=left, pixels=pixels, area=area, score=score)

    def settings(self) -> dict[str, Any]:
        names = ("points", "min_iou", "min_stability", "max_overlap")
        return {"masks": "sam", "model": self._digest, **{name: getattr(self.config, name) for name in names}}


def grid_points(side: int) -> Float32[np.ndarray, "n 2"]:
    """Points (x, y) of a regular grid over the unit square, each in the middle of its cell."""
    ticks = (np.arange(side, dtype=np.float32) + 0.5) / side
    x, y = np.meshgrid(ticks, ticks)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def stability(logits: Float32[np.ndarray, "H W"]) -> float:
    """The IoU of the masks at logit thresholds of 1 and −1, one of which lies in the other."""
    outer = int((logits > -STABILITY_OFFSET).sum())
    return int((logits > STABILITY_OFFSET).sum()) / outer if outer else 0.0


def mask_iou(a: Proposal, b: Proposal) -> float:
    """Shared pixels of two masks, by those of either."""
    (top, left), (bottom, right) = zip(
        *((max(p.start, q.start), min(p.stop, q.stop)) for p, q in zip(a.box, b.box, strict=True)), strict=True
    )
    if top >= bottom or left >= right:
        return 0.0
    parts = (each.pixels[top - each.top : bottom - each.top, left - each.left : right - each.left] for each in (a, b))
    shared = int(np.logical_and(*parts).sum())
    return shared / (a.area + b.area - shared)


def suppress(proposals: Iterable[Proposal], max_overlap: float) -> list[Proposal]:
    """Greedy non-maximum suppression of masks, best score first: one stays if its IoU with no better one that stays is
    above `max_overlap`."""
    staying: list[Proposal] = []
    for proposal in proposals:
        if not any(_overlap(proposal, better, max_overlap) for better in staying):
            staying.append(proposal)
    return staying


def _overlap(a: Proposal, b: Proposal, most: float) -> bool:
    """Whether the IoU of two masks is above `most`; it is at most the ratio of their areas, which is quickly told."""
    return min(a.area, b.area) > most * max(a.area, b.area) and mask_iou(a, b) > most


def paint(proposals: Sequence[Proposal], size: tuple[int, int]) -> Int32[np.ndarray, "H W"]:
    """A label image of masks, numbered from 1 by falling area; where masks overlap, the smaller one is on top."""
    labels = np.zeros(size, np.int32)
    for label, proposal in enumerate(sorted(proposals, key=lambda each: -each.area), start=1):
        labels[proposal.box][proposal.pixels] = label
    return labels
