"""Labels of Gaussians from instance pictures, and what of them speaks for points, on a scene laid out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.evaluate.sources import LabeledPoints, labeled_points
from gsencoder.types import Gaussians, MeshLabels, Scene, SceneObject, Views

MUG, NAMELESS, UNLISTED = 7, 3, 9
LEFT, RIGHT, MIDDLE, OUTSIDE, HIDDEN, FAINT = range(6)


def laid_out(views: int = 1) -> Scene:
    """One camera, or equal ones, before Gaussians at 2 m, and one at 4 m where the sensor saw something at 2 m.

    The left third of the picture shows the mug, the right third a thing without a name, the middle what the objects do
    not list.
    """
    means = np.array([[-0.8, 0.2, 2], [0.8, 0, 2], [0, 0, 2], [9, 0, 2], [-1.6, -0.8, 4], [-0.8, 0.5, 2]], np.float32)
    gaussians = replace(
        random_gaussians(len(means)),
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        scales=np.where(np.arange(len(means))[:, None] == FAINT, 1e-4, 0.05).astype(np.float32).repeat(3, axis=1),
        opacities=np.where(np.arange(len(means)) == FAINT, 0.3, 0.9).astype(np.float32),
    )
    camera = front_camera(60, 40, 50.0)
    instances = np.full((40, 60), UNLISTED, np.int32)
    instances[:, :20], instances[:, 40:] = MUG, NAMELESS
    corner = np.zeros(3)
    return Scene(
        name="made",
        gaussians=gaussians,
        views=Views(
            cameras=camera.select([0] * views), names=tuple(map(str, range(views))),
            depths=[np.full((40, 60), 2, np.float32)] * views, instances=[instances] * views,
        ),
        objects=(
            SceneObject(id=MUG, name="mug", aabb_min=corner, aabb_max=corner + 1),
            SceneObject(id=NAMELESS, name=None, aabb_min=corner, aabb_max=corner + 1),
        ),
    )  # fmt: skip


def test_a_gaussian_is_of_the_listed_object_on_whose_pixels_it_is_seen() -> None:
    points = labeled_points(laid_out())
    # The middle shows what is not listed, one is outside of the picture, one behind what the sensor saw, and the faint
    # one covers less than a pixel.
    assert points.objects.tolist() == [MUG, NAMELESS, 0, 0, 0, 0]
    assert points.gaussians.tolist() == list(range(6))
    assert points.positions is None
    assert points.named_ids() == {MUG: "mug"}
    assert len(points) == 6


def test_without_sensor_depth_what_is_behind_counts_and_pixels_of_all_views_add_up() -> None:
    scene = laid_out(views=2)
    assert labeled_points(scene).objects[FAINT] == MUG
    bare = labeled_points(replace(scene, views=replace(scene.views, depths=None)))
    assert bare.objects.tolist() == [MUG, NAMELESS, 0, 0, MUG, MUG]


def points_of(gaussians: list[int], objects: list[int]) -> LabeledPoints:
    return LabeledPoints(
        scene="s", objects=np.array(objects, np.int32), names={5: "mug", 6: "box"}, gaussians=np.array(gaussians)
    )


def test_rows_of_an_object_are_each_once_and_masks_leave_out_points_without_a_gaussian() -> None:
    points = points_of([4, 1, 4, -1, 0], [5, 5, 5, 5, 6])
    assert points.rows_of(5).tolist() == [1, 4]
    assert points.rows_of(9).tolist() == []
    # The point without a Gaussian is not in the mask of the last one.
    assert points.masked(np.array([4]), 5).tolist() == [True, False, True, False, False]
    assert points.masked(np.array([], np.int64), 5).tolist() == [False] * 5


def test_renamed_objects_keep_their_ids_and_others_lose_their_class() -> None:
    points = points_of([0, 1], [6, 5]).renamed({"mug": "cup"})
    assert points.names == {5: "cup"}
    assert points.named_ids() == {5: "cup"}
    assert points.objects.tolist() == [6, 5]


@pytest.mark.parametrize(("unit", "near"), [(None, True), (2.0, True), (2.2, False)])
def test_the_distance_to_a_vertex_is_in_metres(unit: float | None, near: bool) -> None:
    # The nearest Gaussian is 0.048 units away: 0.048, 0.096 or 0.1056 m.
    gaussians: Gaussians = replace(random_gaussians(1), means=np.array([[0, 0, 0]], np.float32))
    mesh = MeshLabels(
        vertices=np.array([[0.048, 0, 0]], np.float32), instances=np.array([1], np.int32), objects=((1, "mug"),)
    )
    scene = Scene(name="s", gaussians=gaussians, metres_per_unit=unit)
    assert labeled_points(scene, mesh).gaussians.tolist() == [0 if near else -1]


def test_scenes_without_gaussians_or_true_objects_are_refused() -> None:
    scene = laid_out()
    with pytest.raises(InputError, match="scene made has no Gaussians"):
        labeled_points(replace(scene, gaussians=None))
    for lost in ({"views": None}, {"objects": ()}, {"views": replace(scene.views, instances=None)}):
        with pytest.raises(InputError, match="has no true objects: expected a labeled mesh"):
            labeled_points(replace(scene, **lost))
