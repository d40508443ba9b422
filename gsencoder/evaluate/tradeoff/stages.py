"""The stages whose knobs are swept: reconstruction, fusion, encoding, localization, views and packages."""

import io
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import Knob, exact_settings
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.benchmarks.localization import Hit, queryable_objects, score_queries
from gsencoder.evaluate.benchmarks.naming import compare_names
from gsencoder.evaluate.tradeoff.stage import Inputs, Judged, Score, Stage
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.folder import save_features
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.package import (
    FUSION_KNOBS,
    PACKAGE_KNOBS,
    SPLAT_FILE,
    PackageSettings,
    load_package,
    save_arrays,
    save_index_package,
    save_package,
    save_ply,
)
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.draw import Picture
from gsencoder.infer.encode import TorchEncoder
from gsencoder.infer.load import Encoder
from gsencoder.infer.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.onnx.runtime import OnnxEncoder
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.scores import score_views
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet, target_of, targets_of
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.reconstruct.parameters import apply_colors
from gsencoder.reconstruct.plan import ReconstructBudget
from gsencoder.reconstruct.run import ReconstructConfig, Reconstruction, reconstruct
from gsencoder.render import BlendConfig
from gsencoder.render.images import psnr, ssim, view_colors
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.teachers.build import build_teacher, text_table_of
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.table import TextTable
from gsencoder.types import Cameras, GaussianFeatures, Gaussians, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings:
    """How photographs are read and become Gaussians. The budget of minutes is off: it would choose steps and sizes."""

    data: SceneConfig = field(default_factory=SceneConfig)
    reconstruct: ReconstructConfig = field(
        default_factory=lambda: ReconstructConfig(budget=ReconstructBudget(minutes=0.0), validate_every=0)
    )


RECONSTRUCTION_KNOBS = (
    Knob(name="steps", key="reconstruct.optimize.steps", values=(200, 400, 800)),
    Knob(name="voxel", key="reconstruct.seeds.voxel", values=(0.015, 0.03, 0.04)),
    Knob(name="image_scale", key="data.image_scale", values=(0.35, 0.5, 0.7)),
    Knob(name="sh_degree", key="reconstruct.optimize.sh_degree", values=(0, 1)),
)
"""Knobs of `ReconstructionSettings`; none has an exact value, since more steps and Gaussians can also fit noise."""


Graph = Literal["none", "float32", "float16", "int8_weights", "int8_dynamic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderSettings:
    """Which encoder runs, and how.

    Attributes:
        weights: see `gsencoder.models.output_space.find_weights`.
        graph: precision of an ONNX graph that is run in place of torch; none = torch.
        voxel: edge of the token grid in metres; 0 = that of the training.
        patch: largest number of tokens of a patch; 0 = that of the training.
        encode: chunks, halo and torch's precision.
    """

    weights: str = "shipped:house_cpu"
    graph: Graph = "none"
    voxel: float = 0.0
    patch: int = 0
    encode: EncodeConfig = field(default_factory=EncodeConfig)

    def __post_init__(self) -> None:
        if self.voxel < 0 or self.patch < 0:
            raise InputError(
                f"voxel, patch: expected 0 (as in the training) or more, got {self.voxel} and {self.patch}"
            )


ENCODER_KNOBS = (
    Knob(name="weights", key="weights", values=("shipped:house_cpu", "shipped:house")),
    Knob(name="graph", key="graph", values=("float32", "int8_weights", "int8_dynamic"), exact="none"),
    Knob(name="precision", key="encode.precision", values=("float32", "bfloat16"), exact="float32"),
    Knob(name="voxel", key="voxel", values=(0.015, 0.03, 0.04), exact=0.0),
    Knob(name="patch", key="patch", values=(32, 64, 256), exact=0),
    Knob(name="chunk", key="encode.chunk", values=(10_000, 20_000, 40_000), exact=0),
    Knob(name="halo", key="encode.halo", values=(0.0, 0.32, 1.28), needs={"chunk": 20_000}),
)
"""Knobs of `EncoderSettings`. The halo has an effect where there are several chunks."""

LOCALIZATION_KNOBS = (
    Knob(name="relative", key="threshold.relative", values=(0.5, 0.6, 0.8, 0.9)),
    Knob(name="fixed", key="threshold.fixed", values=(0.3, 0.4, 0.6, 0.7)),
    Knob(name="noise", key="threshold.noise", values=(1.0, 4.0)),
    Knob(name="kind", key="threshold.kind", values=("fixed", "relative", "otsu")),
    Knob(name="eps_spacings", key="eps_spacings", values=(1.0, 2.0, 3.0)),
)
"""Knobs of `gsencoder.infer.localize.LocalizeConfig`; nothing but labels says which is right."""

VIEWS_KNOBS = (
    Knob(name="candidates", key="candidates", values=(8, 16, 64), exact=64),
    Knob(name="count", key="count", values=(2, 4, 6)),
    Knob(name="judged_side", key="judged_side", values=(64, 96, 320), exact=320),
)
"""Knobs of `gsencoder.infer.views.targets.ViewsConfig`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaughtScene:
    """A scene with Gaussians and a teacher, whose maps are computed once.

    Attributes:
        scene: with Gaussians.
        teacher: cached.
        words: the teacher's; None where it has none.
        inputs: what it was made with.
    """

    scene: Scene
    teacher: CachedTeacher
    words: TextTable | None
    inputs: Inputs

    def fused(self) -> GaussianFeatures:
        """Features by the settings of fusion that no knob changes."""
        return fuse(self.scene, self.teacher, self.inputs.fusion).features

    def hits(self, features: GaussianFeatures, localize: LocalizeConfig | None = None) -> list[Hit]:
        """One for each object that is queried; none where the teacher has no words."""
        if self.words is None:
            return []
        config = self.inputs.localize if localize is None else localize
        return score_queries(self.scene, features, self.words, self.inputs.protocol, config)[0]

    def with_fused(self) -> Scene:
        """The scene with its fused features."""
        features = self.fused()
        return replace(self.scene, features={features.space.name: features})

    def need_words(self, stage: str) -> TextTable:
        """The words.

        Raises:
            InputError: there are none.
        """
        if self.words is None:
            raise InputError(
                f"tradeoff: the stage {stage} asks for words, and the teacher has none; give teacher=labels"
            )
        return self.words


@contextmanager
def taught_scene(path: Path, inputs: Inputs) -> Iterator[TaughtScene]:
    """Reads a scene, seeds it where it has no Gaussians, and builds its teacher."""
    words = text_table_of(inputs.teacher)
    scene = load_scene(path, options=inputs.data)
    scene = with_gaussians(with_counted_views(scene) if words is not None else scene, inputs.seeds)
    with tempfile.TemporaryDirectory(prefix="gsencoder_maps_") as maps:
        teacher = CachedTeacher(build_teacher(inputs.teacher, scene, words), Path(maps))
        yield TaughtScene(scene=scene, teacher=teacher, words=words, inputs=inputs)


def hit_scores(hits: list[Hit]) -> Mapping[str, Score]:
    """Acc@0.25 and Acc@0.5 as sums over objects; nothing where none is queried."""
    if not hits:
        return {}
    return {
        f"acc_{round(100 * threshold)}": Score(float(sum(hit.iou >= threshold for hit in hits)), len(hits))
        for threshold in (0.25, 0.5)
    }


def stored_bytes(scene: Scene, features: GaussianFeatures) -> int:
    """Bytes of the file of features alone, as every command writes it."""
    from gsencoder.fusion.folder import FEATURES_FILE

    with tempfile.TemporaryDirectory(prefix="gsencoder_stored_") as folder:
        save_features(folder, scene, features)
        return (Path(folder) / FEATURES_FILE).stat().st_size


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
        counts = compare_names(truth, product, teacher)
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


MAX_OBJECTS = 3
"""Objects of a scene that views are chosen of, evenly spread over those that were localized."""
JUDGED_SIDE = 480


class ChosenViews(NamedTuple):
    """Views of one object, and what they look like."""

    views: ViewSet
    pictures: list[Picture]


class ViewsScene:
    """A scene, what was localized in it, and where the objects really are."""

    def __init__(self, taught: TaughtScene) -> None:
        words = taught.need_words("views")
        scene = taught.with_fused()
        assert scene.views is not None
        # Chosen views are judged as renders, as they are when features are all that there is.
        self._scene = replace(scene, views=replace(scene.views, images=None))
        assert scene.gaussians is not None
        protocol = taught.inputs.protocol
        objects = queryable_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
        names = list(dict.fromkeys(scene_object.name for scene_object in objects if scene_object.name))
        if not names:
            raise InputError(f"tradeoff: scene {scene.name} has no object to choose views of")
        boxes = localize(scene, names, words, taught.inputs.localize)
        pairs: list[tuple[Target, Target]] = []
        means = scene.gaussians.means + scene.origin
        for target in targets_of(scene.gaussians, boxes):
            same = [scene_object for scene_object in objects if scene_object.name == target.name]
            away = [
                np.linalg.norm((scene_object.aabb_min + scene_object.aabb_max) / 2 - scene.origin - target.center)
                for scene_object in same
            ]
            nearest = same[int(np.argmin(away))]
            rows = np.flatnonzero(((means >= nearest.aabb_min) & (means <= nearest.aabb_max)).all(axis=1))
            if len(rows):
                pairs.append((target, target_of(target.name, scene.gaussians, rows)))
        if not pairs:
            raise InputError(f"tradeoff: no object of scene {scene.name} was localized, so that it has no views")
        self._pairs = [pairs[index] for index in even_indices(len(pairs), MAX_OBJECTS)]

    def run(self, settings: ViewsConfig) -> list[ChosenViews]:
        selections = []
        for target, _ in self._pairs:
            views = choose_views(self._scene, [target], settings)
            selections.append(ChosenViews(views, view_pictures(self._scene, views)[0]))
        return selections

    def judge(self, product: list[ChosenViews], settings: ViewsConfig) -> Judged:  # noqa: ARG002
        assert self._scene.gaussians is not None
        share = visible = 0.0
        for (_, truth), each in zip(self._pairs, product, strict=True):
            near = replace(BlendConfig(), near=min(BlendConfig().near, each.views.near))
            (box_scores,) = score_views(
                self._scene.gaussians, each.views.cameras, [truth], side=JUDGED_SIDE, config=near
            )
            share += float(box_scores.share.mean())
            visible += float((box_scores.visible * box_scores.inside).mean())
        count = len(product)
        scores = {
            "object_share": Score(share, count),
            "visible": Score(visible, count),
            "views": Score(float(sum(len(each.views) for each in product)), count),
        }
        return Judged(scores=scores, bytes=sum(png_bytes(picture) for each in product for picture in each.pictures))


def png_bytes(picture: Picture) -> int:
    """Bytes of a picture as it is sent to a model."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG")
    return len(stream.getvalue())


def views_stage(inputs: Inputs) -> Stage:
    """Views of objects that are localized in features that `inputs` say how to fuse."""

    @contextmanager
    def opened(path: Path) -> Iterator[ViewsScene]:
        with taught_scene(path, inputs) as taught:
            yield ViewsScene(taught)

    return Stage(name="views", knobs=VIEWS_KNOBS, base=inputs.views, open=opened, accuracy="visible")
