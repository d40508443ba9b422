"""Words to points from the pose of a camera, as a robot asks for what it sees (M3, sec. 4.4).

The features of the scene are rendered at the pose, the pixel that is most relevant to a word is found, and its depth
turns it into a position in the world:

    field = FeatureField(scene)              # once for a scene
    seen = field.at(cameras, view)           # once for a pose
    seen.find(["yellow bath duck"], words)   # for each question

M3's robot takes the depth from its depth camera; here it is that of the splat.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image, ImageDraw

from gsencoder.core.errors import InputError
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.infer.draw import contact_sheet, draw_labels, draw_ring, enlarge, legible_factor, relevancy_overlay
from gsencoder.infer.localize import select_features
from gsencoder.infer.pictures import pixel_features
from gsencoder.infer.relevancy import GaussianProducts, Mode, ThresholdConfig, threshold, word_directions
from gsencoder.render import Blend, blend
from gsencoder.render.images import render_image
from gsencoder.text.table import TextEncoder, check_space
from gsencoder.types import Cameras, QueryMemory, Scene

MEMORY_STRIDE = 4
MAX_RAYS = 1 << 21
"""Pixels that are looked at in a view, at most, unless a stride is asked for; their blend takes about a gigabyte."""
MIN_ALPHA = 0.5
"""Opacity, of the Gaussians that have features, from which a pixel counts: what is fainter is haze, and no surface."""
BLOCK_WORDS = 16
"""Words that are answered at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FromPoseConfig(CheckedConfig):
    """How words are found in a view."""

    mode: Mode = option("centered", "cosines after removing each side's mean (centered), or as they are (raw)")
    threshold: ThresholdConfig = field(default_factory=ThresholdConfig)
    """Over all Gaussians of the scene, so that a word whose best Gaussians are elsewhere is not visible."""
    stride: int | None = option(
        None,
        "step of the pixels that are looked at, in both directions; None = all for features, and every fourth for a "
        "memory, whose attention takes longer, or fewer in large views",
        ge=1,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePoint:
    """Where a camera sees what a word says.

    Attributes:
        visible: whether the relevancy of the pixel reaches the threshold. Where it does not, the other values are those
            of the best pixel there is.
        threshold: relevancy from which on something relevant is visible; NaN where no Gaussian has a feature.
        relevancy: centered cosine of the blended feature at the pixel, in [−1, 1]. This and all that follows is NaN
            where the camera sees no surface with features.
        alpha: opacity of all Gaussians at the pixel.
        pixel: (x, y), pixel centers at .5.
        depth: z in the camera, world units: the median, by blending weight, over those Gaussians of the pixel whose own
            relevancy reaches the threshold, or over all that have features where none does. An expected depth may lie
            between object and background, and the median over all Gaussians may be that of the background, as a cosine
            has no length: a small share of the object before a mean feature is as relevant as the object alone.
        position: in world coordinates, with the scene's origin added.
    """

    query: str
    camera: int
    visible: bool
    threshold: float
    relevancy: float
    alpha: float
    pixel: Float64[np.ndarray, "2"]
    depth: float
    position: Float64[np.ndarray, "3"]


class FeatureField:
    """The features of a scene, ready to be looked at from any pose."""

    def __init__(
        self,
        scene: Scene,
        *,
        space: str | None = None,
        memory: QueryMemory | None = None,
        config: FromPoseConfig = FromPoseConfig(),
    ) -> None:
        """Args:
        space: name of the feature set; None where the scene has only one.
        memory: queries of the same Gaussians. The feature of a pixel is then what its blended query attends to, and
            the features of the scene, if it has any, give only the threshold; they are those of the memory."""
        if memory is not None and not scene.features:
            features, gaussians = memory.features(), scene.gaussians
            if gaussians is None:
                raise InputError(f"scene {scene.name} has no Gaussians")
        else:
            gaussians, features = select_features(scene, space)
        if memory is not None:
            check_space(features.space, memory.space)
            if len(memory) != len(gaussians):
                raise InputError(f"memory: queries of {len(memory):,} Gaussians, and a scene of {len(gaussians):,}")
        self.gaussians, self.origin, self.space = gaussians, scene.origin, features.space
        self.memory, self.config = memory, config
        self.products = GaussianProducts(features, config.mode)

    def stride_in(self, cameras: Cameras, view: int) -> int:
        """The distance in pixels between those of a view that are looked at."""
        if self.config.stride is not None:
            return self.config.stride
        stride = 1 if self.memory is None else MEMORY_STRIDE
        width, height = cameras.widths[view], cameras.heights[view]
        while math.ceil(width / stride) * math.ceil(height / stride) > MAX_RAYS:
            stride += 1
        return stride

    def at(self, cameras: Cameras, view: int = 0) -> "SeenField":
        """What one camera, relative to the scene's origin, sees of the field, kept for many words."""
        if not -len(cameras) <= view < len(cameras):
            raise InputError(f"view: expected 0 to {len(cameras) - 1}, got {view}")
        b = blend(self.gaussians, cameras, view, stride=self.stride_in(cameras, view))
        return SeenField(self, cameras, view % len(cameras), b)


class SeenField:
    """A feature field as one camera sees it; its blend `b`, a row for each pixel that is looked at, answers any number
    of words."""

    def __init__(self, field: FeatureField, cameras: Cameras, view: int, b: Blend) -> None:
        self.field, self.cameras, self.view, self.b = field, cameras, view, b
        self._pixels = pixel_features(field.products, b, memory=field.memory, mode=field.config.mode)
        self._opaque = self._pixels.alpha >= MIN_ALPHA

    def find(self, queries: Sequence[str], text: TextEncoder) -> tuple[PosePoint, ...]:
        """Where the camera sees each word, in their order."""
        points: list[PosePoint] = []
        for start in range(0, len(directions := self._directions(queries, text)), BLOCK_WORDS):
            block = directions[start : start + BLOCK_WORDS]
            of_gaussians = self.field.products.cosines(block)
            of_pixels = self._pixels.cosines(block)
            for word, scores, pixels in zip(queries[start : start + BLOCK_WORDS], of_gaussians, of_pixels, strict=True):
                points.append(self._point(word, scores, pixels))
        return tuple(points)

    def relevancy(self, queries: Sequence[str], text: TextEncoder) -> Float32[np.ndarray, "Q h w"]:
        """Relevancy of each word at the pixels that are looked at; NaN where there is no surface with features."""
        cosines = np.clip(self._pixels.cosines(self._directions(queries, text)), -1, 1)
        cosines[:, ~self._opaque] = np.nan
        return cosines.reshape(len(queries), *self.b.shape)

    def _directions(self, queries: Sequence[str], text: TextEncoder) -> Float64[np.ndarray, "Q D"]:
        if isinstance(queries, str) or not queries or any(not word.strip() for word in queries):
            raise InputError(f"from_pose: expected a list of one or more words, got {queries!r}")
        check_space(self.field.space, text.space)
        return word_directions(text.encode(list(queries)), text.mean, self.field.config.mode)

    def _point(
        self, query: str, of_gaussians: Float32[np.ndarray, " N"], of_pixels: Float32[np.ndarray, " P"]
    ) -> PosePoint:
        least = threshold(of_gaussians, self.field.config.threshold)
        if not self._opaque.any():
            nowhere = np.full(3, math.nan)
            return PosePoint(
                query=query, camera=self.view, visible=False, threshold=least, relevancy=math.nan, alpha=math.nan,
                pixel=nowhere[:2], depth=math.nan, position=nowhere,
            )  # fmt: skip
        best = int(np.where(self._opaque, of_pixels, -np.inf).argmax())
        relevancy = float(np.clip(of_pixels[best], -1, 1))
        lattice = self.b.lattice
        row, column = divmod(best, lattice.width)
        pixel = np.array([lattice.x0 + column * lattice.dx, lattice.y0 + row * lattice.dy])
        entries = slice(int(self.b.crow[best]), int(self.b.crow[best + 1]))
        gaussians, weights = self.b.col[entries].numpy(), self.b.weight[entries].numpy().astype(np.float64)
        entry_relevancy = of_gaussians[gaussians]
        relevant = entry_relevancy >= least
        chosen = relevant if relevant.any() else np.isfinite(entry_relevancy)
        # Entries are in order of depth.
        total = weights[chosen].cumsum()
        middle = int(np.searchsorted(total, total[-1] / 2))
        depth = float(self.b.depths[gaussians[chosen][middle]])
        position = self.cameras.unproject(pixel[None], np.array([depth]), self.view)[0] + self.field.origin
        return PosePoint(
            query=query,
            camera=self.view,
            visible=relevancy >= least,
            threshold=least,
            relevancy=relevancy,
            alpha=float(weights.sum()),
            pixel=pixel,
            depth=depth,
            position=position,
        )


def from_pose(
    scene: Scene,
    cameras: Cameras,
    queries: Sequence[str],
    text: TextEncoder,
    config: FromPoseConfig = FromPoseConfig(),
    *,
    space: str | None = None,
    memory: QueryMemory | None = None,
) -> tuple[PosePoint, ...]:
    """Where each camera sees each word: `FeatureField` for those who ask once.

    Args:
        cameras: relative to the scene's origin.
        space: name of the feature set; None where the scene has only one.
        memory: queries of the same Gaussians; see `FeatureField`.

    Returns:
        A point for each camera and word: all words of the first camera, then those of the next.
    """
    field = FeatureField(scene, space=space, memory=memory, config=config)
    return tuple(point for view in range(len(cameras)) for point in field.at(cameras, view).find(queries, text))


VISIBLE, HIDDEN = (255, 255, 255), (150, 150, 150)
LABEL_AWAY = 24
"""Pixels from a ring's middle to its label."""
MAX_SIDE = 2000
"""Longer side of a picture, at most."""


def view_picture(seen: SeenField) -> UInt8[np.ndarray, "H W 3"]:
    """The view in color, whatever the stride is: in all its pixels, or reduced to a longer side of `MAX_SIDE`."""
    cameras = seen.cameras.select([seen.view])
    small = cameras.resized(MAX_SIDE, enlarge=False)
    same = np.array_equal([small.widths, small.heights], [cameras.widths, cameras.heights])
    blended = seen.b if same and seen.b.lattice.dx == 1 else None
    return render_image(seen.field.gaussians, small, 0, blended=blended)


def pose_picture(
    rgb: UInt8[np.ndarray, "H W 3"], seen: SeenField, point: PosePoint, relevancy: Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "H2 W2 3"]:
    """A view, and next to it the view with the relevancy of a word over it, the word's pixel in a ring in both; small
    views are enlarged.

    Args:
        relevancy: of the word at the pixels that were looked at; NaN where there is no surface.
    """
    lattice, (height, width) = seen.b.lattice, rgb.shape[:2]
    reduced = np.array([seen.cameras.widths[seen.view] / width, seen.cameras.heights[seen.view] / height])
    # Each pixel takes the ray of its block; pixels beyond the last block that of the last.
    columns, rows = (
        np.minimum(((np.arange(size) + 0.5) * factor / step).astype(np.int64), last - 1)
        for size, factor, step, last in (
            (width, reduced[0], lattice.dx, lattice.width),
            (height, reduced[1], lattice.dy, lattice.height),
        )
    )
    factor = legible_factor(width)
    heat = relevancy_overlay(rgb, relevancy[rows[:, None], columns])
    halves = [_marked(half, factor, point, point.pixel / reduced) for half in (rgb, heat)]
    titles = ("rendered", f"relevancy of {point.query!r}, threshold {point.threshold:.2f}")
    return contact_sheet(halves, titles, columns=2, width=halves[0].shape[1])


def _marked(
    picture: UInt8[np.ndarray, "H W 3"], factor: int, point: PosePoint, pixel: Float64[np.ndarray, "2"]
) -> UInt8[np.ndarray, "H2 W2 3"]:
    """A picture, enlarged, with the pixel of a word in a ring, and the word's relevancy and depth."""
    image = Image.fromarray(enlarge(picture, factor))
    draw = ImageDraw.Draw(image)
    at, color, text = np.zeros(2), HIDDEN, f"{point.query}: nothing with features in view"
    if np.isfinite(point.pixel).all():
        at, color = pixel * factor, VISIBLE if point.visible else HIDDEN
        draw_ring(draw, at, color)
        verdict = f"depth {point.depth:.3g}" if point.visible else f"not visible (needs {point.threshold:.2f})"
        text = f"{point.query} {point.relevancy:.2f}, {verdict}"
    # Above the ring, or below it where it would be covered.
    label_at = at + np.array([0, -LABEL_AWAY if at[1] > LABEL_AWAY + 30 else LABEL_AWAY + 30])
    draw_labels(draw, image.size, [(label_at, text, color)])
    return np.asarray(image)
