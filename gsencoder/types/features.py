"""Features: spaces, maps of one view, bases, vectors on Gaussians, memories and localizations."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Integer

from gsencoder.core.arrays import check_array, check_finite, check_rows, fail


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureSpace:
    """Names a feature space and what produced it. Two features may be compared only if their spaces are equal."""

    name: str  # for people, such as "clip-vit-b32"
    channels: int
    teacher: str = ""  # its kind ("labels", "onnx", …)
    weights: str = ""  # a fingerprint of what the teacher was loaded from, never a path
    layer: str = ""  # which output of the teacher
    preprocessing: str = ""  # resize, crop and normalization, in words
    text_encoder: str = ""  # what turns words into this space; empty if nothing does

    def __post_init__(self) -> None:
        if type(self.channels) is not int or self.channels < 1:
            fail("FeatureSpace", "channels", "a whole number from 1", repr(self.channels)[:60])
        for name in ("name", "teacher", "weights", "layer", "preprocessing", "text_encoder"):
            if not isinstance(getattr(self, name), str):
                fail("FeatureSpace", name, "text", repr(getattr(self, name))[:60])

    def describe(self) -> str:
        """One line for error messages and reports."""
        parts = [self.name, f"{self.channels} channels", self.teacher, self.weights, self.layer, self.text_encoder]
        return " · ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureMap:
    """One view's teacher output: dense `features`, `codes` into a `table`, or `shares` of its rows.

    Attributes:
        grid_from_image: affine from image pixels to grid cells, both with centers at .5: the teacher's resize and
            crop. Diagonal: grid = (ax·x + bx, ay·y + by).
        codes: rows of `table`, −1 = no feature here.
        shares: how much of each row of `table` a cell is, from 0, such as the posteriors of a classifier. Their sum is
            the weight of the cell; all zero = no feature here.
    """

    grid_from_image: Float64[np.ndarray, "2 3"]
    space: FeatureSpace
    features: Float32[np.ndarray, "h w D"] | None = None
    codes: Int32[np.ndarray, "h w"] | None = None
    shares: Float32[np.ndarray, "h w C"] | None = None
    table: Float32[np.ndarray, "C D"] | None = None

    def __post_init__(self) -> None:
        forms = sum(form is not None for form in (self.features, self.codes, self.shares))
        if forms != 1 or (self.features is None) != (self.table is not None):
            fail("FeatureMap", "features", "features, or codes or shares with their table", f"{forms} of them")
        if self.shares is not None and self.table is not None:
            if self.shares.shape[-1] != len(self.table):
                fail("FeatureMap", "shares", f"{len(self.table)} columns", str(self.shares.shape[-1]))
            if not (self.shares >= 0).all() or not np.isfinite(self.shares).all():
                fail("FeatureMap", "shares", "finite shares from 0", "others")
        rows = self.features if self.features is not None else self.table
        assert rows is not None
        if rows.shape[-1] != self.space.channels:
            fail("FeatureMap", "features", f"{self.space.channels} channels ({self.space.name})", str(rows.shape[-1]))
        if self.codes is not None and self.table is not None and self.codes.size:
            low, high = int(self.codes.min()), int(self.codes.max())
            if low < -1 or high >= len(self.table):
                fail("FeatureMap", "codes", f"-1 to {len(self.table) - 1}", f"{low} to {high}")
        affine = self.grid_from_image
        if affine[0, 1] or affine[1, 0] or affine[0, 0] <= 0 or affine[1, 1] <= 0:
            fail("FeatureMap", "grid_from_image", "a resize and crop (diagonal, positive)", str(affine.tolist()))

    @property
    def height(self) -> int:
        return int(self._grid.shape[0])

    @property
    def width(self) -> int:
        return int(self._grid.shape[1])

    @property
    def _grid(self) -> np.ndarray:
        grid = next(form for form in (self.features, self.codes, self.shares) if form is not None)
        return np.asarray(grid)

    @property
    def has_vector(self) -> Bool[np.ndarray, "h w"]:
        """Which cells have a feature."""
        if self.codes is not None:
            return self.codes >= 0
        return np.asarray(self._grid.any(axis=2) if self.features is None else np.isfinite(self.features[..., 0]))

    def rows(self) -> Float32[np.ndarray, "P D"]:
        """The vectors of all cells, row by row of the grid; NaN in cells without a feature."""
        if self.features is not None:
            return self.features.reshape(-1, self.space.channels)
        assert self.table is not None
        if self.shares is not None:
            shares = self.shares.reshape(-1, len(self.table))
            weights = shares.sum(axis=1, keepdims=True)
            rows = (shares @ self.table) / np.where(weights > 0, weights, np.float32(np.nan))
            return rows.astype(np.float32)
        assert self.codes is not None
        # The row behind the last one is what code −1 takes.
        padded = np.concatenate([self.table, np.full((1, self.space.channels), np.nan, np.float32)])
        return padded[self.codes.ravel()]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureBasis:
    """An affine subspace of a feature space: feature = mean + coordinates @ components."""

    mean: Float32[np.ndarray, " D"]
    components: Float32[np.ndarray, "R D"]  # orthonormal rows, most energy first
    energy_kept: float  # share of the energy about the mean that the rank keeps, in [0, 1]
    space: FeatureSpace

    def __post_init__(self) -> None:
        d = self.space.channels
        check_array("FeatureBasis", "mean", self.mean, "float32", (d,))
        check_array("FeatureBasis", "components", self.components, "float32", ("R", d))
        check_finite("FeatureBasis", "mean", self.mean)
        check_finite("FeatureBasis", "components", self.components)
        if not 0 <= self.energy_kept <= 1 + 1e-6:
            fail("FeatureBasis", "energy_kept", "a share in [0, 1]", str(self.energy_kept))

    @property
    def rank(self) -> int:
        return len(self.components)

    def coordinates(self, vectors: Float[np.ndarray, "*n D"]) -> Float32[np.ndarray, "*n R"]:
        """Coordinates of vectors: (x − mean) @ componentsᵀ."""
        return np.asarray((vectors - self.mean) @ self.components.T, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianFeatures:
    """Features on Gaussians, fused or predicted: a row each, or, with `index`, rows of a table that many share.

    Attributes:
        features: vectors, or coordinates in `basis`. Rows with weight 0 are zero and mean nothing.
        weights: how much each Gaussian was seen, in summed blending weight (pixels); 0 = never.
        mean: of the space, which centered cosines remove; it equals `basis.mean` where there is a basis.
        index: for each Gaussian its row of the table, −1 where it was never seen; None where each has a row of its own.
        confidence: the probability that the most probable name of a Gaussian is right, where an encoder states it.
    """

    features: Float32[np.ndarray, "rows channels"]
    weights: Float32[np.ndarray, " N"]
    mean: Float32[np.ndarray, " D"]
    space: FeatureSpace
    basis: FeatureBasis | None = None
    index: Int32[np.ndarray, " N"] | None = None
    confidence: Float32[np.ndarray, " N"] | None = None

    def __post_init__(self) -> None:
        columns = self.basis.rank if self.basis is not None else self.space.channels
        check_array("GaussianFeatures", "features", self.features, "float32", ("N", columns))
        count = len(self.features) if self.index is None else len(self.index)
        check_array("GaussianFeatures", "weights", self.weights, "float32", (count,))
        check_array("GaussianFeatures", "mean", self.mean, "float32", (self.space.channels,))
        check_finite("GaussianFeatures", "features", self.features)
        check_finite("GaussianFeatures", "mean", self.mean)
        good = np.asarray((self.weights >= 0) & (self.weights < np.inf))
        check_rows("GaussianFeatures", "weights", good, "finite weights from 0", self.weights)
        if self.basis is not None and self.basis.space != self.space:
            fail("GaussianFeatures", "basis", self.space.describe(), self.basis.space.describe())
        if self.index is not None:
            check_array("GaussianFeatures", "index", self.index, "int32", (count,))
            last = len(self.features) - 1
            good = np.where(self.seen, (self.index >= 0) & (self.index <= last), self.index == -1)
            check_rows("GaussianFeatures", "index", good, f"0 to {last} where seen, else -1", self.index)
        if self.confidence is not None:
            check_array("GaussianFeatures", "confidence", self.confidence, "float32", (count,))
            good = np.asarray((self.confidence >= 0) & (self.confidence <= 1))
            check_rows("GaussianFeatures", "confidence", good, "probabilities", self.confidence)

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def seen(self) -> Bool[np.ndarray, " N"]:
        """True where some view saw the Gaussian."""
        return self.weights > 0

    def select(self, rows: np.ndarray) -> "GaussianFeatures":
        """The features of some Gaussians; a table that they share stays whole."""
        of_rows = {"features": self.features[rows]} if self.index is None else {"index": self.index[rows]}
        confidence = None if self.confidence is None else self.confidence[rows]
        return replace(self, weights=self.weights[rows], confidence=confidence, **of_rows)

    def stored(self, rows: np.ndarray | slice = slice(None)) -> Float32[np.ndarray, "n channels"]:
        """The vectors, or coordinates in the basis, of some Gaussians; those never seen have zeros."""
        if self.index is None:
            return self.features[rows]
        index = self.index[rows]
        values = self.features[index]
        values[index < 0] = 0
        return values

    def decode(self, rows: np.ndarray | slice = slice(None)) -> Float32[np.ndarray, "n D"]:
        """The vectors of some Gaussians, by default of all, in the full space."""
        chosen = self.stored(rows)
        return chosen if self.basis is None else chosen @ self.basis.components + self.basis.mean


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Box:
    """A box of a query, in world coordinates with the origin of the scene added."""

    query: str
    rank: int  # 0 = best of its query
    score: float  # see infer/localize/boxes.py
    probability: float  # that the Gaussians inside are what the word says
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    obb_center: Float64[np.ndarray, "3"]
    obb_rotation: Float64[np.ndarray, "3 3"]  # columns are the axes of the oriented box
    obb_size: Float64[np.ndarray, "3"]
    rows: Integer[np.ndarray, " n"]  # the Gaussians inside

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        return (self.aabb_min + self.aabb_max) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localization:
    """What a set of words found.

    Attributes:
        queries: the words, in the order asked.
        relevancy: in [−1, 1] or [0, 1]; NaN where the Gaussian was never seen.
        thresholds: the relevancy above which a Gaussian was taken.
        probabilities: that a word is in the scene: the highest of its boxes, with the ones left out as too
            improbable; 0 where no Gaussians answer it.
        boxes: best first within each query, queries in order.
    """

    queries: tuple[str, ...]
    relevancy: Float32[np.ndarray, "Q N"]
    thresholds: Float32[np.ndarray, " Q"]
    probabilities: Float32[np.ndarray, " Q"]
    boxes: tuple[Box, ...]

    @property
    def absent(self) -> dict[str, float]:
        """The words without a box, and their probabilities."""
        boxed = {box.query for box in self.boxes}
        return {
            word: float(value)
            for word, value in zip(self.queries, self.probabilities, strict=True)
            if word not in boxed
        }


Scoring = Literal["centered", "cosine", "dot"]
"""How a query is compared with the components: by the cosine after the mean of the space has been subtracted from both,
by the cosine (M3's released code), or by the product (M3's Eq. 2)."""
EPS = 1e-6  # Smallest length that a projected query is divided by, as in M3's released code
BLOCK_SCORES = 1 << 24  # Scores of queries and components that are held at once, 64 MiB


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemoryBank:
    """The principal scene components (PSC) of one teacher in one scene: some of the raw features of its maps.

    Attributes:
        sources: the view, and the row and column of its map's cell, that each component comes from.
        grid_from_image: the affine of the map that each component comes from, as `FeatureMap` has it.
        mean: of the space; zero where cosines are not centered.
        threshold: θ, a cosine.
        coverage: share of the raw features that have a component within the threshold.
        cosine: mean over the raw features of the cosine with the nearest component.
    """

    components: Float32[np.ndarray, "M D"]
    sources: Int32[np.ndarray, "M 3"]
    grid_from_image: Float64[np.ndarray, "M 2 3"]
    mean: Float32[np.ndarray, " D"]
    threshold: float
    coverage: float
    cosine: float
    space: FeatureSpace

    def __post_init__(self) -> None:
        check_array("MemoryBank", "components", self.components, "float32", ("M", self.space.channels))
        check_array("MemoryBank", "sources", self.sources, "int32", (len(self.components), 3))
        check_array("MemoryBank", "grid_from_image", self.grid_from_image, "float64", (len(self.components), 2, 3))
        check_array("MemoryBank", "mean", self.mean, "float32", (self.space.channels,))
        check_finite("MemoryBank", "grid_from_image", self.grid_from_image)
        check_finite("MemoryBank", "components", self.components)
        check_finite("MemoryBank", "mean", self.mean)
        if not len(self.components):
            fail("MemoryBank", "components", "one component or more", "none")
        affine = self.grid_from_image
        diagonal = (affine[:, 0, 1] == 0) & (affine[:, 1, 0] == 0) & (affine[:, 0, 0] > 0) & (affine[:, 1, 1] > 0)
        check_rows("MemoryBank", "grid_from_image", diagonal, "resizes and crops (diagonal, positive)", affine)
        if not 0 < self.threshold <= 1:
            fail("MemoryBank", "threshold", "a cosine above 0 and up to 1", str(self.threshold))
        if not -1 <= self.cosine <= 1 + EPS or not 0 <= self.coverage <= 1:
            fail("MemoryBank", "coverage", "a share, and a cosine", f"{self.coverage} and {self.cosine}")

    def __len__(self) -> int:
        return len(self.components)

    @property
    def cells(self) -> Float64[np.ndarray, "M 4"]:
        """The rectangles that the components come from, in pixels of the images of their views: left, top, right and
        bottom edge. A rectangle may reach beyond its image where the map does."""
        scale, shift = self.grid_from_image[:, [0, 1], [0, 1]], self.grid_from_image[:, :, 2]
        first = self.sources[:, [2, 1]]
        return np.concatenate([(first - shift) / scale, (first + 1 - shift) / scale], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QueryMemory:
    """Principal queries of Gaussians, and the bank that they attend to.

    A query q of s channels stands for the feature softmax(score(q W, PSC) / τ) PSC (Gaussian memory attention, Eq. 2).
    Queries blend as features do: those of a pixel are its row of B times `queries`, divided by its alpha.

    Attributes:
        queries: of the Gaussians; rows with weight 0 are zero and mean nothing.
        weights: how much each Gaussian was seen, in summed blending weight (pixels); 0 = never.
        projection: W_m, from query channels to the space.
        temperature: τ; M3's equation has 1, its code 0.05 with cosines.
        mean: of the space, which centered cosines of decoded features remove.
        basis: in whose coordinates `features` decodes; None = in channels.
    """

    queries: Float32[np.ndarray, "N s"]
    weights: Float32[np.ndarray, " N"]
    projection: Float32[np.ndarray, "s D"]
    bank: MemoryBank
    scoring: Scoring
    temperature: float
    mean: Float32[np.ndarray, " D"]
    basis: FeatureBasis | None = None

    def __post_init__(self) -> None:
        channels = self.space.channels
        check_array("QueryMemory", "queries", self.queries, "float32", ("N", len(self.projection)))
        check_array("QueryMemory", "weights", self.weights, "float32", (len(self.queries),))
        check_array("QueryMemory", "projection", self.projection, "float32", ("s", channels))
        check_array("QueryMemory", "mean", self.mean, "float32", (channels,))
        for name in ("queries", "projection", "mean"):
            check_finite("QueryMemory", name, getattr(self, name))
        good = np.asarray((self.weights >= 0) & (self.weights < np.inf))
        check_rows("QueryMemory", "weights", good, "finite weights from 0", self.weights)
        if not 0 < self.temperature < np.inf:
            fail("QueryMemory", "temperature", "a positive number", str(self.temperature))
        if self.basis is not None and self.basis.space != self.space:
            fail("QueryMemory", "basis", self.space.describe(), self.basis.space.describe())

    @property
    def space(self) -> FeatureSpace:
        """What decoded features are."""
        return self.bank.space

    @property
    def channels(self) -> int:
        """Channels of a query, s."""
        return len(self.projection)

    def __len__(self) -> int:
        return len(self.queries)

    def attention(
        self, queries: Float32[np.ndarray, "n s"], keys: Float32[np.ndarray, "s M"] | None = None
    ) -> Float32[np.ndarray, "n M"]:
        """The weights of the components for queries, each row of sum 1; `keys` are W_m PSCᵀ where these are known."""
        scores = queries @ (self._keys() if keys is None else keys)
        if self.scoring != "dot":
            gram = self.projection.astype(np.float64) @ self.projection.T
            lengths = np.sqrt(np.maximum(np.einsum("ns,st,nt->n", queries, gram, queries, dtype=np.float64), 0))
            scores = scores / np.maximum(lengths, EPS)[:, None].astype(np.float32)
        scores = scores / np.float32(self.temperature)
        weights = np.exp(scores - scores.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)

    def _keys(self) -> Float32[np.ndarray, "s M"]:
        return self.projection @ attention_keys(self.bank.components, self.mean, self.scoring).T

    def attend(
        self, queries: Float32[np.ndarray, "n s"], values: Float32[np.ndarray, "M C"] | None = None
    ) -> Float32[np.ndarray, "n C"]:
        """The features that queries stand for, block by block: averages of `values`, or of the components; with cosines
        the length of a query does not matter."""
        values = self.bank.components if values is None else values
        step, keys = max(1, BLOCK_SCORES // len(self.bank)), self._keys()
        parts = [self.attention(queries[start : start + step], keys) @ values for start in range(0, len(queries), step)]
        return np.concatenate(parts) if parts else np.zeros((0, values.shape[1]), np.float32)

    def features(self) -> GaussianFeatures:
        """The features of the Gaussians themselves, as fusion and encoders give them."""
        values = self.bank.components
        if self.basis is not None:
            # The weights of the components sum to 1, so that coordinates are averaged as vectors are.
            values = self.basis.coordinates(values)
        decoded = np.zeros((len(self), values.shape[1]), np.float32)
        seen = np.flatnonzero(self.weights > 0)
        decoded[seen] = self.attend(self.queries[seen], np.ascontiguousarray(values, np.float32))
        return GaussianFeatures(
            features=decoded, weights=self.weights, mean=self.mean, space=self.space, basis=self.basis
        )


def attention_keys(
    components: Float32[np.ndarray, "M D"], mean: Float32[np.ndarray, " D"], scoring: Scoring
) -> Float32[np.ndarray, "M D"]:
    """What projected queries are multiplied with: the components, for cosines those of unit length, less the mean where
    cosines are centered."""
    if scoring == "dot":
        return components
    keys = (components - mean if scoring == "centered" else components).astype(np.float64)
    lengths = np.linalg.norm(keys, axis=1, keepdims=True)
    return np.asarray(keys / np.where(lengths > 0, lengths, 1), np.float32)
