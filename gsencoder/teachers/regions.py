"""The `regions` teacher from its settings: masks of regions, and one vector for each (M3 sec. 3.3, LangSplat)."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.pretrained import (
    choose_tensors,
    digest_files,
    find_file,
    load_companion,
    load_pretrained,
    open_session,
    quiet_transformers,
    read_config,
    run_on_picture,
)
from gsencoder.core.process import Device
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.teachers.captions import (
    IDENTITY,
    CaptionedRegions,
    Captions,
    captions_of_objects,
    codes_of,
    read_captions,
)
from gsencoder.teachers.masks import (
    FileMasks,
    InstanceMasks,
    OnnxRegionOptions,
    RegionMasks,
    RegionsConfig,
    SamMasks,
    scene_path,
)
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher, normalized
from gsencoder.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.text.models import JOINT
from gsencoder.text.vocabulary import OpenVocabulary, Words
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views


@runtime_checkable
class RegionVectors(Protocol):
    """Makes a vector of each region of a picture.

    Attributes:
        space: of the vectors.
    """

    @property
    def space(self) -> FeatureSpace: ...

    def vectors(
        self, views: Views, view: int, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
    ) -> Float32[np.ndarray, "n D"]:
        """A vector for each of the regions; NaN where there is none."""
        ...

    def settings(self) -> dict[str, Any]:
        """All that the vectors depend on beside views and labels, as JSON values."""
        ...


class PicturedRegions:
    """Each pixel has the vector that its region has in this view; every map has a table of its own."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, views: Views, masks: RegionMasks, vectors: RegionVectors, *, min_area: int) -> None:
        """Looks at the masks of all views once, where they are at hand.

        Args:
            views: of the scene.
            masks: of regions.
            vectors: of regions.
            min_area: smallest number of pixels of a region in a view.

        Raises:
            InputError: the scene has no pictures, or no view has a region that is large enough.

        Warns:
            SceneWarning: regions are too small.
        """
        if views.images is None:
            raise MissingInput("teacher regions: the scene has no pictures to make vectors of regions from")
        self._masks, self._vectors, self._min_area = masks, vectors, min_area
        self.space = vectors.space
        if masks.cheap:
            self._check_sizes(views)

    def _check_sizes(self, views: Views) -> None:
        sizes = np.concatenate([_regions_of(self._masks.labels(views, view))[1] for view in range(len(views))])
        small = int((sizes < self._min_area).sum())
        if not len(sizes):
            raise InputError(
                f"teacher regions: the masks of all {len(views)} views are empty: they have no label above 0"
            )
        if small == len(sizes):
            raise InputError(
                f"teacher regions: all {small:,} regions in {len(views)} views have less than {self._min_area} "
                "pixels (teacher.min_area)"
            )
        if small:
            warnings.warn(
                f"teacher regions: {small:,} of {len(sizes):,} regions in {len(views)} views have less than "
                f"{self._min_area} pixels and no feature (teacher.min_area)",
                SceneWarning,
                stacklevel=4,
            )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at the resolution of the picture, into the vectors of the view's regions.

        Raises:
            InputError: the mask or the picture cannot be read, or a vector is not finite.
        """
        labels = self._masks.labels(views, view)
        values, sizes = _regions_of(labels)
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


def _regions_of(labels: Int32[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Labels above 0, and their numbers of pixels."""
    values, sizes = np.unique(labels, return_counts=True)
    return values[values > 0], sizes[values > 0]


class MapVectors:
    """The mean of a dense teacher's features over the pixels of a region, each with the cell that its center is in."""

    def __init__(self, teacher: Teacher) -> None:
        """Args:
        teacher: with dense maps.
        """
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
        """Means over regions.

        Raises:
            InputError: the teacher gives no finite vector in a region.
        """
        dense = self.teacher.feature_map(views, view)
        means = region_means(dense, labels, regions)
        bad = np.flatnonzero(~np.isfinite(means).all(axis=1))
        if bad.size:
            raise InputError(
                f"teacher regions: view {views.names[view]!r}: {bad.size} of {len(regions)} regions have no finite "
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

    Args:
        dense: of the same view.
        labels: at the resolution of the picture.
        regions: labels whose means are wanted.
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


WHAT = "teacher regions"
JOINT_IMAGE = {
    "clip": ("CLIPVisionModelWithProjection", "image_embeds"),
    "siglip": ("SiglipVisionModel", "pooler_output"),
    "siglip2": ("Siglip2VisionModel", "pooler_output"),
}
"""Image sides of joint models: class of transformers, and its output in the joint space."""
DEFAULT_SIDE = 224


@runtime_checkable
class ImageTower(Protocol):
    """Turns a picture into one vector.

    Attributes:
        name: for people.
        digest: of its files.
        channels: D.
        preprocessing: in words.
        gray: the color, 0 to 255, that means nothing to it.
        joint: whether its files say that it is the image side of a joint model.
    """

    name: str
    digest: str
    channels: int
    preprocessing: str
    gray: tuple[int, int, int]
    joint: bool

    def embed(self, picture: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " D"]:
        """The pooled vector of a square picture."""
        ...


class CropVectors:
    """The vector of each region's box, filled up to a square with plain gray."""

    def __init__(self, tower: ImageTower, *, text_encoder: str, around: str) -> None:
        """Args:
        tower: embeds crops.
        text_encoder: what turns words into its space; empty if nothing does.
        around: "picture", or "nothing" = the rest of the box is gray.
        """
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
        """Unit vectors of crops.

        Raises:
            InputError: the model does not run, or gives a vector that is not finite or has no length.
        """
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
                f"{WHAT}: view {view!r}, label {label}: the vector of {self.tower.name} is not finite or has no "
                "length; check the model, and how pictures are given to it"
            )
        return (vector / length).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        return {
            "vector": "crop",
            "model": self.tower.digest,
            "preprocessing": self.tower.preprocessing,
            "around": self._around,
            "text_encoder": self.space.text_encoder,
        }


def square_crop(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    gray: tuple[int, int, int],
    *,
    masked: bool,
) -> UInt8[np.ndarray, "S S 3"]:
    """The box of a mask, in the middle of a gray square, so that no tower cuts off the ends of a long region.

    Args:
        image: the photograph.
        mask: of one region, not empty.
        gray: the color of what is no part of the crop.
        masked: whether that holds for the pixels of the box outside of the mask, too.
    """
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
    """An .onnx file with a pooled output [1, D]; see `ImageTower`."""

    joint = False

    def __init__(self, path: Path, options: OnnxRegionOptions) -> None:
        """Reads the model's signature, and runs it once to see how many channels it gives.

        Args:
            path: of the file.
            options: how pictures are given to it.

        Raises:
            InputError: it cannot be read, does not take a square picture, or has no pooled output.
        """
        self._session = open_session(path, WHAT, threads=options.threads)
        self._options, self.name = options, path.stem
        advice = " (teacher.onnx.input, teacher.onnx.output)"
        self._tensors = choose_tensors(self._session, options.input, options.output, f"{WHAT}: {path.name}", advice)
        shape = next(each.shape for each in self._session.get_inputs() if each.name == self._tensors[0])
        fixed = shape[-1] if len(shape) == 4 and isinstance(shape[-1], int) and shape[-1] > 0 else 0
        self._side = fixed or options.size or DEFAULT_SIDE
        self.digest = digest_files(path)
        self.gray = _gray([value * options.scale for value in options.mean])
        self.preprocessing = (
            f"square of {self._side} px, output {self._tensors[1]}, / {options.scale:g} − {list(options.mean)} "
            f"/ {list(options.std)}"
        )
        self.channels = len(self.embed(np.zeros((self._side, self._side, 3), np.uint8)))

    def embed(self, picture: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " D"]:
        """See `ImageTower.embed`.

        Raises:
            InputError: the model does not run on it, or its output is no pooled one.
        """
        options = self._options
        resized = Image.fromarray(picture).resize((self._side, self._side), Image.Resampling.BICUBIC)
        tensor = normalized(np.asarray(resized), options.scale, options.mean, options.std).transpose(2, 0, 1)[None]
        output = run_on_picture(self._session, self._tensors, tensor, f"{WHAT}: {self.name}")
        sides = np.shape(output)
        if len(sides) < 2 or sides[0] != 1 or any(side != 1 for side in sides[2:]):
            raise InputError(
                f"{WHAT}: {self.name} gave {self._tensors[1]!r} of shape {list(sides)}, expected a pooled output "
                "[1, channels]; give teacher.onnx.output=, or vector=map for a dense one"
            )
        return np.asarray(output, np.float32).reshape(-1)


class TransformersImageTower:
    """The image side of CLIP, SigLIP or SigLIP2, or another model with a pooled output; see `ImageTower`."""

    def __init__(self, folder: Path, device: Device) -> None:
        """Loads model and preprocessing; nothing is fetched from anywhere.

        Args:
            folder: of the model.
            device: where it runs.

        Raises:
            InputError: transformers is missing, or the folder holds no such model with its preprocessing.
        """
        stated = read_config(folder, WHAT)
        import transformers

        from gsencoder.core.device import choose_device

        kind = stated.model_type.removesuffix("_vision_model")
        loader, self._output = JOINT_IMAGE.get(kind, ("AutoModel", "pooler_output"))
        self.joint = kind in JOINT_IMAGE and kind in JOINT
        other = "ignore" if kind in JOINT_IMAGE else "warn"
        if kind == "clip" and hasattr(stated, "vision_config"):
            # Releases state the width of the joint space at the top alone, where the image side does not look.
            stated.vision_config.projection_dim = stated.projection_dim
            options = {"config": stated.vision_config}
        else:
            options = {}
        model = load_pretrained(getattr(transformers, loader), folder, WHAT, other_parts=other, **options)
        with quiet_transformers():
            self._processor = load_companion(transformers.AutoImageProcessor, folder, WHAT, "preprocessing")
        self._uncut = _without_cropping(self._processor)
        self._device = choose_device(device)
        self._model = model.to(self._device)
        self.name, self.preprocessing = folder.resolve().name, "the model's own, of a whole square"
        self.digest = digest_files(*sorted([*folder.glob("*.safetensors"), *folder.glob("*.json")]))
        self.gray = _gray([255 * value for value in getattr(self._processor, "image_mean", None) or (0.5, 0.5, 0.5)])
        self.channels = len(self.embed(np.zeros((32, 32, 3), np.uint8)))

    def embed(self, picture: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " D"]:
        """See `ImageTower.embed`.

        Raises:
            InputError: the model has no pooled output.
        """
        import torch

        from gsencoder.core.device import enough_memory

        with quiet_transformers():
            inputs = self._processor(images=Image.fromarray(picture), return_tensors="pt", **self._uncut)
        try:
            with torch.inference_mode(), enough_memory(WHAT, "the size of the model"):
                outputs = self._model(**{name: value.to(self._device) for name, value in inputs.items()})
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(
                f"{WHAT}: {self.name} does not run on what its preprocessing makes of a picture: {message}; expected "
                "config.json and preprocessor_config.json of one model"
            ) from error
        pooled = getattr(outputs, self._output, None)
        if pooled is None:
            raise InputError(
                f"{WHAT}: {self.name}: a {self._model.config.model_type} model has no pooled output; give CLIP, SigLIP "
                "or another model with one, or vector=map for a dense one"
            )
        return np.asarray(pooled[0].flatten().float().cpu())


def is_joint(model: str) -> bool:
    """Whether the configuration of a folder says that it is the image side of a joint model.

    Raises:
        InputError: there is no such folder, or transformers cannot read its configuration.
    """
    if model.lower().endswith(".onnx"):
        return False
    stated = read_config(find_file(model, "teacher.model", folder=True), WHAT)
    kind = stated.model_type.removesuffix("_vision_model")
    return kind in JOINT_IMAGE and kind in JOINT


def _without_cropping(processor: Any) -> dict[str, Any]:
    """Options by which a processor gives the whole of a square the size that it would cut out of a larger one."""
    crop = getattr(processor, "crop_size", None)
    if not getattr(processor, "do_center_crop", False) or crop is None or crop["height"] != crop["width"]:
        return {}
    return {"do_center_crop": False, "size": {"shortest_edge": crop["height"]}}


def _gray(values: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(min(max(float(value), 0.0), 255.0)) for value in values)
    return red, green, blue


RegionsTeacher = CaptionedRegions | PicturedRegions
CAPTIONS_FILE = "captions.json"


def build_regions(config: RegionsConfig, scene: Scene, words: Words | None) -> RegionsTeacher:
    """The teacher of one scene.

    Args:
        config: settings.
        scene: whose masks and captions are read.
        words: of the space; they embed captions.

    Raises:
        InputError: masks, captions, a model or words are missing or do not fit.
    """
    if config.vector == "captions" and words is None:
        raise InputError(
            "teacher regions: captions need words: give a text tower (text=onnx text.model=FOLDER), or a text table "
            "that has them (teacher.words=)"
        )
    masks = _masks(config, scene)
    if scene.views is None:
        raise InputError("teacher regions: the scene has no views")
    if config.vector == "captions":
        assert words is not None
        captions = _captions(config, scene, masks)
        return CaptionedRegions(scene.views, masks, captions, words, rest=config.rest == "mean")
    vectors = _vectors(config, words)
    if words is not None and words.space.channels != vectors.space.channels:
        raise InputError(
            f"teacher regions: its vectors have {vectors.space.channels} channels and its words "
            f"{words.space.channels} ({words.space.text_encoder}); expected both of one joint model"
        )
    return PicturedRegions(scene.views, masks, vectors, min_area=config.min_area)


def _masks(config: RegionsConfig, scene: Scene) -> RegionMasks:
    if config.masks == "instances":
        return InstanceMasks(scene)
    return SamMasks(config) if config.masks == "sam" else FileMasks(scene, config.folder)


def _captions(config: RegionsConfig, scene: Scene, masks: RegionMasks) -> Captions:
    assert scene.views is not None
    if config.captions:
        return read_captions(scene_path(scene, config.captions, "teacher.captions"), scene.views.names)
    if isinstance(masks, FileMasks):
        path = masks.folder / CAPTIONS_FILE
        if not path.is_file():
            raise InputError(
                f"teacher regions: {path}: no such file; vector=captions needs captions of the labels: give "
                "teacher.captions=, or vector=map or vector=crop"
            )
        return read_captions(path, scene.views.names)
    return captions_of_objects(scene.objects)


def _vectors(config: RegionsConfig, words: Words | None) -> RegionVectors:
    """Vectors from the picture.

    Raises:
        InputError: no model, one that cannot be used, or words that it is not the image side of.
    """
    if not config.model:
        raise InputError(
            f"teacher.model= is missing: the image tower of vector={config.vector}, an .onnx file or "
            "a folder for transformers"
        )
    text_encoder = words.space.text_encoder if words is not None else ""
    if config.vector == "map":
        dense = dense_teacher(config, text_encoder)
        if isinstance(words, OpenVocabulary) and isinstance(dense, TransformersTeacher) and not dense.joint:
            raise InputError(
                f"text=: no words lead into {dense.space.layer} of {dense.space.name}; leave out text=, or give a "
                "text-aligned model (CLIP, SigLIP, SigLIP2) with its head"
            )
        return MapVectors(dense)
    tower: ImageTower
    if config.model.lower().endswith(".onnx"):
        tower = OnnxImageTower(find_file(config.model, "teacher.model"), config.onnx)
    else:
        tower = TransformersImageTower(find_file(config.model, "teacher.model", folder=True), config.device)
    if words is not None and not (tower.joint or config.joint or config.words):
        raise InputError(
            f"text=: the vectors of {tower.name} are taken for those of the text tower if teacher.joint=true says that "
            "both belong to one joint model, such as CLIP; other towers have no words"
        )
    return CropVectors(tower, text_encoder=text_encoder, around=config.around)


def dense_teacher(config: RegionsConfig, text_encoder: str) -> Teacher:
    """The teacher whose maps are averaged over regions.

    Raises:
        InputError: it cannot be used.
    """
    if not config.model.lower().endswith(".onnx"):
        folder = find_file(config.model, "teacher.model", folder=True)
        if read_config(folder, "teacher regions").model_type != "radio":
            return TransformersTeacher(
                TransformersConfig(model=config.model, device=config.device), text_encoder=text_encoder
            )
        return RadioTeacher(RadioConfig(model=config.model, device=config.device), text_encoder=text_encoder)
    options = config.onnx
    return OnnxTeacher(
        OnnxConfig(
            model=config.model,
            input=options.input,
            output=options.output,
            layout=options.layout,
            skip_tokens=options.skip_tokens,
            patch=options.patch,
            size=options.size or OnnxConfig().size,
            scale=options.scale,
            mean=options.mean,
            std=options.std,
            threads=options.threads,
        ),
        text_encoder=text_encoder,
    )
