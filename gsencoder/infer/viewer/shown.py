"""What a page shows of a scene: its Gaussians, thinned where there are too many, as arrays for the page."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64, UInt8, UInt16

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.data.splats.packed import write_spz
from gsencoder.data.splats.raw import RawSplat, logits_from_opacities, logs_from_scales
from gsencoder.infer.draw.pictures import fit_pca_colors, pca_picture
from gsencoder.infer.localize.localize import select_features
from gsencoder.types import GaussianFeatures, Gaussians, Scene, SceneObject

NO_OBJECT = 0
"""Number of the object of Gaussians that lie in no object's box; the others are numbered from 1."""
GREY = 90
"""Color of Gaussians that were never seen, in red, green and blue."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownScene:
    """A scene with one feature set, as it is drawn.

    Attributes:
        scene: its Gaussians, and the features under the name of their space alone.
        title: for people; the name of the folder.
        total: Gaussians before thinning.
        notes: what was left out or changed, a sentence each.
    """

    scene: Scene
    title: str
    total: int
    notes: tuple[str, ...]

    @property
    def gaussians(self) -> Gaussians:
        assert self.scene.gaussians is not None
        return self.scene.gaussians

    @property
    def features(self) -> GaussianFeatures:
        return next(iter(self.scene.features.values()))


def drawn_scene(scene: Scene, title: str, *, max_gaussians: int, advice: str = "") -> ShownScene:
    """A scene with at most so many Gaussians, evenly chosen and enlarged so that surfaces stay closed.

    Args:
        scene: with one feature set, or one that words lead into.
        title: for people.
        max_gaussians: at least 1.
        advice: what a note about thinning ends with.

    Raises:
        InputError: no Gaussians, no features, or several feature sets.
    """
    gaussians, features = select_features(scene, None)
    total = len(gaussians)
    notes: list[str] = []
    if total > max_gaussians:
        rows = even_indices(total, max_gaussians)
        # The area that a Gaussian covers grows as fast as their number falls.
        factor = np.float32(np.sqrt(total / len(rows)))
        gaussians = gaussians.select(rows)
        gaussians = replace(gaussians, scales=gaussians.scales * factor)
        features = rows_of_features(features, rows)
        notes.append(
            f"{len(rows):,} of {total:,} Gaussians are drawn and searched: evenly chosen, and enlarged {factor:.2f} "
            f"times. {advice or f'max_gaussians={total} takes all, a smaller number draws faster'}."
        )
    unseen = int((~features.seen).sum())
    if unseen:
        notes.append(f"{unseen:,} Gaussians were seen by no view and have no features; they are grey.")
    chosen = replace(scene, gaussians=gaussians, features={features.space.name: features})
    return ShownScene(scene=chosen, title=title, total=total, notes=tuple(notes))


def rows_of_features(features: GaussianFeatures, rows: Int64[np.ndarray, " n"]) -> GaussianFeatures:
    """The features of some Gaussians, in that order; a table that Gaussians share stays whole."""
    if features.index is not None:
        return replace(features, index=features.index[rows], weights=features.weights[rows])
    return replace(features, features=features.features[rows], weights=features.weights[rows])


def spz_bytes(gaussians: Gaussians, *, sh_degree: int = 3) -> bytes:
    """The splat as a file of .spz version 3, in the order of its rows.

    Args:
        gaussians: relative to the scene's origin, which is not added.
        sh_degree: largest degree of spherical harmonics that is written.
    """
    degree = min(sh_degree, gaussians.sh_degree)
    raw = RawSplat(
        means=gaussians.means.astype(np.float64),
        quats=gaussians.quats,
        log_scales=logs_from_scales(gaussians.scales),
        logit_opacities=logits_from_opacities(gaussians.opacities),
        sh=gaussians.sh[:, : (degree + 1) ** 2],
        format="memory",
    )
    stream = io.BytesIO()
    write_spz(Path("the page's splat"), stream, raw, version=3)
    return stream.getvalue()


def pca_bytes(features: GaussianFeatures) -> UInt8[np.ndarray, "N 3"]:
    """The first three principal components as colors; Gaussians that were never seen are grey."""
    colors = np.full((len(features), 3), GREY, np.uint8)
    seen = np.flatnonzero(features.seen)
    if len(seen):
        stored = features.stored(seen)
        colors[seen] = pca_picture(stored[None], fit_pca_colors(stored))[0]
    return colors


def weight_bytes(weights: Float32[np.ndarray, " N"]) -> tuple[UInt8[np.ndarray, " N"], float, float]:
    """Visibility weights on a logarithmic scale: 0 = never seen, 1 = the smallest weight, 255 = the largest.

    Returns:
        The codes, the smallest and the largest weight; 1 and 1 where nothing was seen.
    """
    seen = weights > 0
    if not seen.any():
        return np.zeros(len(weights), np.uint8), 1.0, 1.0
    low, high = float(weights[seen].min()), float(weights[seen].max())
    codes = np.zeros(len(weights), np.uint8)
    shares = np.log(weights[seen].astype(np.float64) / low) / max(np.log(high / low), 1e-12)
    codes[seen] = 1 + np.rint(254 * shares.clip(0, 1)).astype(np.uint8)
    return codes, low, high


def object_numbers(
    means: Float32[np.ndarray, "N 3"], objects: Sequence[SceneObject], origin: np.ndarray, margin: float
) -> UInt16[np.ndarray, " N"]:
    """For each Gaussian the place, from 1, of the smallest object whose box holds its mean; 0 = none.

    Args:
        means: relative to the origin.
        objects: with boxes in world coordinates.
        origin: of the scene.
        margin: by which boxes are enlarged on each side, world units.
    """
    if len(objects) >= 1 << 16:
        raise InputError(f"expected fewer than {1 << 16:,} objects, got {len(objects):,}")
    numbers = np.full(len(means), NO_OBJECT, np.uint16)
    volumes = [float(np.prod(each.aabb_max - each.aabb_min)) for each in objects]
    for row in np.argsort(volumes, kind="stable")[::-1]:
        low, high = objects[row].aabb_min - origin - margin, objects[row].aabb_max - origin + margin
        numbers[((means >= low) & (means <= high)).all(axis=1)] = row + 1
    return numbers
