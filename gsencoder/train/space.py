"""What the scenes of a dataset share: the output space (mean, scale and basis), and adapter heads of its teacher.

A coded teacher's space is that of its tables. That of a dense one is of the moments of maps that are evenly distributed
over the scenes and their views, over which heads are measured, too. Distilled features must work with the heads as the
teacher's features do (SplatDistill Eq. 4); both sides of that loss are decoded from the dataset's basis.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from gsencoder.core.archive import write_archive
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.fusion.basis import Moments, distinct_rows, fit_basis, table_basis, to_coordinates
from gsencoder.fusion.checkpoint import upright
from gsencoder.fusion.errors import CellSample
from gsencoder.fusion.folder import HEADS_FILE, check_heads_space
from gsencoder.fusion.measured_heads import HeadSet, choose_heads, has_head, load_heads, measure_heads, save_heads
from gsencoder.models.output_space import OutputSpace, output_space_parts
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.teachers.build import TeacherConfig, load_teacher_heads
from gsencoder.teachers.heads import Head
from gsencoder.train.distributed import fail_together
from gsencoder.train.losses import AdapterHead
from gsencoder.train.prepare import SPACE_FILE, PrepareConfig, PreparedDataset
from gsencoder.types import FeatureMap, FeatureSpace, Scene

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
    optional: bool = False,
    process: ProcessRank = ProcessRank(),
    track: Track = untracked,
) -> None:
    """Computes and stores the output space of the training scenes of a dataset, unless it is stored already. All
    processes of a training call this, and the first one does it; the arguments are those of `dataset_space`."""
    path = dataset.folder / SPACE_FILE
    with fail_together():
        if process.is_first and not path.is_file():
            outputs, codebook, kinds = dataset_space(scenes, open_scene, config, optional=optional, track=track)
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
    optional: bool = False,
    track: Track = untracked,
) -> tuple[OutputSpace, Float32[np.ndarray, "C channels"] | None, tuple[str, ...]]:
    """Computes the output space of a dataset.

    Args:
        open_scene: reads a scene and builds its teacher.
        config: the basis, the number of maps of a dense teacher, and whether targets are centered and scaled.
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
    space = spaces[0]
    use_basis = fusion.wants_basis(space)
    table = basis = codebook = None
    if tables:
        table = np.unique(np.concatenate(tables), axis=0)
        mean = table.mean(axis=0) if mean is None else mean
        variance = np.square(table - mean, dtype=np.float64).sum(axis=1).mean()
        basis = table_basis(table, mean, space, energy=fusion.table_energy) if use_basis else None
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
    if table is not None:
        codebook = outputs.standardize(table if basis is None else to_coordinates(basis, table))
    return outputs, codebook, tuple(kinds)


def check_space(space: FeatureSpace, other: FeatureSpace, path: Path) -> None:
    """Checks that a scene's teacher has the feature space of the scenes before it."""
    if space != other:
        raise InputError(
            f"training: expected one feature space for all scenes, got several feature spaces: ({space.describe()}), "
            f"and in {path} ({other.describe()})"
        )


class FeatureDecoder(nn.Module):
    """Decodes outputs of the encoder to vectors of the teacher's space; differentiable."""

    mean: Tensor
    components: Tensor

    def __init__(self, outputs: OutputSpace) -> None:
        super().__init__()
        rows = np.eye(outputs.channels, dtype=np.float32) if outputs.basis is None else outputs.basis.components
        mean = outputs.mean if outputs.centered else np.zeros_like(outputs.mean)
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("components", torch.from_numpy(rows * np.float32(outputs.unit)))

    def forward(self, standard: Float[Tensor, "n channels"]) -> Float[Tensor, "n D"]:
        out: Tensor = standard @ self.components + self.mean
        return out


def render_heads(heads: HeadSet, outputs: OutputSpace) -> list[tuple[AdapterHead, nn.Module]]:
    """Heads as the render loss takes them, each with a decoder from standard units to its input."""
    if not heads.heads:
        return []
    check_heads_space(heads.space, outputs.space)
    decode = FeatureDecoder(outputs)
    return [(AdapterHead(each.head.body, torch.from_numpy(each.mean), each.scale), decode) for each in heads.heads]


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
    return [head for head in load_teacher_heads(teacher, names) if head.name not in stored_names]


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
