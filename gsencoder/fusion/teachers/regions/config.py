"""Settings of the `regions` teacher: where masks come from, and what vector each region gets."""

from dataclasses import dataclass, field
from typing import Literal

from gsencoder.core.errors import InputError
from gsencoder.core.process import Device

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
