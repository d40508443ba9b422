"""Training of a scene's memory: first queries, the loop, and what comes out (M3 sec. 3.3)."""

import math
from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import nn

from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.memory.attention import Decoder, MemoryAttention, make_decoder, random_projection
from gsencoder.memory.bank import principal_queries
from gsencoder.train.checkpoint import TrainingState
from gsencoder.train.memory_network import MemoryConfig, MemoryNetwork, MemoryObjective, ViewSamples, join_views
from gsencoder.train.memory_scene import MemoryScene
from gsencoder.train.render_rows import sample_rows
from gsencoder.train.trainer import Trainer
from gsencoder.train.trainer_config import CHANGEABLE_ON_RESUME, TrainerConfig
from gsencoder.types import MemoryBank, QueryMemory


def memory_training() -> TrainerConfig:
    """The training loop's settings for memories."""
    return TrainerConfig(steps=600, learning_rate=0.04, warmup=50, weight_decay=0.0, validate_every=0, log_every=10)


def first_queries(
    scene: MemoryScene, config: MemoryConfig, seed: int
) -> tuple[Float32[np.ndarray, "N s"], Float32[np.ndarray, "s D"]]:
    """Queries and projection before the training: those of the fused features, or random ones."""
    if config.init == "fused":
        return principal_queries(scene.fused_features(), scene.bank, config.channels, config.scoring)
    channels, generator = scene.outputs.space.channels, torch.Generator().manual_seed(seed)
    projection = random_projection(config.channels, channels, generator)
    if config.scoring != "dot":
        projection = projection * math.sqrt(channels)
    return torch.randn(len(scene.prepared), config.channels, generator=generator).numpy(), projection.numpy()


def untrained_memory(scene: MemoryScene, config: MemoryConfig, seed: int = 0) -> QueryMemory:
    """The memory of fused features without any training.

    Raises:
        InputError: no rows to compare with.
    """
    check_rows({scene.bank.space.name: scene}, config.min_alpha)
    queries, projection = first_queries(scene, config, seed)
    return _memory_of(scene, config, queries, projection)


def train_memory(
    scenes: Mapping[str, MemoryScene],
    config: MemoryConfig = MemoryConfig(),
    training: TrainerConfig | None = None,
    *,
    work: Path,
    process: ProcessRank = ProcessRank(),
    device: torch.device = torch.device("cpu"),
    track: Track = untracked,
) -> tuple[dict[str, QueryMemory], TrainingState]:
    """Optimizes the queries of a scene for one teacher or several at once. Interrupted, it is resumed by the next call
    with the same `work`.

    Args:
        scenes: the scene as it was prepared for each teacher.
        config: queries, attention and loss.
        training: settings of the loop; None = those of `memory_training`.
        work: existing folder for the checkpoint and the log.
        process: rank of this process.
        device: of this process.
        track: wraps the loop to show progress.

    Raises:
        InputError: the scenes are of different Gaussians or views, `work` holds a run with other settings, or a loss or
            gradient is not finite.
    """
    training = memory_training() if training is None else training
    network, state = _train(scenes, config, training, None, work, process, device, track)
    memories = {}
    for number, (name, scene) in enumerate(scenes.items()):
        attention = network.decoders[number]
        assert isinstance(attention, MemoryAttention)
        queries, projection = (each.detach().cpu().numpy() for each in (network.queries[number], attention.projection))
        memories[name] = _memory_of(scene, config, queries, projection)
    return memories, state


def train_decoder(
    scene: MemoryScene,
    kind: Decoder,
    config: MemoryConfig,
    training: TrainerConfig,
    *,
    work: Path,
    track: Track = untracked,
) -> MemoryNetwork:
    """The same training with a decoder in place of the attention, to compare with; its outputs are in standard units.

    Args:
        scene: prepared for one teacher.
        kind: of the decoder.
        config: queries and loss; what is said of attention is not used.
        training: settings of the loop.
        work: existing folder for the checkpoint and the log.
        track: wraps the loop to show progress.

    Raises:
        InputError: see `train_memory`.
    """
    network, _ = _train({"": scene}, config, training, kind, work, ProcessRank(), torch.device("cpu"), track)
    return network


def _train(
    scenes: Mapping[str, MemoryScene],
    config: MemoryConfig,
    training: TrainerConfig,
    kind: Decoder | None,
    work: Path,
    process: ProcessRank,
    device: torch.device,
    track: Track,
) -> tuple[MemoryNetwork, TrainingState]:
    _check_same_scene(scenes)
    check_rows(scenes, config.min_alpha)
    queries, decoders = {}, {}
    for name, scene in scenes.items():
        first, projection = first_queries(scene, config, training.seed)
        queries[name] = torch.from_numpy(first)
        decoders[name] = _decoder_of(scene, config, kind, first, projection, training.seed)
    settings = {
        "memory": plain(config),
        "train": {name: value for name, value in plain(training).items() if name not in CHANGEABLE_ON_RESUME},
        "decoder": kind or "attention",
        "teachers": list(scenes),
        "spaces": {name: scene.bank.space.describe() for name, scene in scenes.items()},
        "components": {name: len(scene.bank) for name, scene in scenes.items()},
        "digests": {name: fingerprint_of(scene.bank) for name, scene in scenes.items()},
        "samples_per_step": training.samples_per_step(process.world_size),
    }
    trainer = Trainer(
        MemoryNetwork(queries, decoders),
        ViewSamples(scenes, config, training.seed),
        partial(MemoryObjective, config=config, teachers=list(scenes)),
        training,
        collate=join_views,
        folder=work,
        settings=settings,
        process=process,
        device=device,
    )
    state = trainer.run(track)
    assert isinstance(trainer.network, MemoryNetwork)
    return trainer.network, state


def fingerprint_of(bank: MemoryBank) -> str:
    """A digest of the components and of what they are compared about."""
    digest = sha256(bank.components.tobytes())
    digest.update(bank.mean.tobytes())
    return digest.hexdigest()[:16]


def check_rows(scenes: Mapping[str, MemoryScene], min_alpha: float) -> None:
    """Checks that there is something to compare rendered features with.

    Raises:
        InputError: no view has a row of B that is opaque enough.
    """
    for name, scene in scenes.items():
        prepared = scene.prepared
        seen = prepared.weights > 0
        views = range(len(prepared.view_names))
        if not any(len(sample_rows(prepared.view(view), seen, min_alpha).targets) for view in views):
            raise InputError(
                f"memory.min_alpha: no cell of {len(views)} views of teacher {name} is covered to {min_alpha:g} by "
                "Gaussians with features; give a smaller one"
            )


def _decoder_of(
    scene: MemoryScene,
    config: MemoryConfig,
    kind: Decoder | None,
    queries: Float32[np.ndarray, "N s"],
    projection: Float32[np.ndarray, "s D"],
    seed: int,
) -> nn.Module:
    """What turns queries into features in standard units, before the training."""
    if kind is None:
        return MemoryAttention(
            scene.bank,
            torch.from_numpy(projection),
            mean=scene.outputs.mean,
            scoring=config.scoring,
            temperature=config.temperature,
            values=torch.from_numpy(scene.values),
        )
    # A linear decoder begins as the least squares from the first queries to the fused features.
    seen = np.flatnonzero(scene.prepared.weights)
    targets, chosen = scene.prepared.targets(seen), queries[seen].astype(np.float64)
    weights = np.linalg.lstsq(chosen.T @ chosen, chosen.T @ targets, rcond=None)[0].astype(np.float32)
    return make_decoder(kind, torch.from_numpy(weights), generator=torch.Generator().manual_seed(seed))


def _memory_of(
    scene: MemoryScene,
    config: MemoryConfig,
    queries: Float32[np.ndarray, "N s"],
    projection: Float32[np.ndarray, "s D"],
) -> QueryMemory:
    weights = np.array(scene.prepared.weights)
    return QueryMemory(
        queries=np.where(weights[:, None] > 0, queries, np.float32(0)),
        weights=weights,
        projection=projection,
        bank=scene.bank,
        scoring=config.scoring,
        temperature=config.temperature,
        mean=scene.outputs.mean,
        basis=scene.outputs.basis,
    )


def _check_same_scene(scenes: Mapping[str, MemoryScene]) -> None:
    """Raises:
    InputError: the scenes are of different Gaussians or views."""
    first_name, first = next(iter(scenes.items()))
    for name, scene in scenes.items():
        if len(scene.prepared) != len(first.prepared) or scene.prepared.view_names != first.prepared.view_names:
            raise InputError(
                f"memory: {first_name} and {name} were prepared for different scenes, of {len(first.prepared):,} and "
                f"{len(scene.prepared):,} Gaussians"
            )
