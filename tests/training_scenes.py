"""Small scenes with a teacher, prepared for training, that several test files stand on."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file
from splats import front_camera

from gsencoder.core.archive import open_archive
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.transformer import TransformerConfig
from gsencoder.teachers.base import Teacher
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE, Trainer, TrainerConfig
from gsencoder.train.losses import LossConfig, TeacherRecipe
from gsencoder.train.prepare import PrepareConfig, add_scene, fit_space
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.run import encoder_trainer
from gsencoder.train.samples import Augmentation, SampleDataset, SampleRecipe, SamplingConfig, TrainingScene
from gsencoder.types import FeatureMap, FeatureSpace, Gaussians, Scene, Views

TABLE = np.array([[0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0]], np.float32)
SPACE = FeatureSpace(name="sides", channels=4)
SMALL = EncoderConfig(
    voxel=0.1,
    transformer=TransformerConfig(
        encoder_depths=(1, 1), encoder_channels=(16, 32), decoder_depths=(1,), decoder_channels=(16,),
        head_channels=16, patch=32, drop_path=0.2,
    ),
)  # fmt: skip
LOSSES = LossConfig(contrast_weight=0.3)
"""All terms at once."""
PREPARE = PrepareConfig(fusion=FuseConfig(basis=False), render_cell=4, render_min_weight=0.0)


class SideTeacher:
    """Says of every pixel whether it is in the left or the right half of its picture; a coded teacher."""

    needs_images = False
    cheap = True
    table = TABLE
    mean = TABLE.mean(axis=0)
    space = SPACE

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        width, height = int(views.cameras.widths[view]), int(views.cameras.heights[view])
        codes = np.where(np.arange(width) < width // 2, 1, 2).astype(np.int32)
        return FeatureMap(
            codes=np.broadcast_to(codes, (height, width)).copy(), table=TABLE,
            grid_from_image=np.array([[1.0, 0, 0], [0, 1.0, 0]]), space=SPACE,
        )  # fmt: skip

    def settings(self) -> dict[str, Any]:
        return {"name": "sides"}


class DenseSideTeacher(SideTeacher):
    """The same as dense maps on cells of two pixels."""

    table = None  # type: ignore[assignment]
    mean = None  # type: ignore[assignment]

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        coded = super().feature_map(views, view)
        features = TABLE[coded.codes[::2, ::2]]
        return FeatureMap(features=features, grid_from_image=np.array([[0.5, 0, 0], [0, 0.5, 0]]), space=SPACE)


def scene(number: int, count: int = 400) -> Scene:
    """A wall of Gaussians, red on the left and blue on the right, before two cameras."""
    rng = np.random.default_rng(number)
    means = rng.uniform((-1, -1, 2.9), (1, 1, 3.1), (count, 3)).astype(np.float32)
    left = means[:, 0] < 0
    quats = rng.normal(size=(count, 4))
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    poses[1, 2, 3] = 0.2
    cameras = replace(front_camera(48, 40, 40.0).select([0, 0]), cam_from_world=poses)
    gaussians = Gaussians(
        means=means,
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.full((count, 3), 0.06, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=np.where(left[:, None, None], [[[1.5, -1, -1]]], [[[-1, -1, 1.5]]]).astype(np.float32),
    )
    views = Views(cameras=cameras, names=("near", "far"))
    return Scene(name=f"wall_{number}", gaussians=gaussians, views=views, metres_per_unit=1.0)


def prepared(folder: Path, *, count: int = 3, teacher: Teacher | None = None) -> tuple[PreparedDataset, list[str]]:
    """Some scenes, prepared in a folder."""
    chosen = teacher or SideTeacher()
    dataset = PreparedDataset(folder, {"made": "for a test"})
    names = [f"wall_{number}" for number in range(count)]
    fit_space(dataset, [Path(name) for name in names], lambda path: (scene(int(path.name[5:])), chosen), PREPARE)
    for number in range(count):
        add_scene(dataset, scene(number), chosen, PREPARE, source=Path(f"wall_{number}"))
    dataset.cluster_classes(names)
    return dataset, names


def samples(dataset: PreparedDataset, names: Sequence[str], **changes: Any) -> SampleDataset:
    """Samples of prepared scenes."""
    recipe = {
        "encoder": SMALL, "sampling": SamplingConfig(views=2, gaussians=200), "losses": LOSSES,
        "augmentation": Augmentation(turn=10.0), "seed": 3,
        "teachers": (TeacherRecipe(name="sides", codebook=dataset.load_codebook()),),
    }  # fmt: skip
    scenes = [TrainingScene([scene]) for scene in dataset.scenes(names)]
    return SampleDataset(scenes, SampleRecipe(**{**recipe, **changes}))


def small_encoder(channels: int | Sequence[int] = 4) -> GaussianEncoder:
    """The same parameters every time."""
    import torch

    torch.manual_seed(0)
    return GaussianEncoder(SMALL, channels)


SHORT = TrainerConfig(
    steps=8, learning_rate=3e-3, warmup=2, log_every=1, validate_every=0, precision="float32", checkpoint_every=0.0
)


Prepared = tuple[PreparedDataset, list[str]]


def trainer(dataset: Prepared, folder: Path, config: TrainerConfig = SHORT, **changes: object) -> Trainer:
    changes |= {"folder": made(folder), "settings": {"run": 1}}
    return encoder_trainer(small_encoder(), samples(*dataset), LOSSES, config, **changes)


def losses(folder: Path, column: str = "loss") -> list[float]:
    return [float(row[column]) for row in read_log(folder / LOG_FILE)]


def rows(folder: Path) -> list[dict[str, str]]:
    """The log without what the clock says."""
    return [{name: value for name, value in row.items() if name != "seconds"} for row in read_log(folder / LOG_FILE)]


def weights_in(folder: Path) -> dict[str, np.ndarray]:
    """Parameters of the checkpoint."""
    arrays = load_file(folder / TRAINING_CHECKPOINT_FILE)
    return {name: value for name, value in arrays.items() if name.startswith("model.")}


def steps_in(folder: Path) -> int:
    with open_archive(folder / TRAINING_CHECKPOINT_FILE) as file:
        return file.value("step", int)


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights_in(one), weights_in(other)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name])


def made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def stop_at(last: int, error: BaseException | None = None) -> Callable[[range, str], Iterator[int]]:
    """Goes through the steps of a run, and interrupts it before one of them."""

    def track(steps: range, label: str) -> Iterator[int]:
        for step in steps:
            if step == last:
                raise error or KeyboardInterrupt
            yield step

    return track
