"""Preparation of scenes for training: everything that does not depend on the encoder is computed once and stored.

The scenes of a dataset share the output space (mean, scale and basis) and adapter heads of its teacher. A coded
teacher's space is that of its tables. That of a dense one is of the moments of maps that are evenly distributed over
the scenes and their views, over which heads are measured, too. Distilled features must work with the heads as the
teacher's features do (SplatDistill Eq. 4); both sides of that loss are decoded from the dataset's basis.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64

from gsencoder.core.archive import write_archive
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.files import locked
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.core.settings import check_limits, option
from gsencoder.fusion.basis import (
    CellSample,
    Moments,
    distinct_rows,
    fit_basis,
    project_maps,
    table_basis,
)
from gsencoder.fusion.checkpoint import CachedTeacher, upright
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import limit_rays, row_mask
from gsencoder.fusion.measured_heads import HeadSet, choose_heads, has_head, load_heads, measure_heads, save_heads
from gsencoder.models.output_space import HEADS_FILE, OutputSpace, check_heads_space, output_space_parts
from gsencoder.render import blend
from gsencoder.teachers.base import Head, MissingInput, Teacher
from gsencoder.teachers.build import TeacherConfig
from gsencoder.train.distributed import fail_together
from gsencoder.train.prepared import SPACE_FILE, Precision, PreparedDataset, ViewRows, write_prepared
from gsencoder.types import FeatureMap, FeatureSpace, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareConfig:
    """Settings of targets and of the matrices of the render loss."""

    fusion: FuseConfig = field(default_factory=FuseConfig)
    render_cell: int = option(
        8, "smallest side of a cell of the render loss, pixels; finer teacher maps are averaged", ge=1
    )
    render_min_weight: float = option(1e-3, "smallest blending weight in the matrices of the render loss", ge=0, lt=1)
    render_views: int = option(
        0,
        "views of a scene, evenly spaced, whose matrices are stored and from which samples draw theirs; "
        "0 = all. Targets are fused from all views in any case",
        ge=0,
    )
    basis_views: int = option(256, "number of maps from which the basis of a dense teacher is computed", ge=1)

    center: bool = option(True, "subtract the teacher's mean from targets; false needs fusion.basis=false")
    scale: bool = option(True, "divide targets by their typical distance from the mean; false = in the teacher's units")

    targets: Precision = option(
        "float16",
        "how targets and the teacher's vectors of the render loss are stored: float16, or int8 with a "
        "scale for each column, in half the bytes",
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if not self.center and self.fusion.basis:
            raise InputError(
                "center: expected fusion.basis=false with center=false; coordinates in a basis are about the mean"
            )


OpenScene = Callable[[Path], tuple[Scene, Teacher]]
"""Reads a scene without making Gaussians, and builds its teacher; a `MissingInput` where it lacks what that needs."""
MAX_CELLS_PER_MAP = 4096
"""Approximate limit of the cells of one teacher map that enter the moments."""


def open_teachers(
    scenes: Sequence[Path], open_scene: OpenScene, *, optional: bool = False
) -> Iterator[tuple[Path, Teacher]]:
    """Scenes with their teachers; with `optional` without those that lack what their teacher needs.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do; then the message has that of
            the first.
    """
    missing, opened = "", False
    for path in scenes:
        try:
            _, teacher = open_scene(path)
        except MissingInput as error:
            if not optional:
                raise
            missing = missing or str(error)
            continue
        opened = True
        yield path, teacher
    if not opened:
        raise MissingInput(f"no scene to train on has what it needs; the first one: {missing}")


def sampled_maps(
    scenes: Sequence[Path], open_scene: OpenScene, views: int, *, optional: bool = False
) -> Iterator[tuple[Path, Teacher, FeatureMap]]:
    """Paths, teachers and maps that stand for a dataset, evenly distributed over its scenes and their views: `views` of
    them, fewer where the scenes have fewer views. With `optional` scenes that lack what the teacher needs are left
    out."""
    if optional:
        scenes = [path for path, _ in open_teachers(scenes, open_scene, optional=True)]
    counts = np.diff(np.linspace(0, views, len(scenes) + 1).round()).astype(int)
    counts[0] = max(1, counts[0])
    for path, count in zip(scenes, counts.tolist(), strict=True):
        if count:
            scene, teacher = open_scene(path)
            assert scene.views is not None
            for view in even_indices(len(scene.views), count).tolist():
                yield path, teacher, upright(teacher).feature_map(scene.views, view)


def fit_space(
    dataset: PreparedDataset,
    scenes: Sequence[Path],
    open_scene: OpenScene,
    config: PrepareConfig,
    *,
    made: Sequence[Teacher] = (),
    optional: bool = False,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> None:
    """Computes and stores the output space of the training scenes of a dataset, unless it is stored already. All
    processes of a training call this, and the first one does it; the arguments are those of `dataset_space`."""
    path = dataset.folder / SPACE_FILE
    with fail_together():
        if process.is_first and not path.is_file():
            outputs, codebook, kinds = dataset_space(
                scenes, open_scene, config, made=made, optional=optional, track=track
            )
            arrays, header = output_space_parts(outputs)
            if codebook is not None:
                arrays["codebook"] = codebook
            dataset.folder.mkdir(parents=True, exist_ok=True)
            # Another run that prepares the same scenes may have stored a space in the meantime, and scenes in it.
            if not path.is_file():
                write_archive(path, arrays, {**header, "kinds": list(kinds), "made_with": dataset.settings})


def dataset_space(
    scenes: Sequence[Path],
    open_scene: OpenScene,
    config: PrepareConfig,
    *,
    made: Sequence[Teacher] = (),
    optional: bool = False,
    track: Track = untracked,
) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None, tuple[str, ...]]:
    """Computes the output space of a dataset.

    Args:
        open_scene: reads a scene and builds its teacher.
        config: the basis, the number of maps of a dense teacher, and whether targets are centered and scaled.
        made: coded teachers of scenes that are made during the training.
        optional: leave out scenes that lack what the teacher needs, since they have other teachers.

    Returns:
        The space; for a coded teacher its vectors in standard units, else None; and the names of the things that the
        teacher tells apart, if it has names.
    """
    if not scenes:
        raise InputError("training: no scenes to train on")
    spaces, tables, kinds = list[FeatureSpace](), list[np.ndarray](), dict[str, None]()
    mean, fusion = None, config.fusion
    for path, teacher in open_teachers(scenes, open_scene, optional=optional):
        spaces.append(teacher.space)
        check_space(spaces[0], teacher.space, path)
        if teacher.table is None:
            break
        kinds |= dict.fromkeys(getattr(teacher, "kinds", ()))
        tables.append(teacher.table)
        mean = teacher.mean if teacher.mean is not None else mean
    for teacher in made:
        assert teacher.table is not None
        kinds |= dict.fromkeys(getattr(teacher, "kinds", ()))
        tables.append(teacher.table)
    space = spaces[0]
    use_basis = fusion.wants_basis(space)
    coordinates = basis = None
    if tables:
        table = np.unique(np.concatenate(tables), axis=0)
        mean = table.mean(axis=0) if mean is None else mean
        variance = np.square(table - mean, dtype=np.float64).sum(axis=1).mean()
        basis = table_basis(table, mean, space, energy=fusion.table_energy) if use_basis else None
        coordinates = table if basis is None else basis.coordinates(table)
    else:
        moments, kinds = Moments(space.channels), dict[str, None]()
        maps = sampled_maps(scenes, open_scene, config.basis_views, optional=optional)
        # The moments of each scene are merged, since chunks about a scene's own mean keep more digits.
        for _, of_scene in track(groupby(maps, key=lambda each: each[0]), "fitting the basis"):
            part = Moments(space.channels)
            for path, teacher, feature_map in of_scene:
                check_space(space, teacher.space, path)
                kinds |= dict.fromkeys(getattr(teacher, "kinds", ()))
                rows = distinct_rows(feature_map)
                part.add(rows[:: max(1, len(rows) // MAX_CELLS_PER_MAP)])
            moments.merge(part)
        # The mean of the sampled maps, even if the teacher has another one: the covariance is about it.
        mean, covariance = moments.mean.astype(np.float32), moments.covariance()
        variance = np.trace(covariance)
        if use_basis:
            center = mean.astype(np.float64)
            basis = fit_basis(center, covariance, space, energy=fusion.energy, max_rank=fusion.max_rank)
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Check the images, and the teacher's features of these scenes (`gsencoder fuse`)"
        )
    outputs = OutputSpace(
        space=space,
        mean=mean,
        scale=float(np.sqrt(variance)),
        basis=basis,
        centered=config.center,
        scaled=config.scale,
    )
    codebook = None if coordinates is None else outputs.standardize(coordinates)
    return outputs, codebook, tuple(kinds)


def check_space(space: FeatureSpace, other: FeatureSpace, path: Path) -> None:
    """Checks that a scene's teacher has the feature space of the scenes before it."""
    if space != other:
        raise InputError(
            f"training: expected one feature space for all scenes, got several feature spaces: ({space.describe()}), "
            f"and in {path} ({other.describe()})"
        )


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
    """Computes and writes a scene's Gaussians, fused targets, and rows of the render loss of `config.render_views`;
    `source` is the path that the scene was read from, and B is made and multiplied on `device`."""
    assert scene.gaussians is not None
    assert scene.views is not None
    fusion = replace(config.fusion, basis=outputs.basis is not None)
    fused = fuse(scene, teacher, fusion, basis=outputs.basis, device=device)
    chosen = even_indices(len(scene.views), config.render_views or len(scene.views))
    rows = view_rows(scene, fused.teacher, outputs, config, chosen, device)
    projections = (
        None if outputs.basis is None else project_maps(outputs.basis, fused.teacher, scene.views, fused.views)
    )
    with_rows = replace(scene, views=scene.views.select(chosen))
    write_prepared(
        path,
        with_rows,
        fused.features,
        outputs,
        rows,
        source=source,
        precision=config.targets,
        projections=projections,
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
    teacher's vectors."""
    assert scene.gaussians is not None
    assert scene.views is not None
    blending = replace(config.fusion.blend, min_weight=config.render_min_weight)
    rows, teacher = [], upright(teacher)
    for view in views.tolist():
        targets, valid, grid = _pool_map(teacher.feature_map(scene.views, view), outputs, config.render_cell)
        b = blend(
            scene.gaussians, scene.views.cameras, view, like=grid, config=limit_rays(blending, grid), device=device
        )
        if scene.views.masks is not None:
            valid &= row_mask(scene.views.masks[view], b.lattice) == 1
        crow, col, weight = b.crow.cpu().numpy(), b.col.cpu().numpy(), b.weight.cpu().numpy()
        rows.append(ViewRows(crow=crow, col=col, weight=weight, targets=targets, valid=valid))
    return rows


def _pool_map(
    feature_map: FeatureMap, outputs: OutputSpace, cell: int
) -> tuple[Float32[np.ndarray, "P channels"], Bool[np.ndarray, " P"], FeatureMap]:
    """Pools a feature map to cells of about `cell` pixels or more: their mean vectors in standard units, which of them
    have a vector, and an empty map with their grid. Cells that the pooled grid would have only a part of, at the right
    and lower border, are left out."""
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
        vectors = (shares[:, 1:] @ outputs.project(feature_map.table)).astype(np.float32)
    else:
        dense = outputs.project(feature_map.rows()).reshape(feature_map.height, feature_map.width, -1)
        grid = dense[: height * factor, : width * factor]
        vectors = grid.reshape(height, factor, width, factor, -1).mean(axis=(1, 3)).reshape(height * width, -1)
        valid = np.isfinite(vectors).all(axis=1)
    like = FeatureMap(
        codes=np.zeros((height, width), np.int32),
        table=np.zeros((1, feature_map.space.channels), np.float32),
        grid_from_image=affine / factor,
        space=feature_map.space,
    )
    return np.where(valid[:, None], vectors, np.float32(0)), valid, like


def add_scene(
    dataset: PreparedDataset,
    scene: Scene,
    teacher: Teacher,
    config: PrepareConfig,
    *,
    source: Path = Path(),
    device: torch.device = torch.device("cpu"),
) -> None:
    """Prepares one scene, which was read from `source`, and writes its file atomically."""
    outputs, _ = dataset.load_space()
    path, maps = dataset.scene_path(scene.name), dataset.folder / f".maps.{scene.name}"
    path.parent.mkdir(exist_ok=True)
    maps.mkdir(exist_ok=True)
    with locked(maps, wait=True):
        if path.is_file():  # Another run has prepared the scene meanwhile.
            return
        try:
            maps.mkdir(exist_ok=True)
            for stale in maps.iterdir():
                stale.unlink()
            prepare_scene(path, scene, CachedTeacher(teacher, maps), outputs, config, source=source, device=device)
        finally:
            shutil.rmtree(maps, ignore_errors=True)


def teacher_of_heads(teachers: Mapping[str, TeacherConfig], heads: Sequence[str]) -> str:
    """The name of the teacher that adapter heads belong to; the first teacher where none has heads."""
    with_heads = [name for name, config in teachers.items() if config.has_heads]
    if heads and len(with_heads) > 1:
        raise InputError(
            f"heads={','.join(heads)}: {' and '.join(with_heads)} have adapter heads; expected one such teacher"
        )
    return with_heads[0] if with_heads else next(iter(teachers))


def required_heads(loss_heads: Sequence[str], teachers: Mapping[str, TeacherConfig]) -> tuple[str, ...]:
    """The names of the heads that a training needs: of the render loss, and stored with the weights."""
    stored = [name for config in teachers.values() for name in config.stored_heads]
    return tuple(dict.fromkeys([*loss_heads, *stored]))


def missing_heads(dataset: PreparedDataset, names: Sequence[str], teacher: TeacherConfig) -> list[Head]:
    """The teacher's heads of some names that are not stored in a prepared dataset yet."""
    path = dataset.folder / HEADS_FILE
    stored = load_heads(path) if path.is_file() else None
    if stored is not None and all(has_head(stored, name) for name in names):
        return []
    stored_names = stored.names if stored is not None else ()
    return [head for head in teacher.read_heads(names) if head.name not in stored_names]


def measure_dataset_heads(
    dataset: PreparedDataset,
    heads: Sequence[Head],
    scenes: Sequence[Path],
    open_scene: OpenScene,
    views: int,
    *,
    optional: bool = False,
) -> None:
    """Measures the heads of `missing_heads` over the maps that the dataset's output space was computed from, and adds
    them to its folder."""
    if not heads:
        return
    path, outputs = dataset.folder / HEADS_FILE, dataset.load_space()[0]
    stored = load_heads(path) if path.is_file() else HeadSet(space=outputs.space)
    check_heads_space(stored.space, outputs.space)
    sample = CellSample(views)
    for _, of_scene, feature_map in sampled_maps(scenes, open_scene, views, optional=optional):
        check_heads_space(of_scene.space, outputs.space)
        sample.add(feature_map)
    measured = measure_heads(heads, sample.vectors(), outputs.space, outputs.basis)
    save_heads(path, HeadSet(space=outputs.space, heads=(*stored.heads, *measured.heads)))


def dataset_heads(dataset: PreparedDataset, names: Sequence[str]) -> HeadSet:
    """Heads of a prepared dataset, by name; none for no names."""
    if not names:
        return HeadSet(space=dataset.load_space()[0].space)
    return choose_heads(load_heads(dataset.folder / HEADS_FILE), names)
