"""Instances of Gaussians and of pictures on a scene that is laid out by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splats import front_camera, random_gaussians

from gsencoder.evaluate.stand_in_vlm import PictureTruth
from gsencoder.types import Scene, Views

ORIGIN = np.array([100.0, 0.0, 0.0])
LEFT, RIGHT = 7, 3
K = [[50.0, 0, 30], [0, 50, 20], [0, 0, 1]]
POSE = [[1.0, 0, 0, -100], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def scene_of(means: list[list[float]], opacity: float = 0.95, scale: float = 0.1) -> Scene:
    """Round Gaussians before a camera of 60 × 40 pixels."""
    count = len(means)
    gaussians = replace(
        random_gaussians(count),
        means=np.array(means, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), scale, np.float32),
        opacities=np.full(count, opacity, np.float32),
    )
    return Scene(name="s", gaussians=gaussians, views=views_of(), origin=ORIGIN)


def views_of(*names: str, instances: list[np.ndarray] | None = None) -> Views:
    names = names or ("a",)
    return Views(cameras=front_camera(60, 40, 50.0).select([0] * len(names)), names=names, instances=instances)


def halves(left: int = LEFT, right: int = RIGHT) -> np.ndarray:
    labels = np.full((40, 60), right, np.int32)
    labels[:, :30] = left
    return labels


def truth_of(scene: Scene, *labels: np.ndarray, names: tuple[str, ...] = ("a",)) -> PictureTruth:
    return PictureTruth(scene, replace(scene, views=views_of(*names, instances=list(labels))))


def row(kind: str, frame: int = 0) -> dict[str, Any]:
    return {"kind": kind, "frame": frame, "cam_from_world": POSE, "K": K, "width": 60, "height": 40}


def test_a_gaussian_is_of_the_instance_with_most_of_its_weight_and_of_none_where_no_view_shows_it() -> None:
    faint = scene_of([[-0.4, 0, 2], [0.05, 0, 2], [-0.02, 0, 2], [9, 0, 2]])
    assert truth_of(faint, halves()).gaussian_instances.tolist() == [LEFT, RIGHT, LEFT, 0]
    # However little there is of it.
    small = scene_of([[-0.4, 0, 2]], opacity=0.02, scale=1e-4)
    assert truth_of(small, halves()).gaussian_instances.tolist() == [LEFT]


def test_instance_maps_are_those_of_the_views_names_whatever_else_the_labeled_scene_has() -> None:
    scene = scene_of([[-0.4, 0, 2], [0.4, 0, 2]])
    truth = truth_of(scene, halves(1, 2), halves(), names=("b", "a"))
    assert truth.gaussian_instances.tolist() == [LEFT, RIGHT]
    assert truth.pixels(row("photograph")) == {LEFT: 1200, RIGHT: 1200}


def test_a_rendered_pixel_shows_an_instance_from_half_of_the_weight_on() -> None:
    scene = scene_of([[-0.4, 0, 2], [0.4, 0, 2]])
    pixels = truth_of(scene, halves()).pixels(row("render"))
    # A Gaussian of 0.95 has a weight of one half within sqrt(2 log 1.9) = 1.133 standard deviations, each of them
    # 50 · 0.1 / 2 = 2.5 pixels wide, and 0.3 of a pixel² more: an area of π · 1.133² · 6.55 = 26.4 pixels.
    assert set(pixels) == {LEFT, RIGHT}
    assert all(abs(count - 26.4) < 4 for count in pixels.values())
    faint = scene_of([[-0.4, 0, 2]], opacity=0.49)
    assert truth_of(faint, halves()).pixels(row("render")) == {}


def test_a_box_is_of_the_instance_whose_gaussians_are_most_nearly_those_in_it() -> None:
    # Four on the left and one on the right, along x.
    scene = scene_of([[-0.9, 0, 2], [-0.7, 0, 2], [-0.5, 0, 2], [-0.3, 0, 2], [0.3, 0, 2]])
    truth = truth_of(scene, halves())

    def of(low: float, high: float) -> int:
        return truth.instance_in([100.0 + low, -1.0, 1.0], [100.0 + high, 1.0, 3.0])

    assert of(-1, 0) == LEFT
    assert of(0, 1) == RIGHT
    # One of four on the left is in it, beside one of one on the right: 1 / 5 and 1 / 2.
    assert of(-0.35, 1) == RIGHT
    # Three of four, and one of one: 3 / 5 and 1 / 4.
    assert of(-0.75, 1) == LEFT
    assert of(2, 3) == 0
    # A box is in world coordinates.
    assert truth.instance_in([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0]) == 0
    # Of what is no instance there is none.
    assert truth_of(scene, halves(left=0)).instance_in([99.0, -1.0, 1.0], [100.0, 1.0, 3.0]) == 0


@pytest.mark.parametrize(("window", "expected"), [((0, 0, 60, 40), (1200, 1200)), ((20, 10, 20, 20), (1200, 1200))])
def test_windows_of_photographs_are_counted_at_the_size_they_are_shown_in(
    window: tuple[int, int, int, int], expected: tuple[int, int]
) -> None:
    scene = scene_of([[0, 0, 2]])
    left, upper, width, height = window
    inside = np.array(K)
    inside[:2, 2] -= (left, upper)
    inside[:2] *= np.array([60 / width, 40 / height])[:, None]
    pixels = truth_of(scene, halves()).pixels(row("photograph") | {"K": inside.tolist()})
    assert (pixels[LEFT], pixels[RIGHT]) == expected
