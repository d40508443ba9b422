"""Training of a scene's memory (M3 sec. 3.3): principal queries of Gaussians, rendered through B, attend to banks.

    R̂ = A_gm(B q / alpha),   L = (1 − cos(R̂, R)) + |R̂ − R|² / C

over rows of B that are drawn at random in each view, and Gaussians, which are rows with one entry, with a weight of
their own; in standard units about the mean of the space. With the geometry frozen this is a regression on sparse rows,
without a rasterizer.

The files of each teacher are in a folder of their own, and appear when they are complete; an interrupted preparation
continues with the maps and sums of its fusion.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.utils.data import Dataset

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, error_hint
from gsencoder.core.files import plain, read_foreign, write_json
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.core.settings import CheckedConfig, first_difference, option
from gsencoder.data.scene_arrays import bank_parts, read_bank
from gsencoder.data.splats.files import fingerprint
from gsencoder.fusion.checkpoint import CachedTeacher, upright
from gsencoder.fusion.fuse import fuse
from gsencoder.memory.attention import MemoryAttention, random_projection
from gsencoder.memory.bank import BankConfig, MapStream, RawSample, build_bank, draw_sample, principal_queries
from gsencoder.models.output_space import OutputSpace, output_space_parts, read_output_space
from gsencoder.teachers.base import Teacher
from gsencoder.train.loop import Trainer, TrainerConfig, TrainingState
from gsencoder.train.losses import EPS, RenderRows
from gsencoder.train.prepare import PrepareConfig, view_rows
from gsencoder.train.prepared import PreparedScene, write_prepared
from gsencoder.train.samples import join_rows, sample_rows
from gsencoder.types import FeatureMap, FeatureSpace, GaussianFeatures, MemoryBank, QueryMemory, Scene
from gsencoder.types.features import Scoring

BANK_FILE, SCENE_FILE, MAPS_FOLDER = "bank.safetensors", "scene.safetensors", "maps"
SAMPLE_FILE, SETTINGS_FILE = "sample.safetensors", "made_with.json"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemoryScene:
    """A scene that is prepared for one teacher: its Gaussians, fused features and rows of B, their units, and the
    components."""

    prepared: PreparedScene
    outputs: OutputSpace
    bank: MemoryBank

    @property
    def values(self) -> Float32[np.ndarray, "M channels"]:
        """The components in the units of the outputs."""
        return self.outputs.project(self.bank.components)

    def fused_features(self) -> GaussianFeatures:
        """The fused features, as they were stored."""
        prepared, outputs = self.prepared, self.outputs
        rows = np.arange(len(prepared))
        restored = outputs.restore(prepared.targets(rows))
        weights = np.array(prepared.weights)
        restored[weights == 0] = 0
        return GaussianFeatures(
            features=restored, weights=weights, mean=outputs.mean, space=outputs.space, basis=outputs.basis
        )


def prepare_memory(
    scene: Scene,
    teacher: Teacher,
    folder: Path,
    bank: BankConfig = BankConfig(),
    prepare: PrepareConfig = PrepareConfig(),
    *,
    predicted: GaussianFeatures | None = None,
    sample: int = 0,
    device: torch.device = torch.device("cpu"),
    track: Track = untracked,
) -> MemoryScene:
    """Prepares a scene for one teacher, or opens what was prepared in this folder before.

    Args:
        folder: created if it does not exist.
        predicted: features of the teacher's space that an encoder predicts for the scene; None = they are fused.
        sample: number of raw features that are stored with the bank for `open_raw_sample`, or all if there are fewer.
    """
    if not (prepare.center and prepare.scale):
        raise InputError("prepare.center, prepare.scale: expected true: the losses of a memory are in their units")
    if prepare.render_views:
        raise InputError("prepare.render_views: expected 0: a memory is trained on all views of its scene")
    if prepare.targets != "float16":
        raise InputError("prepare.targets: expected float16: the fused features of a memory are read from its targets")
    if predicted is not None and predicted.space != teacher.space:
        raise InputError(
            f"memory: the predicted features are of ({predicted.space.describe()}), and the teacher's of "
            f"({teacher.space.describe()})"
        )
    assert scene.views is not None
    _begin(folder, _preparation_settings(scene, teacher, bank, prepare, predicted))
    stream = _map_stream(scene, teacher, folder)
    if (folder / BANK_FILE).is_file():
        prepared = open_memory_scene(folder)
        _sample_raw(folder, stream, prepared.outputs.space, sample)
        return prepared
    maps = folder / MAPS_FOLDER
    work = None if teacher.cheap else maps
    features = predicted or fuse(scene, teacher, prepare.fusion, work=work, device=device, track=track).features
    outputs = OutputSpace(space=features.space, mean=features.mean, scale=_spread(features), basis=features.basis)
    maps.mkdir(exist_ok=True)
    components = build_bank(stream, features.space, features.mean, bank)
    rows = view_rows(scene, _source(teacher, folder), outputs, prepare, np.arange(len(scene.views)), device)
    _sample_raw(folder, stream, features.space, sample)
    write_prepared(folder / SCENE_FILE, scene, features, outputs, rows)
    arrays, header = output_space_parts(outputs)
    of_bank, figures = bank_parts(components)
    arrays |= {"bank": components.components, **of_bank}
    write_archive(folder / BANK_FILE, arrays, {**header, **figures})
    return open_memory_scene(folder)


def open_memory_scene(folder: Path) -> MemoryScene:
    """Opens what `prepare_memory` has prepared in a folder."""
    with _advice(folder), open_archive(folder / BANK_FILE) as file:
        outputs = read_output_space(file)
        bank = read_bank(file, file.array("bank", "float32", ("M", outputs.space.channels)), outputs.space)
    return MemoryScene(prepared=PreparedScene(folder / SCENE_FILE), outputs=outputs, bank=bank)


def _advice(folder: Path) -> AbstractContextManager[None]:
    return error_hint(f"give resume=false, or remove {folder}, to prepare the scene again")


def _begin(folder: Path, settings: Mapping[str, Any]) -> None:
    """Writes what a preparation depends on before its first file, or compares it with what an earlier one wrote."""
    path = folder / SETTINGS_FILE
    with _advice(folder):
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            write_json(path, settings)
            return
        try:
            stored = json.loads(read_foreign(path))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: cannot be read ({type(error).__name__})") from error
        if stored != settings:
            raise InputError(f"{folder}: was prepared with {first_difference(stored, dict(settings))}")


def open_raw_sample(folder: Path) -> RawSample:
    """The raw features that were stored with the bank."""
    with error_hint(f"remove {folder} to prepare the scene again"), open_archive(folder / SAMPLE_FILE) as file:
        return RawSample(features=file.array("features", "float32", ("n", "D")), total=file.value("total", int))


def _sample_raw(folder: Path, stream: MapStream, space: FeatureSpace, count: int) -> None:
    """Stores a sample of raw features, unless there is one."""
    path = folder / SAMPLE_FILE
    if count and not path.is_file():
        sample = draw_sample(stream, space, count)
        write_archive(path, {"features": sample.features}, {"total": sample.total})


def _source(teacher: Teacher, folder: Path) -> Teacher:
    """The teacher, its maps read from where the fusion has left them unless they are cheap."""
    teacher = upright(teacher)
    return teacher if teacher.cheap else CachedTeacher(teacher, folder / MAPS_FOLDER)


def _map_stream(scene: Scene, teacher: Teacher, folder: Path) -> MapStream:
    assert scene.views is not None
    views, source = scene.views, _source(teacher, folder)

    def stream() -> Iterator[tuple[int, FeatureMap]]:
        for view in range(len(views)):
            yield view, source.feature_map(views, view)

    return stream


def _preparation_settings(
    scene: Scene, teacher: Teacher, bank: BankConfig, prepare: PrepareConfig, predicted: GaussianFeatures | None
) -> dict[str, Any]:
    """What a preparation depends on, as JSON values."""
    assert scene.gaussians is not None
    assert scene.views is not None
    settings = {
        "gaussians": fingerprint(scene.gaussians)[:16],
        "views": list(scene.views.names),
        "teacher": teacher.settings(),
        "bank": plain(bank),
        "prepare": plain(prepare),
        "predicted": None if predicted is None else sha256(predicted.features.tobytes()).hexdigest()[:16],
    }
    return dict(json.loads(json.dumps(settings, default=str)))


def _spread(features: GaussianFeatures) -> float:
    """The root mean square distance of seen features from the mean."""
    seen = np.flatnonzero(features.seen)
    total = 0.0
    for start in range(0, len(seen), 1 << 14):
        rows = features.stored(seen[start : start + (1 << 14)])
        centered = rows if features.basis is not None else rows - features.mean
        total += float(np.einsum("nc,nc->", centered, centered, dtype=np.float64))
    # Equal features have no spread; any unit does for them.
    return float(np.sqrt(total / len(seen))) or 1.0


ROWS = 2000
"""Rows of B that are drawn in each view of a step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryConfig(CheckedConfig):
    """Queries, attention and loss of a memory."""

    channels: int = option(16, "channels s of a Gaussian's query for each teacher", ge=1, le=1024)
    init: Literal["fused", "random"] = option(
        "fused",
        "first queries: the principal coordinates of the fused features, with which Gaussians themselves "
        "keep features; random = as the paper, where only rendered queries do",
    )
    scoring: Scoring = option(
        "centered",
        "queries and components are compared by the cosine about the mean; cosine = as they are, as M3's "
        "code does; dot = by products, as its equation",
    )
    temperature: float = option(0.05, "temperature of the attention's softmax", gt=0)
    gaussian_weight: float = option(
        0.3,
        "weight of Gaussians that are compared with their fused features, half as many as rows of B; without "
        "them rendered features come nearer to the teacher's, and those of the Gaussians go their own way; 0 = off",
        ge=0,
    )
    min_alpha: float = option(0.5, "smallest opacity of a row", gt=0, le=1)


class MemoryBatch(NamedTuple):
    """Rows of one or more views, for each teacher."""

    names: tuple[str, ...]
    rows: tuple[RenderRows, ...]


class ViewSamples(Dataset[MemoryBatch]):
    """Rows of the views of a scene by number of the sample; each epoch goes through the views in a new order."""

    def __init__(self, scenes: Mapping[str, MemoryScene], config: MemoryConfig, seed: int) -> None:
        self._scenes = {name: scene.prepared for name, scene in scenes.items()}
        self._config, self._seed = config, seed
        self._views = next(iter(self._scenes.values())).view_names

    def __getitem__(self, number: int) -> MemoryBatch:
        epoch, position = divmod(number, len(self._views))
        view = int(np.random.default_rng([self._seed, 0, epoch]).permutation(len(self._views))[position])
        rows = tuple(self._rows(scene, view, number) for scene in self._scenes.values())
        return MemoryBatch(names=(self._views[view],), rows=rows)

    def _rows(self, scene: PreparedScene, view: int, number: int) -> RenderRows:
        config, rng = self._config, np.random.default_rng([self._seed, 1, number])
        seen = scene.weights > 0
        rows = sample_rows(scene.view(view), seen, config.min_alpha, ROWS, rng)
        if not config.gaussian_weight:
            return rows
        of_seen = np.flatnonzero(seen)
        chosen = np.sort(rng.choice(of_seen, min(len(of_seen), ROWS // 2), replace=False))
        # A Gaussian is a row of B with one entry.
        gaussians = RenderRows(
            crow=torch.arange(len(chosen) + 1),
            col=torch.from_numpy(chosen.astype(np.int32)),
            weight=torch.ones(len(chosen)),
            targets=torch.from_numpy(scene.targets(chosen)),
            row_weights=torch.full((len(chosen),), float(config.gaussian_weight)),
        )
        return join_rows([rows, gaussians], [0, 0])


def join_views(samples: Sequence[MemoryBatch]) -> MemoryBatch:
    """Joins samples to a batch."""
    shifts = [0] * len(samples)
    rows = tuple(join_rows(of_teacher, shifts) for of_teacher in zip(*(each.rows for each in samples), strict=True))
    return MemoryBatch(names=tuple(name for each in samples for name in each.names), rows=rows)


class MemoryNetwork(nn.Module):
    """Queries of Gaussians for each teacher, and what turns rendered queries into its features."""

    def __init__(self, queries: Mapping[str, Float[Tensor, "N s"]], decoders: Mapping[str, nn.Module]) -> None:
        super().__init__()
        # Names of modules may hold no dots and are not those of attributes; numbers stand for teachers.
        self.queries = nn.ParameterList([nn.Parameter(each) for each in queries.values()])
        self.decoders = nn.ModuleList(decoders.values())

    def forward(self, rows: tuple[RenderRows, ...]) -> tuple[Float[Tensor, "_ _"], ...]:
        """The features of rows of B for each teacher, in standard units."""
        features = []
        for queries, decoder, each in zip(self.queries, self.decoders, rows, strict=True):
            b = each.blend(len(queries))
            features.append(decoder(b.render(queries) / b.alpha.clamp(min=EPS)[:, None]))
        return tuple(features)


class MemoryObjective:
    """The loss of a memory: for each teacher and row w · ((1 − cos) + |R̂ − R|² / C)."""

    advice = "memory.min_alpha"

    def __init__(self, network: nn.Module, teachers: Sequence[str]) -> None:
        self.network = network
        # The terms of each teacher; in the log they have its name where there are several.
        several = len(teachers) > 1
        self._terms = [tuple(f"{name}/{term}" if several else term for term in ("cosine", "l2")) for name in teachers]
        self.lambdas = {term: 1.0 for terms in self._terms for term in terms}

    def divisors(self, batch: MemoryBatch) -> dict[str, float]:
        """The sum of the weights of the rows, for each term."""
        weights = [float(rows.row_weights.double().sum()) for rows in batch.rows]
        return {term: weight for terms, weight in zip(self._terms, weights, strict=True) for term in terms}

    def __call__(self, batch: MemoryBatch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0."""
        totals: dict[str, Tensor] = {}
        for (cosine, l2), predicted, rows in zip(self._terms, self.network(batch.rows), batch.rows, strict=True):
            predicted, target = predicted.float(), rows.targets
            products = (predicted * target).sum(dim=1)
            lengths = torch.sqrt(((predicted * predicted).sum(dim=1) + EPS) * ((target * target).sum(dim=1) + EPS))
            totals[cosine] = ((1 - products / lengths) * rows.row_weights).sum()
            totals[l2] = ((predicted - target).square().mean(dim=1) * rows.row_weights).sum()
        return totals


def memory_training() -> TrainerConfig:
    """The training loop's settings for memories."""
    return TrainerConfig(steps=600, learning_rate=0.04, warmup=50, validate_every=0)


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
    """The memory of fused features without any training."""
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
    """Optimizes the queries of a scene, as it was prepared for one teacher or several, for all at once. Interrupted, it
    is resumed by the next call with the same `work`, an existing folder."""
    training = memory_training() if training is None else training
    _check_same_scene(scenes)
    check_rows(scenes, config.min_alpha)
    first, decoders = dict[str, Tensor](), dict[str, nn.Module]()
    for name, scene in scenes.items():
        queries, projection = first_queries(scene, config, training.seed)
        first[name] = torch.from_numpy(queries)
        decoders[name] = MemoryAttention(
            scene.bank,
            torch.from_numpy(projection),
            mean=scene.outputs.mean,
            scoring=config.scoring,
            temperature=config.temperature,
            values=torch.from_numpy(scene.values),
        )
    settings = {
        "memory": plain(config),
        "teachers": list(scenes),
        "spaces": {name: scene.bank.space.describe() for name, scene in scenes.items()},
        "digests": {name: fingerprint_of(scene.bank) for name, scene in scenes.items()},
    }
    network = MemoryNetwork(first, decoders)
    trainer = Trainer(
        network,
        ViewSamples(scenes, config, training.seed),
        partial(MemoryObjective, teachers=list(scenes)),
        training,
        collate=join_views,
        folder=work,
        settings=settings,
        process=process,
        device=device,
        weight_decay=0.0,
    )
    state = trainer.run(track)
    memories = {}
    for (name, scene), optimized, attention in zip(scenes.items(), network.queries, network.decoders, strict=True):
        assert isinstance(attention, MemoryAttention)
        queries, projection = (each.detach().cpu().numpy() for each in (optimized, attention.projection))
        memories[name] = _memory_of(scene, config, queries, projection)
    return memories, state


def fingerprint_of(bank: MemoryBank) -> str:
    """A digest of the components and of what they are compared about."""
    digest = sha256(bank.components.tobytes())
    digest.update(bank.mean.tobytes())
    return digest.hexdigest()[:16]


def check_rows(scenes: Mapping[str, MemoryScene], min_alpha: float) -> None:
    """Checks that there is something to compare rendered features with."""
    for name, scene in scenes.items():
        prepared = scene.prepared
        seen = prepared.weights > 0
        views = range(len(prepared.view_names))
        if not any(len(sample_rows(prepared.view(view), seen, min_alpha).targets) for view in views):
            raise InputError(
                f"memory.min_alpha: no cell of {len(views)} views of teacher {name} is covered to {min_alpha:g} by "
                "Gaussians with features; give a smaller one"
            )


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
    """Refuses scenes of different Gaussians or views."""
    first_name, first = next(iter(scenes.items()))
    for name, scene in scenes.items():
        if len(scene.prepared) != len(first.prepared) or scene.prepared.view_names != first.prepared.view_names:
            raise InputError(
                f"memory: {first_name} and {name} were prepared for different scenes, of {len(first.prepared):,} and "
                f"{len(scene.prepared):,} Gaussians"
            )
