"""The output space of a dataset: mean, scale and basis that all its scenes share.

Moments of a teacher's vectors over a dataset, computed by all processes of a training.

The maps are cut into blocks, which depend on the scenes alone. Each process computes the moments of its blocks and
writes a file of each, and the first one merges them in order: the sums are the same, bit for bit, for any number of
processes, as far as the teacher's maps are. A run that was killed goes on with the blocks that are there.

The maps of a dense teacher that stand for a dataset: evenly distributed over its scenes and their views.

Which ones they are depends on the scenes alone, and not on how many processes make them.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

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
"""Reads a scene without making Gaussians, and builds its teacher."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRequest:
    """A number of maps of a scene.

    Attributes:
        path: of the scene.
        count: number of maps, fewer where the scene has fewer views.
        used: views that have been used before.
    """

    path: Path
    count: int
    used: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MapAnswer:
    """What became of a request.

    Attributes:
        views: the views of the maps that were made.
        missing: what the scene lacks, if it lacks what the teacher needs.
    """

    views: tuple[int, ...]
    missing: str | None = None


class MapRounds:
    """Distributes a number of maps over scenes, in rounds: scenes that lack what the teacher needs leave their maps to
    the others, in the next round."""

    def __init__(self, scenes: Sequence[Path], views: int) -> None:
        """Args:
        scenes: all scenes to train on.
        views: number of maps, fewer where the scenes have fewer views.
        """
        self._scenes, self._candidates, self._left = list(scenes), list(scenes), views
        self._used: dict[Path, tuple[int, ...]] = {}
        self._lacking: dict[Path, str] = {}
        self._exhausted: set[Path] = set()

    def requests(self) -> list[MapRequest]:
        """The requests of the next round; none when all maps have been made."""
        if self._left <= 0 or not self._candidates:
            return []
        counts = views_of_scenes(len(self._candidates), self._left)
        return [
            MapRequest(path=path, count=count, used=self._used.get(path, ()))
            for path, count in zip(self._candidates, counts, strict=True)
            if count
        ]

    def record(self, requests: Sequence[MapRequest], answers: Sequence[MapAnswer]) -> None:
        """Takes the answers to the requests of a round into account.

        Raises:
            MissingInput: no scene has what the teacher needs.
        """
        for request, answer in zip(requests, answers, strict=True):
            if answer.views:
                self._used[request.path] = (*request.used, *answer.views)
            if answer.missing is not None:
                self._lacking[request.path] = answer.missing
                continue
            self._left -= len(answer.views)
            if len(answer.views) < request.count:
                self._exhausted.add(request.path)
        if not self._lacking:
            self._candidates = []
            return
        untried = [path for path in self._scenes if path not in self._used and path not in self._lacking]
        again = [path for path in self._used if path not in self._exhausted and path not in self._lacking]
        self._candidates = untried or again
        if not self._candidates and not self._used:
            raise MissingInput(next(iter(self._lacking.values())))


def requested_maps(
    request: MapRequest, open_scene: OpenScene, answers: list[MapAnswer], *, optional: bool = False
) -> Iterator[tuple[Teacher, FeatureMap]]:
    """The maps of a request, evenly spaced beside those that were used before.

    Args:
        request: which maps.
        open_scene: reads the scene.
        answers: gets the answer when all maps have been made.
        optional: a scene that lacks what the teacher needs is answered with what that is.

    Yields:
        The scene's teacher, and a map.

    Raises:
        MissingInput: the scene lacks what the teacher needs, without `optional`.
    """
    views, missing = list[int](), None
    try:
        scene, teacher = open_scene(request.path)
        assert scene.views is not None
        even = even_indices(len(scene.views), len(request.used) + request.count).tolist()
        for view in [view for view in even if view not in request.used][: request.count]:
            yield teacher, upright(teacher).feature_map(scene.views, view)
            views.append(view)
    except MissingInput as error:
        if not optional:
            raise
        missing = str(error)
    answers.append(MapAnswer(views=tuple(views), missing=missing))


def sampled_maps(
    scenes: Sequence[Path], open_scene: OpenScene, views: int, *, optional: bool = False
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
    rounds = MapRounds(scenes, views)
    while requests := rounds.requests():
        answers: list[MapAnswer] = []
        for request in requests:
            for teacher, feature_map in requested_maps(request, open_scene, answers, optional=optional):
                yield request.path, teacher, feature_map
        rounds.record(requests, answers)


def views_of_scenes(scenes: int, views: int) -> list[int]:
    """How many of `views` maps are those of each scene, evenly distributed; the first scene has one at least."""
    counts = [int(count) for count in np.diff(np.linspace(0, views, scenes + 1).round())]
    return [max(1, counts[0]), *counts[1:]]


MAX_CELLS_PER_MAP = 4096
"""Approximate limit of the cells of one teacher map that enter the moments."""
BLOCKS = 64
"""Largest number of blocks of a round: enough for the processes of several machines, and for 1,280 channels their files
take 0.8 GB until they are merged."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """What became of the requests of a block.

    Attributes:
        answers: to each request.
        kinds: names of the things that the teacher tells apart in these scenes.
        moments: of the maps; None where they are in a file.
    """

    answers: list[MapAnswer]
    kinds: tuple[str, ...]
    moments: Moments | None = field(default=None, repr=False)


def sampled_moments(
    scenes: Sequence[Path],
    open_scene: OpenScene,
    space: FeatureSpace,
    *,
    views: int,
    optional: bool = False,
    folder: Path | None = None,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> tuple[Moments, tuple[str, ...]]:
    """Moments of the maps that `sampled_maps` gives. All processes of a training call this.

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        views: number of maps.
        optional: leave out scenes that lack what the teacher needs.
        folder: of the files of blocks, which all processes share; blocks that are there already are not computed again.
            Removed by the caller. None = one process, which holds them in memory.

    Returns:
        The moments, and the names of the things that the teacher tells apart in the scenes.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do.
        InputError: in any process, a scene cannot be used, its teacher has another space, or a file is damaged.
    """
    assert folder is not None or process.world_size == 1
    rounds, kinds = MapRounds(scenes, views), dict[str, None]()
    every: list[tuple[Path | None, list[MapRequest], Block]] = []
    while requests := rounds.requests():
        cuts = np.linspace(0, len(requests), min(BLOCKS, len(requests)) + 1).astype(int).tolist()
        blocks = [requests[start:end] for start, end in pairwise(cuts)]
        files = [folder / f"{len(every) + number:05d}.safetensors" if folder else None for number in range(len(blocks))]
        with fail_together():
            share = range(process.rank, len(blocks), process.world_size)
            computed = {
                number: _block(blocks[number], open_scene, space, files[number], optional=optional)
                for number in track(share, "fitting the basis")
            }
        by_number = {number: block for of_process in values_of_all(computed) for number, block in of_process.items()}
        in_order = [by_number[number] for number in range(len(blocks))]
        every += zip(files, blocks, in_order, strict=True)
        for block in in_order:
            kinds |= dict.fromkeys(block.kinds)
        rounds.record(requests, [answer for block in in_order for answer in block.answers])
    total = Moments(space.channels)
    with fail_together():
        if process.is_first:
            for file, requests, block in every:
                total.merge(_moments(block, requests, open_scene, space, file, optional=optional))
    return value_of_first(total), tuple(kinds)


def _block(
    requests: list[MapRequest], open_scene: OpenScene, space: FeatureSpace, file: Path | None, *, optional: bool
) -> Block:
    """Computes a block and writes its file, unless the file is there."""
    key = {"requests": plain(requests), "space": plain(space)}
    if file is not None and file.is_file():
        with advised(f"remove {file.parent} to compute them again"), open_archive(file) as archive:
            if all(archive.value(name, list, dict) == value for name, value in key.items()):
                answers = [
                    MapAnswer(views=tuple(views), missing=missing) for views, missing in archive.value("answers", list)
                ]
                return Block(answers=answers, kinds=tuple(archive.value("kinds", list)))
    answers, kinds, moments = list[MapAnswer](), dict[str, None](), Moments(space.channels)
    for request in requests:
        for teacher, feature_map in requested_maps(request, open_scene, answers, optional=optional):
            if teacher.space != space:
                raise InputError(several_spaces(space, teacher.space, request.path))
            kinds |= dict.fromkeys(getattr(teacher, "kinds", ()))
            rows = distinct_rows(feature_map)
            moments.add(rows[:: max(1, len(rows) // MAX_CELLS_PER_MAP)])
    if file is None:
        return Block(answers=answers, kinds=tuple(kinds), moments=moments)
    header: dict[str, Any] = {
        **key,
        "answers": [[list(answer.views), answer.missing] for answer in answers],
        "kinds": list(kinds),
    }
    file.parent.mkdir(exist_ok=True)
    write_archive(file, moments.state(), header)
    return Block(answers=answers, kinds=tuple(kinds))


def _moments(
    block: Block,
    requests: list[MapRequest],
    open_scene: OpenScene,
    space: FeatureSpace,
    file: Path | None,
    *,
    optional: bool,
) -> Moments:
    """The moments of a block, from its file where it has one."""
    if block.moments is not None:
        return block.moments
    assert file is not None
    # Another run that prepares the same scenes has removed it; or a file system shows it later to other machines.
    if not file.is_file():
        _block(requests, open_scene, space, file, optional=optional)
    with advised(f"remove {file.parent} to compute them again"), open_archive(file) as archive:
        return Moments.read(archive, space.channels)


def several_spaces(space: FeatureSpace, other: FeatureSpace, path: Path) -> str:
    """The message about a scene whose teacher has another feature space than the scenes before it."""
    return (
        f"training: expected one feature space for all scenes, got several feature spaces: ({space.describe()}), and "
        f"in {path} ({other.describe()})"
    )


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
    """The root mean square distance from the mean, given the variance."""
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Check the images, and the teacher's features of these scenes (`gsencoder fuse`)"
        )
    return float(np.sqrt(variance))
