"""How many pixels of each labeled object the pictures show that `ask` sends.

Photographs and close-ups are counted in the instance maps of the scene, cut and resized as the picture was, by the
nearest pixel. Renders are counted by the instances of the Gaussians, blended as the picture was: each pixel belongs to
the instance with most of its weight, or to none where that is below one half.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int32
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.views.photographs import photograph_window
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.checks import move_origin

LEAST_WEIGHT = 0.5
"""Blending weight of one instance from which on a rendered pixel shows it."""


class PictureTruth:
    """Counts the pixels of objects in pictures of a scene.

    Attributes:
        scene: with Gaussians and cameras, as `ask` looks at it.
        gaussian_instances: the instance that most of a Gaussian's weight in the labeled views falls on; 0 = none.
    """

    def __init__(self, scene: Scene, labeled: Scene) -> None:
        """Args:
        scene: of a folder of features.
        labeled: the same scene with instance maps; its views have the names of those of `scene`, or more views.

        Raises:
            InputError: Gaussians, cameras or instance maps are missing, or a view has no instance map.
        """
        if scene.gaussians is None or scene.views is None:
            raise InputError(f"truth of pictures: scene {scene.name} has no Gaussians or no cameras")
        if labeled.views is None or labeled.views.instances is None:
            raise InputError(f"truth of pictures: scene {labeled.name} has no instance maps")
        row_of = {name: row for row, name in enumerate(labeled.views.names)}
        missing = [name for name in scene.views.names if name not in row_of]
        if missing:
            raise InputError(f"truth of pictures: scene {labeled.name} has no instance map of view {missing[0]!r}")
        self.scene = scene
        self._instances = [labeled.views.instances[row_of[name]] for name in scene.views.names]
        self._values = np.unique(np.concatenate([np.unique(each) for each in self._instances]))
        self.gaussian_instances = self._vote()
        self._counts: dict[tuple[Any, ...], dict[int, int]] = {}

    def _vote(self) -> Int32[np.ndarray, " N"]:
        gaussians, views = self.scene.gaussians, self.scene.views
        assert gaussians is not None
        assert views is not None
        votes = torch.zeros((len(gaussians), len(self._values)))
        for view, labels in enumerate(self._instances):
            size = int(views.cameras.widths[view]), int(views.cameras.heights[view])
            codes = np.searchsorted(self._values, _resized(labels, size, None)).astype(np.int32)
            blend(gaussians, views.cameras, view).lift_codes_into(torch.from_numpy(codes.ravel()), votes)
        winners = self._values[votes.argmax(dim=1).numpy()]
        return np.where(votes.sum(dim=1).numpy() > 0, winners, 0).astype(np.int32)

    def pixels(self, row: Mapping[str, Any]) -> dict[int, int]:
        """The pixels of each instance in a picture.

        Args:
            row: of a view, as `gsencoder.infer.views.pictures.views_to_json` writes it.
        """
        key = (row["kind"], row["frame"], str(row["cam_from_world"]), str(row["K"]), row["width"], row["height"])
        if key not in self._counts:
            cameras = self._camera(row)
            labels = (
                self._photographed(cameras, int(row["frame"]))
                if row["kind"] == "photograph"
                else self._rendered(cameras)
            )
            values, counts = np.unique(labels, return_counts=True)
            self._counts[key] = {int(value): int(count) for value, count in zip(values, counts, strict=True) if value}
        return self._counts[key]

    def instance_in(self, lower: Sequence[float], upper: Sequence[float]) -> int:
        """The instance of a box in world coordinates: that whose Gaussians are most nearly those in the box.

        Returns:
            The instance with the largest intersection over union of Gaussians; 0 where no labeled one is in the box.
        """
        gaussians = self.scene.gaussians
        assert gaussians is not None
        means = gaussians.means + self.scene.origin
        inside: Bool[np.ndarray, " N"] = ((means >= np.array(lower)) & (means <= np.array(upper))).all(axis=1)
        best, instance = 0.0, 0
        for value in np.unique(self.gaussian_instances[inside]):
            same = self.gaussian_instances == value
            overlap = (inside & same).sum() / (inside | same).sum()
            if value and overlap > best:
                best, instance = float(overlap), int(value)
        return instance

    def _camera(self, row: Mapping[str, Any]) -> Cameras:
        pose = move_origin(np.array(row["cam_from_world"], np.float64), self.scene.origin)
        return Cameras(
            cam_from_world=pose[None].astype(np.float32),
            Ks=np.array(row["K"], np.float32)[None],
            widths=np.array([row["width"]], np.int32),
            heights=np.array([row["height"]], np.int32),
        )

    def _photographed(self, cameras: Cameras, frame: int) -> Int32[np.ndarray, "H W"]:
        views: Views | None = self.scene.views
        assert views is not None
        labels = self._instances[frame]
        size = int(cameras.widths[0]), int(cameras.heights[0])
        window = photograph_window(views, frame, cameras, 0, (labels.shape[1], labels.shape[0]))
        return _resized(labels, size, window)

    def _rendered(self, cameras: Cameras) -> Int32[np.ndarray, "P"]:
        gaussians = self.scene.gaussians
        assert gaussians is not None
        codes = np.searchsorted(self._values, self.gaussian_instances)
        one_hot = torch.nn.functional.one_hot(torch.from_numpy(codes), len(self._values)).float()
        shares = blend(gaussians, cameras, 0, config=BlendConfig()).render(one_hot)
        weight, winner = shares.max(dim=1)
        return np.where(weight.numpy() >= LEAST_WEIGHT, self._values[winner.numpy()], 0).astype(np.int32)


def _resized(
    labels: Int32[np.ndarray, "H W"], size: tuple[int, int], window: tuple[float, float, float, float] | None
) -> Int32[np.ndarray, "h w"]:
    """A label image of another size, or a window of it, by the nearest pixel."""
    image = Image.fromarray(labels.astype(np.int32))
    if window is None and image.size == size:
        return labels
    return np.asarray(image.resize(size, Image.Resampling.NEAREST, box=window), np.int32)
