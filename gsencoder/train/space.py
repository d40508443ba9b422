"""The output space of a dataset: mean, scale and basis that all its scenes share.

A coded teacher's space is that of its tables. That of a dense one is of the moments of maps that are evenly distributed
over the scenes and their views. These are cut into blocks, which depend on the scenes alone; each process writes the
moments of its blocks, and the first one merges them in order: the sums are the same, bit for bit, for any number of
processes, as far as the teacher's maps are, and a run that was killed goes on with the blocks that are there.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, advised
from gsencoder.core.files import plain
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.fusion.basis import Moments, distinct_rows, fit_basis, table_basis, to_coordinates
from gsencoder.fusion.checkpoint import upright
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.models.output_space import OutputSpace, output_space_parts
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.train.distributed import check_agreement, fail_together, value_of_first, values_of_all
from gsencoder.train.prepare import SPACE_FILE, PrepareConfig, PreparedDataset
from gsencoder.types import FeatureMap, FeatureSpace, Scene

OpenScene = Callable[[Path], tuple[Scene, Teacher]]
"""Reads a scene without making Gaussians, and builds its teacher; a `MissingInput` where it lacks what that needs."""
MAX_CELLS_PER_MAP = 4096
"""Approximate limit of the cells of one teacher map that enter the moments."""
BLOCKS = 64
"""Largest number of blocks: enough for the processes of several machines, and for 1,280 channels their files take
0.8 GB until they are merged."""
MOMENTS_FOLDER = ".moments"
"""Folder of the moments of blocks, in that of prepared scenes, until their space is stored."""


def views_of_scenes(scenes: int, views: int) -> list[int]:
    """How many of `views` maps are those of each scene, evenly distributed; the first scene has one at least."""
    counts = [int(count) for count in np.diff(np.linspace(0, views, scenes + 1).round())]
    return [max(1, counts[0]), *counts[1:]]


def maps_of_scene(path: Path, count: int, open_scene: OpenScene) -> Iterator[tuple[Teacher, FeatureMap]]:
    """Maps of a scene's teacher, of evenly spaced views; fewer where it has fewer views."""
    scene, teacher = open_scene(path)
    assert scene.views is not None
    for view in even_indices(len(scene.views), count).tolist():
        yield teacher, upright(teacher).feature_map(scene.views, view)


def sampled_maps(
    scenes: Sequence[Path], open_scene: OpenScene, views: int, *, optional: bool = False
) -> Iterator[tuple[Path, Teacher, FeatureMap]]:
    """The maps of a dense teacher that stand for a dataset, evenly distributed over its scenes and their views.

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene and builds its teacher.
        views: number of maps, fewer where the scenes have fewer views.
        optional: leave out scenes that lack what the teacher needs.

    Yields:
        The path of a scene, its teacher, and a map.
    """
    if optional:
        opened = open_all(scenes, open_scene, ProcessRank(), optional=True)
        if not opened.spaces:
            raise MissingInput(next(iter(opened.missing.values())))
        scenes = [scenes[number] for number in opened.spaces]
    for path, count in zip(scenes, views_of_scenes(len(scenes), views), strict=True):
        for teacher, feature_map in maps_of_scene(path, count, open_scene) if count else ():
            yield path, teacher, feature_map


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
    """Computes and stores the output space of the training scenes of a dataset, unless it is stored already. All
    processes of a training call this; the arguments are those of `dataset_space`."""
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

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene and builds its teacher.
        config: share of the energy that the basis keeps, its largest rank, and the number of channels up to which there
            is no basis.
        views: number of maps of a dense teacher to use.
        center: subtract the mean from targets.
        scale: divide targets by the root mean square distance from the mean.
        optional: leave out scenes that lack what the teacher needs, since they have other teachers.
        work: folder of the moments of blocks, which all processes share; None = one process, which does not store them.
        process: rank of this process.
        track: wraps loops to show progress.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do; then the message has that of
            the first.
    """
    if not scenes:
        raise InputError("training: no scenes to train on")
    with fail_together():
        own_share = open_all(scenes, open_scene, process, optional=optional)
    check_agreement("the teacher's weights", next((space.weights for space in own_share.spaces.values()), ""))
    shares = values_of_all(own_share)
    spaces = {number: space for share in shares for number, space in sorted(share.spaces.items())}
    if not spaces:
        missing = {number: message for share in shares for number, message in share.missing.items()}
        raise MissingInput(f"no scene to train on has what it needs; the first one: {missing[min(missing)]}")
    space = spaces[min(spaces)]
    for number in sorted(spaces):
        check_space(space, spaces[number], scenes[number])
    use_basis = config.wants_basis(space)
    tables = [share.table for share in shares if share.table is not None]
    if tables:
        table = np.unique(np.concatenate(tables), axis=0)
        means = {number: mean for share in shares for number, mean in share.means.items()}
        mean = means[max(means)] if means else table.mean(axis=0)
        variance = np.square(table - mean, dtype=np.float64).sum(axis=1).mean()
        basis = table_basis(table, mean, space, energy=config.table_energy) if use_basis else None
        by_scene = {number: names for share in shares for number, names in share.kinds.items()}
        kinds = tuple(dict.fromkeys(name for number in sorted(by_scene) for name in by_scene[number]))
    else:
        usable = [scenes[number] for number in sorted(spaces)] if optional else scenes
        moments, kinds = sampled_moments(
            usable, open_scene, space, views=views, folder=work, process=process, track=track
        )
        # The mean of the sampled maps, even if the teacher has another one: the covariance is about it.
        mean, covariance = moments.mean.astype(np.float32), moments.covariance()
        variance, basis, table = np.trace(covariance), None, None
        if use_basis:
            about = mean.astype(np.float64)
            basis = fit_basis(about, covariance, space, energy=config.energy, max_rank=config.max_rank)
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Check the images, and the teacher's features of these scenes (`gsencoder fuse`)"
        )
    outputs = OutputSpace(
        space=space, mean=mean, scale=float(np.sqrt(variance)), basis=basis, centered=center, scaled=scale
    )
    codebook = None
    if table is not None:
        codebook = outputs.standardize(table if basis is None else to_coordinates(basis, table))
    return DatasetSpace(outputs=outputs, codebook=codebook, kinds=kinds)


@dataclass(slots=True, kw_only=True, eq=False)
class OpenedScenes:
    """What the teachers of a process's share of the scenes say, by the numbers of the scenes.

    Attributes:
        spaces: their spaces.
        means: of the text side, where a coded teacher has one.
        kinds: names of the things that the teachers tell apart.
        missing: what scenes lack.
        table: the distinct vectors of all tables of coded teachers; None for dense ones.
    """

    spaces: dict[int, FeatureSpace] = field(default_factory=dict)
    means: dict[int, Float32[np.ndarray, " D"]] = field(default_factory=dict)
    kinds: dict[int, tuple[str, ...]] = field(default_factory=dict)
    missing: dict[int, str] = field(default_factory=dict)
    table: Float32[np.ndarray, "C D"] | None = None


def open_all(scenes: Sequence[Path], open_scene: OpenScene, process: ProcessRank, *, optional: bool) -> OpenedScenes:
    """Opens the scenes of a process; the first one alone where its teacher is dense and no scene may lack it."""
    share, tables = OpenedScenes(), list[np.ndarray]()
    for number in range(process.rank, len(scenes), process.world_size):
        try:
            _, teacher = open_scene(scenes[number])
        except MissingInput as error:
            if not optional:
                raise
            share.missing[number] = str(error)
            continue
        for space in share.spaces.values():
            check_space(space, teacher.space, scenes[number])
        share.spaces[number] = teacher.space
        if teacher.table is None:
            if optional:
                continue
            break
        share.kinds[number] = tuple(getattr(teacher, "kinds", ()))
        if teacher.mean is not None:
            share.means[number] = teacher.mean
        tables.append(teacher.table)
    share.table = np.unique(np.concatenate(tables), axis=0) if tables else None
    return share


def check_space(space: FeatureSpace, other: FeatureSpace, path: Path) -> None:
    """Checks that a scene's teacher has the feature space of the scenes before it."""
    if space != other:
        raise InputError(
            f"training: expected one feature space for all scenes, got several feature spaces: ({space.describe()}), "
            f"and in {path} ({other.describe()})"
        )


def sampled_moments(
    scenes: Sequence[Path],
    open_scene: OpenScene,
    space: FeatureSpace,
    *,
    views: int,
    folder: Path | None = None,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> tuple[Moments, tuple[str, ...]]:
    """Moments of the maps that `sampled_maps` gives, and the names of the things that their teachers tell apart. All
    processes of a training call this; see `dataset_space` for the arguments."""
    assert folder is not None or process.world_size == 1
    requests = [each for each in zip(scenes, views_of_scenes(len(scenes), views), strict=True) if each[1]]
    cuts = np.linspace(0, len(requests), min(BLOCKS, len(requests)) + 1).astype(int).tolist()
    blocks = [requests[start:end] for start, end in pairwise(cuts)]
    files = [None if folder is None else folder / f"{number:05d}.safetensors" for number in range(len(blocks))]
    with fail_together():
        for number in track(range(process.rank, len(blocks), process.world_size), "fitting the basis"):
            if files[number] is not None:
                block_moments(blocks[number], open_scene, space, files[number])
    total, kinds = Moments(space.channels), dict[str, None]()
    with fail_together():
        if process.is_first:
            for block, file in zip(blocks, files, strict=True):
                # A file that another run has removed, or that a file system shows later, is made again.
                moments, names = block_moments(block, open_scene, space, file)
                total.merge(moments)
                kinds |= dict.fromkeys(names)
    return value_of_first((total, tuple(kinds)))


def block_moments(
    block: list[tuple[Path, int]], open_scene: OpenScene, space: FeatureSpace, file: Path | None
) -> tuple[Moments, tuple[str, ...]]:
    """The moments of a block, given as scenes with their numbers of maps, and the names of the things that the
    teachers tell apart; from its file, if it is there for the same maps, else computed and written to it."""
    key = {"maps": [[str(path), count] for path, count in block], "space": plain(space)}
    if file is not None and file.is_file():
        with advised(f"remove {file.parent} to compute them again"), open_archive(file) as archive:
            if archive.value("maps", list) == key["maps"] and archive.value("space", dict) == key["space"]:
                return Moments.read(archive, space.channels), tuple(archive.value("kinds", list))
    kinds, moments = dict[str, None](), Moments(space.channels)
    for path, count in block:
        for teacher, feature_map in maps_of_scene(path, count, open_scene):
            check_space(space, teacher.space, path)
            kinds |= dict.fromkeys(getattr(teacher, "kinds", ()))
            rows = distinct_rows(feature_map)
            moments.add(rows[:: max(1, len(rows) // MAX_CELLS_PER_MAP)])
    if file is not None:
        file.parent.mkdir(exist_ok=True)
        write_archive(file, moments.state(), {**key, "kinds": list(kinds)})
    return moments, tuple(kinds)
