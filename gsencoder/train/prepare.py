"""Preparation of a scene for training: everything that does not depend on the encoder is computed once and stored."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.checkpoint import upright
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import capped, row_mask
from gsencoder.models.output_space import OutputSpace
from gsencoder.render import blend
from gsencoder.teachers.base import Teacher
from gsencoder.train.prepared_file import Precision, ViewRows, write_prepared
from gsencoder.types import FeatureMap, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareConfig:
    """Settings of targets and of the matrices of the render loss."""

    fusion: FuseConfig = field(default_factory=FuseConfig)
    render_cell: int = field(
        default=8,
        metadata={"help": "smallest side of a cell of the render loss, pixels; finer teacher maps are averaged"},
    )
    render_min_weight: float = field(
        default=1e-3, metadata={"help": "smallest blending weight in the matrices of the render loss"}
    )
    render_views: int = field(
        default=0,
        metadata={
            "help": "views of a scene, evenly spaced, whose matrices are stored and from which samples draw theirs; "
            "0 = all. Targets are fused from all views in any case"
        },
    )
    basis_views: int = field(
        default=256, metadata={"help": "number of maps from which the basis of a dense teacher is computed"}
    )

    center: bool = field(
        default=True, metadata={"help": "subtract the teacher's mean from targets; false needs fusion.basis=false"}
    )
    scale: bool = field(
        default=True,
        metadata={"help": "divide targets by their typical distance from the mean; false = in the teacher's units"},
    )

    targets: Precision = field(
        default="float16",
        metadata={
            "help": "how targets and the teacher's vectors of the render loss are stored: float16, or int8 with a "
            "scale for each column, in half the bytes"
        },
    )

    def __post_init__(self) -> None:
        if not self.center and self.fusion.basis:
            raise InputError(
                "center: expected fusion.basis=false with center=false; coordinates in a basis are about the mean"
            )
        for name in ("render_cell", "basis_views"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        if self.render_views < 0:
            raise InputError(f"render_views: expected 0 (all) or more, got {self.render_views}")
        if not 0 <= self.render_min_weight < 1:
            raise InputError(f"render_min_weight: expected a number in [0, 1), got {self.render_min_weight}")


def prepare_scene(
    path: Path,
    scene: Scene,
    teacher: Teacher,
    outputs: OutputSpace,
    config: PrepareConfig,
    *,
    source: Path | None = None,
    device: torch.device = torch.device("cpu"),
) -> None:
    """Computes and writes a scene's Gaussians, fused targets, and rows of the render loss of `config.render_views`.

    Args:
        path: the file.
        scene: the scene, with Gaussians and views.
        teacher: a teacher of the space of `outputs`.
        outputs: output space of the dataset.
        config: settings of the preparation.
        source: the path that the scene was read from.
        device: where B is made and multiplied.

    Raises:
        InputError: the scene cannot be fused, or the disk is full.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    fusion = replace(config.fusion, basis=outputs.basis is not None)
    fused = fuse(scene, teacher, fusion, basis=outputs.basis, device=device)
    chosen = even_indices(len(scene.views), config.render_views or len(scene.views))
    rows = view_rows(scene, teacher, outputs, config, chosen, device)
    with_rows = replace(scene, views=scene.views.select(chosen))
    write_prepared(
        path,
        with_rows,
        fused.features,
        outputs,
        rows,
        source=source,
        precision=config.targets,
        projections=fused.projections,
    )


def view_rows(
    scene: Scene,
    teacher: Teacher,
    outputs: OutputSpace,
    config: PrepareConfig,
    views: Int64[np.ndarray, " v"],
    device: torch.device = torch.device("cpu"),
) -> list[ViewRows]:
    """The matrices B of some views on the teacher's grid, pooled to cells of `config.render_cell` pixels, with the
    teacher's vectors; the other arguments are those of `prepare_scene`."""
    assert scene.gaussians is not None
    assert scene.views is not None
    blending = replace(config.fusion.blend, min_weight=config.render_min_weight)
    rows, teacher = [], upright(teacher)
    for view in views.tolist():
        targets, valid, grid = _pool_map(teacher.feature_map(scene.views, view), outputs, config.render_cell)
        b = blend(scene.gaussians, scene.views.cameras, view, like=grid, config=capped(blending, grid), device=device)
        if scene.views.masks is not None:
            valid &= row_mask(scene.views.masks[view], b.lattice) == 1
        arrays = tuple(each.cpu().numpy() for each in (b.crow, b.col, b.weight))
        rows.append(ViewRows(crow=arrays[0], col=arrays[1], weight=arrays[2], targets=targets, valid=valid))
    return rows


def _pool_map(
    feature_map: FeatureMap, outputs: OutputSpace, cell: int
) -> tuple[Float32[np.ndarray, "P channels"], Bool[np.ndarray, " P"], FeatureMap]:
    """Pools a feature map to cells of about `cell` pixels or more, in standard units.

    Cells that the pooled grid would have only a part of, at the right and lower border, are left out.

    Returns:
        The mean vectors of the cells, which of them have a vector, and an empty map with the grid of the cells.
    """
    affine = feature_map.grid_from_image
    side = 1 / float(np.sqrt(affine[0, 0] * affine[1, 1]))
    factor = max(1, round(cell / side))
    height, width = feature_map.height // factor, feature_map.width // factor
    if not height or not width:
        raise InputError(f"prepare: a map of {feature_map.width}×{feature_map.height} has no cell of {cell} pixels")
    if feature_map.codes is not None:
        assert feature_map.table is not None
        # By linearity the shares of the codes in each cell replace the mean over pixels, with far less memory.
        codes = feature_map.codes[: height * factor, : width * factor]
        line, column = np.divmod(np.arange(codes.size), codes.shape[1])
        cell_of = (line // factor) * width + column // factor
        count = len(feature_map.table) + 1
        counts = np.bincount(cell_of * count + codes.ravel() + 1, minlength=height * width * count)
        shares = counts.reshape(height * width, count) / factor**2
        valid = shares[:, 0] == 0
        vectors = (shares[:, 1:] @ _standardize(feature_map.table, outputs)).astype(np.float32)
    else:
        dense = feature_map.rows().reshape(feature_map.height, feature_map.width, -1)
        grid = _standardize(dense, outputs)[: height * factor, : width * factor]
        vectors = grid.reshape(height, factor, width, factor, -1).mean(axis=(1, 3)).reshape(height * width, -1)
        valid = np.isfinite(vectors).all(axis=1)
    like = FeatureMap(
        codes=np.zeros((height, width), np.int32),
        table=np.zeros((1, feature_map.space.channels), np.float32),
        grid_from_image=affine / factor,
        space=feature_map.space,
    )
    return np.where(valid[:, None], vectors, np.float32(0)), valid, like


def _standardize(vectors: np.ndarray, outputs: OutputSpace) -> np.ndarray:
    """Projects vectors [..., D] to the basis, if there is one, and converts them to standard units."""
    flat = vectors.reshape(-1, vectors.shape[-1])
    coordinates = to_coordinates(outputs.basis, flat) if outputs.basis is not None else flat
    return outputs.standardize(coordinates).reshape(*vectors.shape[:-1], outputs.channels)
