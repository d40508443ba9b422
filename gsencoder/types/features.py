"""Features: the space that they live in, maps of one view, bases, and vectors on Gaussians."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from gsencoder.types.checks import check_array, check_finite, check_rows, fail


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureSpace:
    """Names a feature space and what produced it. Two features may be compared only if their spaces are equal.

    Attributes:
        name: a short name for people, such as "clip-vit-b32".
        channels: D.
        teacher: the teacher's kind ("labels", "onnx", …).
        weights: what the teacher was loaded from: a fingerprint, never a path.
        layer: which output of the teacher.
        preprocessing: resize, crop and normalization, in words.
        text_encoder: what turns words into this space; empty if nothing does.
    """

    name: str
    channels: int
    teacher: str = ""
    weights: str = ""
    layer: str = ""
    preprocessing: str = ""
    text_encoder: str = ""

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
        features: one vector for each cell of the grid; None where the map is coded or mixed.
        codes: for each cell a row of `table`, −1 = no feature here.
        shares: for each cell how much of each row of `table` it is, from 0; such as the posteriors of a classifier.
            Their sum is the weight of the cell; all zero = no feature here.
        table: the vectors that codes or shares stand for.
        grid_from_image: affine from image pixels to grid cells, both with centers at .5: the teacher's resize and
            crop. Diagonal: grid = (ax·x + bx, ay·y + by).
        space: what the vectors are.
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
    """An affine subspace of a feature space: feature = mean + coordinates @ components.

    Attributes:
        mean: the space's mean over what the basis was fitted to.
        components: orthonormal rows, most energy first.
        energy_kept: share of the energy about the mean that the rank keeps, in [0, 1].
        space: the space that the rows live in.
    """

    mean: Float32[np.ndarray, " D"]
    components: Float32[np.ndarray, "R D"]
    energy_kept: float
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianFeatures:
    """Features on Gaussians, fused or predicted: a row each, or, with `index`, rows of a table that many share.

    Attributes:
        features: vectors, or coordinates in `basis`: of each Gaussian, where rows with weight 0 are zero and mean
            nothing; with `index` of each row of the table.
        weights: how much each Gaussian was seen, in summed blending weight (pixels); 0 = never.
        mean: the space's mean, which centered cosines remove; it equals `basis.mean` where there is a basis.
        space: what the (decoded) vectors are.
        basis: what the coordinates stand for, or None where `features` holds the vectors themselves.
        index: for each Gaussian its row of the table, −1 where it was never seen; None where each has a row of its own.
    """

    features: Float32[np.ndarray, "rows channels"]
    weights: Float32[np.ndarray, " N"]
    mean: Float32[np.ndarray, " D"]
    space: FeatureSpace
    basis: FeatureBasis | None = None
    index: Int32[np.ndarray, " N"] | None = None

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

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def seen(self) -> Bool[np.ndarray, " N"]:
        """True where some view saw the Gaussian."""
        return self.weights > 0

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
