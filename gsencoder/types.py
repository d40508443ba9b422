"""What passes between stages: frozen dataclasses over numpy arrays, checked when they are made.

Axes: N Gaussians, V views, H W pixels, h w feature-map pixels, D channels, R basis rank, K = (sh_degree + 1)²,
Q queries, C codes. World units are metres where known; camera axes are OpenCV's (x right, y down, z forward);
pixel centers lie at .5; quaternions are wxyz; depth is z. Values are physical: scales are standard deviations and
opacities are probabilities, never logarithms or logits.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Integer, UInt8

from gsencoder.core.errors import InputError

SH_C0 = 0.5 / math.sqrt(math.pi)
"""A color is ½ + SH_C0 times its degree-0 coefficient, plus what depends on direction."""

UNIT_TOLERANCE = 1e-3
"""How far from 1 the norm of a quaternion, and from 0 an entry of RᵀR − I, may be."""


def _fail(owner: str, name: str, wanted: str, got: str) -> None:
    raise InputError(f"{owner}.{name}: expected {wanted}, got {got}")


def _check_array(owner: str, name: str, array: object, dtype: str, shape: tuple[int | str, ...]) -> None:
    wanted = f"{dtype}[{', '.join(map(str, shape))}]"
    if not isinstance(array, np.ndarray):
        _fail(owner, name, wanted, type(array).__name__)
        return
    same = array.ndim == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not same:
        _fail(owner, name, wanted, f"{array.dtype}[{', '.join(map(str, array.shape))}]")


def _check_rows(owner: str, name: str, good: np.ndarray, wanted: str, values: np.ndarray) -> None:
    """Fails naming the first bad row and how many there are."""
    if not good.all():
        bad = np.flatnonzero(~good)
        _fail(owner, name, wanted, f"{values[bad[0]].tolist()} in row {bad[0]} ({bad.size} bad of {good.size} rows)")


def _check_finite(owner: str, name: str, array: np.ndarray) -> None:
    if array.size == 0:
        return
    flat = array.reshape(len(array), -1)
    # The sum of a row is finite unless an entry is not (or it overflows): one pass, no boolean array of full size.
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = ~np.isfinite(flat.sum(axis=1, dtype=np.float64))
    if suspicious.any():
        _check_rows(owner, name, np.isfinite(flat).all(axis=1), "finite values", array)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gaussians:
    """A splat in physical values.

    Attributes:
        means: centers, in world units relative to the scene's origin.
        quats: unit rotations wxyz, world_from_gaussian.
        scales: standard deviations along the Gaussian's own axes, > 0, world units.
        opacities: in [0, 1].
        sh: spherical-harmonic color coefficients, degree-major as in the INRIA files; K = 1, 4, 9 or 16.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]

    def __post_init__(self) -> None:
        n = len(self.means) if isinstance(self.means, np.ndarray) and self.means.ndim else 0
        _check_array("Gaussians", "means", self.means, "float32", (n, 3))
        _check_array("Gaussians", "quats", self.quats, "float32", (n, 4))
        _check_array("Gaussians", "scales", self.scales, "float32", (n, 3))
        _check_array("Gaussians", "opacities", self.opacities, "float32", (n,))
        _check_array("Gaussians", "sh", self.sh, "float32", (n, "K", 3))
        if self.sh.shape[1] not in (1, 4, 9, 16):
            _fail("Gaussians", "sh", "1, 4, 9 or 16 coefficients (SH degree 0 to 3)", str(self.sh.shape[1]))
        for name in ("means", "quats", "scales", "opacities", "sh"):
            _check_finite("Gaussians", name, getattr(self, name))
        with np.errstate(over="ignore"):  # A norm beyond float32 is infinite, and refused.
            norms = np.linalg.norm(self.quats, axis=1)
        _check_rows(
            "Gaussians", "quats", np.asarray(np.abs(norms - 1) <= UNIT_TOLERANCE), "unit quaternions", self.quats
        )
        _check_rows("Gaussians", "scales", np.asarray((self.scales > 0).all(axis=1)), "scales > 0", self.scales)
        inside = np.asarray((self.opacities >= 0) & (self.opacities <= 1))
        _check_rows("Gaussians", "opacities", inside, "values in [0, 1]", self.opacities)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def select(self, rows: np.ndarray) -> "Gaussians":
        """The Gaussians of `rows` (indices or a mask), in that order."""
        return Gaussians(
            means=self.means[rows],
            quats=self.quats[rows],
            scales=self.scales[rows],
            opacities=self.opacities[rows],
            sh=self.sh[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cameras:
    """Pinhole cameras without distortion (it is removed at load).

    Attributes:
        cam_from_world: rigid transforms into OpenCV camera axes; world is relative to the scene's origin.
        Ks: intrinsics in pixels, pixel centers at .5.
        widths: image widths in pixels.
        heights: image heights in pixels.
    """

    cam_from_world: Float32[np.ndarray, "V 4 4"]
    Ks: Float32[np.ndarray, "V 3 3"]
    widths: Int32[np.ndarray, " V"]
    heights: Int32[np.ndarray, " V"]

    def __post_init__(self) -> None:
        v = len(self.cam_from_world) if isinstance(self.cam_from_world, np.ndarray) and self.cam_from_world.ndim else 0
        _check_array("Cameras", "cam_from_world", self.cam_from_world, "float32", (v, 4, 4))
        _check_array("Cameras", "Ks", self.Ks, "float32", (v, 3, 3))
        _check_array("Cameras", "widths", self.widths, "int32", (v,))
        _check_array("Cameras", "heights", self.heights, "int32", (v,))
        _check_finite("Cameras", "cam_from_world", self.cam_from_world)
        _check_finite("Cameras", "Ks", self.Ks)
        r = self.cam_from_world[:, :3, :3].astype(np.float64)
        rigid = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2), initial=0) <= UNIT_TOLERANCE
        rigid &= np.linalg.det(r) > 0
        rigid &= (self.cam_from_world[:, 3] == np.array([0, 0, 0, 1], np.float32)).all(axis=1)
        _check_rows(
            "Cameras", "cam_from_world", rigid, "rigid transforms (orthonormal, right-handed)", self.cam_from_world
        )
        pinhole = (self.Ks[:, 0, 0] > 0) & (self.Ks[:, 1, 1] > 0) & (self.Ks[:, 2] == np.array([0, 0, 1])).all(axis=1)
        pinhole &= (self.Ks[:, 1, 0] == 0) & (self.Ks[:, 0, 1] == 0)
        _check_rows("Cameras", "Ks", pinhole, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0", self.Ks)
        _check_rows("Cameras", "widths", self.widths > 0, "positive sizes", self.widths)
        _check_rows("Cameras", "heights", self.heights > 0, "positive sizes", self.heights)

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @property
    def centers(self) -> Float64[np.ndarray, "V 3"]:
        """Camera centers in the world, −Rᵀt."""
        pose = self.cam_from_world.astype(np.float64)
        return -np.einsum("vji,vj->vi", pose[:, :3, :3], pose[:, :3, 3])

    def select(self, views: Sequence[int] | np.ndarray | slice) -> "Cameras":
        """The cameras of `views`, in that order."""
        rows = views if isinstance(views, slice) else np.asarray(views, dtype=np.int64)
        return Cameras(
            cam_from_world=self.cam_from_world[rows],
            Ks=self.Ks[rows],
            widths=self.widths[rows],
            heights=self.heights[rows],
        )

    def resized(self, longest: int, *, enlarge: bool = True) -> "Cameras":
        """The same fields of view in pictures whose longer side has so many pixels; without `enlarge`, at most so
        many."""
        factors = longest / np.maximum(self.widths, self.heights)
        if not enlarge:
            factors = np.minimum(factors, 1)
        sizes = np.maximum(1, np.stack((self.widths, self.heights), axis=1) * factors[:, None] + 0.5).astype(np.int32)
        scale = np.ones((len(self), 3))
        scale[:, 0], scale[:, 1] = sizes[:, 0] / self.widths, sizes[:, 1] / self.heights
        return Cameras(
            cam_from_world=self.cam_from_world,
            Ks=(self.Ks * scale[:, :, None]).astype(np.float32),
            widths=np.ascontiguousarray(sizes[:, 0]),
            heights=np.ascontiguousarray(sizes[:, 1]),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """Cameras with what was seen through them. The sequences load on access: `views.images[3]` reads one file.

    Attributes:
        cameras: V cameras.
        names: V names, unique, as the scene's files give them.
        images: uint8 [H, W, 3] each, RGB; None where there are no pictures.
        depths: float32 [H, W] each, z in world units, 0 = none; None where no sensor depth exists.
        masks: bool [H, W] each, True = use this pixel.
        instances: int32 [H, W] each, 0 = none.
    """

    cameras: Cameras
    names: tuple[str, ...]
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]] | None = None
    depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None
    masks: Sequence[Bool[np.ndarray, "_ _"]] | None = None
    instances: Sequence[Int32[np.ndarray, "_ _"]] | None = None

    def __post_init__(self) -> None:
        if len(self.names) != len(self.cameras):
            _fail("Views", "names", f"{len(self.cameras)} names, one a camera", str(len(self.names)))
        if len(set(self.names)) != len(self.names):
            _fail("Views", "names", "unique names", f"{len(self.names) - len(set(self.names))} repeated")
        for name in ("images", "depths", "masks", "instances"):
            value = getattr(self, name)
            if value is not None and len(value) != len(self.cameras):
                _fail("Views", name, f"{len(self.cameras)} entries, one a camera", str(len(value)))

    def __len__(self) -> int:
        return len(self.cameras)


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
            _fail("FeatureSpace", "channels", "a whole number from 1", repr(self.channels)[:60])
        for name in ("name", "teacher", "weights", "layer", "preprocessing", "text_encoder"):
            if not isinstance(getattr(self, name), str):
                _fail("FeatureSpace", name, "text", repr(getattr(self, name))[:60])

    def describe(self) -> str:
        """One line for error messages and reports."""
        parts = [self.name, f"{self.channels} channels", self.teacher, self.weights, self.layer, self.text_encoder]
        return " · ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureMap:
    """One view's teacher output: dense `features`, or `codes` into a `table`.

    Attributes:
        features: one vector for each cell of the grid; None where the map is coded.
        codes: for each cell a row of `table`, −1 = no feature here; None where the map is dense.
        table: the vectors that codes stand for.
        grid_from_image: affine from image pixels to grid cells, both with centers at .5: the teacher's resize and
            crop. Diagonal: grid = (ax·x + bx, ay·y + by).
        space: what the vectors are.
    """

    grid_from_image: Float64[np.ndarray, "2 3"]
    space: FeatureSpace
    features: Float32[np.ndarray, "h w D"] | None = None
    codes: Int32[np.ndarray, "h w"] | None = None
    table: Float32[np.ndarray, "C D"] | None = None

    def __post_init__(self) -> None:
        dense, coded = self.features is not None, self.codes is not None and self.table is not None
        if dense == coded:
            _fail(
                "FeatureMap", "features", "either features, or codes with their table", "both" if dense else "neither"
            )
        rows = self.features if dense else self.table
        assert rows is not None
        if rows.shape[-1] != self.space.channels:
            _fail("FeatureMap", "features", f"{self.space.channels} channels ({self.space.name})", str(rows.shape[-1]))
        if self.codes is not None and self.table is not None and self.codes.size:
            low, high = int(self.codes.min()), int(self.codes.max())
            if low < -1 or high >= len(self.table):
                _fail("FeatureMap", "codes", f"-1 to {len(self.table) - 1}", f"{low} to {high}")
        affine = self.grid_from_image
        if affine[0, 1] or affine[1, 0] or affine[0, 0] <= 0 or affine[1, 1] <= 0:
            _fail("FeatureMap", "grid_from_image", "a resize and crop (diagonal, positive)", str(affine.tolist()))

    @property
    def height(self) -> int:
        return int((self.features if self.features is not None else self.codes).shape[0])  # type: ignore[union-attr]

    @property
    def width(self) -> int:
        return int((self.features if self.features is not None else self.codes).shape[1])  # type: ignore[union-attr]


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
        _check_array("FeatureBasis", "mean", self.mean, "float32", (d,))
        _check_array("FeatureBasis", "components", self.components, "float32", ("R", d))
        _check_finite("FeatureBasis", "mean", self.mean)
        _check_finite("FeatureBasis", "components", self.components)
        if not 0 <= self.energy_kept <= 1 + 1e-6:
            _fail("FeatureBasis", "energy_kept", "a share in [0, 1]", str(self.energy_kept))

    @property
    def rank(self) -> int:
        return len(self.components)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianFeatures:
    """Features on Gaussians, fused or predicted.

    Attributes:
        features: vectors, or coordinates in `basis`; rows with weight 0 are zero and mean nothing.
        weights: how much each row was seen, in summed blending weight (pixels); 0 = never.
        mean: the space's mean, which centered cosines remove; it equals `basis.mean` where there is a basis.
        space: what the (decoded) vectors are.
        basis: what the coordinates stand for, or None where `features` holds the vectors themselves.
    """

    features: Float32[np.ndarray, "N channels"]
    weights: Float32[np.ndarray, " N"]
    mean: Float32[np.ndarray, " D"]
    space: FeatureSpace
    basis: FeatureBasis | None = None

    def __post_init__(self) -> None:
        columns = self.basis.rank if self.basis is not None else self.space.channels
        _check_array("GaussianFeatures", "features", self.features, "float32", ("N", columns))
        _check_array("GaussianFeatures", "weights", self.weights, "float32", (len(self.features),))
        _check_array("GaussianFeatures", "mean", self.mean, "float32", (self.space.channels,))
        _check_finite("GaussianFeatures", "features", self.features)
        _check_finite("GaussianFeatures", "mean", self.mean)
        good = np.asarray((self.weights >= 0) & (self.weights < np.inf))
        _check_rows("GaussianFeatures", "weights", good, "finite weights from 0", self.weights)
        if self.basis is not None and self.basis.space != self.space:
            _fail("GaussianFeatures", "basis", self.space.describe(), self.basis.space.describe())

    def __len__(self) -> int:
        return len(self.features)

    @property
    def seen(self) -> Bool[np.ndarray, " N"]:
        """True where some view saw the Gaussian."""
        return self.weights > 0

    def decode(self, rows: np.ndarray | slice = slice(None)) -> Float32[np.ndarray, "n D"]:
        """The vectors of `rows` in the full space (all of them unless told)."""
        chosen = self.features[rows]
        return chosen if self.basis is None else chosen @ self.basis.components + self.basis.mean


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneObject:
    """A labeled object, for evaluation. The box is in world coordinates, origin included.

    Attributes:
        id: its value in the instance maps.
        name: a word of the name table, or None.
        aabb_min: lower corner, world units.
        aabb_max: upper corner.
        placed: one of the small objects, as opposed to furniture.
        views: in how many views it shows.
        max_pixels: its largest visible area in a view.
    """

    id: int
    name: str | None
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    placed: bool = True
    views: int = 0
    max_pixels: int = 0


def check_unit(metres_per_unit: float, name: str) -> None:
    """Complains about what is no unit of length.

    Raises:
        InputError: not a positive finite number; `name` begins the message.
    """
    good = isinstance(metres_per_unit, (int, float)) and not isinstance(metres_per_unit, bool)
    if not good or not 0 < metres_per_unit <= sys.float_info.max:
        raise InputError(f"{name}: expected a positive number of metres, got {str(metres_per_unit)[:40]}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A place: Gaussians, or views, or both.

    Attributes:
        name: for people and for output folders.
        gaussians: the splat, relative to `origin`; None until there is one.
        views: posed cameras and what they saw, relative to `origin`; None for a bare splat.
        features: per-Gaussian features by space name.
        origin: float64 offset that was taken off every position; boxes add it back.
        metres_per_unit: None where the unit of length is unknown.
        up: unit vector in the world, or None where unknown.
        objects: labeled objects, where the scene has them.
        sfm_points: structure-from-motion points relative to `origin`, with uint8 colors beside them.
        folder: that the scene was read from; None for one that was made.
    """

    name: str
    gaussians: Gaussians | None = None
    views: Views | None = None
    features: dict[str, GaussianFeatures] = field(default_factory=dict)
    origin: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    metres_per_unit: float | None = None
    up: Float64[np.ndarray, "3"] | None = None
    objects: tuple[SceneObject, ...] = ()
    sfm_points: Float32[np.ndarray, "P 3"] | None = None
    sfm_colors: UInt8[np.ndarray, "P 3"] | None = None
    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or "/" in self.name or "\0" in self.name:
            _fail("Scene", "name", "a name that a folder can have", repr(self.name[:60]))
        _check_array("Scene", "origin", self.origin, "float64", (3,))
        if not np.isfinite(self.origin).all():
            _fail("Scene", "origin", "finite values", str(self.origin.tolist()))
        if self.metres_per_unit is not None:
            check_unit(self.metres_per_unit, "Scene.metres_per_unit")
        if self.up is not None:
            _check_array("Scene", "up", self.up, "float64", (3,))
            if not abs(float(np.linalg.norm(self.up)) - 1) <= UNIT_TOLERANCE:
                _fail("Scene", "up", "a unit vector or None", str(self.up.tolist()))
        for name, features in self.features.items():
            if self.gaussians is None or len(features) != len(self.gaussians):
                got = "no Gaussians" if self.gaussians is None else f"{len(self.gaussians)} Gaussians"
                _fail("Scene", f"features[{name!r}]", f"{len(features)} Gaussians to lie on", got)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Box:
    """Where a query was found, in world coordinates with the scene's origin added back.

    Attributes:
        query: the word.
        rank: 0 = best of its query.
        score: see infer/localize/localize.py.
        aabb_min, aabb_max: axis-aligned corners.
        obb_center, obb_rotation, obb_size: oriented box; columns of the rotation are its axes.
        rows: the Gaussians inside, as row numbers.
    """

    query: str
    rank: int
    score: float
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    obb_center: Float64[np.ndarray, "3"]
    obb_rotation: Float64[np.ndarray, "3 3"]
    obb_size: Float64[np.ndarray, "3"]
    rows: Integer[np.ndarray, " n"]

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        return (self.aabb_min + self.aabb_max) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localization:
    """What a set of words found.

    Attributes:
        queries: the words, in the order asked.
        relevancy: one score a word and Gaussian, in [−1, 1] or [0, 1]; NaN where the Gaussian was never seen.
        thresholds: the relevancy above which a Gaussian was taken, for each word.
        boxes: best first within each query, queries in order.
    """

    queries: tuple[str, ...]
    relevancy: Float32[np.ndarray, "Q N"]
    thresholds: Float32[np.ndarray, " Q"]
    boxes: tuple[Box, ...]
