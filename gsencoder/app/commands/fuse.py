"""`gsencoder fuse SCENE… teacher=…`: per-Gaussian features from a teacher's maps of the views."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsencoder.app.inputs import load_fusable
from gsencoder.app.options import SharedScenesConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.archive import LONGEST_SHARE
from gsencoder.core.budget import MEGABYTE
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, counted
from gsencoder.core.process import Clock, Device
from gsencoder.core.settings import option
from gsencoder.data.orbits import CamerasOfSplat
from gsencoder.data.scenes import SceneConfig, find_scenes
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats.files import READABLE
from gsencoder.fusion.basis import describe_basis, project_maps, sample_cells
from gsencoder.fusion.budget import (
    BudgetFusion,
    FusionBudget,
    check_budget,
    exact_config,
    fuse_within,
    realised_error,
)
from gsencoder.fusion.folder import FEATURES_FILE, save_features
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse
from gsencoder.models.output_space import HEADS_FILE, OutputSpaces, load_output_spaces, name_of_space
from gsencoder.teachers.base import Head
from gsencoder.teachers.build import (
    AutoConfig,
    TeacherConfig,
    choose_teacher,
    stored_words,
    words_of,
)
from gsencoder.text.table import WORDS_FILE, TextTable, save_text_table
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import FeatureBasis, FeatureSpace, Scene

if TYPE_CHECKING:
    from gsencoder.infer.encode import Encoder


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseCommandConfig(SharedScenesConfig):
    """Settings of `fuse`."""

    paths: tuple[str, ...] = option(
        (), "scenes, or folders of scenes: views, or a bare splat", metavar="SCENE", required=True
    )
    splat: str = option(
        "",
        f"Gaussians of a scene with views, where {{scene}} stands for the name of its folder; "
        f"empty = seeds. {READABLE}",
    )
    orbits: int = option(24, "largest number of cameras placed in a splat without views", ge=1, le=10_000)
    cameras: CamerasOfSplat = option(
        "auto", "where they stand: around it, inside it, or auto = inside if that shows most of it (a room)"
    )
    basis: str = option(
        "", "weights in whose basis features are fused, as encoded ones are; empty = a basis of the scene"
    )
    encoder: str = option(
        "",
        "weights of an encoder: each Gaussian has the features of the teacher or of the encoder, whichever are surer; "
        "empty = the teacher's alone",
    )
    device: Device = option("auto", "where maps are lifted, cuda or cpu; auto = cuda if torch sees a GPU")
    report: bool = option(False, "write report.html, a page with pictures and figures")
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    budget: FusionBudget = field(default_factory=FusionBudget)
    teacher: AutoConfig | TeacherConfig = field(
        default_factory=AutoConfig,
        metadata={
            "help": "the 2D model whose maps are lifted; auto = the labels of a scene that has some, else mosaic with "
            "text=minilm: a segmenter and a sentence encoder, which are installed"
        },
    )
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        SharedScenesConfig.__post_init__(self)
        check_budget(self.budget, self.fusion, basis=bool(self.basis))
        if self.encoder and (self.basis or self.budget.limits):
            raise InputError("encoder: expected no basis= and no budget with it")


def run(config: FuseCommandConfig, run: Run) -> None:
    """Fuses one scene into out=, or each of several into the folder OUT/NAME."""
    device = choose_device(config.device)  # A missing device is an error before anything is read.
    paths = find_scenes(config.paths)
    with run.step("teacher"):
        words_once, heads = cache(words_of), list[Head]()
        if config.teacher.name != "auto":
            words_once(config.teacher, config.text)  # What cannot be read is an error before any scene is.
            heads = config.teacher.read_heads(config.teacher.stored_heads, "teacher.heads")
        encoder = None
        if config.encoder:
            from gsencoder.infer.encode import Encoder  # with torch

            encoder = Encoder.load(config.encoder, config.device)
    outputs = load_output_spaces(config.basis, "basis") if config.basis else None

    def one(path: Path, out: Path, run: Run) -> None:
        work = out.parent / f".{out.name}.fusing"  # maps of an unfinished fusion
        with run.folder(out) as folder:
            scene = load_fusable(
                path,
                run,
                splat=config.splat,
                data=config.data,
                seeds=config.seeds,
                orbits=config.orbits,
                cameras=config.cameras,
                blend=config.fusion.blend,
                labels=config.teacher.needs_labels,
            )
            with run.step("teacher"):
                chosen = choose_teacher(config.teacher, config.text, scene, words_once)
                if config.encoder and chosen.teacher.needs_labels:
                    raise InputError(
                        f"encoder: the labels of {path} are exact, and an encoder's names are not; leave encoder= out, "
                        "or give teacher=mosaic text=minilm, a segmenter"
                    )
                teacher = chosen.teacher.build(scene, chosen.words)
            if chosen.reason:
                run.results.update(teacher=settings(chosen.teacher), text=settings(chosen.text))
                run.print(f"{scene.name}: {chosen.reason}; {chosen.describe()}")
            basis = None if outputs is None else basis_for(teacher.space, outputs, config.basis)
            common: dict[str, Any] = {
                "work": None if teacher.cheap else work,
                "device": device,
                "track": run.track,
            }
            budgeted: BudgetFusion | None = None
            with Clock().running() as clock:
                if config.budget.limits:
                    # Of the settings that are written, those that take the most bytes.
                    header = recipe(chosen.teacher, replace(exact_config(config.fusion), energy=LONGEST_SHARE))
                    budgeted = fuse_within(scene, teacher, config.fusion, config.budget, header=header, **common)
                    fusion = budgeted.fusion
                else:
                    fusion = fuse(scene, teacher, config.fusion, basis=basis, **common)
            run.add_seconds(({"choose": budgeted.choosing} if budgeted is not None else {}) | clock.seconds)
            if budgeted is not None:
                made = {"views": len(fusion.views), "rank": fusion.features.features.shape[1]}
                run.report_choice(scene.name, made, predicted=budgeted.predicted, notes=budgeted.notes)
            words = stored_words(teacher, chosen.words)
            if encoder is not None:
                with run.step("encode"):
                    fusion, words = with_encoder(fusion, encoder, scene, run)
            with run.step("write"):
                save_features(folder, scene, fusion.features, recipe(chosen.teacher, fusion.config))
                if words is not None:
                    save_text_table(folder / WORDS_FILE, words)
            add_figures(fusion, run)
            if basis is not None and scene.views is not None:
                run.results.update(project_maps(basis, fusion.teacher, scene.views, fusion.views).fit().figures())
            lines = report_limits(folder, scene, budgeted, config, run) if budgeted is not None else []
            if heads:
                lines += write_heads(folder, heads, scene, fusion, run)
            if config.report:
                from gsencoder.app.reports import report_fusion

                with run.step("report"):
                    report_fusion(folder, scene, fusion.features, fusion.truncation, chosen.teacher.name, run)
        shutil.rmtree(work, ignore_errors=True)
        figures = run.results
        run.print(
            f"{out}: {figures['seen']:,} of {counted(figures['gaussians'], 'Gaussian')} have features, "
            f"{figures['channels']} channels ({describe_basis(figures, 'this scene')}), from "
            f"{counted(figures['views'], 'view')}"
            + (f"; {figures['by_encoder']:.0%} of them are the encoder's" if encoder is not None else ""),
            *(f"{out}: {line}" for line in lines),
        )

    run.scenes(paths, "features", one)


def with_encoder(fusion: Fusion, encoder: "Encoder", scene: Scene, run: Run) -> tuple[Fusion, TextTable]:
    """The fusion with the encoder's features where they are surer, and the encoder's words."""
    from gsencoder.infer.ensemble import surer_features
    from gsencoder.infer.relevancy import expected_share

    assert scene.gaussians is not None
    text_encoder = fusion.features.space.text_encoder
    name = next((name for name, each in encoder.tables.items() if each.space.text_encoder == text_encoder), None)
    if name is None:
        raise InputError(
            f"encoder: has no words of {text_encoder or 'the teacher, which has none'}; give teacher= and text= of the "
            "encoder's words"
        )
    words = encoder.tables[name]
    encoded = encoder.encode(scene.gaussians, space=name, metres_per_unit=unit_of(scene), up=scene.up)
    features, by_encoder = surer_features(
        fusion.features, encoded, words.encode(words.trained or words.names), words.mean
    )
    run.results.update(by_encoder=float(by_encoder.mean()), expected_share=expected_share(encoded, scene.name))
    # Which words the encoder was trained on says nothing of the Gaussians that the teacher names.
    return replace(fusion, features=features), replace(words, trained=None)


def report_limits(folder: Path, scene: Scene, fused: BudgetFusion, config: FuseCommandConfig, run: Run) -> list[str]:
    """Measures what is limited; returns a line for each limit, and warns of those that are broken."""
    size = (folder / FEATURES_FILE).stat().st_size
    measured = {"seconds": fused.seconds, "megabytes": size / MEGABYTE}
    if config.budget.error is not None and config.budget.check:
        with run.step("check"):
            error = realised_error(fused, scene, config.fusion, device=config.device, track=run.track)
        measured["error"] = error.total
        run.results["budget"]["covered"] = error.covered
    return run.report_budget(config.budget, measured)


def basis_for(space: FeatureSpace, outputs: OutputSpaces, weights: str) -> FeatureBasis:
    """The basis in which an encoder gives features of a space."""
    by_name = outputs.by_teacher
    name = name_of_space({each: output.space for each, output in by_name.items()}, space, f"basis={weights}")
    basis = by_name[name].basis
    if basis is None:
        raise InputError(f"basis: the encoder of {weights} gives all channels; leave basis= out, or give other weights")
    return basis


def recipe(teacher: TeacherConfig, fusion: FuseConfig) -> dict[str, Any]:
    """The settings that are written with features."""
    return {"teacher": settings(teacher), "fusion": settings(fusion)}


def add_figures(fusion: Fusion, run: Run) -> None:
    """Adds the figures of a fusion to the summary."""
    features = fusion.features
    seen, space = features.seen, features.space.describe()
    run.results.update(
        gaussians=len(features),
        seen=int(seen.sum()),
        views=len(fusion.views),
        visibility=list(fusion.depth_sources),
        channels=features.space.channels,
        rank=features.features.shape[1],
        energy_kept=features.basis.energy_kept if features.basis is not None else 1.0,
        truncation=fusion.truncation,
        median_weight=float(np.median(features.weights[seen])),
        space=space,
        features="features.safetensors",
    )


def write_heads(folder: Path, heads: Sequence[Head], scene: Scene, fusion: Fusion, run: Run) -> list[str]:
    """Measures adapter heads over the maps that were fused and writes them; returns a line for each head."""
    from gsencoder.fusion.measured_heads import measure_heads, save_heads

    assert scene.views is not None
    with run.step("heads"):
        sample = sample_cells(fusion.teacher, scene.views, fusion.views)
        measured = measure_heads(heads, sample.vectors(), fusion.features.space, fusion.features.basis)
        save_heads(folder / HEADS_FILE, measured)
    run.results.update(heads={head.name: head.figures() for head in measured.heads})
    return [head.describe() for head in measured.heads]
