"""The `labels` teacher: instance maps and a table of name embeddings. An exact oracle for labeled scenes."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.fusion.teachers import MissingInput
from gsencoder.fusion.teachers.regions.captioned import codes_of
from gsencoder.types import FeatureMap, FeatureSpace, SceneObject, Views


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsConfig:
    """Settings of the labels teacher."""

    name: Literal["labels"] = "labels"
    words: str = field(
        default="clip_vitb32_names.npz",
        metadata={
            "help": "text table of the names; a bare name is also looked for in GSENCODER_MODELS; this one is installed"
        },
    )

    cell: int = field(
        default=1,
        metadata={"help": "pixels along a cell; above 1 its vectors are averaged, as a teacher with patches sees them"},
    )

    def __post_init__(self) -> None:
        if not self.words:
            raise InputError("words: the labels teacher needs a text table of its names")
        if self.cell < 1:
            raise InputError(f"cell: expected at least 1 pixel, got {self.cell}")


class LabelsTeacher:
    """Each pixel has the embedding of its object's name; pixels without a name the normalized mean of the table.

    The mean is a direction too, so "other" is something that a Gaussian can be, and not a hole. Maps are coded: an
    index for each pixel into the names of this scene. With `cell` above 1 they are dense: means over square cells,
    what a perfect teacher with patches of that size would give; pixels over the last whole cell are left out.
    """

    needs_images = False
    cheap = True

    def __init__(
        self,
        objects: Sequence[SceneObject],
        names: Sequence[str],
        embeddings: Float32[np.ndarray, "C D"],
        *,
        text_encoder: str,
        mean: Float32[np.ndarray, " D"] | None = None,
        cell: int = 1,
    ) -> None:
        """Makes the scene's table.

        Args:
            objects: which instance value has which name.
            names: the words of the table.
            embeddings: their unit vectors.
            text_encoder: what made these.
            mean: of the text side, which "other" points along; None = that of the table.
            cell: pixels along the side of a cell of the maps.

        Raises:
            MissingInput: no objects.
            InputError: a name that the table lacks.
        """
        if not objects:
            raise MissingInput(
                "teacher labels: the scene lists no objects; it needs an objects.json beside its views, or the "
                "label files of ScanNet or ScanNet++; teacher=mosaic text=minilm looks at pictures instead"
            )
        row_of = {name: row for row, name in enumerate(names)}
        used = sorted({o.name for o in objects if o.name is not None})
        missing = [name for name in used if name not in row_of]
        if missing:
            raise InputError(
                f"teacher labels: {len(missing)} object names are not among the {len(names)} words of {text_encoder}, "
                f"first {missing[0]!r}; change them or set them to null in objects.json, or give a table that has them "
                "(teacher.words=)"
            )
        mean = embeddings.mean(axis=0, dtype=np.float64) if mean is None else mean.astype(np.float64)
        other = (mean / np.sqrt((mean * mean).sum() + 1e-24)).astype(np.float32)
        self.kinds = tuple(used)
        self.names = ("other", *used)
        self.vectors = np.stack([other, *(embeddings[row_of[name]] for name in used)]).astype(np.float32)
        self.cell = cell
        self.table = self.vectors if cell == 1 else None
        self.mean = mean.astype(np.float32)
        self.space = FeatureSpace(
            name=f"labels-{text_encoder}",
            channels=embeddings.shape[1],
            teacher="labels",
            preprocessing=f"mean of {cell}×{cell} pixels" if cell > 1 else "",
            text_encoder=text_encoder,
        )
        self._code = {o.id: self.names.index(o.name) for o in objects if o.name is not None}

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at image resolution, or vectors on a grid of cells.

        Raises:
            MissingInput: the scene has no instance maps.
            InputError: an instance map is smaller than a cell.
        """
        if views.instances is None:
            raise MissingInput("teacher labels: the scene has no instance maps (instance_file_path in transforms.json)")
        instances = views.instances[view]
        codes = np.maximum(codes_of(instances, self._code), 0)
        affine = np.array([[1 / self.cell, 0, 0], [0, 1 / self.cell, 0]])
        if self.table is not None:
            return FeatureMap(codes=codes, table=self.table, grid_from_image=affine, space=self.space)
        h, w = (size // self.cell for size in instances.shape)
        if h == 0 or w == 0:
            raise InputError(f"teacher labels: view {views.names[view]} is smaller than a cell of {self.cell} pixels")
        cells = codes[: h * self.cell, : w * self.cell].reshape(h, self.cell, w, self.cell)
        shares = np.stack([(cells == code).mean(axis=(1, 3)) for code in range(len(self.names))], axis=-1)
        features = (shares @ self.vectors).astype(np.float32)
        return FeatureMap(features=features, grid_from_image=affine, space=self.space)

    def settings(self) -> dict[str, Any]:
        digest = hashlib.sha256(self.vectors.tobytes() + repr(sorted(self._code.items())).encode()).hexdigest()[:16]
        return {"name": "labels", "table": digest, "cell": self.cell}
