"""`experiment=splatdistill`: it composes with others, trains, resumes with equal bits, and encodes."""

from pathlib import Path

import numpy as np
import pytest
import torch

from gsencoder.app import main as cli
from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.infer.encode import Encoder
from gsencoder.infer.onnx.export import random_cloud
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import load_weights
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.losses import LossConfig
from gsencoder.train.run import TrainConfig

SMALL_MODEL = (
    "model=tiny", "model.transformer.encoder_depths=[1,1]", "model.transformer.encoder_channels=[32,32]",
    "model.transformer.decoder_depths=[1]", "model.transformer.decoder_channels=[32]",
    "model.transformer.patch=64",
)  # fmt: skip
QUICK = (
    "quiet=true", "tensorboard=false", "train.warmup=2", "train.log_every=1", "sampling.views=1",
    "seeds.voxel=0.08",
)  # fmt: skip


def composed(*words: str) -> TrainCommandConfig:
    return compose("train", TrainCommandConfig, ["scenes", *words])


def test_it_is_the_paper_where_the_paper_says_something() -> None:
    config = composed("experiment=splatdistill")
    fusion = config.prepare.fusion
    assert (config.model.stem, config.model.transformer.shuffle_orders) == (5, "pooling")
    assert config.model.transformer.encoder_channels == (32, 64, 128, 256, 512)
    assert (fusion.lift, fusion.visibility.against, fusion.basis) == ("center", ("rendered",), False)
    assert (config.prepare.center, config.prepare.scale) == (False, False)
    assert config.sampling.gaussians == 0
    plain = LossConfig(confidence=False, rarity=0.0, divide_by_alpha=False, min_alpha=1e-6, min_kept=1e-6)
    assert config.loss == plain
    assert (plain.cosine, plain.smooth_l1, plain.field_weight, plain.render_weight) == (0.9, 0.1, 1.0, 0.2)
    assert plain.contrast_weight == 0
    assert not config.augment


def test_several_experiments_are_merged_and_the_last_one_wins() -> None:
    config = composed("experiment=[house_cpu, splatdistill]", "model=tiny")
    assert config.train.steps == 5500
    assert (config.loss.smooth_l1, config.loss.contrast_weight, config.sampling.gaussians) == (0.1, 0.0, 0)
    assert config.model.transformer.encoder_channels == (32, 64, 96, 128, 128)
    reversed_order = composed("experiment=[splatdistill,house_cpu]", "loss.contrast_weight=0")
    assert reversed_order.sampling.gaussians == 32000
    with pytest.raises(InputError, match="experiment: expected one of .*scannet, splatdistill, got 'splat'"):
        composed("experiment=[house_cpu,splat]")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["prepare.center=false"], "center: expected fusion.basis=false with center=false"),
        (["prepare.scale=false"], "loss.confidence: weights by distances from the mean"),
        (
            ["prepare.scale=false", "loss.confidence=false", "loss.contrast_weight=0.6"],
            "loss.contrast_weight: compares distances with typical ones; expected 0 with prepare.scale=false",
        ),
        (["model.stem=4"], "stem"),
        (["model.transformer.shuffle_orders=often"], "expected one of once, pooling, never"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(words: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        composed(*words)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("rooms")
    for number in range(2):
        write_room(make_room(number, objects=2, views=3, width=80, height=60), folder / f"room_{number}")
    return [str(folder / f"room_{number}") for number in range(2)]


@pytest.fixture(scope="module")
def trained(scenes: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "paper"
    words = ["experiment=splatdistill", "teacher=palette", "holdout=room_1", "store=float32", "train.steps=4"]
    assert cli.main(["train", *scenes, *words, f"out={out}", *SMALL_MODEL, *QUICK]) == 0
    return out


@pytest.mark.slow
def test_its_encoder_gives_the_teachers_vectors_themselves(trained: Path) -> None:
    encoder, spaces, _ = load_weights(trained)
    outputs = spaces.select()
    assert encoder.stem.weight.shape[0] == 125
    assert (outputs.basis, outputs.centered, outputs.scaled) == (None, False, False)
    assert outputs.channels == outputs.space.channels
    features = Encoder.load(str(trained)).encode(random_cloud(200, encoder.config.voxel))
    assert features.features.shape == (200, outputs.space.channels)
    np.testing.assert_array_equal(features.mean, outputs.mean)
    assert np.linalg.norm(outputs.mean) > 0


@pytest.mark.slow
def test_a_resumed_run_repeats_the_shuffles(scenes: list[str], trained: Path, tmp_path: Path) -> None:
    words = ["experiment=splatdistill", "teacher=palette", "holdout=room_1", "store=float32"]
    config = composed(*words, *SMALL_MODEL, *QUICK, "train.steps=4", "train.checkpoint_every=0")
    from gsencoder.train import train

    def stop_at_two(steps: range, label: str) -> object:
        for step in steps:
            if label == "training" and step == 2:
                raise KeyboardInterrupt
            yield step

    for track in (stop_at_two, None):
        settings = {"work": tmp_path, "prepared": trained.with_name("paper.prepared"), "device": "cpu"}
        kwargs = {"track": track} if track else {}
        try:
            resumed = train(scenes[:1], as_train_config(config), **settings, **kwargs)  # type: ignore[arg-type]
        except KeyboardInterrupt:
            assert track is not None
    straight = load_weights(trained)[0].state_dict()
    for name, value in resumed.encoder.state_dict().items():
        assert torch.equal(value, straight[name]), name


def as_train_config(config: TrainCommandConfig) -> TrainConfig:
    return TrainConfig(**{name: getattr(config, name) for name in TrainConfig.__dataclass_fields__})


@pytest.mark.slow
def test_an_output_space_without_centering_passes_through_an_exported_header(trained: Path) -> None:
    from gsencoder.infer.onnx.runtime import from_metadata, to_metadata

    outputs: OutputSpace = from_metadata(to_metadata(TorchNetwork.load(str(trained)).header)).outputs.select()
    assert (outputs.centered, outputs.scaled) == (False, False)
