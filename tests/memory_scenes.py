"""A wall whose Gaussians have hidden features, and a teacher that sees them blended, for tests of memories."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from training_scenes import scene as wall

from gsencoder.memory.bank import BankConfig
from gsencoder.render import blend
from gsencoder.train.memory import MemoryScene, prepare_memory
from gsencoder.train.prepare import PrepareConfig
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views

WIDTH, HEIGHT = 24, 20
PREPARE = PrepareConfig(render_cell=2, render_min_weight=0.0)


def hidden_features(scene: Scene, channels: int = 12) -> np.ndarray:
    """A smooth field over the wall with a mean that is longer than what varies."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(3, channels))
    waves = np.sin(scene.gaussians.means[:, :2].astype(np.float64) @ rng.normal(size=(2, 3)) * 2.5)
    return np.asarray(4 * rng.normal(size=channels) + waves @ directions, np.float32)


class BlendedTeacher:
    """Sees the hidden features of a scene, blended on cells of two pixels; cells that hit little have no feature."""

    needs_images = False
    cheap = True
    table = None
    mean = None

    def __init__(self, scene: Scene, name: str = "hidden", channels: int = 12) -> None:
        self.space = FeatureSpace(name=name, channels=channels, teacher="blended")
        self.hidden = hidden_features(scene, channels)
        self._scene = scene

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        grid = np.array([[0.5, 0, 0], [0, 0.5, 0]])
        empty = np.zeros((HEIGHT, WIDTH, self.space.channels), np.float32)
        like = FeatureMap(features=empty, grid_from_image=grid, space=self.space)
        b = blend(self._scene.gaussians, views.cameras, view, like=like)
        alpha = b.alpha.numpy()[:, None]
        features = b.render(torch.from_numpy(self.hidden)).numpy() / np.maximum(alpha, 1e-6)
        features[alpha[:, 0] < 0.3] = np.nan
        return FeatureMap(features=features.reshape(empty.shape), grid_from_image=grid, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {"name": self.space.name}


def prepared_wall(folder: Path, name: str = "hidden", bank: BankConfig = BankConfig(), number: int = 0) -> MemoryScene:
    """A wall, prepared for a teacher."""
    scene = wall(number)
    return prepare_memory(scene, BlendedTeacher(scene, name), folder / name, bank, PREPARE)
