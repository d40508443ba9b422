"""Expressions and situations made from labels: each means one object, and holds wherever one stands."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from gsencoder.data.labels.expressions import read_scanrefer, write_scanrefer
from gsencoder.data.labels.made_questions import make_expressions
from gsencoder.data.labels.seen_objects import SeenObject, SeenScene, see_objects
from gsencoder.data.synthetic import make_room


@pytest.fixture(scope="module")
def rooms() -> list[SeenScene]:
    return [
        see_objects(make_room(seed, views=5, width=120, height=90, spacing=0.4, objects=12), min_pixels=40)
        for seed in (0, 3)
    ]


def thing(label: int, name: str | None, low: tuple[float, float, float], size: float = 0.1) -> SeenObject:
    lower = np.array(low, np.float64)
    return SeenObject(id=label, name=name, aabb_min=lower, aabb_max=lower + size, pixels=500)


def scene_of(*things: SeenObject) -> SeenScene:
    return SeenScene(name="made", objects=things, min_pixels=200)


def described(*things: SeenObject) -> dict[str, int]:
    made = make_expressions([scene_of(*things)])
    return {each.text: each.object_id for each in made}


def test_an_only_thing_is_meant_by_its_name_and_one_of_several_is_not() -> None:
    chairs = thing(1, "chair", (0, 0, 0)), thing(2, "chair", (5, 0, 0))
    assert described(*chairs, thing(3, "lamp", (10, 0, 0))) == {"the only lamp in the room": 3}


def test_one_of_several_is_meant_by_what_it_is_next_to_or_on() -> None:
    chairs = thing(1, "chair", (0, 0, 0)), thing(2, "chair", (5, 0, 0))
    table, lamp = thing(3, "table", (5, 5, -1), size=1.0), thing(4, "lamp", (0.2, 0, 0))
    texts = described(*chairs, table, lamp)
    assert texts["the chair next to the lamp"] == 1
    # Both chairs are near the lamp.
    assert "the chair next to the lamp" not in described(chairs[0], thing(2, "chair", (0.4, 0, 0)), lamp)
    mugs = thing(5, "mug", (5.4, 5.4, 0)), thing(6, "mug", (9, 0, 0))
    assert described(*mugs, table, lamp)["the mug on the table"] == 5
    # The other mug stands on the table, too, or leans on it.
    for other in ((5.7, 5.1, 0.0), (6.01, 5.1, -0.5)):
        assert "the mug on the table" not in described(mugs[0], thing(6, "mug", other), table)


def test_each_expression_of_a_room_means_the_one_object_that_its_words_say(rooms: list[SeenScene]) -> None:
    made = make_expressions(rooms, per_object=10)
    assert {re.sub(r"^the (only|\S+)( \S+)? .*?(next to|on|in) the .*$", r"\3", each.text) for each in made} == {
        "next to",
        "on",
        "in",
    }
    scenes = {each.name: each for each in rooms}
    for each in made:
        things = scenes[each.scene].objects
        (meant,) = [one for one in things if one.id == each.object_id]
        assert not each.multiple  # No two things of a room have one name.
        assert each.aabb is not None
        np.testing.assert_allclose(each.aabb, [meant.aabb_min, meant.aabb_max])
        assert str(meant.name) in each.text
        assert meant.pixels >= 40


def test_expressions_are_written_as_scanrefer_has_them(rooms: list[SeenScene], tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.json" for number in range(3)]
    for file, scenes, seed in zip(files, (rooms, rooms[::-1], rooms), (0, 0, 1), strict=True):
        made = make_expressions(scenes, seed=seed, per_object=1)
        write_scanrefer(file, made)
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    assert {row["unique_multiple"] for row in json.loads(files[0].read_text())} == {0}
    assert list(read_scanrefer(files[0])) == [*make_expressions(rooms, per_object=1)]


def test_fewer_objects_may_be_asked_for(rooms: list[SeenScene]) -> None:
    made = make_expressions(rooms, per_scene=2, per_object=1)
    assert len(made) == 4
    assert {each.annotation for each in made} == {"0"}
