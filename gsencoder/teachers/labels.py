"""The `labels` teacher: instance maps and a table of name embeddings. An exact oracle for labeled scenes.

With `synonyms` the words of a kind of thing share one vector, so that "couch" and "sofa" are asked and trained alike.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.settings import option
from gsencoder.data.furnished.kinds import kinds
from gsencoder.teachers.base import MissingInput, Teacher, TeacherSettings
from gsencoder.teachers.pictures import photograph
from gsencoder.text.table import TextTable, make_text_table, unit
from gsencoder.text.vocabulary import OpenVocabulary, Words, closed_table
from gsencoder.types import FeatureMap, FeatureSpace, Scene, SceneObject, Views


def codes_of(labels: Int32[np.ndarray, "H W"], row_of: dict[int, int]) -> Int32[np.ndarray, "H W"]:
    """For each pixel the row of its label, −1 for labels without one."""
    if not row_of:
        return np.full(labels.shape, -1, np.int32)
    known = np.array(sorted(row_of), np.int32)
    rows = np.array([row_of[int(label)] for label in known], np.int32)
    nearest = np.searchsorted(known, labels).clip(max=len(known) - 1)
    return np.where(known[nearest] == labels, rows[nearest], np.int32(-1))


def with_kinds(words: Words) -> Words:
    """The words with one vector for all words of a kind of thing, the mean over those that are known, and for broader
    words that over their kinds; a vocabulary with a tower gets the words that it lacks."""
    if isinstance(words, OpenVocabulary):
        names = [name for kind in kinds().values() for name in (*kind.words, *kind.hypernyms)]
        vocabulary = words.including(dict.fromkeys(names))
        return OpenVocabulary(_with_kinds(vocabulary.table), lambda: vocabulary.tower)
    return _with_kinds(words)


def _with_kinds(table: TextTable) -> TextTable:
    vectors, broader = table.embeddings.copy(), dict[int, list[np.ndarray]]()
    of_kinds: set[int] = set()
    for kind in kinds().values():
        rows = [row for word in kind.words if (row := table.find(word)) is not None]
        if rows:
            vectors[rows] = unit(table.embeddings[rows].mean(axis=0, keepdims=True))
            of_kinds.update(rows)
            for word in kind.hypernyms:
                if (row := table.find(word)) is not None:
                    broader.setdefault(row, []).append(vectors[rows[0]])
    for row, below in broader.items():
        if row not in of_kinds:
            vectors[row] = unit(np.mean(below, axis=0, keepdims=True))[0]
    return replace(table, embeddings=vectors)


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsConfig(TeacherSettings):
    """Settings of the labels teacher."""

    per_scene = True
    needs_labels = True

    name: Literal["labels"] = "labels"
    words: str = option(
        "clip_vitb32_names.npz",
        "text table of the names; a bare name is also looked for in GSENCODER_MODELS; this one is installed",
    )
    cell: int = option(
        1, "pixels along a cell; above 1 its vectors are averaged, as a teacher with patches sees them", ge=1
    )

    synonyms: bool = option(
        False, "one vector for all words of a kind of household thing, their mean: couch and sofa are the same"
    )

    others: bool = option(
        True, "pixels without a name have the mean vector of the words, as something else; false = no vector at all"
    )

    def __post_init__(self) -> None:
        TeacherSettings.__post_init__(self)
        if not self.words:
            raise InputError("words: the labels teacher needs a text table of its names")

    def adapt(self, words: Words) -> Words:
        return with_kinds(words) if self.synonyms else words

    def build(self, scene: Scene, words: Words | None) -> "LabelsTeacher":
        assert words is not None
        if isinstance(words, OpenVocabulary):
            words = words.including(sorted({o.name for o in scene.objects if o.name is not None}))
        return LabelsTeacher(scene.objects, closed_table(words), cell=self.cell, others=self.others)

    def refuse_text(self) -> str:
        return ""


class LabelsTeacher:
    """Each pixel has the embedding of its object's name; pixels without a name the normalized mean of the table.

    The mean is a direction too, so "other" is something that a Gaussian can be, and not a hole; without `others` such
    pixels say nothing. Maps are coded: an index for each pixel into the names of this scene. With `cell` above 1 they
    are dense: means over square cells, what a perfect teacher with patches of that size would give; pixels over the
    last whole cell are left out.
    """

    needs_images = False
    cheap = True

    def __init__(self, objects: Sequence[SceneObject], words: TextTable, *, cell: int = 1, others: bool = True) -> None:
        """Makes the scene's table; MissingInput without objects, InputError for a name that `words` lacks."""
        if not objects:
            raise MissingInput(
                "teacher labels: the scene lists no objects; it needs an objects.json in its folder, or the "
                "label files of ScanNet or ScanNet++; teacher=mosaic text=minilm looks at pictures instead"
            )
        text_encoder, row_of = words.space.text_encoder, {name: row for row, name in enumerate(words.names)}
        used = sorted({o.name for o in objects if o.name is not None})
        missing = [name for name in used if name not in row_of]
        if missing:
            raise InputError(
                f"teacher labels: {len(missing)} object names are not among the {len(words)} words of {text_encoder}, "
                f"first {missing[0]!r}; give text=minilm, which encodes any name, or a table that has them "
                "(teacher.words=), or set them to null in objects.json"
            )
        mean = words.mean.astype(np.float64)
        other = (mean / np.sqrt((mean * mean).sum() + 1e-24)).astype(np.float32)
        # Names of one vector are the same thing.
        things = {words.embeddings[row_of[name]].tobytes() for name in used}
        self.kinds = tuple(name for name, row in row_of.items() if words.embeddings[row].tobytes() in things)
        self.names = ("other", *used)
        self.vectors = np.stack([other, *(words.embeddings[row_of[name]] for name in used)]).astype(np.float32)
        self.cell = cell
        self.table = self.vectors if cell == 1 else None
        self.mean = words.mean
        self.space = FeatureSpace(
            name=f"labels-{text_encoder}",
            channels=words.space.channels,
            teacher="labels",
            preprocessing=f"mean of {cell}×{cell} pixels" if cell > 1 else "",
            text_encoder=text_encoder,
        )
        self._others = others
        self._code = {o.id: self.names.index(o.name) for o in objects if o.name is not None}

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at image resolution, or vectors on a grid of cells."""
        if views.instances is None:
            raise MissingInput("teacher labels: the scene has no instance maps (instance_file_path in transforms.json)")
        instances = views.instances[view]
        codes = np.maximum(codes_of(instances, self._code), 0 if self._others else -1).astype(np.int32)
        affine = np.array([[1 / self.cell, 0, 0], [0, 1 / self.cell, 0]])
        if self.table is not None:
            return FeatureMap(codes=codes, table=self.table, grid_from_image=affine, space=self.space)
        h, w = (size // self.cell for size in instances.shape)
        if h == 0 or w == 0:
            raise InputError(f"teacher labels: view {views.names[view]} is smaller than a cell of {self.cell} pixels")
        cells = codes[: h * self.cell, : w * self.cell].reshape(h, self.cell, w, self.cell)
        shares = np.stack([(cells == code).mean(axis=(1, 3)) for code in range(len(self.names))], axis=-1)
        features = (shares @ self.vectors).astype(np.float32)
        features[(cells < 0).any(axis=(1, 3))] = np.nan
        return FeatureMap(features=features, grid_from_image=affine, space=self.space)

    def settings(self) -> dict[str, Any]:
        digest = hashlib.sha256(self.vectors.tobytes() + repr(sorted(self._code.items())).encode()).hexdigest()[:16]
        return {"name": "labels", "table": digest, "cell": self.cell, "others": self._others}


# The eleven basic color terms of English (Berlin & Kay 1969) and typical sRGB values, several where a name is wide.
_PROTOTYPES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "black": ((12, 12, 12), (35, 35, 38)),
    "grey": ((80, 80, 80), (128, 128, 128), (170, 170, 172)),
    "white": ((230, 230, 230), (255, 255, 255)),
    "red": ((200, 20, 30), (150, 15, 25), (230, 60, 60)),
    "orange": ((245, 130, 30), (220, 100, 20)),
    "yellow": ((245, 220, 40), (220, 190, 30), (250, 240, 120)),
    "green": ((40, 160, 60), (20, 90, 40), (140, 200, 90)),
    "blue": ((30, 80, 200), (20, 40, 110), (110, 170, 230)),
    "purple": ((120, 50, 160), (80, 30, 100), (170, 120, 210)),
    "pink": ((250, 150, 180), (230, 90, 150)),
    "brown": ((120, 75, 40), (85, 50, 30), (160, 110, 70)),
}

COLOR_NAMES = tuple(_PROTOTYPES)


SOFTNESS = 12.0
"""Distance in L*a*b* over which one name gives way to another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaletteConfig(TeacherSettings):
    """Settings of the palette teacher."""

    name: Literal["palette"] = "palette"
    cell: int = option(2, "pixels along the side of a cell, averaged before naming", ge=1)

    def build(self, scene: Scene, words: Words | None) -> Teacher:  # noqa: ARG002
        return PaletteTeacher(self)

    def text_table(self) -> TextTable:
        return make_text_table(COLOR_NAMES, np.eye(len(COLOR_NAMES), dtype=np.float32), "palette-11")


def lab_from_rgb(rgb: UInt8[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """CIE L*a*b* (D65) of 8-bit sRGB; distances in it roughly match what people see (L* from 0 to 100)."""
    c = np.arange(256, dtype=np.float64) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)[rgb]
    to_xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
    )
    xyz = linear @ to_xyz.T / to_xyz.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    lab = np.stack((116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])), axis=-1)
    return lab.astype(np.float32)


class PaletteTeacher:
    """Soft assignment of each cell's mean color to color names, softmax(−distance² / 2·softness²) in L*a*b*.

    Its text side is one channel a word, so `query=red` is the first unit vector that a reader would expect.
    """

    table = None
    mean = None
    needs_images = True
    cheap = True

    def __init__(self, config: PaletteConfig = PaletteConfig()) -> None:
        """Prepares the prototypes of each name."""
        self.cell = cell = config.cell
        self.space = FeatureSpace(
            name="palette-11",
            channels=len(COLOR_NAMES),
            teacher="palette",
            preprocessing=f"mean of {cell}×{cell} pixels, softness {SOFTNESS:g} in L*a*b*",
            text_encoder="palette-11",
        )
        lab = [lab_from_rgb(np.array(colors, np.uint8)) for colors in _PROTOTYPES.values()]
        self._centers = np.concatenate(lab)
        self._owner = np.repeat(np.arange(len(lab)), [len(part) for part in lab])

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Color-name shares on a grid of cells; pixels over the last whole cell are left out."""
        image, cell = photograph(views, view, "teacher palette"), self.cell
        h, w = image.shape[0] // cell, image.shape[1] // cell
        if h == 0 or w == 0:
            raise InputError(f"teacher palette: view {views.names[view]} is smaller than a cell of {cell} pixels")
        blocks = image[: h * cell, : w * cell].reshape(h, cell, w, cell, 3)
        mean = blocks.mean(axis=(1, 3), dtype=np.float32).round().astype(np.uint8)
        return FeatureMap(
            features=self.name_shares(mean.reshape(-1, 3)).reshape(h, w, -1),
            grid_from_image=np.array([[1 / cell, 0, 0], [0, 1 / cell, 0]]),
            space=self.space,
        )

    def name_shares(self, rgb: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 11"]:
        """Share of each color name, summing to 1."""
        # Channel by channel: an array of pixels × prototypes × channels would not fit into the cache.
        lightness, a, b = np.ascontiguousarray(lab_from_rgb(rgb).T)
        nearest = np.full((len(COLOR_NAMES), len(rgb)), np.inf, np.float32)
        for center, owner in zip(self._centers, self._owner, strict=True):
            distance = (lightness - center[0]) ** 2 + (a - center[1]) ** 2 + (b - center[2]) ** 2
            np.minimum(nearest[owner], distance, out=nearest[owner])
        score = -np.ascontiguousarray(nearest.T) / (2 * SOFTNESS**2)
        score = np.exp(score - score.max(axis=1, keepdims=True))
        return (score / score.sum(axis=1, keepdims=True)).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        return {"name": "palette", "cell": self.cell, "softness": SOFTNESS}
