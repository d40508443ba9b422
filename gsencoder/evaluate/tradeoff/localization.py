"""The stage of localization: words to boxes in fused features that stay the same."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.evaluate.boxes import Hit
from gsencoder.evaluate.tradeoff.fused_scene import TaughtScene, hit_scores, taught_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Stage
from gsencoder.infer.knobs import LOCALIZATION_KNOBS
from gsencoder.infer.localize import LocalizeConfig


class LocalizationScene:
    """A scene with features, whose objects are queried by name."""

    def __init__(self, taught: TaughtScene) -> None:
        taught.need_words("localization")
        self._taught, self._features = taught, taught.fused()
        if not taught.hits(self._features):
            raise InputError(
                f"tradeoff: scene {taught.scene.name} has no object to localize; expected placed, named objects that "
                "are seen well enough (asked.min_views and asked.min_pixels)"
            )

    def run(self, settings: LocalizeConfig) -> list[Hit]:
        return self._taught.hits(self._features, settings)

    def judge(self, product: list[Hit], settings: LocalizeConfig) -> Judged:  # noqa: ARG002
        return Judged(scores=hit_scores(product), bytes=0)


def localization_stage(inputs: Inputs) -> Stage:
    """Localization in features that `inputs` say how to fuse."""

    @contextmanager
    def opened(path: Path) -> Iterator[LocalizationScene]:
        with taught_scene(path, inputs) as taught:
            yield LocalizationScene(taught)

    return Stage(name="localization", knobs=LOCALIZATION_KNOBS, base=inputs.localize, open=opened, accuracy="acc_25")
