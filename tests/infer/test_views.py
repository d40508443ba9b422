"""Which views are chosen, and what they are judged by: laws in a room that is known, and a wall that hides."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from rooms import CUBE, HALF, HEIGHT, UP, corner_cameras, cube, room, sheet, splat, walls

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.frames import frames_on
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.pictures import view_pictures, view_sheet
from gsencoder.infer.views.scores import coverage, score_views
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.infer.views.shells import shell_cameras, up_of
from gsencoder.infer.views.targets import Target, target_of, targets_of
from gsencoder.infer.views.utility import CoverageObjective, view_utility
from gsencoder.types import Box, Cameras, Gaussians, Localization, Scene

pytestmark = pytest.mark.slow

SHELLS = ViewsConfig(source="shells", candidates=16, count=6, width=160, height=120)


def cube_in_room(*others: np.ndarray) -> tuple[Scene, Target]:
    scene, rows = room(*others)
    assert scene.gaussians is not None
    return scene, target_of("cube", scene.gaussians, rows)


def box_of(word: str, rank: int, rows: np.ndarray) -> Box:
    return Box(
        query=word,
        rank=rank,
        score=0.5,
        probability=1.0,
        aabb_min=np.zeros(3),
        aabb_max=np.ones(3),
        obb_center=np.full(3, 0.5),
        obb_rotation=np.eye(3),
        obb_size=np.ones(3),
        rows=rows,
    )


def test_targets_are_the_best_boxes_of_each_word_with_the_ball_that_holds_them() -> None:
    splat_ = splat(np.concatenate([cube((0, 0, 0)), cube((1, 0, 0))]))
    half = len(splat_) // 2
    boxes = (box_of("a", 0, np.arange(half)), box_of("a", 1, np.arange(half, 2 * half)), box_of("b", 0, np.array([3])))
    found = Localization(
        queries=("a", "b", "c"),
        relevancy=np.zeros((3, len(splat_)), np.float32),
        thresholds=np.zeros(3, np.float32),
        probabilities=np.ones(3, np.float32),
        boxes=boxes,
    )
    assert [each.name for each in targets_of(splat_, found)] == ["a", "b"]
    named = targets_of(splat_, found, 2)
    assert [each.name for each in named] == ["a", "a 2", "b"]
    np.testing.assert_allclose(named[1].center, [1, 0, 0], atol=1e-6)
    assert named[0].radius == pytest.approx(CUBE * np.sqrt(3), rel=1e-3)
    assert named[2].radius == pytest.approx(2 * 0.6 * 0.06, rel=1e-3)


def test_cameras_on_shells_look_at_the_target_from_free_places_that_were_seen() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
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


def test_a_target_by_itself_is_seen_whole_and_fills_what_it_should() -> None:
    # A plate of side 0.4 two units in front of a camera.
    plate = splat(sheet((0, 0, 2.0), (0, 1), (0.2, 0.2), 0.02), 0.012)
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([0, -1.0, 0]), 200.0, 160, 120)
    (seen,) = score_views(plate, cameras, [target_of("plate", plate, np.arange(len(plate)))])
    assert seen.visible[0] == pytest.approx(1)
    assert seen.inside[0] == 1
    # At least the means' square, at most that with two standard deviations on every side.
    least, most = ((side * 200 / 2) ** 2 / (160 * 120) for side in (0.4, 0.4 + 4 * 0.012))
    assert least < seen.share[0] < most
    assert seen.blur[0] == pytest.approx(200 * 0.012 / 2 / 160, rel=1e-3)
    assert 0.2 < seen.alpha[0] < 0.4
    assert seen.target.shape == (1, len(plate))
    assert seen.context.shape == (1, 0)


def test_what_stands_before_a_target_hides_it_by_its_share() -> None:
    plate = sheet((0, 0, 2.0), (0, 1), (0.2, 0.2), 0.02)
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([0, -1.0, 0]), 200.0, 160, 120)
    visible = []
    for edge in (-0.4, 0.0, 0.4):
        # A screen at half the distance whose right edge covers none, half, or all of the plate.
        screen = sheet((edge / 2 - 0.5, 0, 1.0), (0, 1), (0.5, 0.5), 0.02)
        both = splat(np.concatenate([plate, screen]), 0.012)
        (seen,) = score_views(both, cameras, [target_of("plate", both, np.arange(len(plate)))])
        visible.append(seen.visible[0])
    assert visible[0] > 0.98
    # The screen's rim is twice as wide on the plate.
    assert 0.38 < visible[1] < 0.52
    assert visible[2] < 0.02


def test_views_of_two_targets_are_judged_as_each_by_itself() -> None:
    scene, target = cube_in_room(cube((-0.6, 0.2, 0.8)))
    assert scene.gaussians is not None
    other = target_of(
        "other", scene.gaussians, np.arange(len(scene.gaussians) - len(target.rows), len(scene.gaussians))
    )
    cameras = corner_cameras(5)
    both = score_views(scene.gaussians, cameras, [target, other])
    for place, one in enumerate((target, other)):
        (alone,) = score_views(scene.gaussians, cameras, [one])
        for name in ("visible", "share", "inside", "alpha", "blur", "target", "context"):
            assert (getattr(both[place], name) == getattr(alone, name)).all()


def test_views_are_chosen_from_the_side_that_a_wall_leaves_open() -> None:
    # A screen beside the cube, from the floor up to 1.6, across the whole room.
    screen = sheet((0.0, 0.0, 0.8), (1, 2), (HALF, 0.8))
    scene, target = cube_in_room(screen)
    chosen = choose_views(scene, [target], SHELLS)
    assert len(chosen) == 6
    assert (chosen.cameras.centers[:, 0] > 0.05).sum() >= 5
    assert all(each.target_scores[0].visible > 0.9 for each in chosen.chosen)
    assert all(0.05 <= each.target_scores[0].share <= 0.6 for each in chosen.chosen)
    assert all(each.target_scores[0].alpha > 0.9 for each in chosen.chosen)


def test_the_same_views_are_chosen_however_the_gaussians_are_ordered_and_wherever_the_room_is(
    rng: np.random.Generator,
) -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    assert scene.views is not None
    here = choose_views(scene, [target], replace(SHELLS, source="both"))
    order = rng.permutation(len(scene.gaussians))
    mixed = replace(scene, gaussians=scene.gaussians.select(order))
    again = choose_views(
        mixed, [replace(target, rows=np.sort(np.argsort(order)[target.rows]))], replace(SHELLS, source="both")
    )
    assert [each.name for each in again.chosen] == [each.name for each in here.chosen]
    np.testing.assert_allclose(again.cameras.centers, here.cameras.centers, atol=0.05)


def test_gains_never_grow_and_the_choice_is_near_the_best_of_all() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    cameras = corner_cameras(10, 160, 120)
    config = ViewsConfig(count=3, candidates=10, cover_weight=1.0, context_weight=0.5, spread_weight=1.0)
    values = CoverageObjective(cameras, [target], score_views(scene.gaussians, cameras, [target]), config)
    order, gains = values.greedy(10)
    assert (np.diff(gains) <= 1e-12).all()
    assert sorted(order.tolist()) == list(range(10))
    best = max(values.value_of(each) for each in itertools.combinations(range(10), 3))
    assert values.value_of(order[:3]) == pytest.approx(gains[:3].sum())
    assert values.value_of(order[:3]) >= (1 - 1 / np.e) * best
    assert values.value_of(order[:3]) >= 0.95 * best


def test_what_a_view_is_worth_grows_with_what_it_shows() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    (seen,) = score_views(scene.gaussians, corner_cameras(1), [target])
    config = ViewsConfig()

    def value(**changed: float) -> float:
        base = {"visible": 1.0, "share": 0.2, "inside": 1.0, "alpha": 1.0, "blur": 0.0} | changed
        arrays = {name: np.array([number]) for name, number in base.items()}
        return float(view_utility(replace(seen, **arrays), config)[0])

    shares = [value(share=share) for share in (0.0, 0.01, 0.05, 0.1, 0.3)]
    assert shares == sorted(shares)
    assert shares[0] == 0
    assert shares[-1] == pytest.approx(1)
    assert value(share=0.6) == pytest.approx(1)
    assert value(share=0.8) < 0.6
    assert value(share=1.0) == 0
    assert value(blur=CONSTANTS.half_blur) == pytest.approx(value() / 2)
    # In proportion to what is not hidden, half of it for means outside the picture, and by the opacity's square.
    assert value(visible=0.3) == pytest.approx(0.3 * value())
    assert value(inside=0.0) == pytest.approx(0.5 * value())
    assert value(inside=0.5) == pytest.approx(0.75 * value())
    assert value(alpha=0.45) == pytest.approx(value() / 4)
    assert value(alpha=0.9) == value()
    assert value(blur=2 * CONSTANTS.half_blur) == pytest.approx(value() / 5)


def test_a_target_fills_enough_from_the_least_share_on_and_too_much_beyond_the_most() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    (seen,) = score_views(scene.gaussians, corner_cameras(1), [target])
    config = ViewsConfig(least_share=0.1, most_share=0.5)
    full = {name: np.ones(1) for name in ("visible", "inside", "alpha")} | {"blur": np.zeros(1)}
    for share, expected in (
        (0.05, 0.5 * (0.5 + 0.5 * 0.2)),
        (0.1, 0.5 + 0.5 * 0.4),
        (0.2, 0.5 + 0.5 * 0.8),
        (0.25, 1.0),
        (0.5, 1.0),
        (0.75, 0.5),
        (0.9, 0.2),
    ):
        assert view_utility(replace(seen, share=np.array([share]), **full), config)[0] == pytest.approx(expected)


def test_a_set_is_worth_its_views_and_what_they_cover_of_targets_context_and_directions(
    rng: np.random.Generator,
) -> None:
    """Written out for two targets, one of them without surroundings."""
    scene, first = cube_in_room(cube((-0.6, 0.2, 0.8)))
    assert scene.gaussians is not None
    count = len(scene.gaussians)
    second = target_of("other", scene.gaussians, np.arange(count - len(first.rows), count))
    cameras = corner_cameras(6, 32, 24)
    config = ViewsConfig(count=3, candidates=6, cover_weight=1.0, context_weight=0.5, spread_weight=0.25)
    seen = []
    for target, others in zip((first, second), (7, 0), strict=True):
        (one,) = score_views(scene.gaussians, cameras, [target])
        weights = {"target": rng.random((6, 9)), "context": rng.random((6, others))}
        seen.append(replace(one, **{name: value.astype(np.float32) for name, value in weights.items()}))
    values = CoverageObjective(cameras, [first, second], seen, config)
    for views in ([0], [1, 4], [0, 2, 5]):
        total, covered = 0.0, 0.0
        for target, each in zip((first, second), seen, strict=True):
            own = view_utility(each, config)
            good = own / max(own.max(), 0.1)
            away = cameras.centers.astype(np.float64) - target.center
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            parts = {
                config.cover_weight: coverage(each.target) * good[:, None],
                config.context_weight: coverage(each.context) * good[:, None],
                config.spread_weight: np.clip(away @ away.T, 0, 1) * good[:, None],
            }
            total += own[views].sum() / 3
            total += sum(weight * part[views].max(axis=0).mean() for weight, part in parts.items() if part.size)
            covered += coverage(each.target)[views].max(axis=0).mean()
        assert values.value_of(views) == pytest.approx(total / 2, rel=1e-5)
        assert values.covered(np.array(views)) == pytest.approx(covered / 2, rel=1e-5)
    assert values.greedy(6)[1].sum() == pytest.approx(values.value_of(values.greedy(6)[0]))


@pytest.mark.parametrize("best", [1.0, 0.1, 0.01])
def test_a_view_adds_something_from_a_small_share_of_the_first_one_on_or_of_the_best_there_can_be(best: float) -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    cameras = corner_cameras(4, 32, 24)
    (seen,) = score_views(scene.gaussians, cameras, [target])
    least = max(CONSTANTS.min_relative_gain * best, CONSTANTS.min_gain)
    config = ViewsConfig(count=4, candidates=4, cover_weight=0.0, context_weight=0.0, spread_weight=0.0)
    full = {"share": config.most_share / 2, "inside": 1.0, "alpha": 1.0, "blur": 0.0}
    arrays = {name: np.full(4, value) for name, value in full.items()}
    # All else being perfect, a view is worth what it shows of the target.
    visible = np.array([0.9 * least, 1.1 * least, best, 2 * least])
    values = CoverageObjective(cameras, [target], [replace(seen, visible=visible, **arrays)], config)
    np.testing.assert_allclose(values.utilities[0], visible)
    order, gains = values.greedy(4)
    assert order.tolist() == [2, 3, 1]
    np.testing.assert_allclose(gains * config.count, visible[order])


def test_frames_that_would_show_most_are_taken_first() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    free = FreeSpace(scene.gaussians).without(target.rows)
    middle = corner_cameras(6)
    outward = middle.centers / np.linalg.norm(middle.centers, axis=1, keepdims=True)
    behind = looking_cameras(middle.centers, outward, UP, 40.0, 64, 48)
    both = joined(behind, middle)
    assert frames_on(both, scene.gaussians, [target], 6, [free]).tolist() == list(range(6, 12))
    assert frames_on(both, scene.gaussians, [target], 99, [free]).tolist() == list(range(12))


def joined(*parts: Cameras) -> Cameras:
    names = ("cam_from_world", "Ks", "widths", "heights")
    return Cameras(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def around(center: np.ndarray, distances: np.ndarray, turns: np.ndarray, height: float = 0.4) -> Cameras:
    """Cameras that look at a point from a circle about it."""
    away = np.stack([distances * np.cos(turns), distances * np.sin(turns), np.full(len(turns), height)], axis=1)
    toward = -away / np.linalg.norm(away, axis=1, keepdims=True)
    return looking_cameras(center + away, toward, UP, 40.0, 64, 48)


def test_frames_that_look_at_a_wall_are_taken_last_however_near_the_target_is_behind_it() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    # Next door, nearer to the cube than the cameras of the room are, and pointed at it.
    next_door = around(np.array([0.3, 0.2, 0.8]), np.full(20, 2.4), np.linspace(-0.4, 0.4, 20))
    cameras = joined(next_door, corner_cameras())
    free = FreeSpace(scene.gaussians).without(target.rows)
    assert (frames_on(cameras, scene.gaussians, [target], 6, [free]) >= 20).all()
    assert scene.views is not None
    names = tuple(f"{number:02d}" for number in range(len(cameras)))
    both = replace(scene, views=replace(scene.views, cameras=cameras, names=names))
    for source in ("frames", "both"):
        chosen = choose_views(both, [target], replace(SHELLS, source=source))  # type: ignore[arg-type]
        assert all(each.target_scores[0].visible > 0.5 for each in chosen.chosen)


def test_frames_of_a_film_are_taken_from_all_along_it() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    film = around(np.array([0.3, 0.2, 0.8]), 1.0 + 0.3 * np.abs(turns - np.pi) / np.pi, turns)
    free = FreeSpace(scene.gaussians).without(target.rows)
    taken = frames_on(film, scene.gaussians, [target], 16, [free])
    assert len(taken) == 16
    assert len(np.unique(taken)) == 16
    # The nearest stand together on one side.
    assert np.ptp(turns[taken]) > 0.8


def test_targets_take_turns_at_the_frames() -> None:
    scene, target = cube_in_room(cube((-1.2, -1.2, 0.5), half=0.5))
    assert scene.gaussians is not None
    large = target_of("crate", scene.gaussians, np.arange(len(scene.gaussians) - 5000, len(scene.gaussians)))
    at = np.linspace(0, 6, 20)
    cameras = joined(around(large.center, np.full(20, 1.2), at), around(target.center, np.full(20, 1.2), at))
    free = FreeSpace(scene.gaussians)
    spaces = [free.without(each.rows) for each in (large, target)]
    taken = frames_on(cameras, scene.gaussians, [large, target], 8, spaces)
    assert len(taken) == 8
    for each, space in zip((large, target), spaces, strict=True):
        (best,) = frames_on(cameras, scene.gaussians, [each], 1, [space])
        assert best in taken


def test_views_that_add_nothing_are_left_out_and_that_is_said() -> None:
    scene, target = cube_in_room()
    assert scene.views is not None
    middle = corner_cameras(3)
    away = looking_cameras(
        middle.centers, middle.centers / np.linalg.norm(middle.centers, axis=1, keepdims=True), UP, 40.0, 64, 48
    )
    names = tuple("abcdef")
    half = replace(scene, views=replace(scene.views, cameras=joined(away, middle), names=names))
    with pytest.warns(SceneWarning, match="views: 3 of 6 in scene room: no other shows more"):
        chosen = choose_views(half, [target], replace(SHELLS, source="frames"))
    assert sorted(each.name for each in chosen.chosen) == ["d", "e", "f"]


@pytest.mark.parametrize("unit", [1e-4, 1e-2, 1e3])
def test_the_same_views_are_chosen_in_scenes_of_any_unit(unit: float) -> None:
    scene, target = cube_in_room()
    g = scene.gaussians
    assert g is not None
    assert scene.views is not None
    poses = scene.views.cameras.cam_from_world.copy()
    poses[:, :3, 3] *= unit
    other = replace(
        scene,
        gaussians=replace(g, means=g.means * np.float32(unit), scales=g.scales * np.float32(unit)),
        views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=poses)),
    )
    assert other.gaussians is not None
    here = choose_views(scene, [target], SHELLS)
    there = choose_views(other, [target_of("cube", other.gaussians, target.rows)], SHELLS)
    np.testing.assert_allclose(there.cameras.centers, here.cameras.centers * unit, rtol=1e-3, atol=1e-3 * unit)
    for a, b in zip(here.chosen, there.chosen, strict=True):
        assert b.target_scores[0].visible == pytest.approx(a.target_scores[0].visible, abs=0.01)
    pictures, _ = view_pictures(other, there)
    same, _ = view_pictures(scene, here)
    assert np.abs(np.stack(pictures).astype(int) - np.stack(same)).mean() < 2


@pytest.mark.parametrize("gap", [0.05, 0.2])
def test_a_thing_on_a_wall_of_a_closed_room_is_looked_at_from_inside_though_no_camera_was_there(gap: float) -> None:
    poster = sheet((HALF - gap, 0, 1.2), (1, 2), (0.4, 0.3), 0.03)
    means = np.concatenate([poster, walls()])
    scene = Scene(name="room", gaussians=splat(means), up=UP)
    assert scene.gaussians is not None
    target = target_of("poster", scene.gaussians, np.arange(len(poster)))
    chosen = choose_views(scene, [target], replace(SHELLS, candidates=32, count=6))
    inside = (np.abs(chosen.cameras.centers[:, :2]) < HALF).all(axis=1)
    assert inside.mean() >= 0.8


def test_clearance_of_each_view_is_told() -> None:
    scene, target = cube_in_room()
    chosen = choose_views(scene, [target], SHELLS)
    inner = np.array([HALF, HALF, HEIGHT])
    for center, each in zip(chosen.cameras.centers, chosen.chosen, strict=True):
        walls_ = np.minimum(inner - center, center + np.array([HALF, HALF, 0])).min()
        assert each.clearance is not None
        assert 0 < each.clearance <= walls_


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
    assert judged.chosen[-1].covered is not None
    # All that any of them sees, as well as any sees it: but for the cube's lower face.
    assert judged.chosen[-1].covered > 0.8


def test_more_candidates_never_leave_less_to_choose_from_than_are_asked_for() -> None:
    scene, target = cube_in_room()
    for source in ("frames", "shells", "both"):
        chosen = choose_views(scene, [target], replace(SHELLS, source=source))  # type: ignore[arg-type]
        assert len(chosen) == 6
        assert chosen.judged <= 16
        names = [each.name for each in chosen.chosen]
        assert len(set(names)) == 6
        covered = [each.covered for each in chosen.chosen]
        assert covered == sorted(covered)  # type: ignore[type-var]
        assert all((each.frame is None) == each.name.startswith("around cube") for each in chosen.chosen)


def test_up_is_the_scenes_or_what_its_cameras_agree_on() -> None:
    scene, _ = cube_in_room()
    assert up_of(scene) is scene.up
    unknown = up_of(replace(scene, up=None))
    assert unknown is not None
    assert unknown @ UP > 0.99
    assert up_of(replace(scene, up=None, views=None)) is None


def test_a_splat_without_cameras_has_views_around_its_target() -> None:
    scene, target = cube_in_room()
    bare = replace(scene, views=None, up=None)
    assert len(choose_views(bare, [target], replace(SHELLS, source="both"))) == 6


def test_what_cannot_be_looked_at_is_said(rng: np.random.Generator) -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    with pytest.raises(InputError, match="nothing to look at"):
        choose_views(scene, [], SHELLS)
    with pytest.raises(InputError, match="'cube' has Gaussians beyond the 200 of the splat"):
        choose_views(replace(scene, gaussians=scene.gaussians.select(np.arange(200))), [target], SHELLS)
    with pytest.raises(InputError, match="has no Gaussians to look at"):
        target_of("nothing", scene.gaussians, np.zeros(0, np.int64))
    bare = replace(scene, views=None)
    with pytest.raises(InputError, match="has no cameras; use choose.source=shells"):
        choose_views(bare, [target], replace(SHELLS, source="frames"))
    with pytest.raises(InputError, match="scene room has no Gaussians"):
        choose_views(replace(scene, gaussians=None), [target], SHELLS)
    # A cube in a closed box that leaves no place to see it from.
    closed, rows = room(cube((0.3, 0.2, 0.8), half=CUBE + 0.3, step=0.06))
    assert closed.gaussians is not None
    with (
        pytest.warns(SceneWarning, match="no room for a camera around cube"),
        pytest.raises(InputError, match="no room for a camera around cube"),
    ):
        choose_views(closed, [target_of("cube", closed.gaussians, rows)], SHELLS)
    with (
        pytest.warns(SceneWarning, match="no room for a camera around cube"),
        pytest.warns(SceneWarning, match="no view shows more than 0% of cube"),
        pytest.warns(SceneWarning, match="views: 1 of 6 in scene room: no other shows more"),
    ):
        frames = choose_views(closed, [target_of("cube", closed.gaussians, rows)], replace(SHELLS, source="both"))
    assert all(each.frame is not None for each in frames.chosen)


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": 0},
        {"count": 4097},
        {"candidates": 0},
        {"width": 0},
        {"fov": 0.5},
        {"judged_side": 4},
        {"judged_side": 2048},
        {"fov": 170.0},
        {"candidates": 5000},
        {"cover_weight": 1e300},
        {"method": "uniform", "source": "shells"},
        {"least_share": 0.7},
        {"cover_weight": -1.0},
        {"spread_weight": float("inf")},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        ViewsConfig(**wrong)  # type: ignore[arg-type]


def test_single_gaussians_and_unequal_pictures_can_be_looked_at() -> None:
    scene, _ = cube_in_room()
    assert scene.gaussians is not None
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
    sheet_ = view_sheet(scene, chosen, pictures, [box_of("cube", 0, target.rows)], columns=2)
    assert sheet_.shape[1] > 900


def test_opacity_zero_and_huge_gaussians_break_nothing() -> None:
    scene, target = cube_in_room()
    assert scene.gaussians is not None
    g = scene.gaussians
    scales, opacities = g.scales.copy(), g.opacities.copy()
    scales[-3:], opacities[-50:] = 1e4, 0.0
    odd = Gaussians(means=g.means, quats=g.quats, scales=scales, opacities=opacities, sh=g.sh)
    chosen = choose_views(replace(scene, gaussians=odd), [target], SHELLS)
    assert all(np.isfinite(each.gain) for each in chosen.chosen)  # type: ignore[arg-type]
