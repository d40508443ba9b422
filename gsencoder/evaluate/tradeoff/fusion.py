"""The stage of fusion: blending, visibility, basis and lift, without the teacher, whose maps are computed once."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsencoder.core.settings import exact_settings
from gsencoder.evaluate.tradeoff.fused_scene import TaughtScene, hit_scores, stored_bytes, taught_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.package import FUSION_KNOBS
from gsencoder.types import GaussianFeatures


class FusionScene:
    """A scene to fuse, and its features at the exact settings, which others are compared with."""

    def __init__(self, taught: TaughtScene, base: FuseConfig) -> None:
        self._taught = taught
        self._reference = fuse(taught.scene, taught.teacher, exact_settings(base, FUSION_KNOBS)).features

    def run(self, settings: FuseConfig) -> GaussianFeatures:
        return fuse(self._taught.scene, self._taught.teacher, settings).features

    def judge(self, product: GaussianFeatures, settings: FuseConfig) -> Judged:  # noqa: ARG002
        error = field_error(product, self._reference)
        scores = {
            "error": Score(error.total),
            "covered": Score(error.covered),
            "rank": Score(product.features.shape[1]),
            **hit_scores(self._taught.hits(product)),
        }
        return Judged(scores=scores, bytes=stored_bytes(self._taught.scene, product))


def fusion_stage(inputs: Inputs) -> Stage:
    """Fusion with the teacher, the seeds and the words of `inputs`."""

    @contextmanager
    def opened(path: Path) -> Iterator[FusionScene]:
        with taught_scene(path, inputs) as taught:
            yield FusionScene(taught, inputs.fusion)

    return Stage(name="fusion", knobs=FUSION_KNOBS, base=inputs.fusion, open=opened, accuracy="error")
