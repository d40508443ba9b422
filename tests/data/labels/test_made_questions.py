"""Questions made from labels: each answer follows from the labels in another way, and what is unclear is not asked."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels import made_questions
from gsencoder.data.labels.made_questions import KINDS, kind_of, make_questions
from gsencoder.data.labels.questions import Question, read_questions, write_scanqa
from gsencoder.data.labels.seen_objects import RANGES, SeenObject, SeenScene, color_counts, see_objects
from gsencoder.data.synthetic import color_words, make_room
from gsencoder.types import Scene

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


def scene_of(*things: SeenObject) -> SeenScene:
    return SeenScene(name="made", objects=things, min_pixels=200)


def texts(*things: SeenObject) -> dict[str, tuple[str, ...]]:
    return {each.text: each.answers for each in make_questions([scene_of(*things)], **ALL)}


def distance(a: SeenObject, b: SeenObject) -> float:
    """Of two boxes, by projecting a point on one and the other in turn."""
    point = (a.aabb_min + a.aabb_max) / 2
    for _ in range(200):
        other = np.clip(point, b.aabb_min, b.aabb_max)
        point = np.clip(other, a.aabb_min, a.aabb_max)
    return float(np.linalg.norm(point - other))


def check_answer(question: Question, scene: SeenScene, colors: dict[int, str]) -> None:
    """Derives the answer of a question from its text and the labels."""
    by_name = {each.name: each for each in scene.objects if each.name}
    kind, text = kind_of(question), question.text
    if kind == "is_there":
        name = re.sub(r"^(Is there an? |Are there any )(.*) in the room\?$", r"\2", text)
        assert question.answers == (("yes",) if name in by_name else ("no",))
    elif kind == "how_many":
        assert question.answers == ("1", "one")  # No two things of a room have one name.
    elif kind == "color":
        name = re.sub(r"^What color (?:is|are) the (.*)\?$", r"\1", text)
        assert question.answers == (colors[by_name[name].id],)
    elif kind == "where":
        for answer in question.answers:
            name = re.sub(r"^Where (?:is|are) the (.*)\?$", r"\1", text)
            asked, other = by_name[name], by_name[answer.rpartition(" the ")[2]]
            if answer.startswith("on the "):
                assert asked.aabb_min[2] == pytest.approx(other.aabb_max[2], abs=0.05)
                assert (asked.center[:2] > other.aabb_min[:2]).all()
                assert (asked.center[:2] < other.aabb_max[:2]).all()
            else:
                assert answer.startswith("next to the ")
                assert distance(asked, other) <= 0.5
    else:
        name = re.sub(r"^What is next to the (.*)\?$", r"\1", text)
        asked, answer = by_name[name], by_name[question.answers[0]]
        near = distance(asked, answer)
        assert near <= 0.5
        rivals = [
            each
            for each in by_name.values()
            if each not in (asked, answer)
            and not (each.aabb_max[2] - 0.05 <= asked.aabb_min[2] or asked.aabb_max[2] - 0.05 <= each.aabb_min[2])
            and distance(asked, each) > 0
        ]
        assert all(distance(asked, each) >= max(1.5 * near, near + 0.1) - 1e-9 for each in rivals)


def test_every_answer_follows_from_the_labels(seen: list[SeenScene]) -> None:
    questions = make_questions(seen, **ALL)
    assert {kind_of(each) for each in questions} == set(KINDS)
    scenes = {each.name: each for each in seen}
    for each in questions:
        seed = int(each.scene.removeprefix("room_"))
        check_answer(each, scenes[each.scene], color_words(seed))


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
    assert (
        texts(table, inside, thing(2, "mug", (0, 0, 0.02)), thing(3, "ball", (3, 0, 0))).get("Where is the mug?")
        is None
    )


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
