"""Expressions that mean one object of a labeled scene, made from the labels: ScanRefer's task, and Scan2Cap's.

An object that some photograph shows well enough is described in each way in which people would know that it is meant:

- by its name, if it is the only one of it in the labels;
- by what it is next to, if that has a name of its own, and no other object of the name is as near to it or shown badly;
- by what it stands on, if only one object of the name stands on a thing of that name;
- as the largest of its name, if all are shown well enough and its box is 1.3 times as long across as any other.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.made_questions import scene_rng
from gsencoder.data.labels.seen_objects import (
    NEAR,
    SeenObject,
    SeenScene,
    beside,
    clearly_nearer,
    gap,
    interlocked,
    largest,
    movables,
    near_things,
    neighbor,
    supporter,
)

PART = 100
"""Of the scene's random numbers, those of expressions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeExpression:
    """An expression, and what its words need.

    Attributes:
        expression: as a file has it.
        unique: whether the object is the only one of its name in the labels: ScanRefer's "unique".
        needed: ids of the objects that it speaks of, its own first.
    """

    expression: Expression
    unique: bool
    needed: tuple[int, ...]


def make_expressions(
    scenes: Iterable[SeenScene], *, seed: int = 0, per_object: int = 3, per_scene: int = 0
) -> tuple[MadeExpression, ...]:
    """Expressions for all objects that are shown well enough and can be described.

    Args:
        scenes: in any order.
        seed: of the order in which ways to describe an object are taken, and of the choice of objects.
        per_object: most expressions of an object.
        per_scene: most objects of a scene; 0 = all.

    Raises:
        InputError: numbers out of range, two scenes of one name, or no object can be described.
    """
    if per_object < 1 or per_scene < 0:
        raise InputError(f"expressions: expected per_object from 1 and per_scene from 0, got {per_object}, {per_scene}")
    ordered = sorted(scenes, key=lambda scene: scene.name)
    if len({scene.name for scene in ordered}) < len(ordered):
        raise InputError("expressions: two scenes have one name")
    expressions = [each for scene in ordered for each in _of_scene(scene, seed, per_object, per_scene)]
    if not expressions:
        raise InputError(f"expressions: no object of {len(ordered)} scenes is shown well enough and can be described")
    return tuple(expressions)


def _of_scene(scene: SeenScene, seed: int, per_object: int, per_scene: int) -> list[MadeExpression]:
    rng = scene_rng(seed, scene.name, PART)
    scene_objects = movables(scene.objects)
    near = near_things(scene_objects)
    described = [
        (scene_object, ways)
        for scene_object in scene_objects
        if scene_object.name and scene.shown(scene_object) and (ways := _ways_to_say(scene, scene_object, near))
    ]
    shuffled = rng.permutation(len(described)).tolist()
    expressions = []
    for row in sorted(shuffled[:per_scene] if per_scene else shuffled):
        scene_object, ways = described[row]
        wordings = [ways[way] for way in rng.permutation(len(ways))[:per_object]]
        for number, (text, others) in enumerate(wordings):
            expressions.append(_made(scene, scene_object, text, others, number))
    return expressions


def _ways_to_say(
    scene: SeenScene, scene_object: SeenObject, near: Mapping[int, Sequence[SeenObject]]
) -> list[tuple[str, tuple[SeenObject, ...]]]:
    """All clear descriptions of a thing, and the other things that each speaks of."""
    name = str(scene_object.name)
    others = [other for other in scene.objects if other.name == name and other is not scene_object]
    ways: list[tuple[str, tuple[SeenObject, ...]]] = []
    if scene.unique(name) is scene_object:
        ways.append((f"the only {name} in the room", ()))
    anchor = _anchor(scene, scene_object, others, near[scene_object.id])
    if anchor is not None:
        ways.append((f"the {name} next to the {anchor.name}", (anchor,)))
    below = supporter(scene_object, near[scene_object.id])
    if (
        below is not None
        and scene.shown(below)
        and not any(_may_be_on(other, below, near[other.id]) for other in others)
    ):
        ways.append((f"the {name} on the {below.name}", (below,)))
    if others and all(scene.shown(other) for other in others) and largest([scene_object, *others]) is scene_object:
        ways.append((f"the largest {name}", tuple(others)))
    return ways


def _anchor(
    scene: SeenScene, scene_object: SeenObject, others: Sequence[SeenObject], scene_objects: Sequence[SeenObject]
) -> SeenObject | None:
    """The nearest thing beside another whose name is its own and that no other object of the name is as near to."""
    if not others:
        # The one thing of a name is next to what the question's rule says, too.
        near = neighbor(scene_object, scene_objects)
        return near if near is not None and scene.unique(str(near.name)) is near else None
    for distance, anchor in beside(scene_object, scene_objects):
        if distance > NEAR:
            return None
        if anchor.name is None or scene.unique(anchor.name) is not anchor:
            continue
        if all(clearly_nearer(distance, gap(other, anchor)) and not interlocked(other, anchor) for other in others):
            return anchor
    return None


def _may_be_on(scene_object: SeenObject, below: SeenObject, scene_objects: Sequence[SeenObject]) -> bool:
    """Whether a thing may be said to be on something of another's name: it stands near the top of one, or is in its
    box."""
    same = [other for other in scene_objects if other.name == below.name]
    return any(gap(scene_object, other) < NEAR / 2 for other in same)


def _made(
    scene: SeenScene, scene_object: SeenObject, text: str, others: Sequence[SeenObject], number: int
) -> MadeExpression:
    lower, upper = (
        (corner / scene.metres_per_unit).tolist() for corner in (scene_object.aabb_min, scene_object.aabb_max)
    )
    name = str(scene_object.name)
    unique = len([other for other in scene.objects if other.name == scene_object.name]) == 1
    return MadeExpression(
        expression=Expression(
            scene=scene.name,
            object_id=scene_object.id,
            object_name=name.replace(" ", "_"),
            annotation=str(number),
            text=text,
            tokens=tuple(text.lower().split()),
            aabb=((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])),
            multiple=not unique,
            others=False,
        ),
        unique=unique,
        needed=(scene_object.id, *(other.id for other in others)),
    )
