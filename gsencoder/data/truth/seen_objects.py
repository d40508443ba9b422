"""The objects of a labeled scene, and how well its photographs show them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.truth.color_names import color_word
from gsencoder.types import Scene

COLOR_VIEWS = 4
"""Photographs that a thing's color is read from: those that show most of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenObject:
    """A labeled object.

    Attributes:
        id: its value in the instance maps.
        name: in singular, or None.
        aabb_min: lower corner in world coordinates, meters.
        aabb_max: upper corner.
        pixels: its largest area in a photograph; 0 where none shows it.
        color: its color word, where that is clear.
    """

    id: int
    name: str | None
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    pixels: int
    color: str | None = None

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        return (self.aabb_min + self.aabb_max) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenScene:
    """A labeled scene as questions are made from it: in meters, with z up.

    Attributes:
        name: of the scene.
        objects: all that its labels list, in the order of their ids.
        min_pixels: the area, in some photograph, from which an object may be asked about.
        metres_per_unit: of the scene's files, which boxes were multiplied with.
    """

    name: str
    objects: tuple[SeenObject, ...]
    min_pixels: int
    metres_per_unit: float = 1.0

    def shown(self, scene_object: SeenObject) -> bool:
        """Whether some photograph shows a thing well enough to be asked about."""
        return scene_object.pixels >= self.min_pixels

    def named(self, name: str) -> tuple[SeenObject, ...]:
        """The objects of a name that any photograph shows. What none shows is outside of the recorded place."""
        return tuple(scene_object for scene_object in self.objects if scene_object.name == name and scene_object.pixels)

    def names(self) -> tuple[str, ...]:
        """Names all of whose objects that any photograph shows are shown well enough, sorted.

        Of other names, people would count differently, and not know which one is meant.
        """
        names = sorted(
            {scene_object.name for scene_object in self.objects if scene_object.name and scene_object.pixels}
        )
        return tuple(name for name in names if all(map(self.shown, self.named(name))))

    def unique(self, name: str) -> SeenObject | None:
        """The only object of a name, where it is shown well enough; None where there are several or none."""
        same = [scene_object for scene_object in self.objects if scene_object.name == name]
        return same[0] if len(same) == 1 and self.shown(same[0]) else None


def see_objects(scene: Scene, min_pixels: int = 200) -> SeenScene:
    """Counts the pixels of each object in the photographs, and reads the color of those that are shown well.

    Args:
        scene: with labeled objects, instance maps and photographs, up = z.
        min_pixels: see `SeenScene`.

    Raises:
        InputError: something of this is missing, no object is labeled, or the unit of length is unknown.
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
    assert views.instances is not None
    ids = np.array([scene_object.id for scene_object in scene.objects])
    largest = int(ids.max()) + 1
    counts = np.stack(
        [np.bincount(np.minimum(labels.ravel(), largest), minlength=largest + 1)[ids] for labels in views.instances]
    )
    colors = _colors(scene, counts, min_pixels)
    unit = scene.metres_per_unit
    scene_objects = [
        SeenObject(
            id=scene_object.id,
            name=scene_object.name,
            aabb_min=scene_object.aabb_min * unit,
            aabb_max=scene_object.aabb_max * unit,
            pixels=int(counts[:, row].max()),
            color=colors[row],
        )
        for row, scene_object in enumerate(scene.objects)
    ]
    return SeenScene(
        name=scene.name,
        objects=tuple(sorted(scene_objects, key=lambda scene_object: scene_object.id)),
        min_pixels=min_pixels,
        metres_per_unit=unit,
    )


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
