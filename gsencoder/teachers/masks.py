"""Masks of regions: for each pixel of a view the number of its region, from files, instance maps, or a SAM model.

SAM and SAM2 of transformers are prompted with a grid of points (Kirillov et al., Segment Anything). For each point the
model gives three masks with the IoU that it predicts of each. Masks stay whose predicted IoU and whose stability are
large enough; of two that overlap too much the one with the larger predicted IoU stays. Where masks still overlap, as a
mug and the table under it, the smaller one is on top.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image
from torch.nn.functional import interpolate

from gsencoder.core.device import choose_device, enough_memory
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import ANY, digest_files, find_file, load_companion, load_pretrained, read_config
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.data.readers.masks import LABEL_SUFFIXES, label_files
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.pictures import photograph, read_preprocessing
from gsencoder.types import Scene, Views
from gsencoder.types.orientation import turned

LABEL = "teacher regions"
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")


@runtime_checkable
class RegionMasks(Protocol):
    """The region of each pixel of a view, 0 = none; `settings` and `cheap` are those of `Teacher`."""

    needs_images: bool
    cheap: bool

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]: ...

    def settings(self) -> dict[str, Any]: ...


class InstanceMasks:
    """The instance maps of the scene."""

    needs_images = False
    cheap = True

    def __init__(self, scene: Scene) -> None:
        if scene.views is None or scene.views.instances is None:
            raise MissingInput(
                "teacher regions: masks=instances: the scene has no instance maps (instance_file_path in "
                "transforms.json); give label images with masks=files teacher.folder="
            )
        self._instances = scene.views.instances

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The instance map of a view."""
        assert views.instances is not None
        return views.instances[view]

    def settings(self) -> dict[str, Any]:
        digest = hashlib.sha256()
        for labels in self._instances:
            digest.update(repr(labels.shape).encode() + np.ascontiguousarray(labels).tobytes())
        return {"masks": "instances", "labels": digest.hexdigest()[:16]}


class FileMasks:
    """Label images in a folder, one for each view of a scene."""

    needs_images = False
    cheap = True

    def __init__(self, scene: Scene, folder: str) -> None:
        """Finds the file of each view in a folder; see `scene_path`."""
        if not folder:
            raise InputError(
                "teacher.folder= is missing: the folder of label images, one a view; or give "
                "masks=instances or masks=sam"
            )
        if scene.views is None:
            raise InputError("teacher regions: masks=files: the scene has no views that label images could belong to")
        self.folder = scene_path(scene, folder, "teacher.folder")
        if not self.folder.is_dir():
            raise InputError(f"teacher.folder: {self.folder} is no folder; expected one of label images")
        self._paths = label_paths(self.folder, scene.views.names)
        self._files = label_files(self._paths, scene.views)
        self._row_of = {name: row for row, name in enumerate(scene.views.names)}
        self._orientations = scene.views.orientations

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The label image of a view."""
        row = self._row_of[views.names[view]]
        labels: Int32[np.ndarray, "H W"] = self._files[row]
        # Files lie as photographs are stored; upright views have no orientations.
        if self._orientations is None or views.orientations is not None:
            return labels
        return turned(labels, self._orientations[row])

    def settings(self) -> dict[str, Any]:
        return {"masks": "files", "labels": digest_files(*self._paths)}


def scene_path(scene: Scene, name: str, option: str) -> Path:
    """A file or folder of a scene: in the scene's folder, else at the path itself."""
    inside = scene.folder / name if scene.folder is not None and not Path(name).is_absolute() else None
    existing = [path for path in (inside, Path(name)) if path is not None and path.exists()]
    if not existing:
        tried = " or ".join(str(path) for path in (inside, Path(name)) if path is not None)
        absent = InputError if Path(name).is_absolute() else MissingInput
        raise absent(f"{option}: nothing at {tried}")
    if len(existing) == 2 and not existing[0].samefile(existing[1]):
        raise InputError(
            f"{option}={name}: stands for {existing[0]} and for {existing[1].absolute()}; give a complete path"
        )
    return existing[0]


def view_stem(name: str) -> PurePosixPath:
    """A view's name without the ending of its picture; folders stay, unless they lead upwards."""
    path = PurePosixPath(name)
    stem = path.with_suffix("") if path.suffix.lower() in PICTURE_SUFFIXES else path
    return PurePosixPath(stem.name) if stem.is_absolute() or ".." in stem.parts else stem


def label_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """The label image of each view: called like the view, with another ending; the folders of a view's name may be left
    out where the rest is the name of no other view."""
    stems = [view_stem(name) for name in names]
    count = Counter(stem.name for stem in stems)
    paths: list[Path] = []
    missing: list[str] = []
    for name, stem in zip(names, stems, strict=True):
        bases = [folder / stem, folder / stem.name] if count[stem.name] == 1 else [folder / stem]
        # Not with_suffix, which would cut off the last part of "frame-000012.color".
        candidates = [base.with_name(base.name + suffix) for base in bases for suffix in LABEL_SUFFIXES]
        existing = [path for path in dict.fromkeys(candidates) if path.is_file()]
        if len(existing) > 1:
            raise InputError(
                f"teacher.folder: view {name!r} has {len(existing)} label images, {existing[0]} and {existing[1]}; "
                "remove all but one"
            )
        paths += existing
        missing += [] if existing else [name]
    if missing:
        first = stems[list(names).index(missing[0])]
        raise InputError(
            f"teacher.folder: {folder}: {len(missing)} of {len(names)} views have no label image, first "
            f"{missing[0]!r}; expected {first} with the ending {', '.join(LABEL_SUFFIXES)} (the view's name "
            "with another ending; its folders may be left out where the rest is the name of no other view)"
        )
    if len(set(paths)) < len(paths):
        double = next(path for path in paths if paths.count(path) > 1)
        raise InputError(
            f"teacher.folder: {double} would belong to {paths.count(double)} views; rename the photographs"
        )
    return paths


SAM, SAM2 = ("sam",), ("sam2", "sam2_video")
POINTS_AT_ONCE = 32
STABILITY_OFFSET = 1.0
"""Logits above and below 0 at which the masks are compared whose IoU is the stability."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Proposal:
    """A mask that a model proposes: the pixels of its box, which begins at row `top` and column `left`, how many they
    are, and the IoU that the model predicts."""

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


_Input = tuple[Any, int, int]
"""A picture as the model takes it: its tensor, and the rows and columns of it that the picture fills."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamOptions:
    """Which masks of a SAM model stay."""

    points: int = option(32, "masks=sam: points a side of the grid that prompts it", ge=1, le=256)
    min_iou: float = option(0.88, "masks=sam: smallest IoU that the model predicts of a mask", ge=0, le=1)
    min_stability: float = option(0.95, "masks=sam: smallest IoU of a mask at logit thresholds of 1 and −1", ge=0, le=1)
    max_overlap: float = option(0.7, "masks=sam: of two masks with a larger IoU the better one stays", ge=0, le=1)
    min_area: int = option(
        64, "vector=map and crop, and masks=sam: smallest number of pixels of a region in a view", ge=1, le=1 << 31
    )


class SamMasks:
    """Masks that a model of a folder makes."""

    needs_images = True
    cheap = False

    def __init__(self, model: str, options: SamOptions, device: Device = "auto") -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere."""
        if not model:
            raise InputError("teacher.sam= is missing: the folder of a SAM model, for masks=sam")
        folder = find_file(model, "teacher.sam", folder=True)
        kind = read_config(folder, LABEL).model_type
        if kind not in (*SAM, *SAM2):
            raise InputError(f"{LABEL}: {folder} holds a {kind} model, expected sam or sam2")
        import transformers

        self.options, self._is_first = options, kind in SAM
        loader = transformers.SamModel if self._is_first else transformers.Sam2Model
        # The published SAM2 is a model of videos, whose memory is no part of one of pictures.
        network = load_pretrained(loader, folder, LABEL, ignored=() if self._is_first else ANY)
        if self._is_first:
            self._processor = load_companion(transformers.AutoImageProcessor, folder, LABEL, "preprocessing")
        else:
            self._side = int(network.config.prompt_encoder_config.image_size)
            # The preprocessing of SAM2 in transformers needs torchvision: a squeeze to a square, and these colors.
            self._colors = read_preprocessing(folder, LABEL)
        self._device = choose_device(device)
        self._model = network.to(self._device)
        self._digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("*.json")]))

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The masks of a photograph, numbered from 1 from the largest to the smallest."""
        image = photograph(views, view, f"{LABEL}: masks=sam")
        try:
            staying = suppress(self.proposals(image), self.options.max_overlap)
        except (InputError, RuntimeError) as error:
            message = " ".join(str(error).split())[:200]
            advice = "" if isinstance(error, InputError) else "; expected a configuration and weights of one SAM model"
            raise InputError(f"{LABEL}: view {views.names[view]!r}: {message}{advice}") from error
        return paint(staying, image.shape[:2])

    def proposals(self, image: UInt8[np.ndarray, "H W 3"]) -> Iterator[Proposal]:
        """All masks of the points of the grid whose predicted IoU, stability and size are large enough, best first.

        Masks are made at the resolution of the photograph one at a time, so that memory does not grow with it.
        """
        prepared = self._prepare(image)
        size = image.shape[0], image.shape[1]
        for score, logits in sorted(self._candidates(prepared), key=lambda candidate: -candidate[0]):
            with enough_memory(LABEL, "teacher.points="):
                proposal = self._proposal(self._logits_of_picture(logits, prepared, size), score)
            if proposal is not None:
                yield proposal

    def _candidates(self, prepared: _Input) -> list[tuple[float, Any]]:
        """The masks whose predicted IoU is large enough, as that IoU and logits of the model's own resolution."""
        tensor, rows, columns = prepared
        points = grid_points(self.options.points) * np.array([columns, rows], np.float32)
        candidates: list[tuple[float, Any]] = []
        with torch.inference_mode(), enough_memory(LABEL, "teacher.points="):
            embeddings = self._model.get_image_embeddings(tensor)
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
                good = torch.nonzero(scores >= self.options.min_iou)[:, 0]
                # Indexing copies, so that the other masks of the chunk are freed.
                candidates += zip(scores[good].tolist(), masks[good], strict=True)
        return candidates

    def _prepare(self, image: UInt8[np.ndarray, "H W 3"]) -> _Input:
        if self._is_first:
            inputs = self._processor(images=Image.fromarray(image), return_tensors="pt")
            rows, columns = inputs["reshaped_input_sizes"][0].tolist()
            return inputs["pixel_values"].to(self._device), rows, columns
        side = self._side
        squeezed = np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BILINEAR))
        return self._colors.tensor(squeezed).to(self._device), side, side

    def _logits_of_picture(self, logits: Any, prepared: _Input, size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
        """The logits of a mask at the resolution of the picture, without the padding of the input."""
        values = logits[None, None]
        if self._is_first:
            tensor, rows, columns = prepared
            values = interpolate(values, tuple(tensor.shape[-2:]), mode="bilinear", align_corners=False)
            values = values[..., :rows, :columns]
        return np.asarray(interpolate(values, size, mode="bilinear", align_corners=False)[0, 0].cpu())

    def _proposal(self, logits: Float32[np.ndarray, "H W"], score: float) -> Proposal | None:
        mask = logits > 0
        area = int(mask.sum())
        if area < self.options.min_area or stability(logits) < self.options.min_stability:
            return None
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        pixels = mask[top : rows[-1] + 1, left : columns[-1] + 1].copy()
        return Proposal(top=top, left=left, pixels=pixels, area=area, score=score)

    def settings(self) -> dict[str, Any]:
        names = ("points", "min_iou", "min_stability", "max_overlap")
        return {"masks": "sam", "model": self._digest, **{name: getattr(self.options, name) for name in names}}


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
        # The IoU is at most the ratio of the areas, which is quickly known.
        near = (b for b in staying if min(proposal.area, b.area) > max_overlap * max(proposal.area, b.area))
        if all(mask_iou(proposal, better) <= max_overlap for better in near):
            staying.append(proposal)
    return staying


def paint(proposals: Sequence[Proposal], size: tuple[int, int]) -> Int32[np.ndarray, "H W"]:
    """A label image of masks, numbered from 1 by falling area; where masks overlap, the smaller one is on top."""
    labels = np.zeros(size, np.int32)
    for label, proposal in enumerate(sorted(proposals, key=lambda each: -each.area), start=1):
        labels[proposal.box][proposal.pixels] = label
    return labels
