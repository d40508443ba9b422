"""The objects of a labeled scene, and how well its photographs show them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.data.labels.scans import count_pixels
from gsencoder.types import Scene


class ColorRange(NamedTuple):
    """Pixels that people call by one word: bounds of hue (degrees), saturation and value, the lower ones included."""

    word: str
    hue: tuple[float, float]
    saturation: tuple[float, float]
    value: tuple[float, float]


RANGES = (
    ColorRange("black", (0, 360), (0, 1.01), (0, 0.17)),
    ColorRange("white", (0, 360), (0, 0.12), (0.8, 1.01)),
    ColorRange("red", (350, 370), (0.65, 1.01), (0.35, 1.01)),
    ColorRange("brown", (12, 38), (0.35, 0.75), (0.2, 0.52)),
    ColorRange("orange", (14, 36), (0.75, 1.01), (0.6, 1.01)),
    ColorRange("yellow", (43, 68), (0.45, 1.01), (0.5, 1.01)),
    ColorRange("green", (85, 165), (0.3, 1.01), (0.2, 1.01)),
    ColorRange("blue", (200, 250), (0.35, 1.01), (0.2, 1.01)),
    ColorRange("purple", (264, 295), (0.3, 1.01), (0.2, 1.01)),
    ColorRange("pink", (310, 350), (0.2, 0.6), (0.65, 1.01)),
)
"""The ranges of different words are apart: what lies between them is called differently by different people. Gray is
no word here, since white in the shade has the same pixels."""
LEAST_SHARE = 0.6
"""A thing has a color if it has this share of its pixels …"""
MOST_OTHER = 0.15
"""… and no other color has more than this share."""


def color_word(picture: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]) -> str | None:
    """The color of a thing in a photograph, of `RANGES`, by the pixels of its mask; None where it is not clear.

    It is clear where, of the pixels that do not touch others than the thing's, at least 60 % have the color, and of no
    other color there are more than 15 %.
    """
    from scipy.ndimage import binary_erosion

    pixels = picture[binary_erosion(mask)]
    if not len(pixels):
        return None
    shares = color_counts(pixels) / len(pixels)
    order = np.argsort(-shares, kind="stable")
    clear = shares[order[0]] >= LEAST_SHARE and shares[order[1]] <= MOST_OTHER
    return RANGES[order[0]].word if clear else None


def color_counts(pixels: UInt8[np.ndarray, "n 3"]) -> Int64[np.ndarray, " C"]:
    """How many pixels lie in each of `RANGES`, which do not overlap."""
    from matplotlib.colors import rgb_to_hsv

    hue, saturation, value = rgb_to_hsv(pixels / 255).T
    hue = 360 * hue
    counts = []
    for each in RANGES:
        low, high = each.hue
        inside = ((hue >= low) & (hue < high)) | (hue + 360 < high)
        for channel, (least, most) in ((saturation, each.saturation), (value, each.value)):
            inside &= (channel >= least) & (channel < most)
        counts.append(int(inside.sum()))
    return np.array(counts, np.int64)


COLOR_VIEWS = 4
"""Photographs that a thing's color is read from: the ones that show most of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenObject:
    """A labeled object."""

    id: int  # its value in the instance maps
    name: str | None
    aabb_min: Float64[np.ndarray, "3"]  # world coordinates, meters
    aabb_max: Float64[np.ndarray, "3"]
    pixels: int  # its largest area in a photograph; 0 where none shows it
    color: str | None = None  # its color word, where that is clear

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        return (self.aabb_min + self.aabb_max) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenScene:
    """A labeled scene as questions are made from it: in meters, with z up."""

    name: str
    objects: tuple[SeenObject, ...]  # all that its labels list, in the order of their ids
    min_pixels: int  # the area, in some photograph, from which an object may be asked about
    metres_per_unit: float = 1.0  # of the scene's files, which boxes were multiplied with

    def is_visible(self, scene_object: SeenObject) -> bool:
        """Whether some photograph shows a thing well enough to be asked about."""
        return scene_object.pixels >= self.min_pixels

    def named(self, name: str) -> tuple[SeenObject, ...]:
        """The objects of a name that any photograph shows. What none shows is outside of the recorded place."""
        return tuple(each for each in self.objects if each.name == name and each.pixels)

    def names(self) -> tuple[str, ...]:
        """Names all of whose objects that any photograph shows are well visible, sorted.

        Of other names, people would count differently, and not know which one is meant.
        """
        names = sorted({each.name for each in self.objects if each.name and each.pixels})
        return tuple(name for name in names if all(map(self.is_visible, self.named(name))))

    def unique(self, name: str) -> SeenObject | None:
        """The only object of a name, where it is well visible; None where there are several or none."""
        same = [each for each in self.objects if each.name == name]
        return same[0] if len(same) == 1 and self.is_visible(same[0]) else None


def see_objects(scene: Scene, min_pixels: int = 200) -> SeenScene:
    """Counts the pixels of each object in the photographs, and reads the color of the well visible ones.

    Args:
        scene: with labeled objects, instance maps and photographs, up = z.
    """
    views = scene.views
    missing = [
        part
        for part, there in (
            ("labeled objects (objects.json)", bool(scene.objects)),
            ("instance maps (instance_file_path)", views is not None and views.instances is not None),
            ("photographs", views is not None and views.images is not None),
        )
        if not there
    ]
    if missing:
        raise InputError(f"questions: scene {scene.name} has no {' and no '.join(missing)}; questions need labels")
    if not any(scene_object.name for scene_object in scene.objects):
        raise InputError(f"questions: no object of scene {scene.name} has a name")
    if scene.metres_per_unit is None:
        raise InputError(f"questions: the unit of scene {scene.name} is unknown; give data.metres_per_unit=")
    if scene.up is not None and not np.allclose(scene.up, (0, 0, 1), atol=0.02):
        raise InputError(f"questions: up is {scene.up.round(3).tolist()} in scene {scene.name}; expected z")
    assert views is not None
    ids = np.array([scene_object.id for scene_object in scene.objects])
    counts = count_pixels(replace(views, masks=None), ids)
    colors = _colors(scene, counts, min_pixels)
    unit = scene.metres_per_unit
    scene_objects = tuple(
        SeenObject(
            id=each.id,
            name=each.name,
            aabb_min=each.aabb_min * unit,
            aabb_max=each.aabb_max * unit,
            pixels=int(counts[:, row].max()),
            color=colors[row],
        )
        for row, each in sorted(enumerate(scene.objects), key=lambda pair: pair[1].id)
    )
    return SeenScene(name=scene.name, objects=scene_objects, min_pixels=min_pixels, metres_per_unit=unit)


def _colors(scene: Scene, counts: Int64[np.ndarray, "V objects"], min_pixels: int) -> list[str | None]:
    """The color of each named object that the photographs agree on that show most of it, each with enough of it."""
    views = scene.views
    assert views is not None
    assert views.images is not None
    assert views.instances is not None
    words: list[set[str | None]] = [set() for _ in scene.objects]
    best = np.zeros(counts.shape, bool)
    np.put_along_axis(best, np.argsort(-counts, axis=0, kind="stable")[:COLOR_VIEWS], True, axis=0)
    best &= (counts >= max(min_pixels, 1)) & np.array([bool(each.name) for each in scene.objects])
    # Each photograph is decoded once.
    for view in np.flatnonzero(best.any(axis=1)).tolist():
        picture, labels = views.images[view], views.instances[view]
        for row in np.flatnonzero(best[view]):
            words[row].add(color_word(picture, labels == scene.objects[row].id))
    return [next(iter(each)) if len(each) == 1 else None for each in words]


NEAR = 0.5
"""Things farther apart than this are not next to each other."""
MARGIN = 0.1
"""What is next to a thing is nearer to it than any other kind of thing, by this and by half."""
TOUCHING = 0.04
"""A thing stands on another if its lower side is at most so far from the other's upper side, …"""
ON_SHARE = 0.6
"""… and this share of its outline lies within the other's."""
SAME_PLACE = 0.3
"""Things whose boxes share more than this of the smaller one's volume are in or around each other, not next to."""
REACH = 1.0
"""Things farther apart than this, which is beyond what `clearly_nearer` asks of `NEAR`, do not decide any relation."""
LARGEST = 1.3
"""The largest of some things is this many times as long, across its box, as any other."""


def gap(a: SeenObject, b: SeenObject) -> float:
    """The distance between two boxes; 0 where they touch or overlap."""
    apart = np.maximum(np.maximum(a.aabb_min - b.aabb_max, b.aabb_min - a.aabb_max), 0)
    return float(np.linalg.norm(apart))


def stands_on(upper: SeenObject, lower: SeenObject) -> bool:
    """Whether the lower side of a box lies on the upper side of another."""
    if abs(upper.aabb_min[2] - lower.aabb_max[2]) > TOUCHING:
        return False
    area = (upper.aabb_max - upper.aabb_min)[:2].prod()
    return bool(area > 0 and _overlap(upper, lower)[:2].prod() / area >= ON_SHARE)


def _overlap(a: SeenObject, b: SeenObject) -> Float64[np.ndarray, "3"]:
    return np.maximum(np.minimum(a.aabb_max, b.aabb_max) - np.maximum(a.aabb_min, b.aabb_min), 0)


def interlocked(a: SeenObject, b: SeenObject) -> bool:
    """Whether a box is largely inside of another: in it, around it, or in its hollow."""
    smaller = min((a.aabb_max - a.aabb_min).prod(), (b.aabb_max - b.aabb_min).prod())
    return bool(smaller > 0 and _overlap(a, b).prod() > SAME_PLACE * smaller)


def movables(scene_objects: Sequence[SeenObject]) -> tuple[SeenObject, ...]:
    """All things but parts of the building, which have no name and whose box holds half of the others' centers."""
    centers = np.array([each.center[:2] for each in scene_objects]).reshape(-1, 2)
    movable = []
    for row, each in enumerate(scene_objects):
        others = np.delete(centers, row, axis=0)
        inside = ((others >= each.aabb_min[:2]) & (others <= each.aabb_max[:2])).all(axis=1)
        if each.name is not None or not len(others) or inside.mean() < 0.5:
            movable.append(each)
    return tuple(movable)


def near_things(scene_objects: Sequence[SeenObject]) -> dict[int, tuple[SeenObject, ...]]:
    """For the id of each thing, the things within `REACH` of its box and itself, in order: `neighbor` and `supporter`
    find the same among them as among all."""
    lower, upper = (np.array([getattr(each, f"aabb_{end}") for each in scene_objects]) for end in ("min", "max"))
    near = {}
    for row, each in enumerate(scene_objects):
        apart = np.maximum(lower - upper[row], lower[row] - upper).max(axis=1)
        near[each.id] = tuple(scene_objects[other] for other in np.flatnonzero(apart <= REACH).tolist())
    return near


def adjacent(scene_object: SeenObject, scene_objects: Sequence[SeenObject]) -> list[tuple[float, SeenObject]]:
    """The things that may be next to another, nearest first, with their distances.

    Left out are what it stands on or carries, what it is in or around, and what is wholly above or below it, as a
    carpet is.
    """
    others = [
        (gap(scene_object, other), other)
        for other in scene_objects
        if other is not scene_object
        and not stands_on(scene_object, other)
        and not stands_on(other, scene_object)
        and not interlocked(scene_object, other)
        and min(scene_object.aabb_max[2], other.aabb_max[2]) > max(scene_object.aabb_min[2], other.aabb_min[2])
    ]
    return sorted(others, key=lambda pair: (pair[0], pair[1].id))


def clearly_nearer(first: float, second: float) -> bool:
    """Whether one distance is smaller than another by enough for people to agree."""
    return second >= max(1.5 * first, first + MARGIN)


def neighbor(scene_object: SeenObject, scene_objects: Sequence[SeenObject]) -> SeenObject | None:
    """What a thing is next to, where people would agree on its kind: the nearest of `adjacent`, at most 0.5 m away, and
    nearer than any thing of another name by 0.1 m and by half. None where it has no name or nothing is clear."""
    ranked = adjacent(scene_object, scene_objects)
    if not ranked or ranked[0][1].name is None or ranked[0][1].name == scene_object.name or ranked[0][0] > NEAR:
        return None
    first, nearest = ranked[0]
    second = min((distance for distance, other in ranked if other.name != nearest.name), default=np.inf)
    return nearest if clearly_nearer(first, second) else None


def supporter(scene_object: SeenObject, scene_objects: Sequence[SeenObject]) -> SeenObject | None:
    """What a thing stands on, where only one thing qualifies, it has a name, and the thing is in no other's box."""
    lower = [other for other in scene_objects if other is not scene_object and stands_on(scene_object, other)]
    inside = [other for other in scene_objects if other is not scene_object and interlocked(scene_object, other)]
    return lower[0] if len(lower) == 1 and lower[0].name is not None and not inside else None


def largest(scene_objects: Sequence[SeenObject]) -> SeenObject | None:
    """The largest of several things; None where another is nearly as long across its box."""
    sizes = np.array([np.linalg.norm(scene_object.aabb_max - scene_object.aabb_min) for scene_object in scene_objects])
    if len(scene_objects) < 2:
        return None
    order = np.argsort(-sizes, kind="stable")
    return scene_objects[order[0]] if sizes[order[0]] >= LARGEST * sizes[order[1]] else None
