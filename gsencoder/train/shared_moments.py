"""Moments of a teacher's vectors over a dataset, computed by all processes of a training.

The maps are cut into blocks, which depend on the scenes alone. Each process computes the moments of its blocks and
writes a file of each, and the first one merges them in order: the sums are the same, bit for bit, for any number of
processes, as far as the teacher's maps are. A run that was killed goes on with the blocks that are there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.files import plain
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.fusion.basis import Moments
from gsencoder.fusion.lift import distinct_rows
from gsencoder.train.distributed import fail_together, value_of_first, values_of_all
from gsencoder.train.sampled_maps import MapAnswer, MapRequest, MapRounds, OpenScene, requested_maps
from gsencoder.types import FeatureSpace

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
        space: the space of the teacher.
        views: number of maps.
        optional: leave out scenes that lack what the teacher needs.
        folder: of the files of blocks, which all processes share; blocks that are there already are not computed again.
            Removed by the caller. None = one process, which holds them in memory.
        process: rank of this process.
        track: wraps loops to show progress.

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
    write_archive(file, moments.parts(), header)
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
