"""The stage of reconstruction: photographs to Gaussians, judged by held-out photographs."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.reconstruct.knobs import RECONSTRUCTION_KNOBS, ReconstructionSettings
from gsencoder.reconstruct.run import Reconstruction, reconstruct

FLOAT_BYTES = 4
FIXED_FLOATS = 11
"""Mean, rotation, scales and opacity of a Gaussian in a .ply."""


class ReconstructionScene:
    """A folder of photographs with poses; reading them at their size is a part of each run."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def run(self, settings: ReconstructionSettings) -> Reconstruction:
        with warnings.catch_warnings():
            # Faults of a scene are the same in each run.
            warnings.simplefilter("ignore", SceneWarning)
            return reconstruct(load_scene(self._path, options=settings.data), settings.reconstruct)

    def judge(self, product: Reconstruction, settings: ReconstructionSettings) -> Judged:  # noqa: ARG002
        if not product.log:
            raise InputError(
                f"{self._path}: no photograph was held out, so that nothing judges the result; give more photographs"
            )
        last, count = product.log[-1], len(product.gaussians)
        scores = {name: Score(float(last[name])) for name in ("psnr", "ssim") if last.get(name) is not None}
        floats = FIXED_FLOATS + product.gaussians.sh[0].size
        return Judged(scores={**scores, "gaussians": Score(count)}, bytes=FLOAT_BYTES * floats * count)


def reconstruction_stage(inputs: Inputs) -> Stage:
    """Reconstruction of scenes with poses; `inputs` say how they are read and seeded."""

    @contextmanager
    def opened(path: Path) -> Iterator[ReconstructionScene]:
        yield ReconstructionScene(path)

    base = ReconstructionSettings(data=inputs.data)
    base = replace(base, reconstruct=replace(base.reconstruct, seeds=inputs.seeds))
    return Stage(name="reconstruction", knobs=RECONSTRUCTION_KNOBS, base=base, open=opened, accuracy="psnr")
