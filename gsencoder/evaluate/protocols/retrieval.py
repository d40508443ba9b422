"""The retrieval protocol: whether rendered views and their captions have each other's best scores (M3 table 2).

The score of a view with a text is the largest cosine of its pixels with the text, or their mean
(`gsencoder.evaluate.benchmarks.retrieval`). Texts are the captions of all views, and distractors where a file has them.
"""

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, listed
from gsencoder.data.labels.captions import ViewCaption
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.retrieval import Pooling
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.infer.pictures import pixel_features
from gsencoder.infer.relevancy import GaussianProducts, Mode, word_directions
from gsencoder.render import blend
from gsencoder.text.table import TextEncoder, check_space
from gsencoder.types import GaussianFeatures, QueryMemory, Scene

BLOCK_TEXTS = 64
"""Texts whose cosines with all pixels of a view are in memory at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrievalProtocol:
    """Which texts belong to views, and how both are compared."""

    name: Literal["retrieval"] = "retrieval"
    captions: str = field(default="", metadata={"help": "JSON: a list of {scene_id, view, caption}"})
    distractors: str = field(
        default="",
        metadata={"help": "texts of other pictures, one a line; empty = the pool of a view is the other views' texts"},
    )
    count: int = field(default=0, metadata={"help": "of these, texts in a view's pool, drawn by its name; 0 = all"})
    seed: int = field(default=0, metadata={"help": "of their draw"})
    stride: int = field(
        default=4, metadata={"help": "pixels from one rendered pixel to the next, along both sides of a view"}
    )
    pooling: Pooling = field(default="max", metadata={"help": "of the cosines of a view's pixels: max (M3) or mean"})
    mode: Mode = field(
        default="centered", metadata={"help": "cosines less the mean of features and words, or raw as in M3"}
    )

    def __post_init__(self) -> None:
        for name, least in (("stride", 1), ("count", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneRetrieval:
    """The result of the protocol on one scene.

    Attributes:
        scene: name of the scene.
        captions: of its views, in the order of the file.
        scores: of these views with all texts.
        gaussians: number of Gaussians.
        seconds: seconds of each step.
    """

    scene: str
    captions: tuple[ViewCaption, ...]
    scores: Float64[np.ndarray, "Q T"]
    gaussians: int
    seconds: dict[str, float]


def evaluate_retrieval(
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    words: TextEncoder,
    captions: Sequence[ViewCaption],
    texts: Sequence[str],
    *,
    protocol: RetrievalProtocol = RetrievalProtocol(),
    seeds: SeedConfig = SeedConfig(),
    memory_of: Callable[[Scene], QueryMemory | None] = lambda _: None,
) -> list[SceneRetrieval]:
    """Scores the views of each scene that have captions with all texts; one scene is in memory at a time.

    Args:
        scenes: scenes with views, and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: turns texts into the features' space.
        captions: of views; those of other scenes are passed over.
        texts: that views are compared with.
        protocol: how they are compared.
        seeds: how Gaussians are made for scenes without.
        memory_of: the memory that the features of a scene come from, or None where there is none.

    Raises:
        InputError: a scene without views or without a view that has a caption, or texts that `words` does not know.
    """
    directions = word_directions(words.encode(list(texts)), words.mean, protocol.mode)
    results = []
    for loaded, load_seconds in scenes:
        of_scene = tuple(each for each in captions if each.scene == loaded.name)
        rows = views_of(loaded, of_scene)
        scene, features, seconds = with_features(loaded, source, seeds)
        check_space(features.space, words.space)
        start = time.perf_counter()
        scores = score_views(scene, features, rows, directions, protocol, memory=memory_of(scene))
        seconds = {"load": load_seconds, **seconds, "retrieve": time.perf_counter() - start}
        results.append(
            SceneRetrieval(scene=scene.name, captions=of_scene, scores=scores, gaussians=len(features), seconds=seconds)
        )
    return results


def views_of(scene: Scene, captions: Collection[ViewCaption]) -> list[int]:
    """The numbers of the views that captions are about.

    Raises:
        InputError: the scene has no views, there is no caption, or captions are about views that it does not have.
    """
    names = [] if scene.views is None else list(scene.views.names)
    if not names or not captions:
        lacking = "views" if not names else "a caption of one of its views in protocol.captions="
        raise InputError(f"retrieval: scene {scene.name} needs {lacking}")
    unknown = [each.view for each in captions if each.view not in names]
    if unknown:
        raise InputError(
            f"retrieval: scene {scene.name} has no view called {listed(unknown, 3)}; its views are {listed(names, 3)}"
        )
    return [names.index(each.view) for each in captions]


def score_views(
    scene: Scene,
    features: GaussianFeatures,
    views: Sequence[int],
    directions: Float64[np.ndarray, "T D"],
    protocol: RetrievalProtocol = RetrievalProtocol(),
    *,
    memory: QueryMemory | None = None,
) -> Float64[np.ndarray, "Q T"]:
    """The scores of views with texts; NaN of a view that shows no Gaussian with a feature.

    Args:
        scene: Gaussians and views.
        features: of the Gaussians.
        views: their numbers.
        directions: of the texts, unit vectors (`word_directions`).
        protocol: how they are compared.
        memory: that the features come from; its queries are rendered, and attend to its bank at each pixel.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    products = GaussianProducts(features, protocol.mode)
    scores = np.full((len(views), len(directions)), np.nan)
    for row, view in enumerate(views):
        b = blend(scene.gaussians, scene.views.cameras, view, stride=protocol.stride)
        pixels = pixel_features(products, b, memory=memory, mode=protocol.mode)
        covered = pixels.alpha > 0
        if not covered.any():
            continue
        for start in range(0, len(directions), BLOCK_TEXTS):
            block = slice(start, start + BLOCK_TEXTS)
            cosines = np.clip(pixels.cosines(directions[block])[:, covered], -1, 1)
            scores[row, block] = cosines.max(axis=1) if protocol.pooling == "max" else cosines.mean(axis=1)
    return scores
