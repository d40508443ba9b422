"""Preparation of a scene for the training of its memory: fused features, a bank, and the rows of B of every view.

The files of each teacher are in a folder of their own, and appear when they are complete; an interrupted preparation
continues with the maps and sums of its fusion.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.files import plain, read_foreign, write_json
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import first_difference, with_added_options
from gsencoder.data.scene_arrays import bank_parts, read_bank
from gsencoder.data.splats.files import fingerprint
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.checkpoint import CachedTeacher, upright
from gsencoder.fusion.fuse import fuse
from gsencoder.memory.bank import BankConfig, MapStream, RawSample, build_bank, draw_sample
from gsencoder.models.output_space import OutputSpace, output_space_parts, read_output_space
from gsencoder.teachers.base import Teacher
from gsencoder.train.prepare import PrepareConfig, view_rows
from gsencoder.train.prepared_file import write_prepared
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.types import FeatureMap, FeatureSpace, GaussianFeatures, MemoryBank, Scene

BANK_FILE, SCENE_FILE, MAPS_FOLDER = "bank.safetensors", "scene.safetensors", "maps"
SAMPLE_FILE, SETTINGS_FILE = "sample.safetensors", "made_with.json"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemoryScene:
    """A scene that is prepared for one teacher.

    Attributes:
        prepared: its Gaussians, fused features, and rows of B.
        outputs: the units of these features.
        bank: the components.
    """

    prepared: PreparedScene
    outputs: OutputSpace
    bank: MemoryBank

    @property
    def values(self) -> Float32[np.ndarray, "M channels"]:
        """The components in the units of the outputs."""
        basis = self.outputs.basis
        rows = self.bank.components if basis is None else to_coordinates(basis, self.bank.components)
        return self.outputs.standardize(rows)

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
        scene: with Gaussians and views.
        teacher: whose features are remembered.
        folder: created if it does not exist.
        bank: how the bank is made.
        prepare: settings of the fusion and of the rows.
        predicted: features of the teacher's space that an encoder predicts for the scene; None = they are fused.
        sample: number of raw features that are stored beside the bank for `open_raw_sample`, or all if there are fewer.
        device: where B is made and multiplied.
        track: wraps loops to show progress.

    Raises:
        InputError: features that are not standardized, a scene that cannot be fused, a bank that cannot be made, or a
            folder that was prepared with other settings.
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
    settings = _preparation_settings(scene, teacher, bank, prepare, predicted)
    stream = _map_stream(scene, teacher, folder)
    if (folder / BANK_FILE).is_file():
        prepared = open_memory_scene(folder, settings)
        _sample_raw(folder, stream, prepared.outputs.space, sample)
        return prepared
    _begin(folder, settings)
    maps = folder / MAPS_FOLDER
    work = None if teacher.cheap else maps
    features = predicted or fuse(scene, teacher, prepare.fusion, work=work, device=device, track=track).features
    outputs = OutputSpace(space=features.space, mean=features.mean, scale=_spread(features), basis=features.basis)
    source = _source(teacher, folder)
    maps.mkdir(exist_ok=True)
    components = build_bank(stream, features.space, features.mean, bank)
    assert scene.views is not None
    rows = view_rows(scene, source, outputs, prepare, np.arange(len(scene.views)), device)
    _sample_raw(folder, stream, features.space, sample)
    write_prepared(folder / SCENE_FILE, scene, features, outputs, rows)
    _write_bank(folder / BANK_FILE, components, outputs, settings)
    return open_memory_scene(folder, settings)


def open_memory_scene(folder: Path, settings: Mapping[str, Any] | None = None) -> MemoryScene:
    """Opens a prepared scene.

    Args:
        folder: of `prepare_memory`.
        settings: what the preparation depends on; None = anything.

    Raises:
        InputError: missing, damaged, or prepared with other settings.
    """
    with _advice(folder), open_archive(folder / BANK_FILE) as file:
        stored = with_added_options(file.value("made_with", dict))
        if settings is not None and stored != settings:
            raise InputError(f"was prepared with {first_difference(stored, dict(settings))}")
        outputs = read_output_space(file)
        bank = read_bank(file, file.array("bank", "float32", ("M", outputs.space.channels)), outputs.space)
    return MemoryScene(prepared=PreparedScene(folder / SCENE_FILE), outputs=outputs, bank=bank)


def _advice(folder: Path) -> AbstractContextManager[None]:
    return advised(f"give resume=false, or remove {folder}, to prepare the scene again")


def _begin(folder: Path, settings: Mapping[str, Any]) -> None:
    """Writes what a preparation depends on before its first map and its sample, which do not say so themselves.

    Raises:
        InputError: the folder holds those of other settings, or cannot be used.
    """
    path = folder / SETTINGS_FILE
    with _advice(folder):
        if not path.is_file():
            if any((folder / name).exists() for name in (SAMPLE_FILE, MAPS_FOLDER)):
                raise InputError(f"{folder}: holds parts of a preparation, and not what they were made with")
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"{folder}: cannot be made: {error.strerror or error}") from error
            write_json(path, settings)
            return
        try:
            stored = with_added_options(json.loads(read_foreign(path)))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: cannot be read ({type(error).__name__})") from error
        if stored != settings:
            raise InputError(f"{folder}: was begun with {first_difference(stored, settings)}")


def open_raw_sample(folder: Path) -> RawSample:
    """The raw features that were stored beside the bank.

    Raises:
        InputError: none were, or they are damaged.
    """
    with advised(f"remove {folder} to prepare the scene again"), open_archive(folder / SAMPLE_FILE) as file:
        return RawSample(features=file.array("features", "float32", ("n", "D")), total=file.value("total", int))


def _sample_raw(folder: Path, stream: MapStream, space: FeatureSpace, count: int) -> None:
    """Stores a sample of raw features, unless there is one of this number already."""
    path = folder / SAMPLE_FILE
    if not count:
        return
    if path.is_file():
        with open_archive(path) as file:
            if file.value("limit", int) == count:
                return
    sample = draw_sample(stream, space, count)
    write_archive(path, {"features": sample.features}, {"total": sample.total, "limit": count})


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


def _write_bank(path: Path, bank: MemoryBank, outputs: OutputSpace, settings: Mapping[str, Any]) -> None:
    arrays, header = output_space_parts(outputs)
    of_bank, figures = bank_parts(bank)
    arrays |= {"bank": bank.components, **of_bank}
    write_archive(path, arrays, {**header, **figures, "made_with": dict(settings)})


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
