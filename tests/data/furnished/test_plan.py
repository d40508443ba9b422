"""Plans of homes: nothing overlaps, all lies in its room, rooms can be reached, and a seed gives the same home."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import trimesh
from furniture import write_library

from gsencoder.data.furnished import plan
from gsencoder.data.furnished.kinds import ROOM_TYPES, STRUCTURE, kinds
from gsencoder.data.furnished.library import Mesh, Model, load_libraries
from gsencoder.data.furnished.plan import THICKNESS, Box, Home, Item, Room, plan_home
from gsencoder.data.furnished.shapes import MadeModel, Rectangle, TurnedRanges, made_model, makes, panels

SEEDS = range(12)


def box_of_item(item: Item) -> np.ndarray:
    points = item.mesh.vertices @ item.matrix[:, :3].T + item.matrix[:, 3]
    return np.stack([points.min(axis=0), points.max(axis=0)])


def things(home: Home | Room) -> list[Item]:
    """What stands in rooms, by models."""
    return [item for item in home.items if item.model is not None and kinds()[item.kind].place != "opening"]


@pytest.mark.parametrize("made", [0.0, 1.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_no_two_things_overlap(seed: int, made: float, models: tuple[Model, ...]) -> None:
    home = plan_home(models, np.random.default_rng(seed), made=made)
    placed = [(item.kind, box_of_item(item)) for item in things(home)]
    for (one, a), (other, b) in combinations(placed, 2):
        depth = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
        # A small thing lies on the box of what carries it, or within it above a seat.
        carried = "surface" in (kinds()[one].place, kinds()[other].place)
        assert carried or not (depth > 1e-4).all(), (one, a, other, b)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_things_lie_within_a_room_and_doors_and_windows_in_walls(seed: int, models: tuple[Model, ...]) -> None:
    home = plan_home(models, np.random.default_rng(seed))
    for item in home.items:
        lower, upper = box_of_item(item)
        within = any(
            (lower >= [area.x0 - 0.05, area.y0 - 0.05, -1e-3]).all()
            and (upper <= [area.x1 + 0.05, area.y1 + 0.05, height + 1e-3]).all()
            for _, area, height in home.rooms
        )
        assert item.kind in STRUCTURE or within == (kinds()[item.kind].place != "opening"), item.kind


def test_a_storage_room_has_things_of_most_kinds_on_a_floor_without_walls(models: tuple[Model, ...]) -> None:
    of_models = {model.kind.name for model in models if model.kind.place != "opening"}
    found: set[str] = set()
    for seed in SEEDS:
        items = plan_home(models, np.random.default_rng(seed), ["storage room"]).items
        names = [item.kind for item in items]
        assert [name for name in names if name in STRUCTURE] == ["floor"]
        found |= set(names)
    assert len(found & of_models) > 0.8 * len(of_models)


@pytest.mark.parametrize("room", [each for each in ROOM_TYPES if each != "storage room"])
def test_each_room_has_walls_floor_and_ceiling_and_what_its_type_needs(room: str, models: tuple[Model, ...]) -> None:
    needs = {
        "bedroom": "bed",
        "living room": "couch",
        "kitchen": "kitchen cabinet",
        "bathroom": "toilet",
        "office": "desk",
        "corridor": "door",
    }
    found = []
    for seed in SEEDS:
        home = plan_home(models, np.random.default_rng(seed), [room])  # type: ignore[list-item]
        assert [each for each, _, _ in home.rooms] == [room]
        names = [item.kind for item in home.items]
        assert all(names.count(kind) == 1 for kind in STRUCTURE)
        found.append(needs[room] in names)
    assert np.mean(found) > 0.5


def test_rows_of_a_kitchen_meet_in_corners_and_have_one_height_and_mostly_one_make(models: tuple[Model, ...]) -> None:
    sides, same = [], []
    for seed in range(30):
        home = plan_home(models, np.random.default_rng(seed), ["kitchen"], made=1.0)
        counters = [box_of_item(item) for item in home.items if item.kind == "counter"]
        if not counters:
            continue
        assert np.ptp([box[1, 2] for box in counters]) < 1e-6
        sides.append(len({bool(np.argmax((box[1] - box[0])[:2])) for box in counters}))
        cabinets = [item for item in home.items if item.kind == "kitchen cabinet" and item.matrix[2, 3] == 0]
        ids = [id(item.model) for item in cabinets]
        same.append(max(map(ids.count, ids), default=0) / max(len(ids), 1))
    assert len(sides) > 20
    assert np.mean(np.equal(sides, 2)) > 0.2
    assert np.mean(same) > 0.6


def test_some_shelves_hang_on_walls_and_carry_things(tmp_path: Path) -> None:
    from furniture import MODELS, catalogue

    shelves = ("Shelves", "Living room", (80.0, 30.0, 90.0), dict[str, str]())
    models, carried = load_libraries([write_library(tmp_path / "more.sh3f", catalogue([*MODELS, shelves]))]), 0
    for seed in range(40):
        home = plan_home(models, np.random.default_rng(seed), ["living room"], made=1.0)
        boxes = [box_of_item(item) for item in home.items if item.kind == "shelf"]
        carried += any(
            abs(item.matrix[2, 3] - box[1, 2]) < 0.02 and (box[0, :2] <= item.matrix[:2, 3]).all()
            for item in home.items
            for box in boxes
            if box[0, 2] > 0.9 and kinds()[item.kind].place == "surface"
        )
    assert carried >= 5


def test_rooms_share_walls(models: tuple[Model, ...]) -> None:
    for seed in SEEDS:
        home = plan_home(models, np.random.default_rng(seed), ["living room", "bedroom", "kitchen"])
        areas = [area for _, area, _ in home.rooms]
        assert all(
            a.x1 + THICKNESS <= b.x0 + 1e-6
            or b.x1 + THICKNESS <= a.x0 + 1e-6
            or a.y1 + THICKNESS <= b.y0 + 1e-6
            or b.y1 + THICKNESS <= a.y0 + 1e-6
            for a, b in combinations(areas, 2)
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_a_doorway_leads_to_one_of_the_next_room_and_nothing_stands_before_it(seed, models):
    rng, by_kind = np.random.default_rng(seed), {model.kind.name: [model] for model in models}
    areas = plan._split(Rectangle(0.0, 0.0, 8.0, 6.0), [20.0, 14.0, 14.0], rng)
    rooms = [Room(type="bedroom", area=area, height=2.5) for area in areas]
    plan._open_doorways(rooms, rng)
    here, behind = (
        {tuple(np.round(room.at_wall(side, at, depth), 6)) for room in rooms for side, at, *_ in room.openings}
        for depth in (0.0, -THICKNESS)
    )
    assert here == behind
    assert all(room.openings for room in rooms)
    for room in rooms:
        plan._Furnisher(room, by_kind, rng).furnish()
        boxes = [Box(*box_of_item(item).ravel()) for item in things(room)]
        assert len(next(item.mesh.faces for item in room.items if item.kind == "wall")) > 8
        for side, first, last, lower, upper in room.openings:
            corners = np.array([room.at_wall(side, first, 0.01), room.at_wall(side, last, 0.7 if lower == 0 else 0.1)])
            before = Box(*corners.min(axis=0), lower, *corners.max(axis=0), upper)
            assert not any(map(before.overlaps, boxes))


@pytest.mark.parametrize("side", range(4))
def test_backs_and_pillows_are_at_the_wall_chairs_face_desks_and_what_is_on_them_faces_chairs(side, models):
    room = Room(type="bedroom", area=Rectangle(0.0, 0.0, 6.0, 6.0), height=2.5)
    furnisher = plan._Furnisher(room, {model.kind.name: [model] for model in models}, np.random.default_rng(side))
    desk, angle = furnisher._wall("desk", at=(side, 3.0)), furnisher._front()
    furnisher._next_to(desk, "chair", angle, 0.2)
    furnisher._on(desk, "book", angle)
    bed, head = furnisher._wall("bed", at=((side + 2) % 4, 3.0)), furnisher._front() + np.pi
    fronts, places = zip(*[(-item.matrix[:2, 1], item.matrix[:2, 3]) for item in room.items], strict=True)
    assert [item.kind for item in room.items] == ["desk", "chair", "book", "bed"]
    assert fronts[0] @ (3 - places[0]) > 2
    assert fronts[1] @ (places[0] - places[1]) > 0.4
    assert fronts[2] @ fronts[0] > 0.7
    for _ in range(9):
        furnisher._bedding(bed, head)
    assert max(fronts[3] @ (item.matrix[:2, 3] - places[3]) for item in room.items if item.kind == "pillow") < -0.4


def test_walls_have_holes_where_openings_are_and_show_their_thickness_behind_them() -> None:
    holes = [(side, 1.0, 2.0, lower, 2.0) for side, lower in enumerate((0.0, 1.0, 0.5, 0.0))]
    walls, floor, _ = panels(Rectangle(0.0, 0.0, 5.0, 4.0), 2.5, holes, 0.1)
    areas = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area for mesh in (walls, floor)]
    assert areas == pytest.approx([18 * 2.5 - 6.5 + 0.1 * (2 * 6.5 + 4 + 2), 5 * 4 + 0.1 * 2], rel=1e-5)
    np.testing.assert_allclose(walls.extent, [[-0.1, -0.1, 0], [5.1, 4.1, 2.5]], atol=1e-6)


def test_a_seed_gives_the_same_home(models: tuple[Model, ...]) -> None:
    one, other = (plan_home(models, np.random.default_rng(3)) for _ in range(2))
    assert [item.kind for item in one.items] == [item.kind for item in other.items]
    assert all((a.matrix == b.matrix).all() for a, b in zip(one.items, other.items, strict=True))
    third = plan_home(models, np.random.default_rng(4))
    assert [item.kind for item in one.items] != [item.kind for item in third.items]


def test_a_library_of_one_chair_furnishes_a_home(tmp_path: Path) -> None:
    from furniture import MODELS, catalogue

    models = load_libraries([write_library(tmp_path / "one.sh3f", catalogue(MODELS[:1]))])
    for seed in SEEDS:
        home = plan_home(models, np.random.default_rng(seed))
        assert {"wall", "floor", "ceiling"} <= {item.kind for item in home.items}


@pytest.mark.parametrize("kind", makes())
def test_a_make_of_our_own_is_as_large_as_it_says_and_unlike_the_next(kind: str) -> None:
    sizes = set()
    for seed in range(20):
        model = made_model(kind, np.random.default_rng(seed))
        mesh, size = model.mesh, np.array(model.size)
        np.testing.assert_allclose(
            mesh.extent, [[-size[0] / 2, -size[1] / 2, 0], [size[0] / 2, size[1] / 2, size[2]]], atol=1e-6
        )
        # Only vessels and lamps carry nothing.
        assert model.top is not None or any(isinstance(each, TurnedRanges) for each in makes()[kind])
        assert model.top is None or 0 < model.top <= size[2] + 1e-6
        assert mesh.materials.max() < len(model.finishes)
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert areas.min() > 0
        sizes.add(model.size)
    assert len(sizes) == 20
    again = made_model(kind, np.random.default_rng(19))
    np.testing.assert_array_equal(again.mesh.vertices, mesh.vertices)


def depth_below(mesh: Mesh, height: float) -> float:
    """How far a plumb line hangs down from a height near the middle of a mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rays = o3d.core.Tensor([[0.02, 0.01, height, 0, 0, -1]], o3d.core.float32)
    return float(scene.cast_rays(rays)["t_hit"].numpy()[0])


@pytest.mark.parametrize("seed", range(8))
def test_vessels_are_open_above_and_tables_carry_things_at_their_top(seed: int) -> None:
    tub, (ranges,) = made_model("bathtub", np.random.default_rng(seed)), makes()["bathtub"]
    assert tub.top is None
    assert depth_below(tub.mesh, tub.size[2]) > 0.7 * tub.size[2]
    assert ranges.width[0] <= tub.size[0] <= ranges.width[1]
    (turned,) = (each for each in makes()["table"] if isinstance(each, TurnedRanges))
    built = turned.build(np.random.default_rng(seed))
    assert built.top is not None
    assert depth_below(built.mesh, 2.0) == pytest.approx(2.0 - built.top, abs=1e-5)


def test_makes_of_our_own_come_at_the_share_asked_for_and_of_kinds_that_the_libraries_have(
    models: tuple[Model, ...],
) -> None:
    without = tuple(model for model in models if model.kind.name != "wardrobe")
    counts = {}
    for made in (0.0, 0.5, 1.0):
        homes = [plan_home(without, np.random.default_rng(seed), ["bedroom"], made=made) for seed in range(40)]
        placed = [item for home in homes for item in home.items if item.model is not None and item.kind in makes()]
        assert all(item.kind != "wardrobe" for item in placed)
        counts[made] = np.mean([isinstance(item.model, MadeModel) for item in placed])
    assert counts[0.0] == 0
    assert counts[1.0] == 1
    assert counts[0.5] == pytest.approx(0.5, abs=0.15)
