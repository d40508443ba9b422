"""One output space for a whole dataset: the mean, the scale and the basis that all its scenes share."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.even_indices import evenly
from gsencoder.fusion.basis import Moments, encode, fit_basis, table_basis
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.lift import map_rows
from gsencoder.fusion.teachers import Teacher
from gsencoder.models.output_space import OutputSpace
from gsencoder.types import Scene, Views

MOST_CELLS = 4096
"""Cells of one map that the moments are taken from."""


def dataset_space(
    scenes: Sequence[Path],
    open_scene: Callable[[Path], tuple[Scene, Teacher]],
    config: FuseConfig,
    *,
    views: int,
) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None]:
    """Finds the space of a dataset.

    A coded teacher's tables are put together; each distinct vector counts once. A dense teacher is asked for `views`
    maps, evenly spread over the scenes and their views.

    Args:
        scenes: all that will be trained on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        config: share of the energy to keep, largest rank, channels below which there is no basis.
        views: maps of a dense teacher that are looked at.

    Returns:
        The space, and for a coded teacher its vectors in standard units.

    Raises:
        InputError: no scenes, or teachers of several spaces.
    """
    if not scenes:
        raise InputError("training: no scenes to train on")
    tables: list[np.ndarray] = []
    moments: Moments | None = None
    teacher: Teacher | None = None
    share = np.linspace(0, views, len(scenes) + 1).round().astype(int)
    for number, path in enumerate(scenes):
        if teacher is not None and teacher.table is None and share[number] == share[number + 1]:
            continue
        scene, found = open_scene(path)
        if teacher is not None and found.space != teacher.space:
            raise InputError(
                f"training: scenes of several feature spaces: ({teacher.space.describe()}) and, in {path}, "
                f"({found.space.describe()})"
            )
        teacher = found
        if teacher.table is not None:
            tables.append(teacher.table)
            continue
        moments = moments or Moments(teacher.space.channels)
        assert scene.views is not None
        _look(moments, teacher, scene.views, max(1, int(share[number + 1] - share[number])))
    assert teacher is not None
    if tables:
        return _coded_space(np.unique(np.concatenate(tables), axis=0), teacher, config)
    assert moments is not None
    return _dense_space(moments, teacher, config), None


def _look(moments: Moments, teacher: Teacher, views: Views, count: int) -> None:
    for view in evenly(len(views), count):
        rows = map_rows(teacher.feature_map(views, int(view)))
        rows = rows[np.isfinite(rows[:, 0])]
        moments.add(rows[:: max(1, len(rows) // MOST_CELLS)])


def _coded_space(
    table: Float32[np.ndarray, "C D"], teacher: Teacher, config: FuseConfig
) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"]]:
    mean = teacher.mean if teacher.mean is not None else table.mean(axis=0)
    scale = _scale(np.square(table - mean, dtype=np.float64).sum(axis=1).mean(), teacher)
    wanted = config.basis and teacher.space.channels > config.narrow
    basis = table_basis(table, mean, teacher.space, energy=config.table_energy) if wanted else None
    space = OutputSpace(space=teacher.space, mean=mean, scale=scale, basis=basis)
    return space, space.standardize(encode(basis, table) if basis is not None else table)


def _dense_space(moments: Moments, teacher: Teacher, config: FuseConfig) -> OutputSpace:
    # The mean of what was looked at, and not one that the teacher states: moments are taken about it.
    mean, covariance = moments.mean.astype(np.float32), moments.covariance()
    scale = _scale(np.trace(covariance), teacher)
    basis = None
    if config.basis and teacher.space.channels > config.narrow:
        basis = fit_basis(
            mean.astype(np.float64), covariance, teacher.space, energy=config.energy, max_rank=config.max_rank
        )
    return OutputSpace(space=teacher.space, mean=mean, scale=scale, basis=basis)


def _scale(variance: float, teacher: Teacher) -> float:
    """Root of the mean squared distance from the mean.

    Raises:
        InputError: there is none, so there is nothing to tell apart.
    """
    if not variance > 0:
        raise InputError(
            f"training: the teacher ({teacher.space.describe()}) gives the same features everywhere in these scenes; "
            "there is nothing to learn. Look at their pictures, and at what the teacher says of them (`gsencoder fuse`)"
        )
    return float(np.sqrt(variance))
