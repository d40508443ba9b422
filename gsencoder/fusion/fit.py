"""Does a splat fit the photographs of its scene? Some views are rendered at low size and compared.

A splat in another world than the cameras fuses without an error, to features of whatever its cameras happen to see.
Renderings and photographs are compared after a band pass, which leaves edges and removes exposure, by their
correlation where the rendering is opaque: splats that fit have 0.6 to 0.9, others 0.4 at most.
"""

import json
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import file_of_scene
from gsencoder.data.readers.posed import rigid_pose
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.scenes import SceneConfig, transforms_in
from gsencoder.geometry import colors_from_sh
from gsencoder.render import blend
from gsencoder.types import Cameras, Gaussians, Scene, Views

DATAPARSER = "dataparser_transforms.json"
"""nerfstudio's file, in the folder of a training: positions of its splats are scale · (transform @ original ones)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SplatFrame:
    """A similarity from the world of a splat's file to that of the cameras: x_world = scale · rotation @ x + shift.

    Attributes:
        from_file: whether a file of the scene says so.
        shift: world units of the cameras.
        intrinsics_factor: factor of K with which the photographs fit, in place of a similarity.
    """

    name: str
    from_file: bool = False
    rotation: Float64[np.ndarray, "3 3"]
    shift: Float64[np.ndarray, "3"]
    scale: float = 1.0
    intrinsics_factor: float = 1.0

    def as_dataparser(self) -> dict[str, object]:
        """What nerfstudio's file would hold: transform (3×4) and scale, from the cameras' world to the splat's."""
        inverse = np.column_stack((self.rotation.T, -self.rotation.T @ self.shift))
        return {"transform": (inverse.round(6) + 0.0).tolist(), "scale": 1 / self.scale}


def identity_frame() -> SplatFrame:
    return SplatFrame(name="the world of the cameras", rotation=np.eye(3), shift=np.zeros(3))


def frames_of_files(folder: Path | None, splat: Path) -> list[SplatFrame]:
    """The frames that files in the folders of a splat and of its scene say it may be in.

    `dataparser_transforms.json` leads from the world before `applied_transform` of transforms.json, as nerfstudio
    writes it, or from that of its matrices, as where there is none."""
    folders = list(dict.fromkeys(each for each in (splat.parent, folder) if each is not None))
    frames = list[SplatFrame]()
    applied = None
    transforms = transforms_in(folder) if folder is not None else None
    if transforms is not None:
        data = read_json(transforms)
        if isinstance(data, dict) and data.get("applied_transform") is not None:
            applied = _pose(data["applied_transform"], f"{transforms}: applied_transform")
    for file in (each / DATAPARSER for each in folders if (each / DATAPARSER).is_file()):
        data = read_json(file)
        scale = data.get("scale") if isinstance(data, dict) else None
        if not isinstance(scale, int | float) or not 0 < scale < np.inf:
            raise InputError(f"{file}: expected an object with a transform (3×4) and a positive scale")
        inverse = np.linalg.inv(_pose(data.get("transform"), f"{file}: transform"))
        for name, pose in ((file.name, inverse), (f"{file.name} and applied_transform", applied)):
            if pose is not None:
                pose = inverse if pose is inverse else pose @ inverse
                frames.append(_frame(name, pose, 1 / scale))
    if applied is not None:
        frames.append(_frame("applied_transform", applied, 1.0))
    return frames


def _frame(name: str, pose: Float64[np.ndarray, "4 4"], scale: float) -> SplatFrame:
    return SplatFrame(name=name, from_file=True, rotation=pose[:3, :3], shift=pose[:3, 3], scale=scale)


def _pose(value: object, where: str) -> Float64[np.ndarray, "4 4"]:
    try:
        rows = np.array(value, np.float64)[:3]
        return rigid_pose(np.vstack((rows, (0, 0, 0, 1))), where)
    except (TypeError, ValueError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where}: expected three rows of four numbers") from error


def usual_frames() -> Iterator[SplatFrame]:
    """The frames that programs write without saying so: other orders and signs of the axes, twice or half the size,
    millimeters or centimeters in place of meters and the reverse; and intrinsics of photographs of twice or half the
    size."""
    for rotation in Rotation.create_group("O").as_matrix().round():
        if not np.array_equal(rotation, np.eye(3)):
            axes = ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in rotation)
            yield SplatFrame(name=f"axes ({axes})", rotation=rotation, shift=np.zeros(3))
    for factor in (2.0, 0.5, 1e-3, 1e-2, 1e2, 1e3):
        yield replace(identity_frame(), name=f"{factor:g} times its size", scale=factor)
    for factor, size in ((2.0, "twice"), (0.5, "half")):
        yield replace(identity_frame(), name=f"{size} the intrinsics", intrinsics_factor=factor)


def moved(gaussians: Gaussians, frame: SplatFrame, origin: Float64[np.ndarray, "3"]) -> Gaussians:
    """A splat in the world of the cameras; positions are relative to `origin`, before and after."""
    from gsencoder.geometry import sh_basis  # with torch

    means = frame.scale * (gaussians.means + origin) @ frame.rotation.T + frame.shift - origin
    turn = Rotation.from_matrix(frame.rotation)
    quats = (turn * Rotation.from_quat(gaussians.quats.astype(np.float64), scalar_first=True)).as_quat(
        scalar_first=True
    )
    sh = gaussians.sh
    if gaussians.sh_degree:
        # The color towards a direction is the one that was seen towards the direction turned back; a fit over many
        # directions is exact, since rotations mix coefficients of one degree alone.
        import torch

        directions = np.random.default_rng(0).normal(size=(4 * sh.shape[1], 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        new, old = (
            sh_basis(torch.as_tensor(each), gaussians.sh_degree).numpy()
            for each in (directions, directions @ frame.rotation)
        )
        sh = np.einsum("kj,njc->nkc", np.linalg.pinv(new) @ old, sh).astype(np.float32)
    return replace(
        gaussians,
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=(gaussians.scales * frame.scale).astype(np.float32),
        sh=sh,
    )


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
    """How renderings and photographs correlate: the median of the views that can be compared, 0 where none can."""

    correlation: float
    compared: int


def with_fitting_splat(scene: Scene, splat: str, options: SceneConfig) -> Scene:
    """The scene with its splat in the world of its cameras: as it is, or moved into it as a file says.

    Args:
        splat: the file of its Gaussians, as `load_scene` takes it; empty = none, and nothing is checked.
        options: how it was read; `check_fit` = whether a splat that does not fit is refused.

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
    for frame in (*frames_of_files(scene.folder, file), *usual_frames()):
        if best.from_file and not frame.from_file and found.correlation >= CLEAR:
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
    if best.from_file:
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
    """How a splat agrees with photographs, if its world is that of a frame; Gaussians and cameras are relative to
    `origin`."""
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
