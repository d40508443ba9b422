"""Where selections start, which pixels are looked at and whose they are, and the holes that objects leave."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from feature_fields import answer_of, box_of
from selected_rooms import EMBEDDINGS, selected_room, splat_of, words
from viewed_targets import joined

from gsencoder.core.errors import InputError
from gsencoder.data.orbits import looking_cameras
from gsencoder.infer import select as module
from gsencoder.infer.select import Parts, Votes, box_parts, find_holes, sample_views, select, threshold_parts, votes
from gsencoder.types import Box, Cameras, Gaussians, Scene

SCENE, KINDS = selected_room()
LIKELY = (0.8, 0.4, 0.39)


def box(rank: int, word: str = "mug") -> Box:
    """A box of two Gaussians, the larger row first."""
    rows = np.array([2 * rank + 1, 2 * rank])
    return box_of(word, rank, rows, score=1.0 - rank, probability=LIKELY[rank])


FOUND = answer_of(("mug", "book"), np.zeros((2, 8), np.float32), tuple(box(rank) for rank in range(3)))


def rows_of(parts: Parts) -> list[list[list[int]]]:
    return [[rows.tolist() for rows in groups] for groups in parts]


def test_boxes_that_are_nearly_as_probable_as_the_best_are_taken() -> None:
    assert rows_of(box_parts(FOUND, ())) == [[[0, 1], [2, 3]], []]


def test_boxes_that_are_asked_for_by_number_are_taken_once_whatever_their_probability() -> None:
    mug = answer_of(("mug",), FOUND.relevancy[:1], FOUND.boxes)
    assert rows_of(box_parts(mug, (2, 0, 2))) == [[[4, 5], [0, 1]]]
    with pytest.raises(InputError, match="box=3: 'mug' has 3 boxes, 0 to 2$"):
        box_parts(mug, (0, 3))
    with pytest.raises(InputError, match="box=0: 'book' has no box: absent"):
        box_parts(FOUND, (0,))


def test_a_threshold_takes_what_reaches_it_and_no_part_of_a_word_that_nothing_reaches() -> None:
    relevancy = np.array([[0.5, 0.49, np.nan, 0.9], [0.1, np.nan, 0.2, -1.0]], np.float32)
    assert rows_of(threshold_parts(("a", "b"), relevancy, 0.5)) == [[[0, 3]], []]
    with pytest.raises(InputError, match=r"threshold=0.95: .* the best are 'a' 0.9, 'b' 0.2$"):
        threshold_parts(("a", "b"), relevancy, 0.95)
    with pytest.raises(InputError, match=r"the best are 'a' nan$"):
        threshold_parts(("a",), np.full((1, 2), np.nan, np.float32), 0.5)


def two_mugs() -> Scene:
    """The scene with a second mug, paler than the first, in place of the book."""
    features = SCENE.features["names"]
    vectors = features.features.copy()
    vectors[KINDS == 1] = 0.8 * EMBEDDINGS[0] + 0.2 * EMBEDDINGS[2]
    return replace(SCENE, features={"names": replace(features, features=vectors)})


@pytest.mark.parametrize(("probable", "kinds"), [(0.0, {0, 1}), (1.0, {0})])
def test_of_two_mugs_the_more_probable_one_or_both_are_taken(monkeypatch, probable, kinds):
    monkeypatch.setattr(module, "PROBABLE", probable)
    selection, localization = select(two_mugs(), ("mug",), words())
    likely = [each.probability for each in localization.boxes]
    assert likely == sorted(set(likely), reverse=True)
    assert set(KINDS[selection.labels == 1]) == kinds


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_cameras_are_placed_only_where_something_was_found() -> None:
    bare = replace(SCENE, views=None)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*has no views")
        with pytest.raises(InputError, match="no Gaussian of table is selected"):
            select(bare, ("lamp",), words())


def camera(width: int = 60, height: int = 40) -> Cameras:
    """One camera, a unit above the origin, that looks down."""
    return looking_cameras(
        np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 1.0, 0.0]), 60.0, width, height
    )


def sheets(*heights: float, opacities: tuple[float, ...]) -> Gaussians:
    """Flat Gaussians that are wider than the picture, above one another."""
    made = splat_of(np.array([[0.0, 0.0, height] for height in heights]), np.float32(opacities))
    return replace(made, scales=np.full((len(heights), 3), (3.0, 3.0, 0.001), np.float32))


def voted(gaussians: Gaussians, labels: list[int], *, spacing: float, pixels: int = 10_000) -> Votes:
    cameras = camera()
    samples = sample_views(cameras, 1, pixels)
    return votes(gaussians, cameras, np.array(labels, np.int32), max(labels), samples, spacing=spacing)


@pytest.mark.parametrize(
    ("size", "pixels", "stride"),
    [((200, 50), 10_000, 1), ((200, 50), 9_999, 2), ((200, 50), 2_500, 2), ((50, 200), 2_400, 3), ((8, 8), 10**6, 1)],
)
def test_no_more_pixels_than_asked_for_are_looked_at(size: tuple[int, int], pixels: int, stride: int) -> None:
    assert sample_views(camera(*size), 1, pixels) == [(0, stride)]


@pytest.mark.parametrize(("views", "rows"), [(3, [0, 4, 8]), (20, [*range(9)]), (0, [])])
def test_views_are_evenly_spaced_and_all_where_there_are_fewer(views: int, rows: list[int]) -> None:
    assert [view for view, _ in sample_views(camera().select([0] * 9), views)] == rows


def test_what_lies_farther_behind_the_surface_than_a_spacing_and_a_fiftieth_of_its_depth_does_not_count() -> None:
    for below, spacing, counts in ((0.06, 0.05, True), (0.08, 0.05, False), (0.06, 0.03, False), (0.01, 0.0, True)):
        made = voted(sheets(0.0, -below, opacities=(0.7, 0.9)), [1, 0], spacing=spacing)
        assert made.present[0, 1] == pytest.approx(0.7 * 2400, rel=0.05)
        assert made.present[1, 1] == pytest.approx(0.3 * 0.9 * 2400 if counts else 0.0, rel=0.05)
        # Without the first the second would have all these pixels, which keep their label.
        assert made.removed[1, 1] == pytest.approx(0.9 * 2400 if counts else 0.0, rel=0.05)
        assert not made.removed[0].any()


def test_pixels_are_of_the_label_that_more_than_half_of_their_opacity_is_of() -> None:
    for opacities, owner in (((0.3, 0.9), 2), ((0.6, 0.9), 1), ((0.2, 0.1), 1)):
        made = voted(sheets(0.0, -0.01, opacities=opacities), [1, 2], spacing=0.1)
        assert made.present[:, owner].min() > 0
        assert not np.delete(made.present, owner, axis=1).any()
    # None of three has half of it.
    made = voted(sheets(0.0, -0.01, -0.02, opacities=(0.34, 0.5, 0.99)), [1, 2, 3], spacing=0.1)
    assert not made.present[:, 1:].any()


def test_every_third_pixel_counts_nine_times() -> None:
    gaussians, labels = sheets(0.0, -0.01, opacities=(0.7, 0.9)), [1, 0]
    fine, coarse = (voted(gaussians, labels, spacing=0.1, pixels=pixels) for pixels in (10_000, 300))
    np.testing.assert_allclose(coarse.present, fine.present, rtol=0.1)
    np.testing.assert_allclose(coarse.removed, fine.removed, rtol=0.1)


SIDE = np.arange(-0.2, 0.2001, 0.01)
SQUARE = np.stack([*np.meshgrid(SIDE, SIDE), np.zeros((41, 41))], axis=-1).reshape(-1, 3)
DOWN, NORTH = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 1.0, 0.0])


def above(*heights: float, turned: bool = False) -> Cameras:
    """Cameras above the middle of the square that look down at it, or up and away from it."""
    eyes = np.array([[0.0, 0.0, height] for height in heights])
    return looking_cameras(eyes, np.repeat(-DOWN if turned else DOWN, len(eyes), axis=0), NORTH, 100.0, 100, 80)


def square_splat() -> Gaussians:
    return replace(splat_of(SQUARE), scales=np.full((len(SQUARE), 3), 0.006, np.float32))


TAKEN = SQUARE[:, 0] > -0.199


def test_a_hole_is_what_was_opaque_and_is_not_with_its_area_at_the_depth_that_it_had() -> None:
    wall = np.stack([*np.meshgrid(SIDE * 6, SIDE * 6), np.full((41, 41), -0.5)], axis=-1).reshape(-1, 3)
    camera = above(1.0)
    every = sample_views(camera, 1)
    (hole,) = find_holes(square_splat(), camera, TAKEN, every)
    # Seen from above, 0.4 × 0.4 units; the Gaussians at the edge reach a little beyond.
    assert hole.area == pytest.approx(0.16, rel=0.1)
    assert hole.pixels == pytest.approx(1600, rel=0.1)
    assert hole.pixels * 1e-4 == pytest.approx(hole.area, rel=1e-3)
    behind = splat_of(np.concatenate([SQUARE, wall]))
    behind = replace(behind, scales=np.repeat(np.float32([[0.006], [0.06]]), len(SQUARE), axis=0).repeat(3, axis=1))
    removed = np.arange(len(behind)) < len(SQUARE)
    (covered,) = find_holes(behind, camera, removed, every)
    assert covered.pixels == 0
    assert covered.area == 0
    assert covered.removed == pytest.approx(1700, rel=0.1)
    assert find_holes(behind, camera, np.zeros(len(behind), bool), every) == []


@pytest.mark.parametrize(("height", "stretch"), [(0.8, 1.0), (2.0, 1.0), (1.0, 1.6)])
def test_the_area_of_a_hole_does_not_depend_on_the_camera_and_its_pixels_do(height: float, stretch: float) -> None:
    camera = above(height)
    Ks = camera.Ks.copy()
    Ks[:, 1, 1] *= stretch
    camera = replace(camera, Ks=Ks)
    (hole,) = find_holes(square_splat(), camera, TAKEN, sample_views(camera, 1))
    assert hole.area == pytest.approx(0.16, rel=0.12)
    assert hole.pixels == pytest.approx(1600 / height**2 * stretch, rel=0.12)


def test_holes_have_the_numbers_of_their_views_and_views_without_the_object_have_none() -> None:
    away, down = above(1.0, turned=True), above(1.0, 2.0)
    cameras = joined(away, down)
    holes = find_holes(square_splat(), cameras, TAKEN, sample_views(cameras, 3))
    assert [hole.view for hole in holes] == [1, 2]


@pytest.mark.parametrize(("opacities", "opens"), [((0.45, 0.2), True), ((0.2, 0.45), False), ((0.3, 0.1), None)])
def test_a_pixel_is_of_what_more_than_half_of_its_opacity_is_of(opacities, opens):
    """A wide half-transparent Gaussian that is removed before another one that is not."""
    gaussians = splat_of(np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]]), np.float32(opacities))
    gaussians = replace(gaussians, scales=np.full((2, 3), (2.0, 2.0, 0.01), np.float32))
    camera = above(1.0)
    holes = find_holes(gaussians, camera, np.array([True, False]), sample_views(camera, 1))
    if opens:
        assert holes[0].pixels > 1000
    else:
        # The first is not most of the pixels, or both together are not opaque.
        assert holes == []
