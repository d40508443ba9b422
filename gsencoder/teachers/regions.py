"""The `regions` teacher: masks of regions, and one vector for each, of its caption or of the picture (M3 sec. 3.3,
LangSplat)."""

import hashlib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image

from gsencoder.core.device import choose_device, enough_memory
from gsencoder.core.errors import InputError, SceneWarning, error_prefix, listed
from gsencoder.core.pretrained import (
    ANY,
    digest_files,
    find_file,
    load_companion,
    load_pretrained,
    quiet_transformers,
    read_config,
)
from gsencoder.core.process import Device
from gsencoder.core.settings import option
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.teachers.base import MissingInput, Teacher, TeacherSettings, check_channels, settings_of, text_encoder_of
from gsencoder.teachers.labels import codes_of
from gsencoder.teachers.masks import (
    LABEL,
    FileMasks,
    InstanceMasks,
    RegionMasks,
    SamMasks,
    SamOptions,
    scene_path,
    view_stem,
)
from gsencoder.teachers.onnx import DenseOnnxOptions, OnnxConfig
from gsencoder.teachers.pictures import LARGEST_SIDE, OnnxNetwork
from gsencoder.teachers.radio import RadioConfig
from gsencoder.teachers.tower import TransformersConfig
from gsencoder.text.table import MAX_NAME
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

CAPTIONS_FILE = "captions.json"
Captions = Mapping[str, Mapping[int, str]]
"""Captions by label, for each view that has some by its name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxRegionOptions(DenseOnnxOptions):
    """How pictures are given to the .onnx file of an image tower, and how its output is read."""

    size: int = option(
        0,
        "pixels along the longer side of the picture (map), or the side of a square crop (crop; a model of "
        "a fixed size has its own); 0 = 448 and 224",
        ge=0,
        le=LARGEST_SIDE,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionsConfig(TeacherSettings, SamOptions):
    """Where masks of regions come from, and what vector each region gets."""

    per_scene: ClassVar[bool] = True

    name: Literal["regions"] = "regions"
    masks: Literal["files", "instances", "sam"] = option(
        "files",
        "files = label images in teacher.folder=; instances = the instance maps of the scene; sam = masks "
        "of a SAM model, teacher.sam=",
    )
    folder: str = option(
        "",
        "masks=files: folder of label images, one a view, called like the photograph but with .png, .npy "
        "or .safetensors; looked for in the scene's folder, then as a path",
    )
    vector: Literal["captions", "map", "crop"] = option(
        "captions",
        "captions = the text vector of each region's caption or name; map = the mean of teacher.model's "
        "dense features over the region; crop = teacher.model's pooled vector of the region's box",
    )
    captions: str = option(
        "",
        'vector=captions: a JSON file, {"label": "caption"} or {"view": {"label": "caption"}}; empty = '
        "captions.json in the folder of the masks, or with masks=instances the names of the scene's objects",
    )
    rest: Literal["none", "mean"] = option(
        "mean",
        "vector=captions: what pixels without a captioned region are: mean = something else, the direction "
        "of the text side's mean; none = nothing is known of them, they have no feature",
    )
    words: str = option("", "text table of the teacher's space, or of the captions, if no text= is given")
    model: str = option(
        "",
        "image tower of vector=map and vector=crop: an .onnx file, or a folder of a model for transformers "
        "(map: a vision tower or RADIO; crop: CLIP, SigLIP or another with a pooled output); also looked for in "
        "GSENCODER_MODELS",
    )
    joint: bool = option(
        False,
        "the image tower is the image side of the joint model that text= is the text side of; with "
        "vector=crop a folder of CLIP or SigLIP says so itself",
    )
    around: Literal["picture", "nothing"] = option(
        "picture", "vector=crop: what of the box is not in the region: the photograph as it is, or plain gray"
    )
    sam: str = option("", "folder of a SAM model for transformers; also looked for in GSENCODER_MODELS")
    device: Device = option("auto", "where models of folders run")
    onnx: OnnxRegionOptions = field(default_factory=OnnxRegionOptions)

    def __post_init__(self) -> None:
        TeacherSettings.__post_init__(self)
        if self.vector == "captions" and self.masks == "sam":
            raise InputError(
                "vector: captions belong to labels that are known, and masks=sam numbers its masks itself; give "
                "vector=map or vector=crop, or label images (masks=files)"
            )
        captions, other = self.vector == "captions", "vector=map and vector=crop"
        defaults = {item.name: item.default for item in fields(self)} | {"onnx": OnnxRegionOptions()}
        for name, used, owner in (
            ("folder", self.masks == "files", "masks=files"),
            ("sam", self.masks == "sam", "masks=sam"),
            ("model", not captions, other),
            ("joint", not captions, other),
            ("onnx", not captions, other),
            ("captions", captions, "vector=captions"),
            ("rest", captions, "vector=captions"),
            ("around", self.vector == "crop", "vector=crop"),
        ):
            if not used and getattr(self, name) != defaults[name]:
                raise InputError(f"{name}: is an option of {owner}, and masks is {self.masks}, vector {self.vector}")

    def build(self, scene: Scene, words: Words | None) -> Teacher:
        if self.vector == "captions" and words is None:
            raise InputError(
                f"{LABEL}: captions need words: give a text tower (text=onnx text.model=FOLDER), or a text table "
                "that has them (teacher.words=)"
            )
        masks = self._masks(scene)
        if scene.views is None:
            raise InputError(f"{LABEL}: the scene has no views")
        if words is not None and self.vector == "captions":
            captions, source = self._captions(scene, scene.views, masks)
            return CaptionedRegions(scene.views, masks, captions, words, rest=self.rest == "mean", source=source)
        vectors = self._vectors(scene, words)
        check_channels(vectors.space, words)
        return PicturedRegions(scene.views, masks, vectors, min_area=self.min_area)

    def refuse_text(self) -> str:
        if self.vector != "captions" and not self.joint and not (self.vector == "crop" and is_joint(self.model)):
            return (
                "text=: vectors of regions are taken for those of the text tower if teacher.joint=true says that "
                "teacher.model= and text= belong to one joint model, such as CLIP; other models have no words"
            )
        return TeacherSettings.refuse_text(self)

    def _masks(self, scene: Scene) -> RegionMasks:
        if self.masks == "instances":
            return InstanceMasks(scene)
        if self.masks == "files":
            return FileMasks(scene, self.folder)
        return SamMasks(self.sam, self, self.device)

    def _captions(self, scene: Scene, views: Views, masks: RegionMasks) -> tuple[Captions, str]:
        """Captions, and where they are from."""
        if self.captions:
            path = scene_path(scene, self.captions, "teacher.captions")
        elif isinstance(masks, FileMasks):
            path = masks.folder / CAPTIONS_FILE
        else:
            names = {item.id: item.name for item in scene.objects if item.name is not None}
            if not names:
                raise InputError(
                    f"{LABEL}: masks=instances: no object of the scene has a name (objects.json); give "
                    "a JSON file of captions, teacher.captions="
                )
            return dict.fromkeys(views.names, names), OBJECTS
        if not path.is_file():
            raise InputError(
                f"{LABEL}: {path}: no such file; vector=captions needs captions of the labels: give "
                "teacher.captions=, or vector=map or vector=crop"
            )
        return read_captions(path, views.names), str(path)

    def _vectors(self, scene: Scene, words: Words | None) -> "MapVectors | CropVectors":
        """What makes vectors of regions from the picture."""
        if not self.model:
            raise InputError(
                f"teacher.model= is missing: the image tower of vector={self.vector}, an .onnx file or "
                "a folder for transformers"
            )
        if self.vector == "map":
            return MapVectors(dense_settings(self).build(scene, words))
        tower: OnnxImageTower | TransformersImageTower
        if self.model.lower().endswith(".onnx"):
            tower = OnnxImageTower(find_file(self.model, "teacher.model"), self.onnx)
        else:
            tower = TransformersImageTower(find_file(self.model, "teacher.model", folder=True), self.device)
        return CropVectors(tower, text_encoder=text_encoder_of(words), around=self.around)


def dense_settings(config: RegionsConfig) -> TeacherSettings:
    """The settings of the teacher whose maps are averaged over regions."""
    if config.model.lower().endswith(".onnx"):
        options = {item.name: getattr(config.onnx, item.name) for item in fields(DenseOnnxOptions)}
        return OnnxConfig(model=config.model, **{**options, "size": config.onnx.size or OnnxConfig().size})
    folder = find_file(config.model, "teacher.model", folder=True)
    if read_config(folder, LABEL).model_type == "radio":
        return RadioConfig(model=config.model, device=config.device)
    return TransformersConfig(model=config.model, device=config.device)


OBJECTS = "objects.json"
FORMS = '{"label": "caption"} for all views, or {"view": {"label": "caption"}}'


def read_captions(path: Path, view_names: Sequence[str]) -> Captions:
    """Captions of a JSON file: {"label": "caption"} for all views, or {"view": {"label": "caption"}}.

    Views are called by their names, with or without the ending, or by the last part of the name where that is unique.
    """
    data = read_json(path, unique_keys=True)
    kinds = {isinstance(value, dict) for value in data.values()} if isinstance(data, dict) else set()
    if len(kinds) != 1:
        raise InputError(f"{path}: expected captions of regions, {FORMS}")
    if kinds == {False}:
        return dict.fromkeys(view_names, _labels(data, str(path)))
    by_stem, by_end = dict[str, list[str]](), dict[str, list[str]]()
    for name in view_names:
        by_stem.setdefault(str(view_stem(name)), []).append(name)
        by_end.setdefault(view_stem(name).name, []).append(name)
    captions: dict[str, Mapping[int, str]] = {}
    for view, texts in data.items():
        stem, labels = str(view_stem(view)), _labels(texts, f"{path}: view {view[:40]!r}")
        names = by_stem.get(stem) or by_end.get(stem, [])
        if len(names) > 1 and stem not in by_stem:
            raise InputError(f"{path}: {stem!r} stands for {len(names)} views; write their whole names")
        for name in names:
            if name in captions:
                raise InputError(f"{path}: view {name!r} is listed twice")
            captions[name] = labels
    if not captions:
        raise InputError(
            f"{path}: none of its {len(data)} views is one of the scene, first {next(iter(data))[:40]!r}; the "
            f"scene's are {view_names[0]!r}, …"
        )
    return captions


def _labels(data: Mapping[str, Any], where: str) -> dict[int, str]:
    captions: dict[int, str] = {}
    for key, text in data.items():
        if not (key.isascii() and key.isdigit()) or not 1 <= int(key[:12]) < 2**31:
            raise InputError(f"{where}: expected labels as numbers from 1, got {key[:40]!r} ({FORMS})")
        if not isinstance(text, str) or not text.strip() or len(text) > MAX_NAME:
            raise InputError(
                f"{where}: label {key}: expected a caption of 1 to {MAX_NAME:,} characters, got {str(text)[:40]!r}"
            )
        if int(key) in captions:
            raise InputError(f"{where}: label {int(key)} has two captions")
        captions[int(key)] = text.strip()
    return captions


IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])


class CaptionedRegions:
    """Each pixel has the vector of its region's caption; pixels of no region, or of one without a caption, have none,
    or with `rest` that of something else: the direction of the text side's mean.

    Attributes:
        kinds: the captions, which are stored with the features as words.
        captions: rows of the table, "" where it is the mean's direction.
    """

    cheap = True

    def __init__(
        self, views: Views, masks: RegionMasks, captions: Captions, words: Words, *, rest: bool, source: str
    ) -> None:
        """Embeds the captions, and looks at the labels of all views once; warns of regions without a caption, and of
        captions of labels that no view has. `source` names the captions in messages."""
        self._masks, self._captions, self._rest, self._source = masks, captions, rest, source
        self.needs_images = masks.needs_images
        used = self._check_labels(views)
        self.kinds = tuple(sorted(used))
        self.captions = (*([""] if rest else []), *self.kinds)
        self.mean = words.mean
        with error_prefix(f"{LABEL}: captions"):
            vectors = words.encode(self.kinds)
        if rest:
            direction = words.mean.astype(np.float64)
            direction /= np.sqrt((direction * direction).sum() + 1e-24)
            vectors = np.concatenate([direction.astype(np.float32)[None], vectors])
        self.table: Float32[np.ndarray, "C D"] = np.ascontiguousarray(vectors, np.float32)
        self._row_of = {caption: row for row, caption in enumerate(self.captions)}
        self.space = FeatureSpace(
            name=f"regions-{words.space.text_encoder}",
            channels=words.space.channels,
            teacher="regions",
            layer="captions of regions" + (", the rest as the mean" if rest else ""),
            text_encoder=words.space.text_encoder,
        )

    def _check_labels(self, views: Views) -> set[str]:
        """The captions that occur."""
        used, bare, everywhere, regions = set[str](), set[int](), set[int](), [0, 0]
        for view, name in enumerate(views.names):
            labels = regions_of(self._masks.labels(views, view))[0].tolist()
            captions = self._captions.get(name, {})
            everywhere.update(labels)
            used |= {captions[label] for label in labels if label in captions}
            without = [label for label in labels if label not in captions]
            bare.update(without)
            regions = [regions[0] + len(labels), regions[1] + len(without)]
        if not everywhere:
            raise InputError(f"{LABEL}: the masks of all {len(views)} views are empty: they have no label above 0")
        if not used:
            raise InputError(
                f"{LABEL}: {self._source}: none of its captions belongs to one of the {regions[0]:,} regions, whose "
                f"labels are {_numbers(everywhere)}"
            )
        if bare:
            _warn(
                f"{LABEL}: {regions[1]:,} of {regions[0]:,} regions in {len(views)} views have no caption and "
                f"{'count as something else' if self._rest else 'no feature'}; their labels are {_numbers(bare)}"
            )
        unused = {label for captions in self._captions.values() for label in captions} - everywhere
        # Objects of a scene may be hidden in all views; a file of captions was written for its masks.
        if unused and self._source != OBJECTS:
            _warn(f"{LABEL}: {self._source}: {len(unused)} labels occur in no mask: {_numbers(unused)}")
        return used

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at the resolution of the picture."""
        labels = self._masks.labels(views, view)
        captions = self._captions.get(views.names[view], {})
        rows = {label: self._row_of[text] for label, text in captions.items() if text in self._row_of}
        codes = codes_of(labels, rows)
        if self._rest:
            codes = np.maximum(codes, 0)
        return FeatureMap(codes=codes, table=self.table, grid_from_image=IDENTITY, space=self.space)

    def settings(self) -> dict[str, Any]:
        digest = hashlib.sha256(self.table.tobytes() + repr(self._captions).encode("utf-8", "backslashreplace"))
        return {"name": "regions", "captions": digest.hexdigest()[:16], "rest": self._rest, **self._masks.settings()}


def regions_of(labels: Int32[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Labels above 0, and their numbers of pixels."""
    values, sizes = np.unique(labels, return_counts=True)
    return values[values > 0], sizes[values > 0]


def _numbers(labels: Iterable[int]) -> str:
    return listed([str(label) for label in sorted(labels)])


def _warn(message: str) -> None:
    warnings.warn(message, SceneWarning, stacklevel=2)


class PicturedRegions:
    """Each pixel has the vector that its region has in this view; every map has a table of its own."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, views: Views, masks: RegionMasks, vectors: "MapVectors | CropVectors", *, min_area: int) -> None:
        """Looks at the masks of all views once, where they are at hand, and warns of regions of less than `min_area`
        pixels."""
        if views.images is None:
            raise MissingInput(f"{LABEL}: the scene has no pictures to make vectors of regions from")
        self._masks, self._vectors, self._min_area = masks, vectors, min_area
        self.space = vectors.space
        if masks.cheap:
            self._check_sizes(views)

    def _check_sizes(self, views: Views) -> None:
        sizes = np.concatenate([regions_of(self._masks.labels(views, view))[1] for view in range(len(views))])
        small = int((sizes < self._min_area).sum())
        where = f"regions in {len(views)} views have less than {self._min_area} pixels"
        if not len(sizes):
            raise InputError(f"{LABEL}: the masks of all {len(views)} views are empty: they have no label above 0")
        if small == len(sizes):
            raise InputError(f"{LABEL}: all {small:,} {where} (teacher.min_area)")
        if small:
            _warn(f"{LABEL}: {small:,} of {len(sizes):,} {where} and no feature (teacher.min_area)")

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at the resolution of the picture, into the vectors of the view's regions."""
        labels = self._masks.labels(views, view)
        values, sizes = regions_of(labels)
        regions = [int(value) for value in values[sizes >= self._min_area]]
        table = np.zeros((0, self.space.channels), np.float32)
        if regions:
            table = self._vectors.vectors(views, view, labels, regions)
        codes = codes_of(labels, {label: row for row, label in enumerate(regions)})
        return FeatureMap(codes=codes, table=table, grid_from_image=IDENTITY, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {
            "name": "regions",
            "min_area": self._min_area,
            **self._masks.settings(),
            "vectors": self._vectors.settings(),
        }


class MapVectors:
    """The mean of a dense teacher's features over the pixels of a region, each with the cell that its center is in."""

    def __init__(self, teacher: Teacher) -> None:
        self.teacher = teacher
        space = teacher.space
        self.space = FeatureSpace(
            name=f"regions-{space.name}",
            channels=space.channels,
            teacher="regions",
            weights=space.weights,
            layer=f"{space.layer}, means over regions",
            preprocessing=space.preprocessing,
            text_encoder=space.text_encoder,
        )

    def vectors(
        self, views: Views, view: int, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
    ) -> Float32[np.ndarray, "n D"]:
        """Means over regions; InputError where the teacher gives no finite vector in a region."""
        dense = self.teacher.feature_map(views, view)
        means = region_means(dense, labels, regions)
        bad = np.flatnonzero(~np.isfinite(means).all(axis=1))
        if bad.size:
            raise InputError(
                f"{LABEL}: view {views.names[view]!r}: {bad.size} of {len(regions)} regions have no finite "
                f"vector, first label {regions[bad[0]]}; check the model, and how pictures are given to it"
            )
        return means

    def settings(self) -> dict[str, Any]:
        return {"vector": "map", "teacher": self.teacher.settings()}


def region_means(
    dense: FeatureMap, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
) -> Float32[np.ndarray, "n D"]:
    """The mean vector of a dense map over the pixels of each region: cells weighted by their pixels in it.

    A pixel beyond the border of the grid takes the nearest cell; cells without a vector count for nothing, and a region
    without any other is NaN.
    """
    affine, (height, width) = dense.grid_from_image, labels.shape
    line = np.floor(affine[1, 1] * (np.arange(height) + 0.5) + affine[1, 2]).astype(np.int64).clip(0, dense.height - 1)
    column = np.floor(affine[0, 0] * (np.arange(width) + 0.5) + affine[0, 2]).astype(np.int64).clip(0, dense.width - 1)
    cell = line[:, None] * dense.width + column
    codes = codes_of(labels, {label: row for row, label in enumerate(regions)})
    inside = codes >= 0
    cells = dense.height * dense.width
    counts = np.bincount(codes[inside].astype(np.int64) * cells + cell[inside], minlength=len(regions) * cells)
    counts = counts.reshape(len(regions), cells).astype(np.float64)
    rows = dense.rows()
    finite = np.isfinite(rows).all(axis=1)
    counts = counts[:, finite]
    sizes = counts.sum(axis=1, keepdims=True)
    return ((counts @ rows[finite].astype(np.float64)) / np.where(sizes > 0, sizes, np.nan)).astype(np.float32)


JOINT_IMAGE = {
    "clip": ("CLIPVisionModelWithProjection", "image_embeds"),
    "siglip": ("SiglipVisionModel", "pooler_output"),
    "siglip2": ("Siglip2VisionModel", "pooler_output"),
}
"""Image sides of joint models: class of transformers, and its output in the joint space."""
DEFAULT_SIDE = 224


class CropVectors:
    """The vector of each region's box, filled up to a square with plain gray."""

    def __init__(
        self,
        tower: "OnnxImageTower | TransformersImageTower",
        *,
        text_encoder: str,
        around: Literal["picture", "nothing"],
    ) -> None:
        self.tower, self._around = tower, around
        self.space = FeatureSpace(
            name=f"regions-{tower.name}",
            channels=tower.channels,
            teacher="regions",
            weights=tower.digest,
            layer="crops of regions" + (", masked" if around == "nothing" else ""),
            preprocessing=tower.preprocessing,
            text_encoder=text_encoder,
        )

    def vectors(
        self, views: Views, view: int, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
    ) -> Float32[np.ndarray, "n D"]:
        """Unit vectors of crops; InputError for one that is not finite or has no length."""
        assert views.images is not None
        image = views.images[view]
        vectors = [self._vector(image, labels == label, label, views.names[view]) for label in regions]
        return np.stack(vectors)

    def _vector(
        self, image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], label: int, view: str
    ) -> Float32[np.ndarray, " D"]:
        vector = self.tower.embed(square_crop(image, mask, self.tower.gray, masked=self._around == "nothing"))
        vector = vector.astype(np.float64)
        length = float(np.sqrt((vector * vector).sum()))
        if not 1e-12 < length < np.inf:
            raise InputError(
                f"{LABEL}: view {view!r}, label {label}: the vector of {self.tower.name} is not finite or has no "
                "length; check the model, and how pictures are given to it"
            )
        return (vector / length).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        return settings_of(self.space)


def square_crop(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    gray: tuple[int, int, int],
    *,
    masked: bool,
) -> UInt8[np.ndarray, "S S 3"]:
    """The box of a mask, in the middle of a gray square, so that no tower cuts off the ends of a long region; with
    `masked`, pixels of the box outside of the mask are gray, too."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    crop = image[box]
    color = np.array(gray, np.uint8)
    if masked:
        crop = np.where(mask[box][..., None], crop, color)
    side = max(crop.shape[:2])
    square = np.broadcast_to(color, (side, side, 3)).copy()
    top, left = (side - crop.shape[0]) // 2, (side - crop.shape[1]) // 2
    square[top : top + crop.shape[0], left : left + crop.shape[1]] = crop
    return square


class OnnxImageTower:
    """An .onnx file that gives a square picture one pooled vector, [1, D]; `gray` is the 8-bit color that means nothing
    to it."""

    def __init__(self, path: Path, options: OnnxRegionOptions) -> None:
        """Reads the model's signature, and runs it once to see how many channels it gives."""
        self._network = network = OnnxNetwork(path, options, LABEL)
        self._side = network.fixed[1] if network.fixed else options.size or DEFAULT_SIDE
        self.name, self.digest = network.name, network.digest
        self.gray = _gray([value * options.scale for value in options.mean])
        self.preprocessing = (
            f"square of {self._side} px, output {network.output}, / {options.scale:g} − {list(options.mean)} "
            f"/ {list(options.std)}"
        )
        self.channels = len(self.embed(np.zeros((self._side, self._side, 3), np.uint8)))

    def embed(self, picture: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " D"]:
        """The pooled vector of a square picture."""
        resized = Image.fromarray(picture).resize((self._side, self._side), Image.Resampling.BICUBIC)
        output = self._network.run(np.asarray(resized))
        sides = np.shape(output)
        if len(sides) < 2 or sides[0] != 1 or any(side != 1 for side in sides[2:]):
            raise InputError(
                f"{self._network.subject} gave {self._network.output!r} of shape {list(sides)}, expected a pooled "
                "output [1, channels]; give teacher.onnx.output=, or vector=map for a dense one"
            )
        return np.asarray(output, np.float32).reshape(-1)


class TransformersImageTower:
    """The image side of CLIP, SigLIP or SigLIP2, or another model with a pooled output; attributes are those of
    `OnnxImageTower`."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere."""
        loaded = read_config(folder, LABEL)
        import transformers

        kind = loaded.model_type.removesuffix("_vision_model")
        loader, self._output = JOINT_IMAGE.get(kind, ("AutoModel", "pooler_output"))
        ignored = ANY if kind in JOINT_IMAGE else ()
        if kind == "clip" and hasattr(loaded, "vision_config"):
            # Releases state the width of the joint space at the top alone, where the image side does not look.
            loaded.vision_config.projection_dim = loaded.projection_dim
            options = {"config": loaded.vision_config}
        else:
            options = {}
        model = load_pretrained(getattr(transformers, loader), folder, LABEL, ignored=ignored, **options)
        with quiet_transformers():
            self._processor = load_companion(transformers.AutoImageProcessor, folder, LABEL, "preprocessing")
        self._uncut = _without_cropping(self._processor)
        self._device = choose_device(device)
        self._model = model.to(self._device)
        self.name, self.preprocessing = folder.resolve().name, "the model's own, of a whole square"
        self.digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("*.json")]))
        self.gray = _gray([255 * value for value in getattr(self._processor, "image_mean", None) or (0.5, 0.5, 0.5)])
        self.channels = len(self.embed(np.zeros((32, 32, 3), np.uint8)))

    def embed(self, picture: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " D"]:
        """The pooled vector of a square picture; InputError where the model has none."""
        with quiet_transformers():
            inputs = self._processor(images=Image.fromarray(picture), return_tensors="pt", **self._uncut)
        try:
            with torch.inference_mode(), enough_memory(LABEL, "the size of the model"):
                outputs = self._model(**{name: value.to(self._device) for name, value in inputs.items()})
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(
                f"{LABEL}: {self.name} does not run on what its preprocessing makes of a picture: {message}; expected "
                "config.json and preprocessor_config.json of one model"
            ) from error
        pooled = getattr(outputs, self._output, None)
        if pooled is None:
            raise InputError(
                f"{LABEL}: {self.name}: a {self._model.config.model_type} model has no pooled output; give CLIP, "
                "SigLIP or another model with one, or vector=map for a dense one"
            )
        return np.asarray(pooled[0].flatten().float().cpu())


def is_joint(model: str) -> bool:
    """Whether the configuration of a folder says that it is the image side of a joint model."""
    if not model or model.lower().endswith(".onnx"):
        return False
    loaded = read_config(find_file(model, "teacher.model", folder=True), LABEL)
    kind: str = loaded.model_type.removesuffix("_vision_model")
    return kind in JOINT_IMAGE


def _without_cropping(processor: Any) -> dict[str, Any]:
    """Options by which a processor gives the whole of a square the size that it would cut out of a larger one."""
    crop = getattr(processor, "crop_size", None)
    if not getattr(processor, "do_center_crop", False) or crop is None or crop["height"] != crop["width"]:
        return {}
    return {"do_center_crop": False, "size": {"shortest_edge": crop["height"]}}


def _gray(values: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(min(max(float(value), 0.0), 255.0)) for value in values)
    return red, green, blue
