"""Localizations as JSON values."""

from collections import Counter
from typing import Any

from gsencoder.types import Box, Localization


def localization_to_json(localization: Localization) -> list[dict[str, Any]]:
    """The boxes as JSON values, best first within each word; see `box_to_json`."""
    return [box_to_json(box) for box in localization.boxes]


def box_to_json(box: Box) -> dict[str, Any]:
    """A box as JSON values, in world coordinates with the origin added back.

    It has query, rank, score, probability, aabb_min, aabb_max, center, count (of its Gaussians) and obb: center,
    rotation (rows of the matrix whose columns are the box's axes) and size.
    """
    return {
        "query": box.query,
        "rank": box.rank,
        "score": box.score,
        "probability": box.probability,
        "aabb_min": box.aabb_min.tolist(),
        "aabb_max": box.aabb_max.tolist(),
        "center": box.center.tolist(),
        "count": len(box.rows),
        "obb": {
            "center": box.obb_center.tolist(),
            "rotation": box.obb_rotation.tolist(),
            "size": box.obb_size.tolist(),
        },
    }


def words_to_json(localization: Localization) -> list[dict[str, Any]]:
    """What is known of each word as JSON values: query, probability, absent, threshold and its number of boxes."""
    counts = Counter(box.query for box in localization.boxes)
    return [
        {
            "query": word,
            "probability": float(probability),
            "absent": not counts[word],
            "threshold": float(cutoff),
            "boxes": counts[word],
        }
        for word, probability, cutoff in zip(
            localization.queries, localization.probabilities, localization.thresholds, strict=True
        )
    ]
