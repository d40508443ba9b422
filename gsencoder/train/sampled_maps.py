"""The maps of a dense teacher that stand for a dataset: evenly distributed over its scenes and their views.

Which ones they are depends on the scenes alone, and not on how many processes make them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsencoder.core.arrays import even_indices
from gsencoder.fusion.checkpoint import upright
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.types import FeatureMap, Scene

OpenScene = Callable[[Path], tuple[Scene, Teacher]]
"""Reads a scene without making Gaussians, and builds its teacher."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRequest:
    """A number of maps of a scene.

    Attributes:
        path: of the scene.
        count: number of maps, fewer where the scene has fewer views.
        used: views that have been used before.
    """

    path: Path
    count: int
    used: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MapAnswer:
    """What became of a request.

    Attributes:
        views: the views of the maps that were made.
        missing: what the scene lacks, if it lacks what the teacher needs.
    """

    views: tuple[int, ...]
    missing: str | None = None


class MapRounds:
    """Distributes a number of maps over scenes, in rounds: scenes that lack what the teacher needs leave their maps to
    the others, in the next round."""

    def __init__(self, scenes: Sequence[Path], views: int) -> None:
        """Args:
        scenes: all scenes to train on.
        views: number of maps, fewer where the scenes have fewer views.
        """
        self._scenes, self._candidates, self._left = list(scenes), list(scenes), views
        self._used: dict[Path, tuple[int, ...]] = {}
        self._lacking: dict[Path, str] = {}
        self._exhausted: set[Path] = set()

    def requests(self) -> list[MapRequest]:
        """The requests of the next round; none when all maps have been made."""
        if self._left <= 0 or not self._candidates:
            return []
        counts = views_of_scenes(len(self._candidates), self._left)
        return [
            MapRequest(path=path, count=count, used=self._used.get(path, ()))
            for path, count in zip(self._candidates, counts, strict=True)
            if count
        ]

    def record(self, requests: Sequence[MapRequest], answers: Sequence[MapAnswer]) -> None:
        """Takes the answers to the requests of a round into account.

        Raises:
            MissingInput: no scene has what the teacher needs.
        """
        for request, answer in zip(requests, answers, strict=True):
            if answer.views:
                self._used[request.path] = (*request.used, *answer.views)
            if answer.missing is not None:
                self._lacking[request.path] = answer.missing
                continue
            self._left -= len(answer.views)
            if len(answer.views) < request.count:
                self._exhausted.add(request.path)
        if not self._lacking:
            self._candidates = []
            return
        untried = [path for path in self._scenes if path not in self._used and path not in self._lacking]
        again = [path for path in self._used if path not in self._exhausted and path not in self._lacking]
        self._candidates = untried or again
        if not self._candidates and not self._used:
            raise MissingInput(next(iter(self._lacking.values())))


def requested_maps(
    request: MapRequest, open_scene: OpenScene, answers: list[MapAnswer], *, optional: bool = False
) -> Iterator[tuple[Teacher, FeatureMap]]:
    """The maps of a request, evenly spaced beside those that were used before.

    Args:
        request: which maps.
        open_scene: reads the scene.
        answers: gets the answer when all maps have been made.
        optional: a scene that lacks what the teacher needs is answered with what that is.

    Yields:
        The scene's teacher, and a map.

    Raises:
        MissingInput: the scene lacks what the teacher needs, without `optional`.
    """
    views, missing = list[int](), None
    try:
        scene, teacher = open_scene(request.path)
        assert scene.views is not None
        even = even_indices(len(scene.views), len(request.used) + request.count).tolist()
        for view in [view for view in even if view not in request.used][: request.count]:
            yield teacher, upright(teacher).feature_map(scene.views, view)
            views.append(view)
    except MissingInput as error:
        if not optional:
            raise
        missing = str(error)
    answers.append(MapAnswer(views=tuple(views), missing=missing))


def sampled_maps(
    scenes: Sequence[Path], open_scene: OpenScene, views: int, *, optional: bool = False
) -> Iterator[tuple[Path, Teacher, FeatureMap]]:
    """Maps of a dense teacher, evenly distributed over the scenes and their views.

    Args:
        scenes: all scenes to train on.
        open_scene: reads a scene without making Gaussians, and builds its teacher.
        views: number of maps, fewer where the scenes have fewer views.
        optional: leave out scenes that lack what the teacher needs; the others have their shares of the maps.

    Yields:
        The path of a scene, its teacher, and a map.

    Raises:
        MissingInput: a scene lacks what the teacher needs, or with `optional` all do.
    """
    rounds = MapRounds(scenes, views)
    while requests := rounds.requests():
        answers: list[MapAnswer] = []
        for request in requests:
            for teacher, feature_map in requested_maps(request, open_scene, answers, optional=optional):
                yield request.path, teacher, feature_map
        rounds.record(requests, answers)


def views_of_scenes(scenes: int, views: int) -> list[int]:
    """How many of `views` maps are those of each scene, evenly distributed; the first scene has one at least."""
    counts = [int(count) for count in np.diff(np.linspace(0, views, scenes + 1).round())]
    return [max(1, counts[0]), *counts[1:]]
