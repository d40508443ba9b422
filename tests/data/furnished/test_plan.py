"""Plans of homes: nothing overlaps, all lies in its room, rooms can be reached, and a seed gives the same home."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from furniture import write_library

from gsencoder.data.furnished.kinds import ROOM_TYPES, STRUCTURE, kinds
from gsencoder.data.furnished.library import Model, load_libraries
from gsencoder.data.furnished.plan import THICKNESS, Home, Item, plan_home

SEEDS = range(12)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Model, ...]:
    return load_libraries([write_library(tmp_path_factory.mktemp("library") / "test.sh3f")])


def box_of_item(item: Item) -> np.ndarray:
    points = item.mesh.vertices @ item.matrix[:, :3].T + item.matrix[:, 3]
    return np.stack([points.min(axis=0), points.max(axis=0)])


def things(home: Home) -> list[Item]:
    """What stands in rooms, by models."""
    return [item for item in home.items if item.model is not None and kinds()[item.kind].place != "opening"]


@pytest.mark.parametrize("seed", SEEDS)
def test_no_two_things_overlap(seed: int, models: tuple[Model, ...]) -> None:
    placed = [(item.kind, box_of_item(item)) for item in things(plan_home(models, np.random.default_rng(seed)))]
    for (one, a), (other, b) in combinations(placed, 2):
        depth = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
        # A small thing lies on the box of what carries it, or within it above a seat.
        carried = "surface" in (kinds()[one].place, kinds()[other].place)
        assert carried or not (depth > 1e-4).all(), (one, a, other, b)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_things_lie_within_a_room(seed: int, models: tuple[Model, ...]) -> None:
    home = plan_home(models, np.random.default_rng(seed))
    for item in things(home):
        lower, upper = box_of_item(item)
        assert any(
            (lower >= [area.x0 - 0.05, area.y0 - 0.05, -1e-3]).all()
            and (upper <= [area.x1 + 0.05, area.y1 + 0.05, height + 1e-3]).all()
            for _, area, height in home.rooms
        ), item.kind


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


def test_rooms_share_walls_and_most_are_joined_by_doorways(models: tuple[Model, ...]) -> None:
    reached = 0
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
        # Walls of a room without an opening are four panels of two triangles each.
        walls = [item.mesh for item in home.items if item.kind == "wall"]
        reached += all(len(mesh.faces) > 8 for mesh in walls)
    assert reached >= 0.9 * len(SEEDS)


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
