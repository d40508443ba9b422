"""A scene as the page takes it: the splat, colors, cameras, settings, and for a file the features and the words."""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.fusion.quantize import compact
from gsencoder.infer.localize import presence
from gsencoder.infer.localize.relevancy import feature_axes, word_directions
from gsencoder.infer.viewer.container import Container
from gsencoder.infer.viewer.search import SceneSearch
from gsencoder.infer.viewer.shown import object_numbers, pca_bytes, spz_bytes, weight_bytes
from gsencoder.types import SceneObject, Views

OBJECT_MARGIN = 0.5
"""Boxes of objects are enlarged by this many spacings before it is asked which Gaussians they hold."""
WORD_STEP = 1 / 32767
"""Words are written in such steps, as 16-bit integers."""
PHOTO_QUALITY = 82


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOptions:
    """What a page that is one file holds.

    Attributes:
        error: budget of the quantized features, as of `pack`.
        sh_degree: largest degree of spherical harmonics.
        photographs: at most so many; 0 = none.
        photograph_side: their longer side, pixels.
    """

    error: float
    sh_degree: int
    photographs: int
    photograph_side: int


def scene_container(search: SceneSearch, objects: tuple[SceneObject, ...], *, sh_degree: int = 3) -> Container:
    """What a page needs of a scene whose words a server answers.

    Args:
        search: over the scene.
        objects: labeled ones with boxes in world coordinates; may be empty.
        sh_degree: largest degree of spherical harmonics.
    """
    shown, config = search.shown, search.config
    scene, gaussians, features = shown.scene, shown.gaussians, shown.features
    codes, lightest, heaviest = weight_bytes(features.weights)
    splat = np.frombuffer(spz_bytes(gaussians, sh_degree=sh_degree), np.uint8)
    meta: dict[str, Any] = {
        "name": scene.name,
        "title": shown.title,
        "space": features.space.describe(),
        "count": len(gaussians),
        "total": shown.total,
        "notes": list(shown.notes),
        "origin": scene.origin,
        "up": scene.up,
        "metresPerUnit": scene.metres_per_unit,
        "spacing": search.spacing,
        "shDegree": min(sh_degree, gaussians.sh_degree),
        "weights": [lightest, heaviest],
        "views": [] if scene.views is None else list(scene.views.names),
        "photographs": scene.views is not None and scene.views.images is not None,
        "words": [] if search.table is None else list(search.table.names),
        "localize": {
            "eps": config.radius(search.spacing),
            "followsGaps": config.follows_gaps,
            "minSamples": config.min_samples,
            "minShare": config.min_share,
            "minWeight": config.min_weight,
            "maxBoxes": config.max_boxes,
            "minProbability": config.min_probability,
            "threshold": {
                name: getattr(config.threshold, name) for name in ("kind", "fixed", "relative", "noise", "quantile")
            },
        },
        "objects": [each.name or "" for each in objects],
    }
    arrays: dict[str, np.ndarray] = {"splat": splat, "pca": pca_bytes(features), "weights": codes}
    if scene.views is not None:
        cameras = scene.views.cameras
        arrays |= {
            "camFromWorld": cameras.cam_from_world,
            "Ks": cameras.Ks,
            "sizes": np.stack([cameras.widths, cameras.heights], axis=1),
        }
    if objects:
        margin = OBJECT_MARGIN * search.spacing
        arrays["objects"] = object_numbers(gaussians.means, objects, scene.origin, margin)
    return Container(meta=meta, arrays=arrays)


def file_container(search: SceneSearch, objects: tuple[SceneObject, ...], options: FileOptions) -> Container:
    """What a page needs that answers by itself: also quantized features, the vectors of all known words, labels and
    photographs.

    Features are coordinates z of the codes and levels of `gsencoder.fusion.quantize`. The relevancy of the word
    with vector t in `words` is z·t / √(|z|² + floor), since the basis is orthonormal and its mean is what centered
    cosines remove.

    Raises:
        InputError: nothing was seen, or a threshold that pages do not compute.
    """
    if search.config.threshold.kind == "otsu":
        raise InputError("localize.threshold.kind=otsu: a page does not compute it; use another, or leave out= out")
    base = scene_container(search, objects, sh_degree=options.sh_degree)
    compacted = compact(search.shown.features, error=options.error)
    table = search.table
    directions = np.zeros((0, compacted.space.channels))
    if table is not None:
        directions = word_directions(table.embeddings, table.mean)
    seen = np.zeros(compacted.total, bool)
    seen[compacted.rows] = True
    labels = search.labels()
    words = directions @ compacted.basis.components.astype(np.float64).T
    likeness = directions @ directions.T
    near = {
        str(row): np.flatnonzero(likeness[row] >= presence.SYNONYM).tolist()
        for row in np.flatnonzero((likeness >= presence.SYNONYM).sum(axis=1) > 1).tolist()
    }
    views = search.shown.scene.views
    photographs, listed = photograph_bytes(views, options)
    meta = {
        **base.meta,
        "rank": compacted.basis.rank,
        "floor": feature_axes(search.shown.features).floor,
        "featureError": compacted.error,
        "synonyms": near,
        "trained": None if table is None or table.trained is None else [table.is_trained(name) for name in table.names],
        "presence": {
            "unknown": dict(presence.WITH_RIVALS),
            "trained": dict(presence.TRAINED),
            "untrained": dict(presence.UNTRAINED),
            "smallestSpread": presence.SMALLEST_SPREAD,
        },
        "labels": list(labels.names),
        "photographs": bool(listed),
        "photographViews": listed,
        "photographSizes": [len(each) for each in photographs],
    }
    arrays = {
        **base.arrays,
        "codes": compacted.codes,
        "bits": compacted.bits,
        "levels": compacted.levels,
        "seen": np.packbits(seen),
        "wordVectors": np.rint(words / WORD_STEP).astype(np.int16),
        "labels": labels.numbers,
    }
    if photographs:
        arrays["photographs"] = np.concatenate(photographs)
    return Container(meta=meta, arrays=arrays)


def photograph_bytes(views: Views | None, options: FileOptions) -> tuple[list[UInt8[np.ndarray, " n"]], list[int]]:
    """Photographs as small JPEGs, evenly spaced where there are more than a page holds, and their views."""
    if views is None or views.images is None or not options.photographs:
        return [], []
    listed = even_indices(len(views), options.photographs).tolist()
    return [np.frombuffer(jpeg_of(views, view, options.photograph_side), np.uint8) for view in listed], listed


def jpeg_of(views: Views, view: int, side: int) -> bytes:
    """The photograph of a view as JPEG, its longer side at most `side` pixels.

    Raises:
        InputError: the scene has no photographs, or no such view.
    """
    if views.images is None or not 0 <= view < len(views):
        raise InputError(f"photograph: expected one of {len(views)} views with photographs, got {view}")
    image = Image.fromarray(np.ascontiguousarray(views.images[view]))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=PHOTO_QUALITY)
    return stream.getvalue()
