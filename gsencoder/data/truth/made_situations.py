"""Questions of one who stands in a labeled scene and faces something, made from the labels: SQA3D's task.

- side: "Is the X on my left or on my right?" The answer is the same wherever in the box of the thing one stands at, and
  whichever corners of the two others one looks at, by 20° at least from straight ahead and from straight behind.
- nearer: "Which is closer to me, the X or the Y?" The box of one is nearer to that of the thing one stands at, by half
  and by 0.5 m.

All things have names of their own and are shown well enough; one stands at things of 0.5 m or more.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.truth.made_questions import clear_names, scene_rng
from gsencoder.data.truth.questions import Question
from gsencoder.data.truth.relations import clearly_nearer, gap, movables
from gsencoder.data.truth.seen_objects import SeenObject, SeenScene

PART = 200
SMALLEST_PLACE = 0.5
"""Meters across the box of what one stands at."""
CLEAR_ANGLE = np.radians(20)
CLEAR_DISTANCE = 0.5
MAX_TRIPLES = 50_000
"""Triples of things that are tried: all of 36 things, a random choice of more."""


def make_situations(scenes: Iterable[SeenScene], *, seed: int = 0, per_kind: int = 10) -> tuple[Question, ...]:
    """Questions of both kinds, at most `per_kind` of each a scene, as many to be answered with left as with right.

    Raises:
        InputError: a number out of range, or two scenes of one name.
    """
    if per_kind < 2:
        raise InputError(f"situations: expected per_kind from 2, got {per_kind}")
    ordered = sorted(scenes, key=lambda scene: scene.name)
    if len({scene.name for scene in ordered}) < len(ordered):
        raise InputError("situations: two scenes have one name")
    situations = [each for scene in ordered for each in _of_scene(scene, seed, per_kind)]
    return tuple(situations)


def _of_scene(scene: SeenScene, seed: int, per_kind: int) -> list[Question]:
    rng = scene_rng(seed, scene.name, PART)
    scene_objects = movables(scene.objects)
    single = [
        scene_object
        for scene_object in map(scene.unique, clear_names(scene))
        if scene_object is not None and scene_object in scene_objects
    ]
    landmarks = [
        scene_object
        for scene_object in single
        if np.linalg.norm(scene_object.aabb_max - scene_object.aabb_min) >= SMALLEST_PLACE
    ]
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
            sides[side].append(_question(scene, at, facing, [other], text, side))
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
            nearer.append(_question(scene, at, facing, [aside], text, str(near.name)))
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
    """A landmark and two other things, each another one, in random order; of very many a random choice."""
    count = len(landmarks) * len(single) ** 2
    if count <= MAX_TRIPLES:
        triples = [each for each in product(landmarks, single, single) if len({one.id for one in each}) == 3]
        return [triples[row] for row in rng.permutation(len(triples))]
    numbers = rng.choice(count, MAX_TRIPLES, replace=False) if count < 2**24 else rng.integers(0, count, MAX_TRIPLES)
    rows = np.unravel_index(numbers, (len(landmarks), len(single), len(single)))
    chosen = [(landmarks[at], single[facing], single[other]) for at, facing, other in zip(*rows, strict=True)]
    return [each for each in chosen if len({one.id for one in each}) == 3]


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


def _question(
    scene: SeenScene, at: SeenObject, facing: SeenObject, others: Sequence[SeenObject], text: str, answer: str
) -> Question:
    boxes = [(scene_object.aabb_min, scene_object.aabb_max) for scene_object in scene.objects]
    middle = (np.min([low for low, _ in boxes], axis=0) + np.max([high for _, high in boxes], axis=0)) / 2
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
        object_ids=tuple(scene_object.id for scene_object in objects),
        object_names=tuple(str(scene_object.name) for scene_object in objects),
        situation=f"I am standing at the {at.name} and facing the {facing.name}.",
        position=(float(position[0]), float(position[1]), 0.0),
        rotation=(float(np.cos(turn / 2)), 0.0, 0.0, float(np.sin(turn / 2))),
    )
