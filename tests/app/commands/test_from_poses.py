"""What `localize … pose=` hands on: mode and threshold of its settings, and the memory of the space that is asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_samples import make_memory
from splats import front_camera, random_gaussians

from gsencoder.app.commands.localize import memory_of, search_from_poses
from gsencoder.fusion.folder import load_features, save_features, save_memories
from gsencoder.infer.from_pose import FromPoseConfig, from_pose
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.text.table import make_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, QueryMemory, Scene

CHANNELS = 24
WORDS = ("mug", "chair")
TEXT = make_text_table(WORDS, np.linalg.qr(np.ones((CHANNELS, 2)) + np.eye(CHANNELS, 2))[0].T.astype(np.float32), "toy")


def asked_scene(count: int = 200) -> Scene:
    rng = np.random.default_rng(0)
    features = GaussianFeatures(
        features=(rng.normal(size=(count, CHANNELS)) + 1).astype(np.float32),
        weights=np.ones(count, np.float32),
        mean=np.ones(CHANNELS, np.float32),
        space=FeatureSpace(name="s", channels=CHANNELS, text_encoder="toy"),
    )
    ball = random_gaussians(count, log_scale=-1.6)
    return Scene(name="toy", gaussians=replace(ball, opacities=np.sqrt(ball.opacities)), features={"s": features})


@pytest.mark.parametrize(
    "config",
    [
        LocalizeConfig(mode="raw"),
        LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=0.99)),
        LocalizeConfig(threshold=ThresholdConfig(kind="otsu")),
    ],
)
def test_points_are_those_of_the_mode_and_the_threshold_that_are_asked_for(config: LocalizeConfig) -> None:
    scene, cameras = asked_scene(), front_camera()
    ((points, drawn),) = search_from_poses(scene, cameras, [None], WORDS, TEXT, config, pictures=False)
    expected = from_pose(scene, cameras, WORDS, TEXT, FromPoseConfig(mode=config.mode, threshold=config.threshold))
    assert [(each["relevancy"], each["threshold"], each["visible"]) for each in points] == [
        (each.relevancy, each.threshold, each.visible) for each in expected
    ]
    usual = from_pose(scene, cameras, WORDS, TEXT)
    assert points[0]["threshold"] != usual[0].threshold
    assert drawn == []


def memory_in(name: str) -> QueryMemory:
    memory = make_memory()
    return replace(memory, bank=replace(memory.bank, space=FeatureSpace(name=name, channels=CHANNELS)))


def test_the_memory_that_is_asked_is_that_of_the_features_of_the_scene(tmp_path: Path) -> None:
    scene = Scene(name="toy", gaussians=random_gaussians(200))
    save_memories(tmp_path / "several", scene, {"a": memory_in("first"), "b": memory_in("second")})
    loaded = load_features(tmp_path / "several")
    for teacher, name in (("a", "first"), ("b", "second")):
        memory = memory_of(tmp_path / "several", replace(loaded, features={teacher: loaded.features[teacher]}))
        assert memory.space.name == name
    save_features(tmp_path / "features", scene, memory_in("first").features())
    assert memory_of(tmp_path / "features", load_features(tmp_path / "features")) is None
