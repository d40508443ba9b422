"""Adapter heads of the teacher in a training: measured once for a prepared dataset, and used by the render loss.

Distilled features must work with the heads as the teacher's features do, so the render loss can be computed on their
outputs (SplatDistill Eq. 4). Both sides of the loss are decoded from the dataset's basis first, so a head sees the
teacher's vectors without what the basis drops; the dataset's file of heads states what that costs each of them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.fusion.errors import CellSample
from gsencoder.fusion.folder import HEADS_FILE, check_heads_space
from gsencoder.fusion.measured_heads import (
    HeadSet,
    choose_heads,
    has_head,
    load_heads,
    measure_heads,
    save_heads,
)
from gsencoder.models.output_space import OutputSpace
from gsencoder.teachers.build import TeacherConfig, load_teacher_heads
from gsencoder.teachers.heads import Head
from gsencoder.train.losses import AdapterHead
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.space import OpenScene, sampled_maps


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
    """Measures heads over the maps that the dataset's output space was computed from, and adds them to its folder.

    Args:
        dataset: with its output space.
        heads: those of `missing_heads`.
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        views: number of maps.
        optional: leave out scenes that lack what the teacher needs.
    """
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
