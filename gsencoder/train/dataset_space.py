"""The output space of a dataset: mean, scale and basis that all its scenes share."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.even_indices import even_indices
from gsencoder.core.files.archive import write_archive
from gsencoder.fusion.basis import Moments, fit_basis, table_basis, to_coordinates
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.lift import distinct_rows
from gsencoder.fusion.teachers import MissingInput, Teacher
from gsencoder.models.output_space import OutputSpace, output_space_parts
from gsencoder.train.prepare import PrepareConfig
from gsencoder.train.prepared_dataset import SPACE_FILE, PreparedDataset
from gsencoder.types import FeatureMap, Scene

MAX_CELLS_PER_MAP = 4096
"""Approximate limit of the cells of one teacher map that enter the moments."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DatasetSpace:
    """The output space of a dataset, and what else its teacher says of all scenes.

    Attributes:
        outputs: the output space.
        codebook: for a coded teacher its vectors in standard units, else None.
        kinds: names of the things that the teacher tells apart, of all scenes, if it has names.
    """

    outputs: OutputSpace
    codebook: Float32[np.ndarray, "C channels"] | None = None
    kinds: tuple[str, ...] = ()


def fit_space(
    dataset: PreparedDataset,
    scenes: Sequence[Path],
    open_scene: Callable[[Path], tuple[Scene, Teacher]],
    config: PrepareConfig,
    *,
    optional: bool = False,
) -> None:
    """Computes and stores the output space of the training scenes of a dataset, unless it is stored already.

    With `optional`, scenes that lack what the teacher needs are left out.

    Raises:
        InputError: the dataset's folder holds scenes without their space, or see `dataset_space`.
    """
    path = dataset.folder / SPACE_FILE
    if path.is_file():
        return
    if dataset.holds_scenes():
        raise InputError(
            f"{dataset.folder}: holds scenes, but not the space that they were prepared for ({SPACE_FILE}); give "
            "another folder as prepared="
        )
    space = dataset_space(
        scenes,
        open_scene,
        config.fusion,
        views=config.basis_views,
        center=config.center,
        scale=config.scale,
        optional=optional,
    )
    arrays, header = output_space_parts(space.outputs)
    if space.codebook is not None:
        arrays["codebook"] = space.codebook
    # Another run that prepares the same scenes may have stored a space in the meantime, and scenes in it.
    if not path.is_file():
        write_archive(path, arrays, {**header, "kinds": list(space.kinds)})


def dataset_space(
    scenes: Sequence[Path],
    open_scene: Callable[[Path], tuple[Scene, Teacher]],
    config: FuseConfig,
    *,
    views: int,
    center: bool = True,
    scale: bool = True,
    optional: bool = False,
) -> DatasetSpace:
    """Computes the output space of a dataset.

    For a teacher whose maps share a table the moments are those of the distinct vectors of all its tables. For others
    they are those of `views` maps, evenly distributed over the scenes and their views.

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        config: share of the energy that the basis keeps, its largest rank, and the number of channels up to which there
            is no basis.
        views: number of maps of a dense teacher to use.
        center: subtract the mean from targets.
        scale: divide targets by the root mean square distance from the mean.
        optional: leave out scenes that lack what the teacher needs, since they have other teachers.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do; then the message has that of
            the first.
        InputError: there are no scenes, or their teachers have different spaces.
    """
    if not scenes:
        raise InputError("training: no scenes to train on")
    teacher, tables, kinds = None, list[np.ndarray](), dict[str, None]()
    missing: MissingInput | None = None
    for path in scenes:
        try:
            _, of_scene = open_scene(path)
        except MissingInput as error:
            if not optional:
                raise
            missing = missing or error
            continue
        teacher = _same_space(teacher, of_scene, path)
        kinds |= dict.fromkeys(getattr(of_scene, "kinds", ()))
        if of_scene.table is None:
            break
        tables.append(of_scene.table)
    if teacher is None:
        assert missing is not None
        raise MissingInput(f"no scene to train on has what it needs; the first one: {missing}") from missing
    if tables:
        table = np.unique(np.concatenate(tables), axis=0)
        space = replace(_coded_space(table, teacher, config), centered=center, scaled=scale)
        coordinates = to_coordinates(space.basis, table) if space.basis is not None else table
        return DatasetSpace(outputs=space, codebook=space.standardize(coordinates), kinds=tuple(kinds))
    moments = Moments(teacher.space.channels)
    for path, of_scene, feature_map in sampled_maps(scenes, open_scene, views, optional=optional):
        teacher = _same_space(teacher, of_scene, path)
        kinds |= dict.fromkeys(getattr(of_scene, "kinds", ()))
        rows = distinct_rows(feature_map)
        moments.add(rows[:: max(1, len(rows) // MAX_CELLS_PER_MAP)])
    outputs = replace(_dense_space(moments, teacher, config), centered=center, scaled=scale)
    return DatasetSpace(outputs=outputs, kinds=tuple(kinds))


def _same_space(teacher: Teacher | None, other: Teacher, path: Path) -> Teacher:
    if teacher is not None and other.space != teacher.space:
        raise InputError(
            f"training: expected one feature space for all scenes, got several feature spaces: "
            f"({teacher.space.describe()}), and in {path} ({other.space.describe()})"
        )
    return other


def sampled_maps(
    scenes: Sequence[Path],
    open_scene: Callable[[Path], tuple[Scene, Teacher]],
    views: int,
    *,
    optional: bool = False,
) -> Iterator[tuple[Path, Teacher, FeatureMap]]:
    """Maps of a dense teacher, evenly distributed over the scenes and their views.

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        views: number of maps, fewer where the scenes have fewer views.
        optional: leave out scenes that lack what the teacher needs; the others have their shares of the maps.

    Yields:
        The path of a scene, its teacher, and a map.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do.
    """
    used: dict[Path, list[int]] = {}
    lacking: dict[Path, MissingInput] = {}
    exhausted: set[Path] = set()
    left, candidates = views, list(scenes)
    while left > 0 and candidates:
        for path, count in zip(candidates, views_of_scenes(len(candidates), left), strict=True):
            if not count:
                continue
            try:
                scene, teacher = open_scene(path)
                assert scene.views is not None
                before = used.get(path, [])
                even = [int(view) for view in even_indices(len(scene.views), len(before) + count)]
                new = [view for view in even if view not in before][:count]
                for view in new:
                    yield path, teacher, teacher.feature_map(scene.views, view)
                    used.setdefault(path, []).append(view)
                left -= len(new)
                if len(new) < count:
                    exhausted.add(path)
            except MissingInput as error:
                if not optional:
                    raise
                lacking[path] = error
        if not lacking:
            return
        untried = [path for path in scenes if path not in used and path not in lacking]
        candidates = untried or [path for path in used if path not in exhausted]
    if not used:
        raise next(iter(lacking.values()))


def views_of_scenes(scenes: int, views: int) -> list[int]:
    """How many of `views` maps are those of each scene, evenly distributed; the first scene has one at least."""
    counts = [int(count) for count in np.diff(np.linspace(0, views, scenes + 1).round())]
    return [max(1, counts[0]), *counts[1:]]


def _coded_space(table: Float32[np.ndarray, "C D"], teacher: Teacher, config: FuseConfig) -> OutputSpace:
    mean = teacher.mean if teacher.mean is not None else table.mean(axis=0)
    scale = _scale(np.square(table - mean, dtype=np.float64).sum(axis=1).mean(), teacher)
    use_basis = config.basis and teacher.space.channels > config.narrow
    basis = table_basis(table, mean, teacher.space, energy=config.table_energy) if use_basis else None
    return OutputSpace(space=teacher.space, mean=mean, scale=scale, basis=basis)


def _dense_space(moments: Moments, teacher: Teacher, config: FuseConfig) -> OutputSpace:
    # The mean of the sampled maps, even if the teacher states another one: the covariance is about it.
    mean, covariance = moments.mean.astype(np.float32), moments.covariance()
    scale = _scale(np.trace(covariance), teacher)
    basis = None
    if config.basis and teacher.space.channels > config.narrow:
        basis = fit_basis(
            mean.astype(np.float64), covariance, teacher.space, energy=config.energy, max_rank=config.max_rank
        )
    return OutputSpace(space=teacher.space, mean=mean, scale=scale, basis=basis)


def _scale(variance: float, teacher: Teacher) -> float:
    """The root mean square distance from the mean, given the variance.

    Raises:
        InputError: the variance is 0: all features are equal.
    """
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({teacher.space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Check the images, and the teacher's features of these scenes (`gsencoder fuse`)"
        )
    return float(np.sqrt(variance))
