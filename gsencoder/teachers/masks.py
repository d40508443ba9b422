"""Masks of regions: for each pixel of a view the number of its region, from files or from the scene's instance maps.

Masks of a SAM or SAM2 model of transformers, prompted with a grid of points (Kirillov et al., Segment Anything).

For each point the model gives three masks with the IoU that it predicts of each. Masks stay whose predicted IoU and
whose stability are large enough; of two that overlap too much the one with the larger predicted IoU stays. What still
overlaps, as a mug and the table under it, is painted with the smaller mask on top.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import digest_files, find_file, load_companion, load_pretrained, read_config
from gsencoder.core.process import Device
from gsencoder.data.readers.label_images import LABEL_SUFFIXES, label_files
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.onnx import normalized
from gsencoder.teachers.tower import read_preprocessing
from gsencoder.types import Scene, Views
from gsencoder.types.orientation import turned

ENDINGS = tuple(ending for suffix in LABEL_SUFFIXES for ending in (suffix, suffix.upper()))
"""Of label images, as cameras and people write them."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")


@runtime_checkable
class RegionMasks(Protocol):
    """Tells each pixel of a view which region it belongs to.

    Attributes:
        needs_images: whether it looks at photographs.
        cheap: whether making masks twice costs less than keeping them.
    """

    @property
    def needs_images(self) -> bool: ...

    @property
    def cheap(self) -> bool: ...

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The number of each pixel's region, 0 = none."""
        ...

    def settings(self) -> dict[str, Any]:
        """All that the masks depend on beside the views, as JSON values."""
        ...


class InstanceMasks:
    """The instance maps of the scene."""

    needs_images = False
    cheap = True

    def __init__(self, scene: Scene) -> None:
        """Checks that there are some.

        Raises:
            MissingInput: there are none.
        """
        if scene.views is None or scene.views.instances is None:
            raise MissingInput(
                "teacher regions: masks=instances: the scene has no instance maps (instance_file_path in "
                "transforms.json); give label images with masks=files teacher.folder="
            )
        self._instances = scene.views.instances

    def labels(self, views: Views, view: int) -> Int32[np.ndarray, "H W"]:
        """The instance map of a view.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        if views.instances is None:
            raise MissingInput("teacher regions: masks=instances: the scene has no instance maps")
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
        """Finds the file of each view.

        Args:
            scene: whose views.
            folder: see `scene_path`.

        Raises:
            MissingInput: no such folder beside the scene.
            InputError: no folder is named or there, files that are missing, or several for one view.
        """
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
        """The label image of a view.

        Raises:
            InputError: it cannot be read, or has another size than the photograph.
        """
        row = self._row_of[views.names[view]]
        labels: Int32[np.ndarray, "H W"] = self._files[row]
        # Files lie as photographs are stored; upright views have no orientations.
        if self._orientations is None or views.orientations is not None:
            return labels
        return turned(labels, self._orientations[row])

    def settings(self) -> dict[str, Any]:
        return {"masks": "files", "labels": digest_files(*self._paths)}


def scene_path(scene: Scene, name: str, option: str) -> Path:
    """A file or folder beside a scene: in the scene's folder, else at the path itself.

    Raises:
        MissingInput: there is none, and the name is relative, so that other scenes may have one.
        InputError: there is none at an absolute path, or the name stands for both.
    """
    beside = scene.folder / name if scene.folder is not None and not Path(name).is_absolute() else None
    existing = [path for path in (beside, Path(name)) if path is not None and path.exists()]
    if not existing:
        tried = " or ".join(str(path) for path in (beside, Path(name)) if path is not None)
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
    out where the rest is the name of no other view.

    Raises:
        InputError: views have no file, or several.
    """
    stems = [view_stem(name) for name in names]
    count = Counter(stem.name for stem in stems)
    paths: list[Path] = []
    missing: list[str] = []
    for name, stem in zip(names, stems, strict=True):
        bases = [folder / stem, folder / stem.name] if count[stem.name] == 1 else [folder / stem]
        # Not with_suffix, which would cut off the last part of "frame-000012.color".
        candidates = [base.with_name(base.name + suffix) for base in bases for suffix in ENDINGS]
        existing: list[Path] = []
        for path in dict.fromkeys(candidates):
            # A file system that ignores case has one file under both spellings of an ending.
            if path.is_file() and not any(path.samefile(other) for other in existing):
                existing.append(path)
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


LARGEST_SIDE = 8192


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxRegionOptions:
    """How pictures are given to the .onnx file of an image tower, and how its output is read."""

    input: str = field(default="", metadata={"help": "input tensor [B,3,H,W]; empty = the model's first"})
    output: str = field(default="", metadata={"help": "output tensor; empty = the model's first"})
    layout: Literal["tokens", "grid"] = field(
        default="tokens", metadata={"help": "vector=map: output as [B, T, D] tokens or as [B, D, h, w] grid"}
    )
    skip_tokens: int = field(default=0, metadata={"help": "vector=map: leading tokens that are no patches"})
    patch: int = field(default=14, metadata={"help": "vector=map: pixels of the resized picture in a cell"})
    size: int = field(
        default=0,
        metadata={
            "help": "pixels along the longer side of the picture (map), or the side of a square crop (crop; a model of "
            "a fixed size has its own); 0 = 448 and 224"
        },
    )
    scale: float = field(default=255.0, metadata={"help": "8-bit values are divided by this, then mean and std apply"})
    mean: tuple[float, ...] = field(default=(0.485, 0.456, 0.406), metadata={"help": "subtracted per channel"})
    std: tuple[float, ...] = field(default=(0.229, 0.224, 0.225), metadata={"help": "divided per channel"})
    threads: int = field(default=0, metadata={"help": "onnxruntime threads; 0 = its own choice"})

    def __post_init__(self) -> None:
        for name, low, high in (
            ("skip_tokens", 0, 1_000_000),
            ("patch", 1, LARGEST_SIDE),
            ("size", 0, LARGEST_SIDE),
            ("threads", 0, 1024),
        ):
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}: expected a whole number from {low} to {high}, got {getattr(self, name)}")
        if not 1e-6 <= self.scale <= 1e6:
            raise InputError(f"scale: expected a number from 1e-6 to 1e6, got {self.scale}")
        for name, least in (("mean", -1e6), ("std", 1e-6)):
            values = getattr(self, name)
            if len(values) != 3 or not all(least <= value <= 1e6 for value in values):
                raise InputError(f"{name}: expected three numbers, one a channel, got {list(values)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionsConfig:
    """Where masks of regions come from, and what vector each region gets."""

    name: Literal["regions"] = "regions"
    masks: Literal["files", "instances", "sam"] = field(
        default="files",
        metadata={
            "help": "files = label images in teacher.folder=; instances = the instance maps of the scene; sam = masks "
            "of a SAM model, teacher.sam="
        },
    )
    folder: str = field(
        default="",
        metadata={
            "help": "masks=files: folder of label images, one a view, called like the photograph but with .png, .npy "
            "or .safetensors; looked for in the scene's folder, then as a path"
        },
    )
    vector: Literal["captions", "map", "crop"] = field(
        default="captions",
        metadata={
            "help": "captions = the text vector of each region's caption or name; map = the mean of teacher.model's "
            "dense features over the region; crop = teacher.model's pooled vector of the region's box"
        },
    )
    captions: str = field(
        default="",
        metadata={
            "help": 'vector=captions: a JSON file, {"label": "caption"} or {"view": {"label": "caption"}}; empty = '
            "captions.json in the folder of the masks, or with masks=instances the names of the scene's objects"
        },
    )
    rest: Literal["none", "mean"] = field(
        default="mean",
        metadata={
            "help": "vector=captions: what pixels without a captioned region are: mean = something else, the direction "
            "of the text side's mean; none = nothing is known of them, they have no feature"
        },
    )
    words: str = field(
        default="", metadata={"help": "text table that leads into the space, or has the captions, if no text= is given"}
    )
    model: str = field(
        default="",
        metadata={
            "help": "image tower of vector=map and vector=crop: an .onnx file, or a folder of a model for transformers "
            "(map: a vision tower or RADIO; crop: CLIP, SigLIP or another with a pooled output); also looked for in "
            "GSENCODER_MODELS"
        },
    )
    joint: bool = field(
        default=False,
        metadata={
            "help": "the image tower is the image side of the joint model that text= is the text side of; with "
            "vector=crop a folder of CLIP or SigLIP says so itself"
        },
    )
    around: Literal["picture", "nothing"] = field(
        default="picture",
        metadata={"help": "vector=crop: what of the box is not in the region: the photograph as it is, or plain gray"},
    )
    min_area: int = field(
        default=64,
        metadata={"help": "vector=map and crop, and masks=sam: smallest number of pixels of a region in a view"},
    )
    sam: str = field(
        default="",
        metadata={"help": "folder of a SAM model for transformers; also looked for in GSENCODER_MODELS"},
    )
    points: int = field(default=32, metadata={"help": "masks=sam: points a side of the grid that prompts it"})
    min_iou: float = field(default=0.88, metadata={"help": "masks=sam: smallest IoU that the model predicts of a mask"})
    min_stability: float = field(
        default=0.95,
        metadata={"help": "masks=sam: smallest IoU of a mask at logit thresholds of 1 and −1"},
    )
    max_overlap: float = field(
        default=0.7, metadata={"help": "masks=sam: of two masks with a larger IoU the better one stays"}
    )
    device: Device = field(default="auto", metadata={"help": "where models of folders run"})
    onnx: OnnxRegionOptions = field(default_factory=OnnxRegionOptions)

    def __post_init__(self) -> None:
        if self.vector == "captions" and self.masks == "sam":
            raise InputError(
                "vector: captions belong to labels that are known, and masks=sam numbers its masks anew; give "
                "vector=map or vector=crop, or label images (masks=files)"
            )
        if self.folder and self.masks != "files":
            raise InputError(f"folder: holds label images of masks=files, and masks is {self.masks}")
        if self.sam and self.masks != "sam":
            raise InputError(f"sam: makes the masks of masks=sam, and masks is {self.masks}")
        if self.vector == "captions" and (self.model or self.joint):
            raise InputError("model, joint: belong to vector=map and vector=crop, and vector is captions")
        if self.vector != "captions" and self.captions:
            raise InputError(f"captions: are the vectors of vector=captions, and vector is {self.vector}")
        if self.vector == "captions" and self.onnx != OnnxRegionOptions():
            raise InputError("onnx: says how an image tower is run (vector=map or crop), and vector is captions")
        if self.around != "picture" and self.vector != "crop":
            raise InputError(f"around: says what crops show (vector=crop), and vector is {self.vector}")
        if self.rest != "mean" and self.vector != "captions":
            raise InputError(f"rest: is what has no caption (vector=captions), and vector is {self.vector}")
        if not 1 <= self.min_area <= 1 << 31:
            raise InputError(f"min_area: expected a number from 1, got {self.min_area}")
        if not 1 <= self.points <= 256:
            raise InputError(f"points: expected 1 to 256 points a side, got {self.points}")
        for name in ("min_iou", "min_stability", "max_overlap"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a share in [0, 1], got {getattr(self, name)}")


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
    """Masks that a model of a folder makes; see `gsencoder.teachers.masks.RegionMasks`."""

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
