"""The output space of a dataset: mean, scale and basis that all its scenes share."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.fusion.basis import Moments, fit_basis, table_basis, to_coordinates
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.models.output_space import OutputSpace, output_space_parts
from gsencoder.teachers.base import MissingInput
from gsencoder.train.distributed import check_agreement, fail_together, value_of_first, values_of_all
from gsencoder.train.prepare import PrepareConfig
from gsencoder.train.prepared_dataset import SPACE_FILE, PreparedDataset
from gsencoder.train.sampled_maps import OpenScene
from gsencoder.train.shared_moments import sampled_moments, several_spaces
from gsencoder.types import FeatureSpace

MOMENTS_FOLDER = ".moments"
"""Folder of the moments of maps, in that of prepared scenes, until their space is stored."""


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
    open_scene: OpenScene,
    config: PrepareConfig,
    *,
    optional: bool = False,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> None:
    """Computes and stores the output space of the training scenes of a dataset, unless it is stored already.

    All processes of a training call this and share the work. A run that was killed goes on where it was, with any
    number of processes, and stores the same space.

    Args:
        dataset: where it is stored.
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        config: settings of the preparation.
        optional: leave out scenes that lack what the teacher needs.
        process: rank of this process.
        track: wraps loops to show progress.

    Raises:
        InputError: the dataset's folder holds scenes without their space, or see `dataset_space`.
    """
    path, work = dataset.folder / SPACE_FILE, dataset.folder / MOMENTS_FOLDER
    if value_of_first(not path.is_file()):
        if value_of_first(dataset.holds_scenes()):
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
            work=work,
            process=process,
            track=track,
        )
        arrays, header = output_space_parts(space.outputs)
        if space.codebook is not None:
            arrays["codebook"] = space.codebook
        with fail_together():
            # Another run that prepares the same scenes may have stored a space in the meantime, and scenes in it.
            if process.is_first and not path.is_file():
                write_archive(path, arrays, {**header, "kinds": list(space.kinds)})
    if process.is_first:
        shutil.rmtree(work, ignore_errors=True)


def dataset_space(
    scenes: Sequence[Path],
    open_scene: OpenScene,
    config: FuseConfig,
    *,
    views: int,
    center: bool = True,
    scale: bool = True,
    optional: bool = False,
    work: Path | None = None,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> DatasetSpace:
    """Computes the output space of a dataset. All processes of a training call this, and have the same result.

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
        work: folder of intermediate results of a dense teacher; see `sampled_moments`.
        process: rank of this process.
        track: wraps loops to show progress.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do; then the message has that of
            the first.
        InputError: there are no scenes, or their teachers have different spaces.
    """
    if not scenes:
        raise InputError("training: no scenes to train on")
    with fail_together():
        own_share = _share_of_teachers(scenes, open_scene, process, optional=optional)
    check_agreement("the teacher's weights", own_share.space.weights if own_share.space is not None else "")
    shares = values_of_all(own_share)
    space = _common_space(scenes, shares)
    tables = [share.table for share in shares if share.table is not None]
    if tables:
        table = np.unique(np.concatenate(tables), axis=0)
        mean = max(shares, key=lambda share: share.last).mean
        outputs = replace(_coded_space(table, mean, space, config), centered=center, scaled=scale)
        coordinates = to_coordinates(outputs.basis, table) if outputs.basis is not None else table
        by_scene = {number: names for share in shares for number, names in share.kinds.items()}
        kinds = dict.fromkeys(name for number in sorted(by_scene) for name in by_scene[number])
        return DatasetSpace(outputs=outputs, codebook=outputs.standardize(coordinates), kinds=tuple(kinds))
    moments, names = sampled_moments(
        scenes, open_scene, space, views=views, optional=optional, folder=work, process=process, track=track
    )
    outputs = replace(_dense_space(moments, space, config), centered=center, scaled=scale)
    return DatasetSpace(outputs=outputs, kinds=names)


@dataclass(slots=True, kw_only=True, eq=False)
class _ShareOfTeachers:
    """What the teachers of a process's share of the scenes say; scenes are numbered.

    Attributes:
        space: of all of them; None if there are none.
        first, last: the first and the last scene with a teacher.
        mean: what the last one states as its mean.
        table: the distinct vectors of all tables of coded teachers; None for dense ones.
        kinds: names of the things that the teachers tell apart, by scene.
        missing: what scenes lack.
    """

    space: FeatureSpace | None = None
    first: int = -1
    last: int = -1
    mean: Float32[np.ndarray, " D"] | None = None
    table: Float32[np.ndarray, "C D"] | None = None
    kinds: dict[int, tuple[str, ...]] = field(default_factory=dict)
    missing: dict[int, str] = field(default_factory=dict)


def _share_of_teachers(
    scenes: Sequence[Path], open_scene: OpenScene, process: ProcessRank, *, optional: bool
) -> _ShareOfTeachers:
    """Opens the scenes of a process, or the first one of them whose teacher is dense, since that has no tables."""
    share, tables = _ShareOfTeachers(), list[np.ndarray]()
    for number in range(process.rank, len(scenes), process.world_size):
        try:
            _, teacher = open_scene(scenes[number])
        except MissingInput as error:
            if not optional:
                raise
            share.missing[number] = str(error)
            continue
        if share.space is None:
            share.space, share.first = teacher.space, number
        elif teacher.space != share.space:
            raise InputError(several_spaces(share.space, teacher.space, scenes[number]))
        share.kinds[number], share.last, share.mean = tuple(getattr(teacher, "kinds", ())), number, teacher.mean
        if teacher.table is None:
            break
        tables.append(teacher.table)
    share.table = np.unique(np.concatenate(tables), axis=0) if tables else None
    return share


def _common_space(scenes: Sequence[Path], shares: Sequence[_ShareOfTeachers]) -> FeatureSpace:
    """The space of the teachers of all processes.

    Raises:
        MissingInput: no scene has what the teacher needs.
        InputError: they have different spaces.
    """
    present = sorted((share for share in shares if share.space is not None), key=lambda share: share.first)
    if not present:
        missing = {number: message for share in shares for number, message in share.missing.items()}
        raise MissingInput(f"no scene to train on has what it needs; the first one: {missing[min(missing)]}")
    space = present[0].space
    assert space is not None
    for share in present[1:]:
        assert share.space is not None
        if share.space != space:
            raise InputError(several_spaces(space, share.space, scenes[share.first]))
    return space


def _coded_space(
    table: Float32[np.ndarray, "C D"], mean: Float32[np.ndarray, " D"] | None, space: FeatureSpace, config: FuseConfig
) -> OutputSpace:
    """The space of a table, about the mean that the teacher states, or that of the table."""
    mean = mean if mean is not None else table.mean(axis=0)
    scale = _scale(np.square(table - mean, dtype=np.float64).sum(axis=1).mean(), space)
    use_basis = config.basis and space.channels > config.narrow
    basis = table_basis(table, mean, space, energy=config.table_energy) if use_basis else None
    return OutputSpace(space=space, mean=mean, scale=scale, basis=basis)


def _dense_space(moments: Moments, space: FeatureSpace, config: FuseConfig) -> OutputSpace:
    # The mean of the sampled maps, even if the teacher states another one: the covariance is about it.
    mean, covariance = moments.mean.astype(np.float32), moments.covariance()
    scale = _scale(np.trace(covariance), space)
    basis = None
    if config.basis and space.channels > config.narrow:
        basis = fit_basis(mean.astype(np.float64), covariance, space, energy=config.energy, max_rank=config.max_rank)
    return OutputSpace(space=space, mean=mean, scale=scale, basis=basis)


def _scale(variance: float, space: FeatureSpace) -> float:
    """The root mean square distance from the mean, given the variance.

    Raises:
        InputError: the variance is 0: all features are equal.
    """
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Check the images, and the teacher's features of these scenes (`gsencoder fuse`)"
        )
    return float(np.sqrt(variance))
