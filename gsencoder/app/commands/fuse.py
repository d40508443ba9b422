"""`gsencoder fuse SCENE… teacher=…`: per-Gaussian features from a teacher's maps of the views."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from gsencoder.app.commands.basis_figures import describe_basis
from gsencoder.app.commands.fusable_scene import load_fusable
from gsencoder.app.commands.fuse_budget import check_promises, fuse_in_budget
from gsencoder.app.commands.head_figures import describe_heads, head_figures
from gsencoder.app.reports.results import report_fusion
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.scene_queue import run_scenes
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, counted
from gsencoder.core.process import Device
from gsencoder.data.scenes import SceneConfig, find_scenes
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats.files import READABLE
from gsencoder.fusion.adapter_heads import Head
from gsencoder.fusion.budget import BudgetFusion
from gsencoder.fusion.cameras import CamerasOfSplat, check_orbits
from gsencoder.fusion.cost_model import BudgetConfig, check_budget
from gsencoder.fusion.folder import FEATURES_FILE, HEADS_FILE, WORDS_FILE, save_features
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse
from gsencoder.fusion.measured_heads import heads_of, measure_heads, save_heads, stored_heads
from gsencoder.models.output_space import OutputSpaces, name_of_space
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import AutoConfig, TeacherConfig, build_teacher, choose_teacher, words_beside, words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.table import TextTable, save_text_table
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import FeatureBasis, FeatureSpace, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseCommandConfig(CommonConfig):
    """Settings of `fuse`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "scenes, or folders of scenes: views, or a bare splat", "metavar": "SCENE", "required": True},
    )
    splat: str = field(
        default="",
        metadata={
            "help": f"Gaussians of a scene with views, where {{scene}} stands for the name of its folder; "
            f"empty = seeds. {READABLE}"
        },
    )
    orbits: int = field(default=24, metadata={"help": "largest number of cameras placed in a splat without views"})
    cameras: CamerasOfSplat = field(
        default="auto",
        metadata={"help": "where they stand: around it, inside it, or auto = inside if that shows most of it (a room)"},
    )
    basis: str = field(
        default="",
        metadata={
            "help": "weights in whose basis features are fused, as encoded ones are; empty = a basis of the scene"
        },
    )
    worker: int = field(
        default=0,
        metadata={"help": "number of this process among several that share the scenes: -m worker=0,1,2 starts three"},
    )
    device: Device = field(
        default="auto", metadata={"help": "where maps are lifted, cuda or cpu; auto = cuda if torch sees a GPU"}
    )
    report: bool = field(default=False, metadata={"help": "write report.html, a page with pictures and figures"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    teacher: AutoConfig | TeacherConfig = field(
        default_factory=AutoConfig,
        metadata={
            "help": "the 2D model whose maps are lifted; auto = the labels of a scene that has some, else mosaic with "
            "text=minilm: a segmenter and a sentence encoder, which are installed"
        },
    )
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        check_orbits(self.orbits)
        check_budget(self.budget, self.fusion, basis=bool(self.basis))


def run(config: FuseCommandConfig, summary: Summary) -> None:
    """Fuses one scene into out=, or each of several into the folder OUT/NAME."""
    choose_device(config.device)  # A missing device is an error before anything is read.
    paths = find_scenes(config.paths)
    with summary.step("teacher"):
        words_once, heads = cache(words_of), list[Head]()
        if not isinstance(config.teacher, AutoConfig):
            words_once(config.teacher, config.text)  # What cannot be read is an error before any scene is.
            heads = heads_of(config.teacher, stored_heads(config.teacher), "teacher.heads")
    outputs = load_weights_spaces(config.basis) if config.basis else None
    screen = console(config.quiet)

    def run_one(path: Path, out: Path, scene_summary: Summary) -> None:
        with output_folder(out, overwrite=config.overwrite, summary=scene_summary) as folder:
            scene = load_fusable(
                path,
                scene_summary,
                splat=config.splat,
                data=config.data,
                seeds=config.seeds,
                orbits=config.orbits,
                cameras=config.cameras,
                blend=config.fusion.blend,
                labels=isinstance(config.teacher, LabelsConfig),
                quiet=config.quiet,
            )
            with scene_summary.step("teacher"):
                chosen = choose_teacher(config.teacher, config.text, scene, words_once)
                teacher = build_teacher(chosen.teacher, scene, chosen.words)
            if chosen.reason:
                scene_summary.results.update(teacher=settings(chosen.teacher), text=settings(chosen.text))
                screen.print(f"{scene.name}: {chosen.reason}; {chosen.describe()}")
            basis = None if outputs is None else basis_for(teacher.space, outputs, config.basis)
            in_budget: BudgetFusion | None = None
            if config.budget.promised:
                in_budget = fuse_in_budget(
                    scene, teacher, config, scene_summary, work_folder(out), sample_cells=bool(heads)
                )
                fusion = in_budget.fusion
            else:
                fusion = fuse_scene(scene, teacher, config, scene_summary, out, basis=basis, sample_cells=bool(heads))
            write_features(folder, scene, fusion, words_beside(teacher, chosen.words), chosen.teacher, scene_summary)
            promises = []
            if in_budget is not None:
                promises = check_promises(in_budget, folder / FEATURES_FILE, config, scene_summary)
            lines = write_heads(folder, heads, fusion, scene_summary)
            if config.report:
                with scene_summary.step("report"):
                    report_fusion(folder, scene, fusion.features, fusion.truncation, chosen.teacher.name, scene_summary)
        shutil.rmtree(work_folder(out), ignore_errors=True)
        with_features, total = scene_summary.results["seen"], scene_summary.results["gaussians"]
        screen.print(
            f"{out}: {with_features:,} of {counted(total, 'Gaussian')} have features, "
            f"{scene_summary.results['channels']} channels ({describe_basis(scene_summary.results, 'this scene')}), "
            f"from {counted(scene_summary.results['views'], 'view')}"
        )
        for line in (*promises, *lines):
            screen.print(f"{out}: {line}")

    run_scenes(
        paths,
        config.out,
        "features",
        run_one,
        summary,
        overwrite=config.overwrite,
        worker=config.worker,
        screen=screen,
    )


def load_weights_spaces(weights: str) -> OutputSpaces:
    """The output spaces of an encoder's weights; torch is imported only for them."""
    from gsencoder.models.weights import load_weights

    return load_weights(weights, "basis")[1]


def basis_for(space: FeatureSpace, outputs: OutputSpaces, weights: str) -> FeatureBasis:
    """The basis in which an encoder gives features of a space.

    Raises:
        InputError: it gives none of them, or all their channels.
    """
    by_name = outputs.by_teacher
    name = name_of_space({each: output.space for each, output in by_name.items()}, space, f"basis={weights}")
    basis = by_name[name].basis
    if basis is None:
        raise InputError(f"basis: the encoder of {weights} gives all channels; leave basis= out, or give other weights")
    return basis


def work_folder(out: Path) -> Path:
    """The folder for the maps and sums of an unfinished fusion."""
    return out.parent / f".{out.name}.fusing"


def fuse_scene(
    scene: Scene,
    teacher: Teacher,
    config: FuseCommandConfig,
    summary: Summary,
    out: Path,
    *,
    basis: FeatureBasis | None = None,
    sample_cells: bool = False,
) -> Fusion:
    """Fuses, in a given basis or in one of the scene's own, and adds the seconds of the steps to the summary."""
    work = None if teacher.cheap else work_folder(out)
    track = Progress(quiet=config.quiet)
    fusion = fuse(
        scene,
        teacher,
        config.fusion,
        basis=basis,
        work=work,
        sample_cells=sample_cells,
        device=config.device,
        track=track,
    )
    summary.add_seconds(fusion.seconds)
    return fusion


def write_features(
    folder: Path, scene: Scene, fusion: Fusion, words: TextTable | None, teacher: TeacherConfig, summary: Summary
) -> None:
    """Writes features, scene and words, and adds the figures of the fusion to the summary."""
    features = fusion.features
    with summary.step("write"):
        recipe = {"teacher": settings(teacher), "fusion": settings(fusion.config)}
        save_features(folder, scene, features, recipe)
        if words is not None:
            save_text_table(folder / WORDS_FILE, words)
    summary.results.update(
        gaussians=len(features),
        seen=int(features.seen.sum()),
        views=len(fusion.views),
        visibility=list(fusion.tested),
        channels=features.space.channels,
        rank=features.features.shape[1],
        energy_kept=features.basis.energy_kept if features.basis is not None else 1.0,
        **(fusion.projections.fit().figures() if fusion.projections is not None else {}),
        truncation=fusion.truncation,
        median_weight=float(np.median(features.weights[features.seen])),
        space=features.space.describe(),
        features="features.safetensors",
    )


def write_heads(folder: Path, heads: Sequence[Head], fusion: Fusion, summary: Summary) -> list[str]:
    """Measures adapter heads over the maps that were fused, writes them, and adds their figures to the summary; returns
    a line for each head."""
    if fusion.sample is None:
        return []
    with summary.step("heads"):
        measured = measure_heads(heads, fusion.sample, fusion.features.space, fusion.features.basis)
        save_heads(folder / HEADS_FILE, measured)
    summary.results.update(heads=head_figures(measured))
    return describe_heads(measured)
