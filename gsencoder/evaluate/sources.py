"""Sources of the features to evaluate: fusion of a teacher's maps, or an encoder.

Points with a true object each, and the Gaussians that speak for them.

Benchmarks count points of a scan. Where a scene has a labeled mesh, the points are its vertices: a mask or a feature
reaches each vertex from the nearest Gaussian, a class from a vote of the nearest ones. Where a scene has instance
pictures instead, the points are the Gaussians themselves, and the object of each is the instance on whose pixels most
of its blending weight falls, less what measured depth says is hidden.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.process import Clock
from gsencoder.data.labels.mesh import nearest_rows
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.basis import sample_cells
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import VisibilityConfig, keep_visible
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, head_features, measure_heads
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.relevancy import relevancy
from gsencoder.render import blend
from gsencoder.teachers.base import Head
from gsencoder.teachers.build import TeacherConfig
from gsencoder.text.table import TextEncoder, TextTable, check_space
from gsencoder.text.vocabulary import Words
from gsencoder.types import GaussianFeatures, MeshLabels, Scene

FeatureSource = Callable[[Scene], tuple[GaussianFeatures, dict[str, float]]]
"""A function from a scene with Gaussians to their features and the seconds of each step."""


def fusion_source(teacher: TeacherConfig, words: Words | None, config: FuseConfig = FuseConfig()) -> FeatureSource:
    """A source that fuses a teacher's maps; `words` are those of the teacher, if it has any."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        with Clock().running() as clock:
            features = fuse(scene, teacher.build(scene, words), config).features
        return features, clock.seconds

    return source


def encoder_source(encoder: Encoder, config: EncodeConfig = EncodeConfig(), space: str | None = None) -> FeatureSource:
    """A source that runs an encoder; `space` is one of several teachers, None = the only one."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        assert scene.gaussians is not None
        start = time.perf_counter()
        unit = unit_of(scene)
        features = encoder.encode(scene.gaussians, config, space=space, metres_per_unit=unit, up=scene.up)
        return features, {"encode": time.perf_counter() - start}

    return source


def space_of_words(encoder: Encoder, words: Words) -> str | None:
    """The teacher of an encoder in whose space words are; None if it has one teacher."""
    if len(encoder.spaces) == 1:
        return None
    text_encoder = words.space.text_encoder
    fitting = [name for name, space in encoder.spaces.items() if space.text_encoder == text_encoder]
    if len(fitting) != 1:
        listing = "; ".join(f"{name}: {space.describe()}" for name, space in encoder.spaces.items())
        raise InputError(
            f"the words of {text_encoder} are those of {len(fitting)} of the encoder's teachers ({listing}); give the "
            "words of one (teacher.words= or text=), or name it with space="
        )
    return fitting[0]


def find_table(encoder: Encoder, space: str | None) -> TextTable | None:
    """The text table stored with an encoder: that of a teacher, or without a name the first one."""
    return encoder.tables.get(space) if space else encoder.words


def head_source(source: FeatureSource, heads: HeadSet, head: MeasuredHead, text_encoder: str) -> FeatureSource:
    """A source that applies one of some adapter heads to backbone features; `text_encoder` is that of its space."""

    def outputs(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        features, seconds = source(scene)
        start = time.perf_counter()
        through = head_features(features, head, heads.space, text_encoder=text_encoder)
        return through, {**seconds, "head": time.perf_counter() - start}

    return outputs


def fused_head_source(
    teacher: TeacherConfig, head: Head, text_encoder: str, config: FuseConfig = FuseConfig()
) -> FeatureSource:
    """A source that fuses a teacher's maps, measures an adapter head over them, and applies it."""

    def outputs(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        assert scene.views is not None
        with Clock().running() as clock:
            fusion = fuse(scene, teacher.build(scene, None), config)
        start, sample = time.perf_counter(), sample_cells(fusion.teacher, scene.views, fusion.views)
        heads = measure_heads([head], sample.vectors(), fusion.features.space, fusion.features.basis)
        through = head_features(fusion.features, heads.heads[0], heads.space, text_encoder=text_encoder)
        return through, {**clock.seconds, "head": time.perf_counter() - start}

    return outputs


def with_features(
    scene: Scene, source: FeatureSource, seeds: SeedConfig
) -> tuple[Scene, GaussianFeatures, dict[str, float]]:
    """A scene with Gaussians, which are seeded where it has none, their features, and the seconds of each step."""
    start = time.perf_counter()
    scene = with_gaussians(scene, seeds)
    seconds = {"seeds": time.perf_counter() - start}
    features, source_seconds = source(scene)
    return scene, features, seconds | source_seconds


MIN_WEIGHT = 1.0
"""Pixels that a Gaussian must cover in all views together for its label to count."""
MAX_DISTANCE = 0.1
"""Metres from a vertex to the nearest Gaussian, beyond which nothing is predicted for it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabeledPoints:
    """Points of a scene.

    Attributes:
        objects: id of the object of each point, 0 = none.
        names: the class of each object that has one, by its id.
        gaussians: row of the Gaussian that each point takes predictions from, -1 = none is near.
        positions: of vertices, in the frame of the Gaussians; None where the points are the Gaussians themselves.
    """

    scene: str
    objects: Int32[np.ndarray, " P"]
    names: Mapping[int, str]
    gaussians: Int64[np.ndarray, " P"]
    positions: Float64[np.ndarray, "P 3"] | None = None

    def __len__(self) -> int:
        return len(self.objects)

    def named_ids(self) -> dict[int, str]:
        """The classes of the objects that have points, by their id in ascending order."""
        present = np.unique(self.objects)
        return {int(number): self.names[int(number)] for number in present if int(number) in self.names}

    def renamed(self, names: Mapping[str, str]) -> "LabeledPoints":
        """The points with other class names; objects whose name is not a key have no class."""
        return replace(self, names={number: names[name] for number, name in self.names.items() if name in names})

    def rows_of(self, number: int) -> Int64[np.ndarray, " n"]:
        """The Gaussians that speak for the points of an object, ascending, each once."""
        rows = np.unique(self.gaussians[self.objects == number])
        return rows[rows >= 0]

    def masked(self, rows: Int64[np.ndarray, " n"], count: int) -> Bool[np.ndarray, " P"]:
        """Which points take their prediction from some of `count` Gaussians."""
        inside = np.zeros(count + 1, bool)
        inside[rows] = True
        return inside[self.gaussians]


def labeled_points(scene: Scene, mesh: MeshLabels | None = None) -> LabeledPoints:
    """The labeled points of a scene with Gaussians: the vertices of a mesh in the world of the scene, or without one
    the Gaussians, by views with instance pictures, and objects."""
    gaussians, views = scene.gaussians, scene.views
    if gaussians is None:
        raise InputError(f"scene {scene.name} has no Gaussians")
    if mesh is not None:
        positions = mesh.vertices.astype(np.float64) - scene.origin
        max_distance = MAX_DISTANCE / (scene.metres_per_unit or 1.0)
        nearest = nearest_rows(positions, gaussians.means.astype(np.float64), max_distance=max_distance)
        return LabeledPoints(
            scene=scene.name,
            objects=mesh.instances,
            names=dict(mesh.objects),
            gaussians=nearest,
            positions=positions,
        )
    if views is None or views.instances is None or not scene.objects:
        raise InputError(
            f"scene {scene.name} has no true objects: expected a labeled mesh, or views with instance pictures "
            "(instance_file_path in transforms.json) and an objects.json that names them"
        )
    ids = np.array(sorted({each.id for each in scene.objects}), np.int32)
    sums = torch.zeros(len(gaussians), len(ids) + 1)
    for view in range(len(views)):
        b = blend(gaussians, views.cameras, view)
        if views.depths is not None:
            b = keep_visible(b, views.depths[view], VisibilityConfig())
        # Column 0 is for pixels of no object.
        pixels = np.asarray(views.instances[view]).ravel()
        columns = np.where(np.isin(pixels, ids), np.searchsorted(ids, pixels) + 1, 0)
        b.lift_codes_into(torch.from_numpy(columns.astype(np.int32)), sums)
    best = np.concatenate([[0], ids])[sums.argmax(dim=1).numpy()]
    return LabeledPoints(
        scene=scene.name,
        objects=np.where(sums.sum(dim=1).numpy() >= MIN_WEIGHT, best, 0).astype(np.int32),
        names={each.id: each.name for each in scene.objects if each.name},
        gaussians=np.arange(len(gaussians)),
    )


NAMES_AT_ONCE = 16
"""Classes whose cosines with all Gaussians are in memory together."""


def nearest_class(features: GaussianFeatures, names: Sequence[str], text: TextEncoder) -> Int64[np.ndarray, " N"]:
    """The class whose name has the largest centered cosine with each Gaussian's feature, of equal ones the first.

    Returns:
        Number of the class in `names`; -1 for Gaussians without a feature.
    """
    check_space(features.space, text.space)
    vectors = text.encode(list(names))
    best = np.full(len(features), -np.inf, np.float32)
    classes = np.full(len(features), -1, np.int64)
    for start in range(0, len(names), NAMES_AT_ONCE):
        scores = relevancy(features, vectors[start : start + NAMES_AT_ONCE], text.mean)
        # Comparisons with NaN are false: Gaussians never seen have no class.
        for number, row in enumerate(scores, start=start):
            better = row > best
            best[better], classes[better] = row[better], number
    return classes


def class_cosines(
    features: GaussianFeatures, parts: Sequence[Int64[np.ndarray, " _"]], names: Sequence[str], text: TextEncoder
) -> Float32[np.ndarray, "M C"]:
    """Centered cosines of the mean feature of some sets of Gaussians with the names of classes.

    The mean of a set is over its Gaussians that were seen, each counting the same; NaN where none was.
    """
    check_space(features.space, text.space)
    seen = features.seen
    means = np.zeros((len(parts), features.features.shape[1]), np.float32)
    counts = np.zeros(len(parts), np.float32)
    for number, part in enumerate(parts):
        rows = part[seen[part]]
        counts[number] = len(rows)
        if len(rows):
            means[number] = features.stored(rows).mean(axis=0, dtype=np.float64)
    # A mean of coordinates is the coordinates of the mean.
    of_sets = replace(features, features=means, weights=counts, index=None, confidence=None)
    return relevancy(of_sets, text.encode(list(names)), text.mean).T


EPS = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedErrors:
    """Means over the cells of all pictures: cosine (M3 prints 1 − cosine), centered: after the mean of the space has
    been subtracted from both, and l2: squared distance, averaged over channels. Pictures with a feature that is not
    finite are left out, and counted."""

    cosine: float
    centered: float
    l2: float
    cells: int
    pictures: int
    not_finite: int


class RenderedTally:
    """Adds up the errors of pictures, about the mean of the space."""

    def __init__(self, mean: Float32[np.ndarray, " D"]) -> None:
        self._mean = mean
        self._sums, self._cells, self._pictures, self._not_finite = np.zeros(3), 0, 0, 0

    def add(self, predicted: Float32[np.ndarray, "n D"], target: Float32[np.ndarray, "n D"]) -> None:
        """Takes the cells of one picture."""
        if not (np.isfinite(predicted).all() and np.isfinite(target).all()):
            self._not_finite += 1
            return
        difference = predicted.astype(np.float64) - target
        self._sums += (
            _cosines(predicted, target).sum(),
            _cosines(predicted - self._mean, target - self._mean).sum(),
            (difference**2).mean(axis=1).sum() if len(target) else 0.0,
        )
        self._cells, self._pictures = self._cells + len(target), self._pictures + 1

    def errors(self) -> RenderedErrors:
        """The means; NaN where no cell was compared."""
        means = self._sums / self._cells if self._cells else np.full(3, np.nan)
        cosine, centered, l2 = means.tolist()
        counts = {"cells": self._cells, "pictures": self._pictures, "not_finite": self._not_finite}
        return RenderedErrors(cosine=cosine, centered=centered, l2=l2, **counts)


def _cosines(a: Float32[np.ndarray, "n D"], b: Float32[np.ndarray, "n D"]) -> np.ndarray:
    first, second = a.astype(np.float64), b.astype(np.float64)
    products = (first * second).sum(axis=1)
    return np.asarray(products / np.sqrt(((first**2).sum(axis=1) + EPS) * ((second**2).sum(axis=1) + EPS)))
