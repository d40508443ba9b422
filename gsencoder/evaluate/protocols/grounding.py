"""The grounding protocol: how well rendered features show where in a picture the objects of a name are.

In each view of a labeled scene the names of the objects that it shows are looked for in the features, which are
rendered at its pixels. The ground truth is the union of all instances of a name; scores are M3's
(`gsencoder.evaluate.grounding`).
"""

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.grounding import GroundedPair, ground, grounding_scores
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.evaluate.tables import mean_of
from gsencoder.infer.pictures import pixel_features
from gsencoder.infer.relevancy import GaussianProducts, word_directions
from gsencoder.render import blend
from gsencoder.render.rays import strided_lattice
from gsencoder.text.table import TextEncoder, check_space
from gsencoder.types import GaussianFeatures, QueryMemory, Scene, SceneObject


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundingProtocol:
    """Selection of the pairs of a view and a name, and of the pixels that are compared."""

    name: Literal["grounding"] = "grounding"
    stride: int = field(
        default=1, metadata={"help": "pixels from one rendered pixel to the next, along both sides of a view"}
    )
    min_pixels: int = field(
        default=60, metadata={"help": "smallest area that the objects of a name must have in a view to be looked for"}
    )
    furniture: bool = field(
        default=True, metadata={"help": "whether furniture is looked for, and not the small objects alone"}
    )

    def __post_init__(self) -> None:
        for name in ("stride", "min_pixels"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneGrounding:
    """The result of the protocol on one scene.

    Attributes:
        scene: name of the scene.
        pairs: of its views and the names of what they show.
        small: pairs that were left out because the objects of the name have too few pixels in the view.
        views: number of views.
        gaussians: number of Gaussians.
        seconds: seconds of each step.
    """

    scene: str
    pairs: tuple[GroundedPair, ...]
    small: int
    views: int
    gaussians: int
    seconds: dict[str, float]


def evaluate_grounding(
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    words: TextEncoder,
    *,
    protocol: GroundingProtocol = GroundingProtocol(),
    seeds: SeedConfig = SeedConfig(),
    memory_of: Callable[[Scene], QueryMemory | None] = lambda _: None,
) -> list[SceneGrounding]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: scenes with labeled objects and instance maps, and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: turns names into the features' space.
        protocol: which names are looked for.
        seeds: how Gaussians are made for scenes without.
        memory_of: the memory that the features of a scene come from, or None where there is none. Its queries are
            rendered, and attend to its bank at each pixel.

    Returns:
        One result per scene, in order.

    Warns:
        SceneWarning: scenes have no pair.

    Raises:
        InputError: a scene cannot be used, a name is unknown to `words`, or no scene has a pair.
    """
    results = []
    for loaded_scene, load_seconds in scenes:
        views = loaded_scene.views
        if views is None or views.instances is None or not loaded_scene.objects:
            raise InputError(
                f"grounding: scene {loaded_scene.name} needs views with instance maps (instance_file_path in "
                "transforms.json) and an objects.json that names them, or the label files of ScanNet or ScanNet++"
            )
        scene, features, seconds = with_features(loaded_scene, source, seeds)
        start = time.perf_counter()
        pairs, small = ground_scene(scene, features, words, protocol, memory=memory_of(scene))
        seconds = {"load": load_seconds, **seconds, "ground": time.perf_counter() - start}
        results.append(
            SceneGrounding(
                scene=scene.name,
                pairs=tuple(pairs),
                small=small,
                views=len(views),
                gaussians=len(features),
                seconds=seconds,
            )
        )
    empty = [result.scene for result in results if not result.pairs]
    if len(empty) == len(results):
        raise InputError(
            f"grounding: no view of {len(results)} scenes shows a named object with {protocol.min_pixels} pixels "
            f"({sum(result.small for result in results)} have fewer); lower protocol.min_pixels, or name objects"
        )
    if empty:
        warnings.warn(
            f"{len(empty)} of {len(results)} scenes show no named object with {protocol.min_pixels} pixels (first: "
            f"{empty[0]!r})",
            SceneWarning,
            stacklevel=2,
        )
    return results


def ground_scene(
    scene: Scene,
    features: GaussianFeatures,
    words: TextEncoder,
    protocol: GroundingProtocol = GroundingProtocol(),
    *,
    memory: QueryMemory | None = None,
) -> tuple[list[GroundedPair], int]:
    """Looks for the names of a scene's objects in features of its Gaussians, in each view that shows them.

    Pixels that show no Gaussian with a feature have a relevancy of 0.

    Args:
        scene: Gaussians, views with instance maps, and objects.
        features: of the Gaussians.
        words: turns names into the features' space.
        protocol: which names are looked for.
        memory: that the features come from; see `evaluate_grounding`.

    Returns:
        The pairs, view by view, and the number of pairs that were left out because they have too few pixels.

    Raises:
        InputError: the words are of another space, or do not have a name; features of other Gaussians.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    assert scene.views.instances is not None
    check_space(features.space, words.space)
    ids = ids_by_name(scene.objects, furniture=protocol.furniture)
    if not ids:
        return [], 0
    directions = dict(zip(ids, word_directions(words.encode(list(ids)), words.mean), strict=True))
    products = GaussianProducts(features)
    pairs, small = [], 0
    for view, name in enumerate(scene.views.names):
        masks, left_out = masks_of(scene.views.instances[view], ids, protocol)
        small += left_out
        if not masks:
            continue
        b = blend(scene.gaussians, scene.views.cameras, view, stride=protocol.stride)
        pixels = pixel_features(products, b, memory=memory)
        cosines = np.clip(pixels.cosines(np.stack([directions[phrase] for phrase in masks])), -1, 1)
        maps = np.where(pixels.alpha > 0, cosines, 0).reshape(-1, *b.shape)
        pairs += [
            ground(relevancy, mask, view=name, phrase=phrase)
            for (phrase, mask), relevancy in zip(masks.items(), maps, strict=True)
        ]
    return pairs, small


def ids_by_name(objects: Sequence[SceneObject], *, furniture: bool = True) -> dict[str, list[int]]:
    """The values in instance maps of the objects of each name, in alphabetical order of the names."""
    ids: dict[str, list[int]] = {}
    for each in objects:
        if each.name and (furniture or each.placed):
            ids.setdefault(each.name, []).append(each.id)
    return dict(sorted(ids.items()))


def masks_of(
    instances: Int32[np.ndarray, "H W"], ids: dict[str, list[int]], protocol: GroundingProtocol
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], int]:
    """The mask of each name in a view at the rendered pixels, and the number of names that it shows with too few.

    Names that the view does not show are neither. A mask that has pixels, but none of those that are rendered, has too
    few.
    """
    lattice = strided_lattice(instances.shape[1], instances.shape[0], protocol.stride)
    rows, columns = (slice(int(first), None, protocol.stride) for first in (lattice.y0, lattice.x0))
    masks, small = {}, 0
    for name, values in ids.items():
        full_mask = np.isin(instances, values)
        mask = full_mask[rows, columns]
        if full_mask.sum() >= protocol.min_pixels and mask.any():
            masks[name] = mask
        elif full_mask.any():
            small += 1
    return masks, small


def scores_by_phrase(pairs: Sequence[GroundedPair]) -> dict[str, dict[str, Any]]:
    """The scores of each phrase separately, in ascending order of mean IoU."""
    phrases: dict[str, list[GroundedPair]] = {}
    for pair in pairs:
        phrases.setdefault(pair.phrase, []).append(pair)
    table = {phrase: asdict(grounding_scores(group)) for phrase, group in phrases.items()}
    return dict(sorted(table.items(), key=lambda item: (item[1]["miou"], item[0])))


def phrase_mean(table: dict[str, dict[str, Any]]) -> float:
    """Mean over phrases of their mean IoU: each name counts the same, in however many views it is; NaN without any."""
    return mean_of([row["miou"] for row in table.values()])
