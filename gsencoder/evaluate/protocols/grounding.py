"""The grounding protocol: how well rendered features show where in a picture the objects of a name are.

In each view of a labeled scene the names of the objects that it shows are looked for in the features, which are
rendered at its pixels. The ground truth is the union of all instances of a name; scores are M3's
(`gsencoder.evaluate.grounding`).
"""

import math
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64, Int32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.grounding import GroundedPair, ground, grounding_scores
from gsencoder.evaluate.rendered_relevancy import RenderedRelevancy
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.text.encoder import TextEncoder, check_space
from gsencoder.types import FeatureMap, FeatureSpace, GaussianFeatures, Scene, SceneObject, Views


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
) -> list[SceneGrounding]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: scenes with labeled objects and instance maps, and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: turns names into the features' space.
        protocol: which names are looked for.
        seeds: how Gaussians are made for scenes without.

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
                "transforms.json) and an objects.json that names them"
            )
        scene, features, seconds = with_features(loaded_scene, source, seeds)
        start = time.perf_counter()
        pairs, small = ground_scene(scene, features, words, protocol)
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
    scene: Scene, features: GaussianFeatures, words: TextEncoder, protocol: GroundingProtocol = GroundingProtocol()
) -> tuple[list[GroundedPair], int]:
    """Looks for the names of a scene's objects in features of its Gaussians, in each view that shows them.

    Returns:
        The pairs, view by view, and the number of pairs that were left out because they have too few pixels.

    Raises:
        InputError: the words are of another space, or do not have a name.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    assert scene.views.instances is not None
    check_space(features.space, words.space)
    ids = ids_by_name(scene.objects, furniture=protocol.furniture)
    if not ids:
        return [], 0
    relevancy = RenderedRelevancy(features, words.encode(list(ids)), words.mean)
    pairs, small = [], 0
    for view, name in enumerate(scene.views.names):
        instances = scene.views.instances[view]
        masks, left_out = masks_of(instances, ids, protocol)
        small += left_out
        if not masks:
            continue
        maps = relevancy.maps(_blend_at(scene, scene.views, view, protocol.stride))
        rows = {phrase: row for row, phrase in enumerate(ids)}
        pairs += [ground(maps[rows[phrase]], mask, view=name, phrase=phrase) for phrase, mask in masks.items()]
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
    first = protocol.stride // 2
    masks, small = {}, 0
    for name, values in ids.items():
        whole = np.isin(instances, values)
        mask = whole[first :: protocol.stride, first :: protocol.stride]
        if whole.sum() >= protocol.min_pixels and mask.any():
            masks[name] = mask
        elif whole.any():
            small += 1
    return masks, small


def _blend_at(scene: Scene, views: Views, view: int, stride: int) -> Blend:
    """The blending weights of every stride-th pixel of a view, from the stride // 2-th on."""
    assert scene.gaussians is not None
    if stride == 1:
        return blend(scene.gaussians, views.cameras, view)
    first = stride // 2
    width, height = (
        len(range(first, int(side[view]), stride)) for side in (views.cameras.widths, views.cameras.heights)
    )
    # A blend takes its grid from a map; the center of a cell is that of the pixel.
    cells = FeatureMap(
        grid_from_image=pixel_affine(stride),
        space=FeatureSpace(name="grid", channels=1),
        features=np.zeros((height, width, 1), np.float32),
    )
    return blend(scene.gaussians, views.cameras, view, like=cells, config=BlendConfig(rays_per_patch=1))


def pixel_affine(stride: int) -> Float64[np.ndarray, "2 3"]:
    """From pixels to a grid whose cell (r, c) has the middle of pixel (stride·r + stride // 2, …) as its middle."""
    offset = 0.5 - (stride // 2 + 0.5) / stride
    return np.array([[1 / stride, 0, offset], [0, 1 / stride, offset]])


def scores_by_phrase(pairs: Sequence[GroundedPair]) -> dict[str, dict[str, Any]]:
    """The scores of each phrase separately, in ascending order of mean IoU."""
    phrases: dict[str, list[GroundedPair]] = {}
    for pair in pairs:
        phrases.setdefault(pair.phrase, []).append(pair)
    table = {phrase: asdict(grounding_scores(group)) for phrase, group in phrases.items()}
    return dict(sorted(table.items(), key=lambda item: (item[1]["miou"], item[0])))


def phrase_mean(table: dict[str, dict[str, Any]]) -> float:
    """Mean over phrases of their mean IoU: each name counts the same, in however many views it is; NaN without any."""
    return float(np.mean([row["miou"] for row in table.values()])) if table else math.nan
