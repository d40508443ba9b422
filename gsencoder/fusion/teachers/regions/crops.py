"""Crops of regions through an image tower: one vector for the box of each region, of unit length."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from PIL import Image

from gsencoder.core.errors import InputError
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
from gsencoder.fusion.teachers.regions.config import OnnxRegionOptions
from gsencoder.fusion.teachers.resize import normalized
from gsencoder.text.models import JOINT
from gsencoder.types import FeatureSpace, Views

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
