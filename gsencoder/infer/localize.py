"""Open-vocabulary localization: words to 3D boxes by relevancy, threshold and DBSCAN (SplatDistill, sec. 3.4).

The rule by which boxes are found is in this file: clusters, their scores, and the boxes around them. After a change of
the clusters or of the threshold refit the probabilities (`bench/presence.py` prints the coefficients of
`gsencoder.infer.relevancy`).
"""

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import combinations, pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, Integer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.data.seeding.points import scene_spacing
from gsencoder.infer.relevancy import (
    KNOWN,
    Cluster,
    Evidence,
    Presence,
    ThresholdConfig,
    expected_share,
    probability,
    relevancy,
    threshold,
)
from gsencoder.text.table import TextEncoder, TextTable, check_space
from gsencoder.text.vocabulary import OpenVocabulary, closed_table
from gsencoder.types import Box, GaussianFeatures, Gaussians, Localization, Scene
from gsencoder.types.scene import perpendicular

Extent = Literal["means", "sigma"]
NEGATIVES = ("object", "things", "stuff", "texture")
"""Negative words of LERF's contrast."""
MIN_SAMPLES = 3
"""Gaussians within the radius that make a core point of a cluster."""
MIN_SHARE = 0.05
"""Clusters with less than this share of the heaviest cluster's weight are floaters."""
SHARE_POWER = 0.05
"""With 0.25 large things that look alike come before what is asked: in four house rooms Acc@0.25 of `rooms` was 0.57,
for 0.73. Without it the largest of several things as relevant would not come first."""
MAX_BOXES = 10
"""Boxes of a word, at most."""
EMPTY_EXTENT = 1e-5
"""Share of the largest extent below which a direction counts as empty (float32 coordinates are good to 1e-7)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizeConfig(CheckedConfig):
    """How words become boxes. Relative lengths are in units of the scene's spacing
    (`gsencoder.data.seeding.points.scene_spacing`)."""

    mode: Literal["centered", "raw"] = option("centered", "cosines after removing each side's mean, or as they are")
    contrast: bool = option(
        False,
        "score by contrast with negative words and the other queries (LERF), not by cosine; use "
        "localize.threshold.kind=fixed localize.threshold.fixed=0.9",
    )
    temperature: float = option(0.1, "temperature of the contrast's softmax", gt=0, lt=math.inf)
    threshold: ThresholdConfig = field(
        default_factory=ThresholdConfig, metadata={"help": "relevancy from which Gaussians are selected"}
    )
    min_weight: float = option(
        0.0,
        "Gaussians whose weight (summed blending weight, in pixels) is not above this are left out",
        ge=0,
        lt=math.inf,
    )
    eps: float | None = option(
        None, "DBSCAN radius in world units; empty = eps_spacings times the spacing", gt=0, lt=math.inf
    )
    eps_spacings: float | None = option(
        None,
        "DBSCAN radius in spacings, where eps is not given; empty = 1.5, or more for words whose Gaussians are sparse, "
        "and clusters whose gap is small for their size are one",
        gt=0,
        lt=math.inf,
    )
    extent: Extent = option("means", "boxes around Gaussian means, or around their ellipsoids")
    min_probability: float = option(
        0.02,
        "boxes that are less probable are left out, and words without a box are absent; 0 = every box that reaches the "
        "threshold stays",
        ge=0,
        le=1,
    )


_DEFAULT = LocalizeConfig()


def localize(
    scene: Scene,
    queries: Sequence[str],
    text: TextEncoder,
    config: LocalizeConfig = _DEFAULT,
    *,
    space: str | None = None,
    rivals: TextTable | None = None,
    spacing: float | None = None,
) -> Localization:
    """Finds words in a scene.

    The Gaussians of a word at or above the threshold are clustered (DBSCAN), and clusters that are parts of one thing
    joined (`cluster_by_gaps`); every one becomes a box with a score (`score_clusters`) and a probability
    (`gsencoder.infer.relevancy`), which falls in proportion where an encoder expects fewer than half (`KNOWN`) of its
    names there to be right. Boxes that are less probable than `config.min_probability` are left out, and a word that
    has no box is absent. One axis of oriented boxes follows the scene's up, where it is known. The scene's origin is
    added back in float64. A word's boxes do not depend on the other queries, unless `config.contrast` is on.

    Args:
        space: name of the feature set; None where the scene has only one.
        rivals: words that may fit the Gaussians better than those asked; None = the names that `text` knows, if any.
        spacing: `spacing_of` the Gaussians, for callers that localize in one scene more than once; None = computed.

    Returns:
        Relevancy, thresholds, probabilities, and the boxes best first within each word.
    """
    gaussians, features = select_features(scene, space)
    expected_share(features, scene.name)
    scores, candidates = find_candidates(gaussians, features, queries, text, config, rivals=rivals, spacing=spacing)
    boxes: list[Box] = []
    probabilities = np.zeros(len(queries), np.float32)
    for number, (word, candidate) in enumerate(zip(queries, candidates, strict=True)):
        rank = 0
        for each, evidence in zip(candidate.clusters, candidate.evidence, strict=True):
            value = probability(evidence)
            if features.confidence is not None:
                confidence = float(features.confidence[each.rows].mean(dtype=np.float64))
                value *= min(1.0, confidence / KNOWN)
            probabilities[number] = max(probabilities[number], value)
            if value < config.min_probability:
                continue
            around = box_around(gaussians, each.rows, extent=config.extent, up=scene.up)
            boxes.append(
                Box(
                    query=word,
                    rank=rank,
                    score=each.score,
                    probability=value,
                    aabb_min=around.aabb_min + scene.origin,
                    aabb_max=around.aabb_max + scene.origin,
                    obb_center=around.center + scene.origin,
                    obb_rotation=around.rotation,
                    obb_size=around.size,
                    rows=each.rows,
                )
            )
            rank += 1
    localization = Localization(
        queries=tuple(queries),
        relevancy=scores,
        thresholds=np.array([candidate.threshold for candidate in candidates], np.float32),
        probabilities=probabilities,
        boxes=tuple(boxes),
    )
    if absent := localization.absent:
        more = ", …" if len(absent) > 5 else ""
        words = ", ".join(map(repr, list(absent)[:5])) + more
        values = ", ".join(f"{value:.2f}" for value in list(absent.values())[:5]) + more
        warnings.warn(
            f"scene {scene.name}: {len(absent)} of {len(queries)} words have no box ({words}): no cluster of Gaussians "
            f"reaches their threshold and is probable enough (probability {values})",
            SceneWarning,
            stacklevel=2,
        )
    return localization


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordCandidates:
    """The clusters of one word, best first, with the evidence for each, before improbable ones are left out."""

    threshold: float
    clusters: tuple[Cluster, ...]
    evidence: tuple[Evidence, ...]


def find_candidates(
    gaussians: Gaussians,
    features: GaussianFeatures,
    queries: Sequence[str],
    text: TextEncoder,
    config: LocalizeConfig = _DEFAULT,
    *,
    rivals: TextTable | None = None,
    spacing: float | None = None,
) -> tuple[Float32[np.ndarray, "Q N"], list[WordCandidates]]:
    """Relevancy of each word, and its clusters of Gaussians with the evidence for them; see `localize`."""
    if isinstance(queries, str) or not queries or not all(map(str.strip, queries)):
        raise InputError(f"localize: expected a list of one or more words, got {queries!r}")
    find_clusters = cluster if config.eps or config.eps_spacings else cluster_by_gaps
    radius = config.eps or (config.eps_spacings or EPS_SPACINGS) * (spacing or spacing_of(gaussians))
    if rivals is None and isinstance(text, (TextTable, OpenVocabulary)):
        rivals = closed_table(text)
    check_space(features.space, text.space)
    if rivals is not None:
        check_space(features.space, rivals.space)
    vectors = text.encode(list(queries))
    trained = [None] * len(queries) if rivals is None else list(map(rivals.is_trained, queries))
    cosines = scores = relevancy(features, vectors, text.mean)
    if config.contrast or config.mode == "raw":
        negatives = _negatives(text) if config.contrast else None
        scores = relevancy(
            features, vectors, text.mean, negatives=negatives, temperature=config.temperature, mode=config.mode
        )
    presence = Presence(features, text.mean, rivals)
    candidates = []
    for number, vector in enumerate(vectors):
        cutoff = threshold(scores[number], config.threshold)
        # Comparisons with NaN are false: Gaussians never seen are never taken.
        rows = np.flatnonzero((scores[number] >= cutoff) & (features.weights > config.min_weight))
        labels = find_clusters(gaussians.means[rows], radius, MIN_SAMPLES)
        ranked = score_clusters(labels, rows, scores[number][rows], features.weights[rows], min_share=MIN_SHARE)
        ranked = ranked[:MAX_BOXES]
        evidence = presence.evidence(vector, cosines[number], ranked, trained=trained[number])
        candidates.append(WordCandidates(threshold=cutoff, clusters=tuple(ranked), evidence=tuple(evidence)))
    return scores, candidates


def spacing_of(gaussians: Gaussians) -> float:
    """The spacing that radii are multiples of; of Gaussians in one place their median size."""
    return scene_spacing(gaussians.means) or (float(np.median(gaussians.scales)) if len(gaussians) else 1.0)


def select_features(scene: Scene, space: str | None) -> tuple[Gaussians, GaussianFeatures]:
    """A scene's Gaussians and one of its feature sets.

    Args:
        space: name of the feature set, of its space, or of its teacher; None = the only one, or the only one with a
            text encoder.
    """
    if scene.gaussians is None or not scene.features:
        missing = "Gaussians" if scene.gaussians is None else "features"
        raise InputError(f"scene {scene.name} has no {missing}; run `gsencoder fuse` on it first")
    listed = list(scene.features.values())
    if space is None:
        fitting = listed if len(listed) == 1 else [each for each in listed if each.space.text_encoder]
    elif space in scene.features:
        fitting = [scene.features[space]]
    else:
        fitting = [each for each in listed if each.space.name == space]
        if len(fitting) != 1:
            fitting = [each for each in listed if each.space.teacher == space]
    if len(fitting) != 1:
        raise InputError(
            f"scene {scene.name} has features of {', '.join(sorted(scene.features))}; "
            + ("name one with space=" if space is None else f"none of {space!r}")
        )
    return scene.gaussians, fitting[0]


def _negatives(text: TextEncoder) -> Float32[np.ndarray, "M D"]:
    """Vectors of the negative words that the encoder knows; the mean of the text side where it knows none."""
    vectors, unknown = [], []
    for word in NEGATIVES:
        try:
            vectors.append(text.encode([word]))
        except InputError:
            unknown.append(word)
    if unknown:
        instead = "" if vectors else "; the mean of its words stands for them"
        warnings.warn(
            f"negative words that {text.space.text_encoder} does not know are left out: {', '.join(unknown)}{instead}",
            SceneWarning,
            stacklevel=4,
        )
    if not vectors:
        vectors = [(text.mean / max(float(np.linalg.norm(text.mean)), 1e-12))[None].astype(np.float32)]
    return np.concatenate(vectors)


def describe_absent(probability: float) -> str:
    """What people read of a word without a box."""
    return f"absent (probability {probability:.2f})"


EPS_SPACINGS = 1.5
"""Radius of clusters, in spacings: a surface on a square grid holds together at √2."""
MAX_NEIGHBORS = 50_000_000
"""Neighbors of all points together that are held in memory (8 bytes each); with more of them the cells of a grid of
eps / 4 are clustered."""
NEIGHBOR_CELLS = 4.2
"""Volume of a ball of radius eps, in cubes of edge eps."""
SPARSE, GROWTH, SPARSE_RADII = 0.25, 2**0.5, 6
"""Where more than this share of the points is in no cluster of four neighbors within a spacing, they are sparser than
the scene: the radius grows by this factor, at most this often (8 times)."""
GAP = 0.25
"""Clusters are one thing up to a gap of this share of the larger one's size."""
STRAY = 0.02
"""Clusters with less than this share of the larger one's points are not joined to it: strays would thicken a door."""
WIDEST = 8
"""No gap within a thing is wider than this many radii. In house rooms those of tables and sofas are up to 7.5 wide, and
those between two things of a name 11 and more."""
MAX_PARTS = 32
"""The number of the largest clusters that are joined; others stay as they are."""


def cluster_by_gaps(points: Float32[np.ndarray, "n 3"], smallest: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels after joining clusters whose gap is small for their size, −1 = noise.

    One thing is seen or fitted in patches, and the gaps between these are small for the thing: the legs of a table
    and its top, the halves of a treadmill. The next thing of the name is farther away than a quarter of its size. The
    size is that of what was joined so far, twice the root mean square distance from the center (0.6 of a rod's length,
    0.8 of a square's side), which does not depend on the axes of the world.

    Args:
        smallest: radius of DBSCAN, in their unit, `EPS_SPACINGS` of the scene; larger where the points are sparser.
    """
    radius = smallest
    for _ in range(SPARSE_RADII):
        if np.count_nonzero(cluster(points, radius / EPS_SPACINGS, 5) < 0) <= SPARSE * len(points):
            break
        radius *= GROWTH
    labels = cluster(points, radius, min_samples)
    largest = np.argsort(-np.bincount(labels[labels >= 0]), kind="stable")[:MAX_PARTS]
    parts = [_ClusterUnion(points, np.flatnonzero(labels == label)) for label in largest]
    belong = cache(partial(_belong_together, widest=WIDEST * radius))
    while pair := next((pair for pair in combinations(parts, 2) if belong(*pair)), None):
        rows = np.concatenate([part.rows for part in pair])
        parts = [part for part in parts if part not in pair] + [_ClusterUnion(points, rows)]
        parts.sort(key=lambda part: -len(part.rows))
    for part in parts:
        labels[part.rows] = labels[part.rows].min()
    return np.unique(np.append(labels, -1), return_inverse=True)[1][:-1].astype(np.int64) - 1


class _ClusterUnion:
    """A cluster, or several that were joined."""

    def __init__(self, points: Float32[np.ndarray, "N 3"], rows: Int64[np.ndarray, " n"]) -> None:
        self.rows, self.points = rows, points[rows].astype(np.float64)
        self.low, self.high = self.points.min(axis=0), self.points.max(axis=0)
        self.size = 2 * float(np.sqrt(self.points.var(axis=0).sum()))

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def _belong_together(larger: _ClusterUnion, smaller: _ClusterUnion, widest: float) -> bool:
    if len(smaller.rows) < STRAY * len(larger.rows):
        return False
    limit = min(GAP * max(larger.size, smaller.size), widest)
    near = ((smaller.points >= larger.low - limit) & (smaller.points <= larger.high + limit)).all(axis=1)
    return bool(np.isfinite(larger.tree.query(smaller.points[near], distance_upper_bound=limit)[0]).any())


def cluster(points: Float32[np.ndarray, "n 3"], eps: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels, −1 = noise; clusters are numbered in the order of the points.

    Libraries keep the neighbors of every point, which on a dense splat grows with the square of the density. Where
    these would not fit into memory, the occupied cells of a grid of eps / 4 are clustered instead, each weighted by its
    number of points, and points take the label of their cell: distances are then off by up to 0.43 eps.

    Args:
        eps: radius. Points at this distance are neighbors, also where their float32 coordinates round.
        min_samples: points within the radius, the point itself included, that make it a core point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    local = points.astype(np.float64) - points.min(axis=0)
    # open3d looks for distances below the radius, not up to it.
    eps = float(np.nextafter(eps + 2 * np.spacing(np.abs(points).max()), np.inf))
    if _expected_neighbors(local, eps) <= MAX_NEIGHBORS:
        return _dbscan(local, eps, min_samples)
    from sklearn.cluster import DBSCAN

    cells = np.floor(local * (4 / eps))
    _, cell_of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell_of = cell_of.ravel()
    centers = np.stack([np.bincount(cell_of, local[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    labels = DBSCAN(eps=eps, min_samples=min_samples).fit_predict(centers, sample_weight=counts)
    return labels[cell_of].astype(np.int64)


def _expected_neighbors(local: Float64[np.ndarray, "n 3"], eps: float) -> float:
    """An estimate of the neighbors of all points together, by the cells of a grid of eps."""
    cells = np.floor(local / eps).astype(np.int64)
    size = cells.max(axis=0) + 1
    if np.prod(size.astype(np.float64)) < 2**62:
        counts = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_counts=True)[1]
    else:
        counts = np.unique(cells, axis=0, return_counts=True)[1]
    return NEIGHBOR_CELLS * float(np.square(counts.astype(np.float64)).sum())


def _dbscan(local: Float64[np.ndarray, "n 3"], eps: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """Labels by open3d, which is the fastest, or by scikit-learn where open3d cannot be loaded."""
    try:
        import open3d
    except (ImportError, OSError):
        from sklearn.cluster import DBSCAN

        return np.asarray(DBSCAN(eps=eps, min_samples=min_samples).fit_predict(local), np.int64)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(local))
    return np.asarray(cloud.cluster_dbscan(eps, min_samples), np.int64)


def score_clusters(
    labels: Integer[np.ndarray, " n"],
    rows: Integer[np.ndarray, " n"],
    relevancy: Float[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
    *,
    min_share: float = 0.0,
) -> list[Cluster]:
    """The clusters of one word, best first; equal scores go by the first row.

    The score is the mean relevancy times the share of the selected weight to the power of `SHARE_POWER`, so that of two
    clusters as relevant the larger comes first.

    Args:
        labels: cluster of each selected Gaussian, −1 = none.
        min_share: clusters with less than this share of the heaviest one's weight are floaters and are left out.
    """
    total = float(weights.sum(dtype=np.float64))
    clusters = []
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(int(labels.max(initial=-1)) + 2))
    for start, stop in pairwise(starts.tolist()):
        members = np.sort(order[start:stop])
        member_weights = weights[members].astype(np.float64)
        weight = float(member_weights.sum())
        mean = float(relevancy[members].astype(np.float64) @ member_weights) / weight
        # A negative mean is made worse by a small share, not better.
        damping = (weight / total) ** SHARE_POWER
        score = mean * damping if mean >= 0 else mean / damping
        clusters.append(
            Cluster(rows=np.sort(rows[members]).astype(np.int64), score=score, weight=weight, share=weight / total)
        )
    heaviest = max((each.weight for each in clusters), default=0.0)
    clusters.sort(key=lambda each: (-each.score, int(each.rows[0])))
    return [each for each in clusters if each.weight >= min_share * heaviest]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extents:
    """Axis-aligned box, and the oriented one: its center, its axes as columns, right-handed, and its side lengths."""

    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    center: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    size: Float64[np.ndarray, "3"]


def box_around(
    gaussians: Gaussians,
    rows: Integer[np.ndarray, " n"],
    *,
    extent: Extent = "means",
    up: Float64[np.ndarray, "3"] | None = None,
) -> Extents:
    """The axis-aligned and the oriented box of one or more Gaussians.

    Args:
        extent: "means" bounds the centers; "sigma" bounds the ellipsoids of one standard deviation, whose half-width
            along a unit vector a is √(aᵀΣa).
        up: direction of the last axis of the oriented box; None = the smallest box of any orientation.
    """
    from scipy.spatial.transform import Rotation

    points = gaussians.means[rows].astype(np.float64)
    rotation = oriented_axes(points, up)
    half_widths = np.zeros_like(points)
    half_widths_rotated = half_widths
    if extent == "sigma":
        rotations = Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
        stretched = rotations * gaussians.scales[rows].astype(np.float64)[:, None, :]
        half_widths = np.sqrt((stretched**2).sum(axis=2))
        half_widths_rotated = np.sqrt((np.einsum("ka,nkj->naj", rotation, stretched) ** 2).sum(axis=2))
    # Coordinates about the middle: rotating those of a far-away scene would round.
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    rotated = (points - middle) @ rotation
    low, high = (rotated - half_widths_rotated).min(axis=0), (rotated + half_widths_rotated).max(axis=0)
    return Extents(
        aabb_min=(points - half_widths).min(axis=0),
        aabb_max=(points + half_widths).max(axis=0),
        center=middle + rotation @ ((low + high) / 2),
        rotation=rotation,
        size=high - low,
    )


def oriented_axes(
    points: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, "3"] | None = None
) -> Float64[np.ndarray, "3 3"]:
    """Axes (columns, right-handed) of the smallest box around points, or of the smallest with an axis along `up`.

    Points in a plane, on a line or in one place have no volume to minimize: the box then lies in the plane with the
    smallest area, along the line, or along the world's axes. So does one whose convex hull cannot be found.
    """
    centered = points - points.mean(axis=0)
    if up is not None:
        return _axes_about(up / math.sqrt(float(up @ up)), centered)
    # Eigenvectors of the 3×3 scatter suffice to tell which directions are empty; extents are measured along them.
    _, axes = np.linalg.eigh(centered.T @ centered)
    spans = np.ptp(centered @ axes, axis=0)[::-1]
    axes = axes[:, ::-1]
    empty = spans <= EMPTY_EXTENT * max(float(spans.max(initial=0)), 1e-300)
    if spans.max(initial=0) == 0:
        return np.eye(3)
    if empty[1]:
        return _right_handed(axes)
    if empty[2]:
        return _axes_about(axes[:, 2], centered)
    from scipy.spatial import QhullError
    from trimesh.bounds import oriented_bounds

    try:
        # In units of its size: trimesh has no box for a volume of 1e-12.
        to_origin, _ = oriented_bounds(centered / spans.max(), ordered=False)
    except (QhullError, ValueError):
        return _right_handed(axes)
    # trimesh rounds its transform; the nearest rotation is exact.
    u, _, vt = np.linalg.svd(to_origin[:3, :3].T)
    return _right_handed(u @ vt)


def _axes_about(normal: Float64[np.ndarray, "3"], points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """The axes of the smallest box with its last axis along a unit vector; x, y and z of an upright square."""
    second = perpendicular(normal)
    first = np.cross(second, normal)
    angle = _smallest_rectangle(points @ np.stack([first, second], axis=1))
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([c * first + s * second, c * second - s * first, normal], axis=1)


def _smallest_rectangle(plane_points: Float64[np.ndarray, "n 2"]) -> float:
    """Angle of the rectangle of least area around points: one of its sides lies on a side of their convex hull."""
    from scipy.spatial import ConvexHull, QhullError

    if not np.ptp(plane_points, axis=0).any():
        return 0.0
    try:
        corners = plane_points[ConvexHull(plane_points).vertices] if len(plane_points) > 2 else None
    except QhullError:
        corners = None
    if corners is None:  # Two points, or all on a line.
        centered = plane_points - plane_points.mean(axis=0)
        longest = np.linalg.eigh(centered.T @ centered)[1][:, 1]
        return float(np.arctan2(longest[1], longest[0]))
    sides = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.round(np.arctan2(sides[:, 1], sides[:, 0]) % (np.pi / 2), 12))
    cosines, sines = np.cos(angles), np.sin(angles)
    along = corners @ np.stack([cosines, sines])
    across = corners @ np.stack([-sines, cosines])
    areas = np.ptp(along, axis=0) * np.ptp(across, axis=0)
    # Of equal rectangles the least turned one, so that an upright box stays upright.
    return float(angles[np.flatnonzero(areas <= areas.min() * (1 + 1e-9))[0]])


def _right_handed(axes: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    axes = np.array(axes, np.float64)
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return axes


def localization_to_json(localization: Localization) -> list[dict[str, Any]]:
    """The boxes as JSON values, best first within each word."""
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
    probabilities, cutoffs = localization.probabilities.tolist(), localization.thresholds.tolist()
    return [
        {"query": word, "probability": value, "absent": not counts[word], "threshold": cutoff, "boxes": counts[word]}
        for word, value, cutoff in zip(localization.queries, probabilities, cutoffs, strict=True)
    ]
