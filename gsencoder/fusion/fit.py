"""Does a splat fit the photographs of its scene? Some views are rendered at low size and compared.

A splat in another world than the cameras fuses without an error, to features of whatever its cameras happen to see.
Renderings and photographs are compared after a band pass, which leaves edges and removes exposure, by their
correlation where the rendering is opaque: splats that fit have 0.6 to 0.9, those that do not 0.4 at most.
"""

import json
import warnings
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.layouts import file_of_scene
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.splat_frame import DATAPARSER, SplatFrame, identity_frame, moved, stated_frames, usual_frames
from gsencoder.geometry import colors_from_sh
from gsencoder.render import blend
from gsencoder.types import Cameras, Gaussians, Scene, Views

PIXELS = 96
"""Longest side of the pictures that are compared."""
VIEWS, POOL = 3, 16
"""Views that are compared, of this many evenly spaced ones."""
MAX_GAUSSIANS, SAMPLES = 60_000, 2_000
"""Gaussians of a random choice that are rendered, larger by as much as they are fewer, and means that are projected to
choose views."""
EDGES = (1.0, 4.0)
"""Standard deviations of the band pass, pixels of the small pictures."""
FITS, CLEAR, BETTER = 0.45, 0.5, 0.2
"""Correlation from which on a splat fits; that of another frame which is named, and by how much it must be better."""
COVERED, CONTRAST = 0.04, 0.01
"""Views with a smaller opaque share, or whose photograph has less contrast there, say nothing."""


class Agreement(NamedTuple):
    """How renderings and photographs correlate.

    Attributes:
        correlation: median of the views; 0 where none can be compared.
        compared: number of views.
    """

    correlation: float
    compared: int


def with_fitting_splat(scene: Scene, splat: str, options: SceneConfig) -> Scene:
    """The scene with its splat in the world of its cameras: as it is, or moved into it as a file says.

    Args:
        scene: as `load_scene` reads it.
        splat: the file of its Gaussians, as `load_scene` takes it; empty = none, and nothing is checked.
        options: how it was read; `check_fit` = whether a splat that does not fit is refused.

    Raises:
        InputError: the splat fits in another frame, which no file states.

    Warns:
        SceneWarning: the splat is moved; or it does not fit, or nothing can tell, and no frame was found.
    """
    if not splat or scene.gaussians is None or scene.views is None or scene.views.images is None:
        return scene
    assert scene.folder is not None
    file = file_of_scene("splat", splat, scene.folder)
    small = SmallViews(scene.views)
    gaussians = _thinned(scene.gaussians)
    given = agreement(gaussians, small, identity_frame(), scene.origin)
    if given.correlation >= FITS:
        return scene
    best, found = identity_frame(), given
    for frame in (*stated_frames(scene.folder, file), *usual_frames()):
        if best.stated and not frame.stated and found.correlation >= CLEAR:
            break
        fit = agreement(gaussians, small, frame, scene.origin)
        if fit.correlation > found.correlation:
            best, found = frame, fit
    here = f"{file}: the splat does not fit the photographs of {scene.name} (correlation {given.correlation:.2f}"
    if found.correlation < max(CLEAR, given.correlation + BETTER):
        why = ", and no usual frame fits better" if given.compared else ": they show too little of it to tell"
        warnings.warn(
            f"{here}, where fitting ones have {CLEAR:g} or more){why}; features will be wrong if its world is not "
            "that of the cameras",
            SceneWarning,
            stacklevel=2,
        )
        return scene
    fits = f"{here}); with {best.name} it does ({found.correlation:.2f})"
    if best.stated:
        warnings.warn(f"{fits}, and is moved into the world of the cameras", SceneWarning, stacklevel=2)
        return replace(scene, gaussians=moved(scene.gaussians, best, scene.origin))
    if not options.check_fit:
        warnings.warn(f"{fits}; it is used as it is (data.check_fit=false)", SceneWarning, stacklevel=2)
        return scene
    if best.intrinsics_factor != 1:
        values = best.intrinsics_factor * scene.views.cameras.Ks[0][[0, 1, 0, 1], [0, 1, 2, 2]]
        advice = f"give data.intrinsics=[{','.join(f'{value:g}' for value in values)}]"
    else:
        text = json.dumps(best.as_dataparser())
        place = file.parent / DATAPARSER
        what = "in place of what it holds" if place.exists() else "and the splat is moved into the world of the cameras"
        advice = f"save {text} as {place}, {what}"
    raise InputError(f"{fits}: {advice}, or go on with it as it is: data.check_fit=false")


class SmallViews:
    """Some views, evenly spaced, at low size."""

    def __init__(self, views: Views) -> None:
        """Args:
        views: with photographs.
        """
        self._views, self._rows = views, even_indices(len(views), POOL)
        self.cameras = views.cameras.select(self._rows).resized(PIXELS)
        self.picture = cache(self._picture)
        """float64 [h, w] of a view, grey, 0 to 1; NaN where masked. Photographs are decoded once, on access."""

    def _picture(self, view: int) -> Float64[np.ndarray, "_ _"]:
        from PIL import Image

        views, row = self._views, int(self._rows[view])
        assert views.images is not None
        size = int(self.cameras.widths[view]), int(self.cameras.heights[view])
        grey = Image.fromarray(views.images[row]).convert("L").resize(size, Image.Resampling.BOX)
        picture = np.asarray(grey, np.float64) / 255
        if views.masks is not None:
            mask = Image.fromarray(views.masks[row]).resize(size, Image.Resampling.NEAREST)
            picture = np.where(np.asarray(mask), picture, np.nan)
        return picture


def _thinned(gaussians: Gaussians) -> Gaussians:
    """A random choice of the Gaussians, of colors that do not depend on the direction."""
    if len(gaussians) > MAX_GAUSSIANS:
        rows = np.random.default_rng(0).choice(len(gaussians), MAX_GAUSSIANS, replace=False)
        wider = np.float32(np.sqrt(len(gaussians) / MAX_GAUSSIANS))
        gaussians = gaussians.select(np.sort(rows))
        gaussians = replace(gaussians, scales=gaussians.scales * wider)
    return replace(gaussians, sh=gaussians.sh[:, :1])


def agreement(
    gaussians: Gaussians, views: SmallViews, frame: SplatFrame, origin: Float64[np.ndarray, "3"]
) -> Agreement:
    """How a splat agrees with photographs, if its world is that of a frame.

    Args:
        gaussians: relative to `origin`.
        views: photographs.
        frame: the world of the splat.
        origin: that Gaussians and cameras are relative to.
    """
    cameras, scale = _cameras_in(views.cameras, frame, origin), np.float32(frame.scale)
    gaussians = replace(gaussians, means=gaussians.means * scale, scales=gaussians.scales * scale)
    colors = colors_from_sh(torch.as_tensor(gaussians.sh), torch.zeros(1, 3).expand(len(gaussians), 3), torch.ones(3))
    correlations = []
    for view in _best_views(gaussians, cameras):
        picture = views.picture(int(view))
        blended = blend(gaussians, cameras, int(view))
        alpha = blended.alpha.reshape(blended.shape).double().numpy()
        weights = np.where((alpha > 0.5) & np.isfinite(picture), alpha, 0)
        rendered = blended.render(colors).mean(dim=1).reshape(blended.shape).double().numpy()
        rendered = rendered / np.maximum(alpha, 1e-3)
        if weights.mean() < COVERED:
            continue
        valid = np.isfinite(picture).astype(np.float64)
        # Edges of the photograph are compared with those of the rendering, neither with where the other ends.
        expected, made = (_edges(np.nan_to_num(picture), valid * (weights > 0)), _edges(rendered, weights))
        power = [float(np.average(each**2, weights=weights)) for each in (expected, made)]
        if np.sqrt(power[0]) < CONTRAST or power[1] <= 0:
            continue
        correlations.append(float(np.average(expected * made, weights=weights)) / np.sqrt(power[0] * power[1]))
    return Agreement(float(np.median(correlations)) if correlations else 0.0, len(correlations))


def _cameras_in(cameras: Cameras, frame: SplatFrame, origin: Float64[np.ndarray, "3"]) -> Cameras:
    """Cameras that see a splat, only scaled, as the given ones see it moved: the cameras are turned, not the splat."""
    given = cameras.cam_from_world.astype(np.float64)
    rotation, shift, poses = given[:, :3, :3], given[:, :3, 3], given.copy()
    # x_cam = R (s Q (x + o) + t − o) + c = R Q (s x) + R (s Q o + t − o) + c
    offset = frame.scale * frame.rotation @ origin + frame.shift - origin
    poses[:, :3, :3] = rotation @ frame.rotation
    poses[:, :3, 3] = rotation @ offset + shift
    Ks = cameras.Ks.copy()
    Ks[:, :2] *= frame.intrinsics_factor
    return replace(cameras, cam_from_world=poses.astype(cameras.cam_from_world.dtype), Ks=Ks)


def _best_views(gaussians: Gaussians, cameras: Cameras) -> Int64[np.ndarray, " n"]:
    """Some of the views that show many of the Gaussians: at least half as many as the view that shows most."""
    means = gaussians.means[even_indices(len(gaussians), SAMPLES)]
    pixels, depths = cameras.project(means)
    counts = cameras.in_image(pixels, depths).sum(axis=1)
    rows = np.flatnonzero(counts >= max(1, counts.max() / 2))
    return rows[even_indices(len(rows), VIEWS)]


def _edges(values: Float64[np.ndarray, "h w"], weights: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """The band pass of a picture: its weighted mean nearby less the one around."""
    from scipy.ndimage import gaussian_filter

    near, around = (
        gaussian_filter(values * weights, sigma) / np.maximum(gaussian_filter(weights, sigma), 1e-3) for sigma in EDGES
    )
    return near - around
