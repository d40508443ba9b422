"""Questions, expressions and situations follow from the labels that they are made of; what is unclear is not asked."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import made_questions
import numpy as np
import pytest
from made_questions import kind_of, make_expressions, make_questions, make_situations, side_of
from questions import write_scanqa, write_sqa3d
from seen_objects import (
    COLOR_VIEWS,
    RANGES,
    SeenObject,
    SeenScene,
    color_counts,
    color_word,
    see_objects,
)
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import read_scanrefer, write_scanrefer
from gsencoder.data.labels.questions import Question, read_questions
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene, SceneObject, Views

ALL = {"balance": False, "per_kind": 100}
ROOMS = (0, 1)


@pytest.fixture(scope="module")
def rooms() -> list[Scene]:
    return [make_room(seed, views=5, width=120, height=90, spacing=0.4) for seed in ROOMS]


@pytest.fixture(scope="module")
def seen(rooms: list[Scene]) -> list[SeenScene]:
    return [see_objects(room, min_pixels=40) for room in rooms]


def thing(
    label: int, name: str | None, low: tuple[float, float, float], size: float = 0.1, pixels: int = 500
) -> SeenObject:
    lower = np.array(low, np.float64)
    return SeenObject(id=label, name=name, aabb_min=lower, aabb_max=lower + size, pixels=pixels)


def scene_of(*things: SeenObject, unit: float = 1.0) -> SeenScene:
    return SeenScene(name="made", objects=things, min_pixels=200, metres_per_unit=unit)


def texts(*things: SeenObject) -> dict[str, tuple[str, ...]]:
    return {each.text: each.answers for each in make_questions([scene_of(*things)], **ALL)}


def test_kinds_are_balanced_and_nothing_is_asked_twice(seen: list[SeenScene]) -> None:
    questions = make_questions(seen)
    counts = Counter(kind_of(each) for each in questions)
    least = min(counts.values())
    # Questions about presence come in pairs.
    assert all(count in (least, least + 1) for count in counts.values())
    assert len({(each.scene, each.text) for each in questions}) == len(questions)
    assert len({each.id for each in questions}) == len(questions)
    presence = Counter(each.answers[0] for each in questions if kind_of(each) == "is_there")
    assert presence["yes"] == presence["no"] > 0


def test_one_seed_gives_the_same_bytes_and_another_one_others(seen: list[SeenScene], tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.json" for number in range(3)]
    write_scanqa(files[0], make_questions(seen, per_kind=4))
    write_scanqa(files[1], make_questions(seen[::-1], per_kind=4))
    write_scanqa(files[2], make_questions(seen, per_kind=4, seed=1))
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    assert read_questions(files[0]) == make_questions(seen, per_kind=4)
    keys = {"scene_id", "question_id", "question", "answers", "object_ids", "object_names"}
    assert all(set(row) == keys for row in json.loads(files[0].read_text()))


def test_questions_about_a_scene_do_not_depend_on_the_others(seen: list[SeenScene]) -> None:
    alone = make_questions(seen[:1], per_kind=4, balance=False)
    every = make_questions(seen, per_kind=4, balance=False)
    assert alone == tuple(each for each in every if each.scene == seen[0].name)


def test_several_of_a_name_are_counted_and_nothing_else_is_asked_about_them() -> None:
    questions = texts(thing(1, "mug", (0, 0, 0)), thing(2, "mug", (1, 0, 0)), thing(3, "book", (1.15, 0, 0)))
    assert questions["How many mugs are there in the room?"] == ("2", "two")
    assert questions["What is next to the book?"] == ("mug",)
    assert not any("the mug" in text for text in questions)


def test_a_name_one_of_whose_objects_is_hardly_shown_is_not_asked_about() -> None:
    questions = texts(thing(1, "mug", (0, 0, 0)), thing(2, "mug", (1, 0, 0), pixels=199), thing(3, "ball", (3, 0, 0)))
    assert not any("mug" in text for text in questions)
    # What no photograph shows is not in the recorded place, but "the mug" might still be that one.
    questions = texts(thing(1, "mug", (0, 0, 0)), thing(2, "mug", (1, 0, 0), pixels=0), thing(3, "ball", (0.15, 0, 0)))
    assert questions["How many mugs are there in the room?"] == ("1", "one")
    assert "What is next to the mug?" not in questions
    assert "What is next to the ball?" in questions


def test_names_that_may_mean_the_same_are_not_asked_about() -> None:
    questions = texts(thing(1, "mug", (0, 0, 0)), thing(2, "cup", (1, 0, 0)), thing(3, "ball", (3, 0, 0)))
    assert not any(re.search("mug|cup", text) for text in questions)
    questions = texts(thing(1, "table", (0, 0, 0)), thing(2, "coffee table", (1, 0, 0)), thing(3, "ball", (3, 0, 0)))
    assert not any("table" in text for text in questions)


def test_what_a_thing_stands_on_is_where_it_is_and_not_next_to_it() -> None:
    table = thing(1, "table", (-0.5, -0.5, -1.0), size=1.0)
    questions = texts(table, thing(2, "mug", (0, 0, 0.02)), thing(3, "ball", (0.2, 0, 0)))
    assert questions["Where is the mug?"] == ("on the table", "next to the ball")
    assert questions["What is next to the mug?"] == ("ball",)
    inside = thing(4, "bed", (-0.5, -0.5, -0.5), size=1.0)
    questions = texts(table, inside, thing(2, "mug", (0, 0, 0.02)), thing(3, "ball", (3, 0, 0)))
    assert "Where is the mug?" not in questions


def test_absent_names_are_those_that_no_label_may_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(made_questions, "ABSENT", ("cup", "guitar", "book", "table"))
    labels = (thing(1, "mug", (0, 0, 0)), thing(2, "book", (3, 0, 0), pixels=0), thing(3, "coffee table", (5, 0, 0)))
    questions = make_questions([scene_of(*labels)], **ALL)
    assert [each.text for each in questions if each.answers == ("no",)] == ["Is there a guitar in the room?"]


def test_color_ranges_do_not_overlap() -> None:
    levels = np.arange(0, 256, 15, dtype=np.uint8)
    cube = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    counts = color_counts(cube)
    each = np.stack([color_counts(part) for part in cube[::37, None]])
    assert counts.min() > 0
    assert len(counts) == len(RANGES)
    assert each.sum(axis=1).max() == 1


def test_scenes_without_labels_are_refused(rooms: list[Scene]) -> None:
    room = rooms[0]
    for broken, problem in (
        (replace(room, objects=()), "no labeled objects"),
        (replace(room, views=replace(room.views, instances=None)), "no instance maps"),
        (replace(room, views=replace(room.views, images=None)), "no photographs"),
        (replace(room, views=None), "no instance maps .* and no photographs"),
        (replace(room, metres_per_unit=None), "unit of scene room_000 is unknown"),
        (replace(room, up=np.array([0.0, 1.0, 0.0])), "up is"),
        (replace(room, objects=tuple(replace(each, name=None) for each in room.objects)), "has a name"),
    ):
        with pytest.raises(InputError, match=problem):
            see_objects(broken)
    with pytest.raises(InputError, match="nothing can be asked"):
        make_questions([scene_of(thing(1, "mug", (0, 0, 0), pixels=3))])
    with pytest.raises(InputError, match="one name"):
        make_questions([scene_of(), scene_of()])


@pytest.fixture(scope="module")
def furnished() -> list[SeenScene]:
    made = [make_room(seed, views=5, width=120, height=90, spacing=0.4, objects=12) for seed in (0, 3)]
    return [see_objects(room, min_pixels=40) for room in made]


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


def test_each_expression_of_a_room_means_the_one_object_that_its_words_say(furnished: list[SeenScene]) -> None:
    made = make_expressions(furnished, per_object=10)
    relation = re.compile(r"^the (only|\S+)( \S+)? .*?(next to|on|in) the .*$")
    assert {relation.sub(r"\3", each.text) for each in made} == {"next to", "on", "in"}
    scenes = {each.name: each for each in furnished}
    for each in made:
        things = scenes[each.scene].objects
        (meant,) = [one for one in things if one.id == each.object_id]
        assert not each.multiple  # No two things of a room have one name.
        assert each.aabb is not None
        np.testing.assert_allclose(each.aabb, [meant.aabb_min, meant.aabb_max])
        assert str(meant.name) in each.text
        assert meant.pixels >= 40


def test_expressions_are_written_as_scanrefer_has_them(furnished: list[SeenScene], tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.json" for number in range(3)]
    for file, scenes, seed in zip(files, (furnished, furnished[::-1], furnished), (0, 0, 1), strict=True):
        made = make_expressions(scenes, seed=seed, per_object=1)
        write_scanrefer(file, made)
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    assert {row["unique_multiple"] for row in json.loads(files[0].read_text())} == {0}
    assert list(read_scanrefer(files[0])) == [*make_expressions(furnished, per_object=1)]


def test_fewer_objects_may_be_asked_for(furnished: list[SeenScene]) -> None:
    made = make_expressions(furnished, per_scene=2, per_object=1)
    assert len(made) == 4
    assert {each.annotation for each in made} == {"0"}


RED, BLUE, GREEN = (200, 20, 30), (20, 60, 220), (20, 160, 40)


def photographed(pictures: list[tuple[np.ndarray, np.ndarray]], ids: tuple[int, ...] = (40, 7, 12)) -> Scene:
    """A scene of 30 × 20 photographs with instance maps; the unit is half a metre."""
    return Scene(
        name="made",
        gaussians=random_gaussians(1),
        metres_per_unit=0.5,
        views=Views(
            cameras=front_camera(30, 20).select([0] * len(pictures)),
            names=tuple(map(str, range(len(pictures)))),
            images=[image for image, _ in pictures],
            instances=[labels for _, labels in pictures],
        ),
        objects=tuple(
            SceneObject(id=n, name=f"thing {n}", aabb_min=np.full(3, float(n)), aabb_max=np.full(3, n + 2.0))
            for n in ids
        ),
    )


def picture(color: tuple[int, int, int], width: int, label: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """A thing of a color in the left columns of a photograph."""
    image, labels = np.full((20, 30, 3), 128, np.uint8), np.zeros((20, 30), np.int32)
    image[:, :width], labels[:, :width] = color, label
    return image, labels


def test_areas_are_those_of_the_objects_own_value_and_boxes_become_metres() -> None:
    labels = np.zeros((20, 30), np.int32)
    labels[:, :10], labels[:5, 10:], labels[5:, 10:] = 7, 40, 99
    other = np.full((20, 30), 12, np.int32)
    other[0] = 40
    gray = np.full((20, 30, 3), 128, np.uint8)
    seen = see_objects(photographed([(gray, labels), (gray, other)]), min_pixels=50)
    found = [(each.id, each.name, each.pixels) for each in seen.objects]
    assert found == [(7, "thing 7", 200), (12, "thing 12", 570), (40, "thing 40", 100)]
    assert (seen.objects[0].aabb_min.tolist(), seen.objects[0].aabb_max.tolist()) == ([3.5] * 3, [4.5] * 3)
    assert seen.objects[0].center.tolist() == [4.0] * 3
    assert seen.metres_per_unit == 0.5
    assert seen.is_visible(seen.objects[2])
    assert not replace(seen, min_pixels=101).is_visible(seen.objects[2])


def test_the_color_is_that_of_the_photographs_that_show_most_of_a_thing() -> None:
    # Four photographs show more of it than the blue one, which is not looked at.
    pictures = [picture(BLUE, 11), *(picture(RED, 12 + number) for number in range(COLOR_VIEWS))]
    assert see_objects(photographed(pictures), min_pixels=100).objects[0].color == "red"
    assert see_objects(photographed(pictures[:COLOR_VIEWS]), min_pixels=100).objects[0].color is None
    # One that shows too little to be asked about is not looked at either: 220 pixels and 240.
    few = [pictures[0], pictures[1]]
    assert see_objects(photographed(few), min_pixels=221).objects[0].color == "red"
    assert see_objects(photographed(few), min_pixels=241).objects[0].color is None


def test_a_color_needs_six_tenths_and_no_other_has_more_than_three_twentieths() -> None:
    def of(reds: int, blues: int, red: tuple[int, int, int] = RED) -> str | None:
        """Of a hundred inner pixels."""
        image = np.full((12, 12, 3), 128, np.uint8)
        inner = image[1:11, 1:11].reshape(100, 3).copy()
        inner[:reds], inner[reds : reds + blues] = red, BLUE
        image[1:11, 1:11] = inner.reshape(10, 10, 3)
        return color_word(image, np.ones((12, 12), bool))

    assert (of(60, 0), of(59, 0), of(60, 15), of(60, 16), of(0, 60)) == ("red", None, "red", None, "blue")
    # Reds lie on both sides of zero.
    reds = [(220, 10, 40), (220, 40, 10), (220, 10, 80), (220, 50, 10)]
    assert [of(60, 0, red) for red in reds] == ["red", "red", None, None]


def test_of_many_questions_of_a_kind_only_so_many_are_asked() -> None:
    names = ("mug", "ball", "lamp", "apple", "lemon", "clock", "book")
    things = [replace(thing(n, name, (3.0 * n, 0, 0)), color=f"c{n}") for n, name in enumerate(names)]
    made = make_questions([scene_of(*things)], balance=False, per_kind=5)
    colors = {each.text: each.answers for each in made if "What color" in each.text}
    assert len(colors) == 5
    for number, name in enumerate(names):
        assert colors.get(f"What color is the {name}?", (f"c{number}",)) == (f"c{number}",)
    # An odd number leaves half of a pair out, and at most half, rounded up, have one answer.
    assert sum("there a" in each.text for each in made) == 4
    assert sum("How many" in each.text for each in made) == 3
    assert {each.answers for each in made if "How many" in each.text} == {("1", "one")}


def test_the_largest_means_the_largest_and_words_of_names_are_joined_in_files() -> None:
    boxes = [thing(1, "card box", (0, 0, 0)), thing(2, "card box", (5, 0, 0)), thing(3, "card box", (9, 0, 0), 0.2)]
    (expression,) = make_expressions([scene_of(*boxes, unit=0.5)])
    assert (expression.text, expression.tokens) == ("the largest card box", ("the", "largest", "card", "box"))
    assert (expression.object_id, expression.object_name, expression.multiple) == (3, "card_box", True)
    # Files have units of half a metre.
    np.testing.assert_allclose(expression.aabb, [[18, 0, 0], [18.4, 0.4, 0.4]])


def test_a_side_needs_twenty_degrees_from_straight_ahead_and_from_straight_behind() -> None:
    def of(degrees: float) -> str | None:
        position = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0]) * 10
        places = ((0, 0, 0), (10, 0, 0), tuple(position))
        return side_of(*(thing(number, "a", place, 1e-6) for number, place in enumerate(places)))

    assert [of(angle) for angle in (19.9, 20.1, 90, 159.9, 160.1)] == [None, "left", "left", "left", None]
    assert [of(-angle) for angle in (19.9, 20.1, 90, 159.9, 160.1)] == [None, "right", "right", "right", None]


def test_one_stands_at_the_center_from_the_middle_of_the_scene_and_turns_to_what_one_faces() -> None:
    table, lamp = thing(1, "table", (1, 1, 0), 1.0), thing(2, "lamp", (1.45, 6, 0))
    aside = thing(3, "mug", (6, 1.45, 0)), thing(4, "clock", (-5, 1.45, 0))
    made = make_situations([scene_of(table, lamp, *aside)], per_kind=4)
    facing_lamp = [each for each in made if each.situation == "I am standing at the table and facing the lamp."]
    assert facing_lamp
    for each in facing_lamp:
        # The scene reaches from -5 to 6.1 and from 1 to 6.1; the lamp is straight in y, a quarter turn about z.
        assert each.position == pytest.approx((1.5 - 0.55, 1.5 - 3.55, 0))
        assert each.rotation == pytest.approx((np.sqrt(0.5), 0, 0, np.sqrt(0.5)), abs=1e-6)
        assert each.object_ids[:2] == (1, 2)
    sides = {each.text: each.answers[0] for each in facing_lamp if "left" in each.text}
    expected = {f"Is the {n} on my left or on my right?": side for n, side in (("mug", "right"), ("clock", "left"))}
    assert sides.items() <= expected.items()
    answers = [each.answers[0] for each in made if "left or" in each.text]
    assert answers.count("left") == answers.count("right") > 0


def test_of_each_kind_there_are_at_most_so_many() -> None:
    rng = np.random.default_rng(0)
    names = ("table", "lamp", "mug", "clock", "apple", "guitar", "piano", "tent")
    things = [thing(number, name, tuple(rng.uniform(0, 30, 3) * (1, 1, 0)), 0.6) for number, name in enumerate(names)]
    for per_kind in (2, 5):
        made = make_situations([scene_of(*things)], per_kind=per_kind)
        kinds = [each.id.split("-")[1] for each in made]
        assert kinds.count("side") == 2 * (per_kind // 2)
        assert kinds.count("nearer") == per_kind


SITUATED = Question(
    dataset="sqa3d",
    id="7",
    scene="s",
    text="Left?",
    answers=("yes", "y"),
    situation="I sit.",
    position=(1.0, 2.0, 0.0),
    rotation=(0.5, 0.1, 0.2, 0.8),
)


def test_situated_questions_are_written_in_sqa3ds_two_files(tmp_path: Path) -> None:
    beside = write_sqa3d(tmp_path / "v1_questions_x.json", [SITUATED])
    assert beside == tmp_path / "v1_sqa_annotations_x.json"
    (annotation,) = json.loads(beside.read_text())["annotations"]
    assert annotation["rotation"] == {"_x": 0.1, "_y": 0.2, "_z": 0.8, "_w": 0.5}
    assert annotation["position"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    assert [(row["answer"], row["answer_id"]) for row in annotation["answers"]] == [("yes", 1), ("y", 2)]
    assert read_questions(tmp_path / "v1_questions_x.json") == (SITUATED,)
    with pytest.raises(InputError, match="questions in it"):
        write_sqa3d(tmp_path / "other.json", [SITUATED])
    for lacking in ("situation", "position", "rotation"):
        with pytest.raises(InputError, match="question 7 has no situation"):
            write_sqa3d(tmp_path / "questions.json", [replace(SITUATED, **{lacking: None})])
