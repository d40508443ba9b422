"""The stage of the encoder: features of a splat in one pass, judged by the names that fused labels give."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.settings import exact_settings
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.protocols.localization import score_queries
from gsencoder.evaluate.protocols.naming import compare_names
from gsencoder.evaluate.tradeoff.fused_scene import hit_scores, stored_bytes
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.knobs import ENCODER_KNOBS, EncoderSettings, Graph
from gsencoder.infer.load import Encoder
from gsencoder.infer.onnx.runtime import OnnxEncoder
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene


@lru_cache(maxsize=4)
def encoder_of(weights: str, voxel: float, patch: int) -> TorchEncoder:
    """Weights with another grid or other patches than they were trained with; 0 = those of the training."""
    encoder = TorchEncoder(weights)
    config = encoder.network.config
    shape = replace(config.transformer, patch=patch or config.transformer.patch)
    # Both are settings of the grid, from which no parameter has its size.
    encoder.network.config = replace(config, voxel=voxel or config.voxel, transformer=shape)
    return encoder


@lru_cache(maxsize=8)
def graph_of(weights: str, voxel: float, patch: int, graph: Graph) -> OnnxEncoder:
    """The same as an ONNX graph.

    Raises:
        InputError: a package for the export is missing.
    """
    from gsencoder.infer.onnx.export import export_onnx, lower

    assert graph != "none"
    encoder = encoder_of(weights, voxel, patch)
    with tempfile.TemporaryDirectory(prefix="gsencoder_graph_") as folder:
        file = Path(folder) / "encoder.onnx"
        file.write_bytes(export_onnx(encoder, lower(encoder, half=graph == "float16"), graph))
        return OnnxEncoder(str(file), device="cpu")


class EncoderScene:
    """A scene with Gaussians and labels; what holds for one encoder's words is made when its turn comes."""

    def __init__(self, scene: Scene, inputs: Inputs, base: EncoderSettings) -> None:
        self._scene, self._inputs, self._base = scene, inputs, base
        self._truths: dict[str, tuple[str, TextTable, LabelsTeacher, GaussianFeatures]] = {}
        self._references: dict[str, GaussianFeatures] = {}

    def run(self, settings: EncoderSettings) -> GaussianFeatures:
        made_of = (settings.weights, settings.voxel, settings.patch)
        if settings.graph == "none":
            return self._encoded(encoder_of(*made_of), settings.weights, settings.encode)
        # A graph computes in the precision that it was exported in.
        config = replace(settings.encode, precision="auto")
        return self._encoded(graph_of(*made_of, settings.graph), settings.weights, config)

    def _encoded(self, encoder: Encoder, weights: str, config: EncodeConfig) -> GaussianFeatures:
        assert self._scene.gaussians is not None
        unit = unit_of(self._scene, encoder.voxel)
        return encoder.encode(self._scene.gaussians, config, space=self._truth(weights)[0], metres_per_unit=unit)

    def _truth(self, weights: str) -> tuple[str, TextTable, LabelsTeacher, GaussianFeatures]:
        """The first teacher of an encoder that has words, its words, and labels fused in their space."""
        if weights not in self._truths:
            tables = encoder_of(weights, 0.0, 0).tables
            if not tables:
                raise InputError(f"{weights}: no words lie beside the encoder, so that nothing names what it says")
            space, words = next(iter(tables.items()))
            teacher = build_teacher(LabelsConfig(), self._scene, words)
            assert isinstance(teacher, LabelsTeacher)
            self._truths[weights] = (space, words, teacher, fuse(self._scene, teacher, self._inputs.fusion).features)
        return self._truths[weights]

    def judge(self, product: GaussianFeatures, settings: EncoderSettings) -> Judged:
        if settings.weights not in self._references:
            exact = exact_settings(replace(self._base, weights=settings.weights), ENCODER_KNOBS)
            self._references[settings.weights] = self.run(exact)
        _, words, teacher, truth = self._truth(settings.weights)
        counts = compare_names(self._scene.name, truth, product, teacher, {})
        accuracies = [counts.correct[name] / total for name, total in counts.total.items()]
        hits, _ = score_queries(self._scene, product, words, self._inputs.protocol, self._inputs.localize)
        scores = {
            "error": Score(field_error(product, self._references[settings.weights]).total),
            "names": Score(sum(accuracies), len(accuracies)),
            "cosine": Score(counts.cosine),
            **hit_scores(hits),
        }
        return Judged(scores=scores, bytes=stored_bytes(self._scene, product))


def encoder_stage(inputs: Inputs) -> Stage:
    """The encoders that come with the package, on seeds or splats of `inputs`."""
    base = EncoderSettings(encode=inputs.encode)

    @contextmanager
    def opened(path: Path) -> Iterator[EncoderScene]:
        scene = with_gaussians(with_counted_views(load_scene(path, options=inputs.data)), inputs.seeds)
        yield EncoderScene(scene, inputs, base)

    return Stage(name="encoder", knobs=ENCODER_KNOBS, base=base, open=opened, accuracy="names")
