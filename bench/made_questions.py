"""Questions about labeled scenes with their answers, made from the labels by a seed: of the kinds of ScanQA.

A question is made only where people would agree on its answer:

- A thing is asked about if some photograph shows at least `min_pixels` of it, by its name, if no other name of the
  scene may stand for the same thing (`alike`). "The" thing is the only one of its name in the labels.
- next_to: the nearest thing to it, at most 0.5 m away, and nearer than any of another name by 0.1 m and by half
  (`seen_objects.neighbor`).
- how_many: every object of the name that any photograph shows is well visible; at most ten.
- color: nearly all pixels of it have one color word in every photograph that shows it well (`seen_objects.color_word`).
- where: what it stands on, if one thing qualifies and it is in none (`seen_objects.supporter`), or what it is next to.
- is_there: yes where an object of the name is well visible; no for names that no label has, nor any name that may
  stand for the same thing.

Questions of one who stands in a labeled scene and faces something, made from the labels: SQA3D's task.

- side: "Is the X on my left or on my right?" The answer is the same wherever in the box of the thing one stands at, and
  whichever corners of the two others one looks at, by 20° at least from straight ahead and from straight behind.
- nearer: "Which is closer to me, the X or the Y?" The box of one is nearer to that of the thing one stands at, by half
  and by 0.5 m.

All things have names of their own and are well visible; one stands at things of 0.5 m or more.

Expressions that mean one object of a labeled scene, made from the labels: ScanRefer's task, and Scan2Cap's.

An object that some photograph shows well enough is described in each way in which people would know that it is meant:

- by its name, if it is the only one of it in the labels;
- by what it is next to, if that has a name of its own, and no other object of the name is as near to it;
- by what it stands on, if only one object of the name stands on a thing of that name;
- as the largest of its name, if all are well visible and its box is 1.3 times as long across as any other.
"""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64
from seen_objects import (
    NEAR,
    SeenObject,
    SeenScene,
    adjacent,
    clearly_nearer,
    gap,
    interlocked,
    largest,
    movables,
    near_things,
    neighbor,
    supporter,
)

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.questions import Question

NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
PLURAL_ONLY = ("scissors", "dice", "pants", "glasses", "products", "utensils")
"""Last words of names that are plurals."""
VES = {"knife": "knives", "shelf": "shelves", "bookshelf": "bookshelves", "loaf": "loaves", "leaf": "leaves"}
SAME_THINGS = (
    ("cup", "mug", "pitcher"),
    ("cabinet", "cupboard", "wardrobe", "nightstand", "shelf", "dresser"),
    ("table", "coffee table", "dining table", "desk", "nightstand"),
    ("ball", "softball", "baseball", "tennis ball", "golf ball"),
    ("sofa", "couch"),
    ("chair", "stool", "bench"),
    ("carpet", "rug"),
    ("television", "monitor", "laptop"),
    ("picture frame", "painting", "poster"),
    ("trash can", "basket", "barrel"),
    ("box", "cracker", "pudding", "book"),
    ("cube", "dice", "lego", "box"),
    ("tin can", "can", "soup"),
    ("bottle", "condiment", "detergent", "cleaning products"),
    ("bowl", "plate"),
    ("candle", "vase", "bottle"),
)
"""Names that people use for the same thing, or for things that look alike: where one is there, neither the
number nor the absence of the other is clear."""


def is_plural(name: str) -> bool:
    """Whether a name is a plural, such as scissors."""
    return name.split()[-1] in PLURAL_ONLY


def with_article(name: str) -> str:
    """The name with "a" or "an"; plurals have none."""
    if is_plural(name):
        return name
    return (
        f"{'an' if name[0].lower() in 'aeiou' and not name.lower().startswith(('uni', 'use', 'one')) else 'a'} {name}"
    )


def plural(name: str) -> str:
    """The plural of a name that is a singular."""
    first, last = name.rpartition(" ")[0::2]
    if last in VES:
        last = VES[last]
    elif last.endswith("y") and last[-2:-1] not in "aeiou":
        last = last[:-1] + "ies"
    else:
        last += "es" if last.endswith(("s", "x", "z", "ch", "sh")) else "s"
    return f"{first} {last}".strip()


def alike(a: str, b: str) -> bool:
    """Whether two different names may be used for one thing: by `SAME_THINGS`, or as one has all words of the other."""
    if a == b:
        return False
    (words_a, groups_a), (words_b, groups_b) = _words_and_groups(a), _words_and_groups(b)
    return words_a <= words_b or words_b <= words_a or not groups_a.isdisjoint(groups_b)


@lru_cache(maxsize=4096)
def _words_and_groups(name: str) -> tuple[frozenset[str], frozenset[int]]:
    return frozenset(name.split()), frozenset(row for row, group in enumerate(SAME_THINGS) if name in group)


Kind = Literal["next_to", "how_many", "color", "where", "is_there"]
KINDS: tuple[Kind, ...] = get_args(Kind)
ABSENT = (
    "apple", "backpack", "banana", "bathtub", "bed", "bicycle", "broom", "drill", "drum", "dumbbell", "fireplace",
    "globe", "guitar", "hammer", "helmet", "keyboard", "ladder", "lemon", "microwave", "orange", "piano", "printer",
    "refrigerator", "scissors", "skateboard", "sofa", "stroller", "suitcase", "teddy bear", "telephone", "tent",
    "toaster", "toilet", "treadmill", "tricycle", "trumpet", "umbrella", "violin", "washing machine", "wheelchair",
)  # fmt: skip
"""Names that are asked about where a scene does not have them. None is of a thing that others hide in or consist of, as
forks lie among other utensils without a label of their own."""

Unit = tuple[Question, ...]
"""Questions that stay together, such as one whose answer is yes and one whose answer is no."""


def make_questions(
    scenes: Iterable[SeenScene], *, seed: int = 0, per_kind: int = 10, balance: bool = True
) -> tuple[Question, ...]:
    """Questions about scenes, without two of one text in a scene.

    What is asked about a scene depends on the scene, its name and the seed alone; which of it is left out for balance
    depends on the other scenes. The order of the scenes does not matter.

    Args:
        per_kind: most questions of a kind about a scene, from 2.
        balance: as many questions of each kind as there are of the rarest.
    """
    units = {scene.name: scene_units(scene, seed, per_kind) for scene in _in_order(scenes)}
    questions = balanced(units, balance)
    if not questions:
        raise InputError(f"questions: nothing can be asked about {len(units)} scenes: no named object is clear in them")
    return questions


def _in_order(scenes: Iterable[SeenScene]) -> list[SeenScene]:
    ordered = sorted(scenes, key=lambda scene: scene.name)
    if len({scene.name for scene in ordered}) < len(ordered):
        raise InputError("questions: two scenes have one name")
    return ordered


def scene_rng(seed: int, scene: str, part: int) -> np.random.Generator:
    """Random numbers of a scene, the same whichever other scenes there are."""
    return np.random.default_rng([seed, zlib.crc32(scene.encode()), part])


def scene_units(scene: SeenScene, seed: int, per_kind: int) -> dict[Kind, Sequence[Unit]]:
    """What is asked about a scene: of each kind at most `per_kind` questions, and, of how_many and color, not more than
    half of them, rounded up, with one answer."""
    units: dict[Kind, Sequence[Unit]] = {}
    for number, (kind, questions) in enumerate(_candidates(scene).items()):
        rng = scene_rng(seed, scene.name, number)
        shuffled = [questions[row] for row in rng.permutation(len(questions))]
        units[kind] = _paired(shuffled, per_kind) if kind == "is_there" else _varied(shuffled, per_kind)
    return units


def balanced(units: Mapping[str, Mapping[Kind, Sequence[Unit]]], equal: bool) -> tuple[Question, ...]:
    """Questions with their ids, kind by kind, scene by scene.

    Args:
        equal: as many of each kind as of the rarest that there is at all, or one more where a pair is not to be torn
            apart; they are taken from all scenes in turn.
    """
    by_kind: dict[Kind, list[tuple[int, str, Unit]]] = {
        kind: sorted(
            ((row, name, unit) for name, kinds in units.items() for row, unit in enumerate(kinds[kind])),
            key=lambda entry: entry[:2],
        )
        for kind in KINDS
    }
    counts = [sum(len(unit) for _, _, unit in ranked) for ranked in by_kind.values() if ranked]
    most = min(counts, default=0)
    numbered: list[Question] = []
    for kind, ranked in by_kind.items():
        selected = ranked[: -(-most // len(ranked[0][2]))] if equal and ranked else ranked
        numbers: dict[str, int] = {}
        for _, name, unit in sorted(selected, key=lambda entry: (entry[1], entry[0])):
            for question in unit:
                numbers[name] = numbers.get(name, -1) + 1
                numbered.append(replace(question, id=f"{name}-{kind}-{numbers[name]}"))
    return tuple(numbered)


def kind_of(question: Question) -> Kind | None:
    """The kind of a question that was made here; None of another one."""
    parts = question.id.rsplit("-", 2)
    return next((kind for kind in KINDS if len(parts) == 3 and parts[1] == kind), None)


def clear_names(scene: SeenScene) -> tuple[str, ...]:
    """Names all of whose objects are well visible, for which the scene has no other name that may mean the same."""
    there = {each.name for each in scene.objects if each.name and each.pixels}
    return tuple(name for name in scene.names() if not any(alike(name, other) for other in there))


def _candidates(scene: SeenScene) -> dict[Kind, list[Question]]:
    """All that can be asked, kind by kind, sorted by name."""
    near = near_things(movables(scene.objects))
    clear = clear_names(scene)
    single = [each for each in map(scene.unique, clear) if each is not None]
    return {
        "next_to": [
            _question(scene, f"What is next to the {each.name}?", [str(other.name)], [each, other])
            for each in single
            if (other := neighbor(each, near[each.id])) is not None and scene.is_visible(other)
        ],
        "how_many": [
            _question(
                scene, f"How many {plural(name)} are there in the room?", [str(len(same)), NUMBERS[len(same)]], same
            )
            for name in clear
            if not is_plural(name) and len(same := scene.named(name)) < len(NUMBERS)
        ],
        "color": [
            _question(scene, f"What color {_be(each)} the {each.name}?", [each.color], [each])
            for each in single
            if each.color is not None
        ],
        "where": [question for each in single if (question := _where(scene, each, near[each.id])) is not None],
        "is_there": [
            *(_question(scene, _there(name), ["yes"], list(scene.named(name))) for name in clear),
            *(_question(scene, _there(name), ["no"], []) for name in absent_names(scene, ABSENT)),
        ],
    }


def absent_names(scene: SeenScene, names: Sequence[str]) -> list[str]:
    """The names that no label of a scene has, nor any name that may stand for the same thing."""
    there = {each.name for each in scene.objects if each.name}
    return sorted({name for name in names if name not in there and not any(alike(name, other) for other in there)})


def _where(scene: SeenScene, scene_object: SeenObject, scene_objects: Sequence[SeenObject]) -> Question | None:
    """Where a thing is: on what, and next to what, as far as this is clear; the first of both is what must be seen."""
    on, near = supporter(scene_object, scene_objects), neighbor(scene_object, scene_objects)
    answers: list[str] = []
    objects: list[SeenObject] = []
    for word, other in (("on", on), ("next to", near)):
        if other is not None and scene.is_visible(other):
            answers.append(f"{word} the {other.name}")
            objects = objects or [scene_object, other]
    return (
        _question(scene, f"Where {_be(scene_object)} the {scene_object.name}?", answers, objects) if answers else None
    )


def _there(name: str) -> str:
    return f"Are there any {name} in the room?" if is_plural(name) else f"Is there {with_article(name)} in the room?"


def _be(scene_object: SeenObject) -> str:
    return "are" if scene_object.name and is_plural(scene_object.name) else "is"


def _question(scene: SeenScene, text: str, answers: Sequence[str], objects: Sequence[SeenObject]) -> Question:
    return Question(
        dataset="scanqa",
        id="",
        scene=scene.name,
        text=text,
        answers=tuple(answers),
        object_ids=tuple(each.id for each in objects),
        object_names=tuple(each.name or "" for each in objects),
    )


def _varied(questions: Sequence[Question], count: int) -> list[Unit]:
    """The first `count` questions, of which no answer has more than half, rounded up."""
    most = -(-count // 2)
    counts: dict[str, int] = {}
    selected: list[Unit] = []
    for question in questions:
        answer = question.answers[0]
        if counts.get(answer, 0) < most and len(selected) < count:
            counts[answer] = counts.get(answer, 0) + 1
            selected.append((question,))
    return selected


def _paired(questions: Sequence[Question], count: int) -> Sequence[Unit]:
    """Pairs of a question to be answered with yes and one with no."""
    yes, no = ([each for each in questions if each.answers == (answer,)] for answer in ("yes", "no"))
    return [*zip(yes, no, strict=False)][: count // 2]


PART = 200
SMALLEST_PLACE = 0.5
"""Meters across the box of what one stands at."""
CLEAR_ANGLE = np.radians(20)
CLEAR_DISTANCE = 0.5
MAX_THINGS = 36
"""Things whose triples are all tried."""


def make_situations(scenes: Iterable[SeenScene], *, seed: int = 0, per_kind: int = 10) -> tuple[Question, ...]:
    """Questions of both kinds, at most `per_kind` of each a scene, as many answered with left as with right."""
    return tuple(each for scene in _in_order(scenes) for each in _situations_of_scene(scene, seed, per_kind))


def _situations_of_scene(scene: SeenScene, seed: int, per_kind: int) -> list[Question]:
    rng = scene_rng(seed, scene.name, PART)
    scene_objects = movables(scene.objects)
    single = [each for each in map(scene.unique, clear_names(scene)) if each is not None and each in scene_objects]
    landmarks = [each for each in single if np.linalg.norm(each.aabb_max - each.aabb_min) >= SMALLEST_PLACE]
    shuffled = _shuffled_triples(landmarks, single, rng)
    sides: dict[str, list[Question]] = {"left": [], "right": []}
    nearer: list[Question] = []
    pairs: set[tuple[int, int]] = set()
    for at, facing, other in shuffled:
        if min(map(len, sides.values())) == per_kind // 2:
            break
        side = side_of(at, facing, other)
        if side is not None and len(sides[side]) < per_kind // 2 and (at.id, other.id) not in pairs:
            pairs.add((at.id, other.id))
            text = f"Is the {other.name} on my left or on my right?"
            sides[side].append(_situation_question(scene, at, facing, [other], text, side))
    for number, (at, near, other) in enumerate(shuffled):
        if len(nearer) == per_kind:
            break
        first, second = gap(at, near), gap(at, other)
        if first > second or (at.id, near.id) in pairs:
            continue
        if clearly_nearer(first, second) and second - first >= CLEAR_DISTANCE:
            pairs.add((at.id, near.id))
            pair = sorted((near, other), key=lambda scene_object: str(scene_object.name))
            text = f"Which is closer to me, the {pair[0].name} or the {pair[1].name}?"
            # What one faces must not tell which is the nearer one.
            facing, aside = (near, other) if number % 2 else (other, near)
            nearer.append(_situation_question(scene, at, facing, [aside], text, str(near.name)))
    count = min(map(len, sides.values()))
    questions = [*sides["left"][:count], *sides["right"][:count], *nearer]
    kinds = ["side"] * (2 * count) + ["nearer"] * len(nearer)
    return [
        replace(each, id=f"{scene.name}-{kind}-{row}")
        for row, (kind, each) in enumerate(zip(kinds, questions, strict=True))
    ]


def _shuffled_triples(
    landmarks: Sequence[SeenObject], single: Sequence[SeenObject], rng: np.random.Generator
) -> list[tuple[SeenObject, SeenObject, SeenObject]]:
    """A landmark and two other things, each another one, in random order; of very many things a random choice."""
    if len(landmarks) * len(single) ** 2 > MAX_THINGS**3:
        landmarks, single = (
            [each[row] for row in rng.permutation(len(each))[:MAX_THINGS]] for each in (landmarks, single)
        )
    triples = [each for each in product(landmarks, single, single) if len({one.id for one in each}) == 3]
    return [triples[row] for row in rng.permutation(len(triples))]


def side_of(at: SeenObject, facing: SeenObject, other: SeenObject) -> str | None:
    """Whether a thing is on the left or on the right of one who stands at another and faces a third; None where that
    depends on where exactly, or on which part of it."""
    origin = _corners(at)[:, None, None]
    ahead, aside = _corners(facing)[None, :, None] - origin, _corners(other)[None, None] - origin
    cross = ahead[..., 0] * aside[..., 1] - ahead[..., 1] * aside[..., 0]
    angles = np.arctan2(cross, (ahead * aside).sum(axis=-1))
    if (np.linalg.norm(ahead, axis=-1) < 1e-6).any() or (np.linalg.norm(aside, axis=-1) < 1e-6).any():
        return None
    # Of directions all around, some corners would be on the other side.
    for side, turned in (("left", angles), ("right", -angles)):
        if turned.min() >= CLEAR_ANGLE and turned.max() <= np.pi - CLEAR_ANGLE:
            return side
    return None


def _corners(scene_object: SeenObject) -> Float64[np.ndarray, "4 2"]:
    low, high = scene_object.aabb_min[:2], scene_object.aabb_max[:2]
    return np.array([(low[0], low[1]), (low[0], high[1]), (high[0], low[1]), (high[0], high[1])])


def _situation_question(
    scene: SeenScene, at: SeenObject, facing: SeenObject, others: Sequence[SeenObject], text: str, answer: str
) -> Question:
    lower, upper = (np.array([getattr(each, f"aabb_{end}") for each in scene.objects]) for end in ("min", "max"))
    middle = (lower.min(axis=0) + upper.max(axis=0)) / 2
    position = at.center - middle
    ahead = facing.center - at.center
    turn = float(np.arctan2(ahead[1], ahead[0]))
    objects = [at, facing, *others]
    return Question(
        dataset="sqa3d",
        id="",
        scene=scene.name,
        text=text,
        answers=(answer,),
        object_ids=tuple(each.id for each in objects),
        object_names=tuple(str(each.name) for each in objects),
        situation=f"I am standing at the {at.name} and facing the {facing.name}.",
        position=(float(position[0]), float(position[1]), 0.0),
        rotation=(float(np.cos(turn / 2)), 0.0, 0.0, float(np.sin(turn / 2))),
    )


EXPRESSIONS_PART = 100
"""Of the scene's random numbers, those of expressions."""


def make_expressions(
    scenes: Iterable[SeenScene], *, seed: int = 0, per_object: int = 3, per_scene: int = 0
) -> tuple[Expression, ...]:
    """Expressions for all objects that are well visible and can be described.

    Args:
        seed: of the order in which ways to describe an object are taken, and of the choice of objects.
        per_object: most expressions of an object.
        per_scene: most objects of a scene; 0 = all.
    """
    ordered = _in_order(scenes)
    expressions = [each for scene in ordered for each in _expressions_of_scene(scene, seed, per_object, per_scene)]
    if not expressions:
        raise InputError(f"expressions: no object of {len(ordered)} scenes is well visible and can be described")
    return tuple(expressions)


def _expressions_of_scene(scene: SeenScene, seed: int, per_object: int, per_scene: int) -> list[Expression]:
    rng = scene_rng(seed, scene.name, EXPRESSIONS_PART)
    scene_objects = movables(scene.objects)
    near = near_things(scene_objects)
    described = [
        (scene_object, ways)
        for scene_object in scene_objects
        if scene_object.name and scene.is_visible(scene_object) and (ways := _ways_to_say(scene, scene_object, near))
    ]
    shuffled = rng.permutation(len(described)).tolist()
    expressions = []
    for row in sorted(shuffled[:per_scene] if per_scene else shuffled):
        scene_object, ways = described[row]
        for number, way in enumerate(rng.permutation(len(ways))[:per_object]):
            expressions.append(_expression(scene, scene_object, ways[way], number))
    return expressions


def _ways_to_say(scene: SeenScene, scene_object: SeenObject, near: Mapping[int, Sequence[SeenObject]]) -> list[str]:
    """All clear descriptions of a thing."""
    name = str(scene_object.name)
    others = [other for other in scene.objects if other.name == name and other is not scene_object]
    ways: list[str] = []
    if scene.unique(name) is scene_object:
        ways.append(f"the only {name} in the room")
    anchor = _anchor(scene, scene_object, others, near[scene_object.id])
    if anchor is not None:
        ways.append(f"the {name} next to the {anchor.name}")
    below = supporter(scene_object, near[scene_object.id])
    if (
        below is not None
        and scene.is_visible(below)
        and not any(_may_be_on(other, below, near[other.id]) for other in others)
    ):
        ways.append(f"the {name} on the {below.name}")
    if others and all(scene.is_visible(other) for other in others) and largest([scene_object, *others]) is scene_object:
        ways.append(f"the largest {name}")
    return ways


def _anchor(
    scene: SeenScene, scene_object: SeenObject, others: Sequence[SeenObject], scene_objects: Sequence[SeenObject]
) -> SeenObject | None:
    """The nearest thing to another whose name is its own and that no other object of the name is as near to."""
    if not others:
        # The one thing of a name is next to what the question's rule says, too.
        near = neighbor(scene_object, scene_objects)
        return near if near is not None and scene.unique(str(near.name)) is near else None
    for distance, anchor in adjacent(scene_object, scene_objects):
        if distance > NEAR:
            return None
        if anchor.name is None or scene.unique(anchor.name) is not anchor:
            continue
        if all(clearly_nearer(distance, gap(other, anchor)) and not interlocked(other, anchor) for other in others):
            return anchor
    return None


def _may_be_on(scene_object: SeenObject, below: SeenObject, scene_objects: Sequence[SeenObject]) -> bool:
    """Whether a thing may be said to be on something of another's name: it is near the box of one."""
    return any(other.name == below.name and gap(scene_object, other) < NEAR / 2 for other in scene_objects)


def _expression(scene: SeenScene, scene_object: SeenObject, text: str, number: int) -> Expression:
    corners = scene_object.aabb_min, scene_object.aabb_max
    lower, upper = ((corner / scene.metres_per_unit).tolist() for corner in corners)
    return Expression(
        scene=scene.name,
        object_id=scene_object.id,
        object_name=str(scene_object.name).replace(" ", "_"),
        annotation=str(number),
        text=text,
        tokens=tuple(text.lower().split()),
        aabb=((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])),
        multiple=sum(other.name == scene_object.name for other in scene.objects) > 1,
        others=False,
    )
