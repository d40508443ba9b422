"""The stage of packages: features as bytes, read back."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsencoder.evaluate.tradeoff.fused_scene import TaughtScene, hit_scores, taught_scene
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.package import (
    PACKAGE_KNOBS,
    SPLAT_FILE,
    PackageSettings,
    load_package,
    save_arrays,
    save_index_package,
    save_package,
    save_ply,
)
from gsencoder.infer.localize import select_features
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.types import GaussianFeatures


class PackageScene:
    """A scene whose features are packed into a folder again and again."""

    def __init__(self, taught: TaughtScene, folder: Path) -> None:
        self._taught, self._scene, self._folder = taught, taught.with_fused(), folder
        (self._features,) = self._scene.features.values()

    def run(self, settings: PackageSettings) -> Path:
        target = Path(tempfile.mkdtemp(dir=self._folder))
        if settings.form == "compact":
            save_package(target, self._scene, self._features, error=settings.error)
        elif settings.form == "index":
            indexed = index_features(self._features, IndexConfig(threshold=settings.threshold))
            save_index_package(target, self._scene, indexed.features, error=indexed.error)
        elif settings.form == "ply":
            save_ply(target, self._scene, self._features, decoded=False)
        else:
            save_arrays(target, self._scene, self._features, settings.form, decoded=False)
        return target

    def judge(self, product: Path, settings: PackageSettings) -> Judged:
        size = sum(file.stat().st_size for file in product.iterdir() if file.name != SPLAT_FILE)
        # Arrays for other programs hold the features as they are.
        features: GaussianFeatures = self._features
        if settings.form in ("compact", "index"):
            features = select_features(load_package(product), None)[1]
        error = field_error(features, self._features)
        scores = {"error": Score(error.total), **hit_scores(self._taught.hits(features))}
        return Judged(scores=scores, bytes=size)


def packages_stage(inputs: Inputs) -> Stage:
    """Packages of features that `inputs` say how to fuse."""

    @contextmanager
    def opened(path: Path) -> Iterator[PackageScene]:
        with taught_scene(path, inputs) as taught, tempfile.TemporaryDirectory(prefix="gsencoder_packed_") as folder:
            yield PackageScene(taught, Path(folder))

    return Stage(
        name="packages", knobs=PACKAGE_KNOBS, base=PackageSettings(), open=opened, accuracy="error", cost="bytes"
    )
