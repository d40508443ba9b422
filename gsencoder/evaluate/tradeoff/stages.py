"""The stages whose knobs are swept: reconstruction, fusion, encoding, localization, views and packages.

A new knob is a row in the list of its stage. A new stage is a function that opens a scene, and a line in `make_stage`.
"""

import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import picture_bytes
from gsencoder.core.settings import CheckedConfig, Knob, exact_settings, option
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.evaluate.benchmarks.localization import Hit, LocalizationProtocol, queryable_objects, score_queries
from gsencoder.evaluate.benchmarks.naming import compare_names
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.checkpoint import CachedTeacher
from gsencoder.fusion.folder import FEATURES_FILE, save_features
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
from gsencoder.infer.draw import Picture
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.infer.views.choose import choose_views, score_views
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.targets import ViewsConfig, ViewSet, target_of, targets_of
from gsencoder.memory.index import IndexConfig, index_features
from gsencoder.reconstruct.plan import ReconstructBudget
from gsencoder.reconstruct.run import ReconstructConfig, Reconstruction, reconstruct
from gsencoder.render import BlendConfig
from gsencoder.render.images import apply_colors, psnr, ssim, view_colors
from gsencoder.render.rasterize import rasterize
from gsencoder.teachers.build import TeacherConfig, text_table_of
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

StageName = Literal["reconstruction", "fusion", "encoder", "packages", "localization", "views"]
Cost = Literal["cpu_seconds", "seconds", "mib", "bytes"]
"""What a run costs: CPU seconds of all threads, wall-clock seconds, growth of peak memory, bytes written."""

HIGHER_IS_BETTER = {
    "acc_25": True,
    "acc_50": True,
    "error": False,
    "covered": True,
    "rank": False,
    "psnr": True,
    "ssim": True,
    "names": True,
    "cosine": True,
    "object_share": True,
    "visible": True,
    "views": False,
    "gaussians": False,
}
"""The scores that stages give, and whether more of one is better."""


class Score(NamedTuple):
    """A score of one scene as a sum over `things` that count alike (objects, names, or the scene itself)."""

    total: float
    things: float = 1.0


Scores = dict[str, Score]
"""By the names of `HIGHER_IS_BETTER`."""
Opened = tuple[Callable[[Any], Any], Callable[[Any, Any], tuple[Scores, int]]]
"""A scene with all that no knob changes: run(settings) -> product, which is timed, and judge(product, settings) -> its
scores against labels or the exact reference, and the bytes that it takes as files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage and its knobs.

    Attributes:
        base: the settings that a sweep starts from, the "defaults" of its tables.
        open: prepares a scene; entered once for all runs on it.
        accuracy: the score that the front is drawn with.
        cost: what the front is drawn with.
    """

    name: StageName
    knobs: tuple[Knob, ...]
    base: Any
    open: Callable[[Path], AbstractContextManager[Opened]]
    accuracy: str
    cost: Cost = "cpu_seconds"


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What stages start from, which no knob changes. Without slots, for a command to inherit."""

    asked: LocalizationProtocol = field(default_factory=LocalizationProtocol)
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class TaughtScene:
    """A scene with Gaussians, a teacher whose maps are computed once, and its words, if it has any."""

    scene: Scene
    teacher: CachedTeacher
    words: TextTable | None
    inputs: Inputs

    def fused(self) -> GaussianFeatures:
        return fuse(self.scene, self.teacher, self.inputs.fusion).features

    def hits(self, features: GaussianFeatures, localize: LocalizeConfig | None = None) -> list[Hit]:
        """One for each object that is queried; none where the teacher has no words."""
        if self.words is None:
            return []
        return score_queries(self.scene, features, self.words, self.inputs.asked, localize or self.inputs.localize)[0]


@contextmanager
def taught_scene(inputs: Inputs, path: Path, needs_words: str = "") -> Iterator[TaughtScene]:
    """Reads a scene, seeds it where it has no Gaussians, and builds its teacher; `needs_words` names a stage that asks
    for words."""
    words = text_table_of(inputs.teacher)
    if words is None and needs_words:
        raise InputError(
            f"tradeoff: the stage {needs_words} asks for words, and the teacher has none; give teacher=labels"
        )
    scene = load_scene(path, options=inputs.data)
    scene = with_gaussians(with_counted_views(scene) if words is not None else scene, inputs.seeds)
    with tempfile.TemporaryDirectory(prefix="gsencoder_maps_") as maps:
        teacher = CachedTeacher(inputs.teacher.build(scene, words), Path(maps))
        yield TaughtScene(scene=scene, teacher=teacher, words=words, inputs=inputs)


def hit_scores(hits: list[Hit]) -> Scores:
    """Acc@0.25 and Acc@0.5 as sums over objects; nothing where none is queried."""
    if not hits:
        return {}
    return {
        f"acc_{round(100 * threshold)}": Score(float(sum(hit.iou >= threshold for hit in hits)), len(hits))
        for threshold in (0.25, 0.5)
    }


def stored_bytes(scene: Scene, features: GaussianFeatures) -> int:
    """Bytes of the file of features alone, as every command writes it."""
    with tempfile.TemporaryDirectory(prefix="gsencoder_stored_") as folder:
        save_features(folder, scene, features)
        return (Path(folder) / FEATURES_FILE).stat().st_size


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
FLOAT_BYTES = 4
FIXED_FLOATS = 11
"""Mean, rotation, scales and opacity of a Gaussian in a .ply."""


@contextmanager
def open_reconstruction(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A folder of photographs with poses; reading them at their size is a part of each run. Whatever size is fitted,
    held-out photographs are judged in that of `inputs`."""

    def read(data: SceneConfig) -> Scene:
        with warnings.catch_warnings():
            # Faults of a scene are the same in each run.
            warnings.simplefilter("ignore", SceneWarning)
            return load_scene(path, options=data)

    def run(settings: ReconstructionSettings) -> Reconstruction:
        return reconstruct(read(settings.data), settings.reconstruct)

    views = read(inputs.data).views
    photographs = None if views is None else Photographs(views)

    @torch.no_grad()
    def judge(product: Reconstruction, settings: ReconstructionSettings) -> tuple[Scores, int]:
        if not product.held_out:
            raise InputError(
                f"{path}: no photograph was held out, so that nothing judges the result; give more photographs"
            )
        assert photographs is not None
        cameras, gaussians = photographs.cameras, product.gaussians
        psnrs, ssims = [], []
        for view, colors in zip(product.held_out, product.held_out_colors, strict=True):
            photo = photographs.at_scale(view)
            picture = rasterize(
                torch.from_numpy(gaussians.means),
                torch.from_numpy(gaussians.quats),
                torch.from_numpy(gaussians.scales),
                torch.from_numpy(gaussians.opacities),
                view_colors(gaussians, cameras, view),
                torch.from_numpy(cameras.cam_from_world[view].copy()),
                torch.from_numpy(cameras.Ks[view].copy()),
                int(cameras.widths[view]),
                int(cameras.heights[view]),
                config=settings.reconstruct.raster,
            ).rgb
            picture = apply_colors(picture, torch.from_numpy(colors)).clamp(0, 1)
            psnrs.append(psnr(picture, photo.image, photo.mask))
            ssims.append(float(ssim(picture, photo.image, photo.mask)))
        count = len(gaussians)
        scores = {"psnr": Score(float(np.mean(psnrs))), "ssim": Score(float(np.mean(ssims))), "gaussians": Score(count)}
        return scores, FLOAT_BYTES * (FIXED_FLOATS + gaussians.sh[0].size) * count

    yield run, judge


@contextmanager
def open_fusion(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A scene to fuse, whose features are compared with those at the exact settings."""
    with taught_scene(inputs, path) as taught:

        def run(settings: FuseConfig) -> GaussianFeatures:
            return fuse(taught.scene, taught.teacher, settings).features

        reference = run(exact_settings(inputs.fusion, FUSION_KNOBS))

        def judge(product: GaussianFeatures, _: FuseConfig) -> tuple[Scores, int]:
            error = field_error(product, reference)
            scores = {
                "error": Score(error.total),
                "covered": Score(error.covered),
                "rank": Score(product.features.shape[1]),
                **hit_scores(taught.hits(product)),
            }
            return scores, stored_bytes(taught.scene, product)

        yield run, judge


Graph = Literal["none", "float32", "float16", "int8_weights", "int8_dynamic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderSettings(CheckedConfig):
    """Which encoder runs, and how; 0 = as in its training.

    Attributes:
        graph: precision of an ONNX graph that is run in place of torch; none = torch.
        voxel: edge of the token grid in metres.
        patch: largest number of tokens of a patch.
    """

    weights: str = "shipped:rooms"
    graph: Graph = "none"
    voxel: float = option(0.0, "edge of the token grid, metres", ge=0)
    patch: int = option(0, "largest number of tokens of a patch", ge=0)
    encode: EncodeConfig = field(default_factory=EncodeConfig)


ENCODER_KNOBS = (
    Knob(name="weights", key="weights", values=("shipped:rooms", "shipped:house")),
    Knob(name="graph", key="graph", values=("float32", "int8_weights", "int8_dynamic"), exact="none"),
    Knob(name="precision", key="encode.precision", values=("float32", "bfloat16"), exact="float32"),
    Knob(name="voxel", key="voxel", values=(0.015, 0.03, 0.04), exact=0.0),
    Knob(name="patch", key="patch", values=(32, 64, 256), exact=0),
    Knob(name="chunk", key="encode.chunk", values=(10_000, 20_000, 40_000), exact=0),
    Knob(name="halo", key="encode.halo", values=(0.0, 0.32, 1.28), needs={"chunk": 20_000}),
)
"""Knobs of `EncoderSettings`. The halo has an effect where there are several chunks."""


@lru_cache(maxsize=4)
def encoder_of(weights: str, voxel: float, patch: int) -> Encoder:
    """Weights with another grid or other patches than they were trained with; 0 = those of the training."""
    network = TorchNetwork.load(weights)
    config, header = network.module.config, network.header
    shape = replace(config.transformer, patch=patch or config.transformer.patch)
    # Both are settings of the grid, from which no parameter has its size.
    network.module.config = replace(config, voxel=voxel or config.voxel, transformer=shape)
    return Encoder(TorchNetwork(network.module, header.outputs, header.tables, header.made_by))


@lru_cache(maxsize=8)
def graph_of(weights: str, voxel: float, patch: int, graph: Graph) -> Encoder:
    """The same as an ONNX graph."""
    from gsencoder.infer.onnx.export import export_onnx

    assert graph != "none"
    network = encoder_of(weights, voxel, patch).network
    with tempfile.TemporaryDirectory(prefix="gsencoder_graph_") as folder:
        file = Path(folder) / "encoder.onnx"
        lowered = network.lower(half=graph == "float16")
        file.write_bytes(export_onnx(replace(network.header, precision=graph), lowered))
        return Encoder.load(str(file), "cpu")


@contextmanager
def open_encoder(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A scene with Gaussians and labels; what holds for one encoder's words is made when its turn comes."""
    scene = with_gaussians(with_counted_views(load_scene(path, options=inputs.data)), inputs.seeds)
    gaussians = scene.gaussians
    assert gaussians is not None

    @lru_cache
    def labels_of(weights: str) -> tuple[str, TextTable, LabelsTeacher, GaussianFeatures]:
        """The first teacher of an encoder that has words, its words, and labels fused in their space."""
        tables = encoder_of(weights, 0.0, 0).tables
        if not tables:
            raise InputError(f"{weights}: no words lie next to the encoder, so that nothing names what it says")
        space, words = next(iter(tables.items()))
        teacher = LabelsConfig().build(scene, words)
        return space, words, teacher, fuse(scene, teacher, inputs.fusion).features

    def run(settings: EncoderSettings) -> GaussianFeatures:
        shape, config = (settings.weights, settings.voxel, settings.patch), settings.encode
        if settings.graph != "none":
            # A graph computes in the precision that it was exported in.
            config = replace(config, precision="auto")
        encoder = encoder_of(*shape) if settings.graph == "none" else graph_of(*shape, settings.graph)
        space, unit = labels_of(settings.weights)[0], unit_of(scene)
        return encoder.encode(gaussians, config, space=space, metres_per_unit=unit, up=scene.up)

    @lru_cache
    def reference_of(weights: str) -> GaussianFeatures:
        return run(exact_settings(EncoderSettings(weights=weights, encode=inputs.encode), ENCODER_KNOBS))

    def judge(product: GaussianFeatures, settings: EncoderSettings) -> tuple[Scores, int]:
        _, words, teacher, labeled = labels_of(settings.weights)
        counts = compare_names(labeled, product, teacher)
        accuracies = [counts.correct[name] / total for name, total in counts.total.items()]
        hits, _ = score_queries(scene, product, words, inputs.asked, inputs.localize)
        scores = {
            "error": Score(field_error(product, reference_of(settings.weights)).total),
            "names": Score(sum(accuracies), len(accuracies)),
            "cosine": Score(counts.cosine),
            **hit_scores(hits),
        }
        return scores, stored_bytes(scene, product)

    yield run, judge


@contextmanager
def open_packages(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A scene whose features are packed into a folder again and again."""
    with taught_scene(inputs, path) as taught, tempfile.TemporaryDirectory(prefix="gsencoder_packed_") as folder:
        features = taught.fused()
        scene = replace(taught.scene, features={features.space.name: features})

        def run(settings: PackageSettings) -> Path:
            target = Path(tempfile.mkdtemp(dir=folder))
            if settings.form == "compact":
                save_package(target, scene, features, error=settings.error)
            elif settings.form == "index":
                indexed = index_features(features, IndexConfig(threshold=settings.threshold))
                save_index_package(target, scene, indexed.features, error=indexed.error)
            elif settings.form == "ply":
                save_ply(target, scene, features, decoded=False)
            else:
                save_arrays(target, scene, features, settings.form, decoded=False)
            return target

        def judge(product: Path, settings: PackageSettings) -> tuple[Scores, int]:
            size = sum(file.stat().st_size for file in product.iterdir() if file.name != SPLAT_FILE)
            # Arrays for other programs hold the features as they are.
            packed = features
            if settings.form in ("compact", "index"):
                packed = select_features(load_package(product), None)[1]
            return {"error": Score(field_error(packed, features).total), **hit_scores(taught.hits(packed))}, size

        yield run, judge


LOCALIZATION_KNOBS = (
    Knob(name="relative", key="threshold.relative", values=(0.5, 0.6, 0.8, 0.9)),
    Knob(name="fixed", key="threshold.fixed", values=(0.3, 0.4, 0.6, 0.7)),
    Knob(name="kind", key="threshold.kind", values=("fixed", "relative", "otsu")),
    Knob(name="eps_spacings", key="eps_spacings", values=(1.0, 2.0, 3.0)),
)
"""Knobs of `gsencoder.infer.localize.LocalizeConfig`; nothing but labels says which is right."""


@contextmanager
def open_localization(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A scene with features, whose objects are queried by name."""
    with taught_scene(inputs, path, "localization") as taught:
        features = taught.fused()
        if not taught.hits(features):
            raise InputError(
                f"tradeoff: scene {taught.scene.name} has no object to localize; expected placed, named objects that "
                "are seen well enough (asked.min_views and asked.min_pixels)"
            )
        yield partial(taught.hits, features), lambda hits, _: (hit_scores(hits), 0)


VIEWS_KNOBS = (
    Knob(name="candidates", key="candidates", values=(8, 16, 64), exact=64),
    Knob(name="count", key="count", values=(2, 4, 6)),
    Knob(name="judged_side", key="judged_side", values=(64, 96, 320), exact=320),
)
"""Knobs of `gsencoder.infer.views.targets.ViewsConfig`."""
MAX_OBJECTS = 3
"""Objects of a scene that views are chosen of, evenly spread over those that were localized."""
JUDGED_SIDE = 480


@contextmanager
def open_views(inputs: Inputs, path: Path) -> Iterator[Opened]:
    """A scene, what was localized in it, and where the objects really are."""
    with taught_scene(inputs, path, "views") as taught:
        features, views, words = taught.fused(), taught.scene.views, taught.words
        assert views is not None
        assert words is not None
        # Chosen views are judged as renders, as they are when features are all that there is.
        scene = replace(taught.scene, features={features.space.name: features}, views=replace(views, images=None))
        gaussians = scene.gaussians
        assert gaussians is not None
        objects = queryable_objects(scene.objects, min_views=inputs.asked.min_views, min_pixels=inputs.asked.min_pixels)
        names = list(dict.fromkeys(each.name for each in objects if each.name))
        if not names:
            raise InputError(f"tradeoff: scene {scene.name} has no object to choose views of")
        pairs = []
        means = gaussians.means + scene.origin
        for target in targets_of(gaussians, localize(scene, names, words, inputs.localize)):
            same = [each for each in objects if each.name == target.name]
            away = [np.linalg.norm((each.aabb_min + each.aabb_max) / 2 - scene.origin - target.center) for each in same]
            nearest = same[int(np.argmin(away))]
            rows = np.flatnonzero(((means >= nearest.aabb_min) & (means <= nearest.aabb_max)).all(axis=1))
            if len(rows):
                pairs.append((target, target_of(target.name, gaussians, rows)))
        if not pairs:
            raise InputError(f"tradeoff: no object of scene {scene.name} was localized, so that it has no views")
        pairs = [pairs[index] for index in even_indices(len(pairs), MAX_OBJECTS)]

        def run(settings: ViewsConfig) -> list[tuple[ViewSet, list[Picture]]]:
            chosen = [choose_views(scene, [target], settings) for target, _ in pairs]
            return [(each, view_pictures(scene, each)[0]) for each in chosen]

        def judge(product: list[tuple[ViewSet, list[Picture]]], settings: ViewsConfig) -> tuple[Scores, int]:  # noqa: ARG001
            share = visible = 0.0
            for (_, labeled), (chosen, _) in zip(pairs, product, strict=True):
                near = replace(BlendConfig(), near=min(BlendConfig().near, chosen.near))
                (scores,) = score_views(gaussians, chosen.cameras, [labeled], side=JUDGED_SIDE, config=near)
                share += float(scores.share.mean())
                visible += float((scores.visible * scores.inside).mean())
            count = len(product)
            sizes = [
                len(picture_bytes(picture, ".png", compress_level=6)) for _, pictures in product for picture in pictures
            ]
            views_of_all = float(sum(len(chosen) for chosen, _ in product))
            return {
                "object_share": Score(share, count),
                "visible": Score(visible, count),
                "views": Score(views_of_all, count),
            }, sum(sizes)

        yield run, judge


def make_stage(name: StageName, inputs: Inputs) -> Stage:
    """A stage that starts from `inputs`."""
    photographs = ReconstructionSettings(data=inputs.data)
    photographs = replace(photographs, reconstruct=replace(photographs.reconstruct, seeds=inputs.seeds))
    encoder = EncoderSettings(encode=inputs.encode)
    opened, knobs, base, accuracy = {
        "reconstruction": (open_reconstruction, RECONSTRUCTION_KNOBS, photographs, "psnr"),
        "fusion": (open_fusion, FUSION_KNOBS, inputs.fusion, "error"),
        "encoder": (open_encoder, ENCODER_KNOBS, encoder, "names"),
        "packages": (open_packages, PACKAGE_KNOBS, PackageSettings(), "error"),
        "localization": (open_localization, LOCALIZATION_KNOBS, inputs.localize, "acc_25"),
        "views": (open_views, VIEWS_KNOBS, inputs.choose, "visible"),
    }[name]
    cost: Cost = "bytes" if name == "packages" else "cpu_seconds"
    return Stage(name=name, knobs=knobs, base=base, open=partial(opened, inputs), accuracy=accuracy, cost=cost)


STAGES: tuple[StageName, ...] = get_args(StageName)
"""The stages that have knobs, in the order of the pipeline."""
