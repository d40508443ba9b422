"""Teachers whose maps are given, and small scenes to fuse them on, that several test files stand on."""

from dataclasses import replace
from typing import Any

import numpy as np
from splats import front_camera, random_gaussians

from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.lift import VisibilityConfig
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, Gaussians, Scene, Views

SPACE = FeatureSpace(name="s", channels=6)
EXACT = FuseConfig(energy=1.0, visibility=VisibilityConfig(against=()))


class FixedTeacher:
    """Gives back the maps that it was made with."""

    table = None
    mean = None
    needs_images = False
    cheap = False

    def __init__(self, maps: list[np.ndarray], stride: int = 4) -> None:
        self.maps, self.stride, self.space, self.calls = maps, stride, SPACE, 0
        self.fail_at: int | None = None

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        if view == self.fail_at:
            raise KeyboardInterrupt
        grid = np.array([[1 / self.stride, 0, 0], [0, 1 / self.stride, 0]])
        return FeatureMap(features=self.maps[view], grid_from_image=grid, space=SPACE)

    def settings(self) -> dict[str, Any]:
        return {"name": "fixed"}


class CodedTeacher(FixedTeacher):
    cheap = True

    def __init__(self, codes: list[np.ndarray], table: np.ndarray) -> None:
        super().__init__(codes, stride=1)
        self.table = table  # type: ignore[assignment]

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        return FeatureMap(
            codes=self.maps[view], table=self.table, grid_from_image=np.array([[1.0, 0, 0], [0, 1.0, 0]]), space=SPACE
        )


def ring(count: int = 5, width: int = 32, height: int = 24) -> Cameras:
    """Cameras in a row, all looking along +z."""
    one = front_camera(width, height, 30.0).select([0] * count)
    poses = one.cam_from_world.copy()
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, count)
    return replace(one, cam_from_world=poses)


def make_scene(n: int = 150, count: int = 5, gaussians: Gaussians | None = None, **views: Any) -> Scene:
    all_views = Views(cameras=ring(count), names=tuple(f"v{i}" for i in range(count)), **views)
    return Scene(name="test", gaussians=random_gaussians(n) if gaussians is None else gaussians, views=all_views)
