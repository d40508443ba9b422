"""Which views are chosen: laws in a room that is known, and a wall that hides."""

from dataclasses import replace

import numpy as np
import pytest
from feature_fields import answer_of, box_of
from rooms import CUBE, HALF, HEIGHT, UP, corner_cameras, cube, room, sheet, splat, walls
from viewed_targets import SHELLS, around, cube_in_room, joined

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views.candidates import FreeSpace, frames_on, shell_cameras, up_of
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.pictures import view_pictures, view_sheet
from gsencoder.infer.views.targets import ViewsConfig, target_of, targets_of
from gsencoder.types import Cameras, Scene

pytestmark = pytest.mark.slow


def turned_outward(cameras: Cameras) -> Cameras:
    outward = cameras.centers / np.linalg.norm(cameras.centers, axis=1, keepdims=True)
    return looking_cameras(cameras.centers, outward, UP, 40.0, 64, 48)


def test_targets_are_the_best_boxes_of_each_word_with_the_ball_that_holds_them() -> None:
    splat_ = splat(np.concatenate([cube((0, 0, 0)), cube((1, 0, 0))]))
    half = len(splat_) // 2
    boxes = (box_of("a", 0, np.arange(half)), box_of("a", 1, np.arange(half, 2 * half)), box_of("b", 0, np.array([3])))
    localization = answer_of(("a", "b", "c"), np.zeros((3, len(splat_)), np.float32), boxes)
    assert [each.name for each in targets_of(splat_, localization)] == ["a", "b"]
    named = targets_of(splat_, localization, 2)
    assert [each.name for each in named] == ["a", "a 2", "b"]
    np.testing.assert_allclose(named[1].center, [1, 0, 0], atol=1e-6)
    assert named[0].radius == pytest.approx(CUBE * np.sqrt(3), rel=1e-3)
    assert named[2].radius == pytest.approx(2 * 0.6 * 0.06, rel=1e-3)


def test_cameras_on_shells_look_at_the_target_from_free_places_that_were_seen() -> None:
    scene, target = cube_in_room()
    free = FreeSpace(scene.gaussians).seen_by(corner_cameras()).without(target.rows)
    around = shell_cameras(scene.gaussians, target, 16, free, up=UP)
    assert len(around) == 16
    centers = around.centers
    away = centers - target.center
    forward = around.cam_from_world[:, 2, :3]
    cosines = -(away * forward).sum(axis=1) / np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(cosines, 1, atol=1e-6)
    assert (np.abs(centers[:, :2]) < HALF).all()
    assert (centers[:, 2] > 0).all()
    assert (centers[:, 2] < HEIGHT).all()
    assert (free.clearance(centers) > 0.02).all()
    assert free.seen_empty(centers).all()
    # The pictures' right stays level.
    np.testing.assert_allclose(around.cam_from_world[:, 0, 2], 0, atol=1e-6)


def test_views_are_chosen_from_the_side_that_a_wall_leaves_open() -> None:
    # A screen beside the cube, from the floor up to 1.6, across the whole room.
    screen = sheet((0.0, 0.0, 0.8), (1, 2), (HALF, 0.8))
    scene, target = cube_in_room(screen)
    chosen = choose_views(scene, [target], SHELLS)
    assert len(chosen) == 6
    assert (chosen.cameras.centers[:, 0] > 0.05).sum() >= 5
    assert all(each.target_scores[0].visible > 0.9 for each in chosen.chosen)
    inner = np.array([HALF, HALF, HEIGHT])
    for center, each in zip(chosen.cameras.centers, chosen.chosen, strict=True):
        to_walls = np.minimum(inner - center, center + np.array([HALF, HALF, 0])).min()
        assert 0 < each.clearance <= to_walls
    assert all(0.05 <= each.target_scores[0].share <= 0.6 for each in chosen.chosen)
    assert all(each.target_scores[0].alpha > 0.9 for each in chosen.chosen)


def test_the_same_views_are_chosen_however_the_gaussians_are_ordered_and_wherever_the_room_is(rng):
    scene, target = cube_in_room()
    here = choose_views(scene, [target], replace(SHELLS, source="both"))
    order = rng.permutation(len(scene.gaussians))
    mixed = replace(scene, gaussians=scene.gaussians.select(order))
    again = choose_views(
        mixed, [replace(target, rows=np.sort(np.argsort(order)[target.rows]))], replace(SHELLS, source="both")
    )
    assert [each.name for each in again.chosen] == [each.name for each in here.chosen]
    np.testing.assert_allclose(again.cameras.centers, here.cameras.centers, atol=0.05)


def test_views_that_add_nothing_are_left_out_and_that_is_said() -> None:
    scene, target = cube_in_room()
    middle = corner_cameras(3)
    away = turned_outward(middle)
    names = tuple("abcdef")
    half = replace(scene, views=replace(scene.views, cameras=joined(away, middle), names=names))
    with pytest.warns(SceneWarning, match="views: 3 of 6 in scene room: no other shows more"):
        chosen = choose_views(half, [target], replace(SHELLS, source="frames"))
    assert sorted(each.name for each in chosen.chosen) == ["d", "e", "f"]


@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_the_same_views_are_chosen_in_scenes_of_any_unit(unit: float) -> None:
    scene, target = cube_in_room()
    g = scene.gaussians
    poses = scene.views.cameras.cam_from_world.copy()
    poses[:, :3, 3] *= unit
    other = replace(
        scene,
        gaussians=replace(g, means=g.means * np.float32(unit), scales=g.scales * np.float32(unit)),
        views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=poses)),
    )
    here = choose_views(scene, [target], SHELLS)
    there = choose_views(other, [target_of("cube", other.gaussians, target.rows)], SHELLS)
    np.testing.assert_allclose(there.cameras.centers, here.cameras.centers * unit, rtol=1e-3, atol=1e-3 * unit)
    for a, b in zip(here.chosen, there.chosen, strict=True):
        assert b.target_scores[0].visible == pytest.approx(a.target_scores[0].visible, abs=0.01)
    pictures, _ = view_pictures(other, there)
    same, _ = view_pictures(scene, here)
    assert np.abs(np.stack(pictures).astype(int) - np.stack(same)).mean() < 2


def test_a_thing_on_a_wall_of_a_closed_room_is_looked_at_from_inside_though_no_camera_was_there() -> None:
    poster = sheet((HALF - 0.05, 0, 1.2), (1, 2), (0.4, 0.3), 0.03)
    means = np.concatenate([poster, walls()])
    scene = Scene(name="room", gaussians=splat(means), up=UP)
    target = target_of("poster", scene.gaussians, np.arange(len(poster)))
    chosen = choose_views(scene, [target], replace(SHELLS, candidates=32, count=6))
    inside = (np.abs(chosen.cameras.centers[:, :2]) < HALF).all(axis=1)
    assert inside.mean() >= 0.8


def test_uniform_views_of_a_splat_without_cameras_go_around_it() -> None:
    scene, _ = cube_in_room()
    bare = replace(scene, views=None)
    chosen = choose_views(bare, [], ViewsConfig(method="uniform", count=40, width=64, height=48))
    assert len(chosen) == 40
    assert all(each.frame is None and each.name.startswith("orbit") for each in chosen.chosen)
    assert (chosen.cameras.widths == 64).all()


def test_uniform_frames_are_evenly_spread_and_need_no_target() -> None:
    scene, target = cube_in_room()
    config = ViewsConfig(method="uniform", count=4)
    blank, judged = choose_views(scene, [], config), choose_views(scene, [target], config)
    assert [each.frame for each in blank.chosen] == [0, 4, 7, 11]
    assert [each.frame for each in judged.chosen] == [0, 4, 7, 11]
    assert all(each.target_scores == () and each.covered is None and each.gain is None for each in blank.chosen)
    # All that any of them sees, as well as any sees it: but for the cube's lower face.
    assert judged.chosen[-1].covered > 0.8


def test_more_candidates_never_leave_less_to_choose_from_than_are_asked_for() -> None:
    scene, target = cube_in_room()
    for source in ("frames", "shells", "both"):
        chosen = choose_views(scene, [target], replace(SHELLS, source=source))
        assert len(chosen) == 6
        assert chosen.judged <= 16
        names = [each.name for each in chosen.chosen]
        assert len(set(names)) == 6
        covered = [each.covered for each in chosen.chosen]
        assert covered == sorted(covered)
        assert all((each.frame is None) == each.name.startswith("around cube") for each in chosen.chosen)


def test_a_splat_without_cameras_has_views_around_its_target() -> None:
    scene, target = cube_in_room()
    # Up is the scene's, or what its cameras agree on.
    assert up_of(scene) is scene.up
    assert up_of(replace(scene, up=None)) @ UP > 0.99
    bare = replace(scene, views=None, up=None)
    assert up_of(bare) is None
    assert len(choose_views(bare, [target], replace(SHELLS, source="both"))) == 6


def test_what_cannot_be_looked_at_is_said(rng: np.random.Generator) -> None:
    scene, target = cube_in_room()
    with pytest.raises(InputError, match="nothing to look at"):
        choose_views(scene, [], SHELLS)
    with pytest.raises(InputError, match="has no Gaussians to look at"):
        target_of("nothing", scene.gaussians, np.zeros(0, np.int64))
    with pytest.raises(InputError, match="source: expected frames or both with method=uniform"):
        ViewsConfig(method="uniform", source="shells")
    bare = replace(scene, views=None)
    with pytest.raises(InputError, match="has no cameras; use choose.source=shells"):
        choose_views(bare, [target], replace(SHELLS, source="frames"))
    with pytest.raises(InputError, match="scene room has no Gaussians"):
        choose_views(replace(scene, gaussians=None), [target], SHELLS)
    # A cube in a closed box that leaves no place to see it from.
    closed, rows = room(cube((0.3, 0.2, 0.8), half=CUBE + 0.3, step=0.06))
    inside, no_room = target_of("cube", closed.gaussians, rows), "no room for a camera around cube"
    with pytest.warns(SceneWarning, match=no_room), pytest.raises(InputError, match=no_room):
        choose_views(closed, [inside], SHELLS)
    with pytest.warns(SceneWarning) as said:
        frames = choose_views(closed, [inside], replace(SHELLS, source="both"))
    for part in (no_room, "no view shows more than 0% of cube", "views: 1 of 6 in scene room: no other shows more"):
        assert any(part in str(each.message) for each in said)
    assert all(each.frame is not None for each in frames.chosen)


def test_single_gaussians_and_unequal_pictures_can_be_looked_at() -> None:
    scene, _ = cube_in_room()
    point = target_of("point", scene.gaussians, np.array([7]))
    chosen = choose_views(scene, [point], replace(SHELLS, candidates=8, count=1, width=31, height=77))
    assert (chosen.cameras.widths == 31).all()
    assert (chosen.cameras.heights == 77).all()


def test_pictures_and_the_sheet_are_of_the_chosen_cameras() -> None:
    scene, target = cube_in_room()
    chosen = choose_views(scene, [target], replace(SHELLS, count=3))
    pictures, _ = view_pictures(scene, chosen)
    assert [picture.shape for picture in pictures] == [(120, 160, 3)] * 3
    assert all(picture.std() > 10 for picture in pictures)
    sheet_ = view_sheet(scene, chosen, pictures, [box_of("cube", 0, target.rows)])
    assert sheet_.shape[1] > 900


def test_opacity_zero_and_huge_gaussians_break_nothing() -> None:
    scene, target = cube_in_room()
    g = scene.gaussians
    scales, opacities = g.scales.copy(), g.opacities.copy()
    scales[-3:], opacities[-50:] = 1e4, 0.0
    odd = replace(scene, gaussians=replace(g, scales=scales, opacities=opacities))
    chosen = choose_views(odd, [target], SHELLS)
    assert all(np.isfinite(each.gain) for each in chosen.chosen)


def test_frames_that_would_show_most_are_taken_first() -> None:
    scene, target = cube_in_room()
    free = FreeSpace(scene.gaussians).without(target.rows)
    middle = corner_cameras(6)
    both = joined(turned_outward(middle), middle)
    assert frames_on(both, scene.gaussians, [target], 6, [free]).tolist() == list(range(6, 12))
    assert frames_on(both, scene.gaussians, [target], 99, [free]).tolist() == list(range(12))


def test_frames_that_look_at_a_wall_are_taken_last_however_near_the_target_is_behind_it() -> None:
    scene, target = cube_in_room()
    # Next door, nearer to the cube than the cameras of the room are, and pointed at it.
    next_door = around(np.array([0.3, 0.2, 0.8]), np.full(20, 2.4), np.linspace(-0.4, 0.4, 20))
    cameras = joined(next_door, corner_cameras())
    free = FreeSpace(scene.gaussians).without(target.rows)
    assert (frames_on(cameras, scene.gaussians, [target], 6, [free]) >= 20).all()
    names = tuple(f"{number:02d}" for number in range(len(cameras)))
    both = replace(scene, views=replace(scene.views, cameras=cameras, names=names))
    for source in ("frames", "both"):
        chosen = choose_views(both, [target], replace(SHELLS, source=source))
        assert all(each.target_scores[0].visible > 0.5 for each in chosen.chosen)


def test_frames_of_a_film_are_taken_from_all_along_it() -> None:
    scene, target = cube_in_room()
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    film = around(np.array([0.3, 0.2, 0.8]), 1.0 + 0.3 * np.abs(turns - np.pi) / np.pi, turns)
    free = FreeSpace(scene.gaussians).without(target.rows)
    frames = frames_on(film, scene.gaussians, [target], 16, [free])
    assert len(frames) == 16
    assert len(np.unique(frames)) == 16
    # The nearest stand together on one side.
    assert np.ptp(turns[frames]) > 0.8


def test_targets_take_turns_at_the_frames() -> None:
    scene, target = cube_in_room(cube((-1.2, -1.2, 0.5), half=0.5))
    large = target_of("crate", scene.gaussians, np.arange(len(scene.gaussians) - 5000, len(scene.gaussians)))
    at = np.linspace(0, 6, 20)
    cameras = joined(around(large.center, np.full(20, 1.2), at), around(target.center, np.full(20, 1.2), at))
    free = FreeSpace(scene.gaussians)
    spaces = [free.without(each.rows) for each in (large, target)]
    frames = frames_on(cameras, scene.gaussians, [large, target], 8, spaces)
    assert len(frames) == 8
    for each, space in zip((large, target), spaces, strict=True):
        (best,) = frames_on(cameras, scene.gaussians, [each], 1, [space])
        assert best in frames
