"""The stage of reconstruction, judged by held-out photographs, at one size whatever the size that is fitted."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.reconstruct.exposure import apply_colors
from gsencoder.reconstruct.knobs import RECONSTRUCTION_KNOBS, ReconstructionSettings
from gsencoder.reconstruct.run import Reconstruction, reconstruct
from gsencoder.render.images import psnr, ssim, view_colors
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.types import Cameras, Gaussians, Scene

FLOAT_BYTES = 4
FIXED_FLOATS = 11
"""Mean, rotation, scales and opacity of a Gaussian in a .ply."""


class ReconstructionScene:
    """A folder of photographs with poses; reading them at their size is a part of each run."""

    def __init__(self, path: Path, data: SceneConfig) -> None:
        """Args:
        path: of the scene.
        data: how it is read for the judgment; a knob may make the photographs that are fitted smaller.
        """
        self._path, self._data = path, data
        self._photographs: Photographs | None = None

    def run(self, settings: ReconstructionSettings) -> Reconstruction:
        return reconstruct(self._read(settings.data), settings.reconstruct)

    @torch.no_grad()
    def judge(self, product: Reconstruction, settings: ReconstructionSettings) -> Judged:
        if not product.held_out:
            raise InputError(
                f"{self._path}: no photograph was held out, so that nothing judges the result; give more photographs"
            )
        if self._photographs is None:
            views = self._read(self._data).views
            assert views is not None
            self._photographs = Photographs(views)
        psnrs, ssims = [], []
        for view, colors in zip(product.held_out, product.held_out_colors, strict=True):
            photo = self._photographs.at_scale(view)
            picture = _render(product.gaussians, self._photographs.cameras, view, settings.reconstruct.raster)
            picture = apply_colors(picture, torch.from_numpy(colors)).clamp(0, 1)
            psnrs.append(psnr(picture, photo.image, photo.mask))
            ssims.append(float(ssim(picture, photo.image, photo.mask)))
        count = len(product.gaussians)
        scores = {"psnr": Score(float(np.mean(psnrs))), "ssim": Score(float(np.mean(ssims))), "gaussians": Score(count)}
        floats = FIXED_FLOATS + product.gaussians.sh[0].size
        return Judged(scores=scores, bytes=FLOAT_BYTES * floats * count)

    def _read(self, data: SceneConfig) -> Scene:
        with warnings.catch_warnings():
            # Faults of a scene are the same in each run.
            warnings.simplefilter("ignore", SceneWarning)
            return load_scene(self._path, options=data)


def _render(gaussians: Gaussians, cameras: Cameras, view: int, config: RasterConfig) -> Float[torch.Tensor, "H W 3"]:
    """A view over black, as a reconstruction renders it."""
    return rasterize(
        torch.from_numpy(gaussians.means),
        torch.from_numpy(gaussians.quats),
        torch.from_numpy(gaussians.scales),
        torch.from_numpy(gaussians.opacities),
        view_colors(gaussians, cameras, view),
        torch.from_numpy(cameras.cam_from_world[view].copy()),
        torch.from_numpy(cameras.Ks[view].copy()),
        int(cameras.widths[view]),
        int(cameras.heights[view]),
        config=config,
    ).rgb


def reconstruction_stage(inputs: Inputs) -> Stage:
    """Reconstruction of scenes with poses; `inputs` say how they are read and seeded."""

    @contextmanager
    def opened(path: Path) -> Iterator[ReconstructionScene]:
        yield ReconstructionScene(path, inputs.data)

    base = ReconstructionSettings(data=inputs.data)
    base = replace(base, reconstruct=replace(base.reconstruct, seeds=inputs.seeds))
    return Stage(name="reconstruction", knobs=RECONSTRUCTION_KNOBS, base=base, open=opened, accuracy="psnr")
