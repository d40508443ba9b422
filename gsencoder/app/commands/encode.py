"""`gsencoder encode SPLAT weights=FILE`: features of every Gaussian in one pass, without photographs or a teacher."""

import math
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsencoder.app.compose import from_dict
from gsencoder.app.options import SharedScenesConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import MEGABYTE
from gsencoder.core.errors import InputError, SceneWarning, counted, error_prefix
from gsencoder.core.pretrained import digest_files
from gsencoder.core.process import retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import READABLE
from gsencoder.data.up import upright_gaussians, with_up
from gsencoder.fusion.basis import basis_figures, describe_basis, project_maps
from gsencoder.fusion.folder import FEATURES_FILE, save_features
from gsencoder.infer.encode import EncodeConfig, Encoder, file_of_encoder
from gsencoder.infer.encode_budget import (
    BudgetEncoding,
    EncodeBudget,
    check_encode_budget,
    encode_within,
    exact_encoding,
    realised_error,
)
from gsencoder.infer.relevancy import expected_share
from gsencoder.models.output_space import HEADS_FILE, copy_heads, find_heads, teacher_of_space
from gsencoder.text.table import file_of_teacher, save_tables
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeCommandConfig(SharedScenesConfig):
    """Settings of `encode`."""

    paths: tuple[str, ...] = option((), "splats, scenes, or folders of scenes", metavar="SPLAT", required=True)
    weights: str = option(
        "",
        "folder or file written by `train` or `export`, or the name of an encoder that comes with "
        "gsencoder; empty = rooms, which does",
    )
    spaces: tuple[str, ...] = option(
        (), "teachers whose features are written, of an encoder with several; empty = all of them", names=True
    )
    splat: str = option("", f"Gaussians of a scene with views; empty = seeds. {READABLE}")
    basis_views: int = option(
        0,
        "views in which the encoder's teacher is run, to show what the basis keeps of its vectors there; 0 = none",
        ge=0,
    )
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    budget: EncodeBudget = field(default_factory=EncodeBudget)

    def __post_init__(self) -> None:
        SharedScenesConfig.__post_init__(self)
        check_encode_budget(self.budget, self.encode)


def run(config: EncodeCommandConfig, run: Run) -> None:
    """Encodes one scene into out=, or each of several into the folder OUT/NAME."""
    retain_freed_memory()
    paths = find_scenes(config.paths)
    with run.step("weights"):
        encoder, file = Encoder.load(config.weights, config.encode.device), file_of_encoder(config.weights)
        heads = find_heads(file)
        _warn_of_missing(encoder, file, heads, config.spaces)
    made_with = {"weights": str(file), "weights_digest": digest_files(file)}

    def one(path: Path, out: Path, run: Run) -> None:
        with run.folder(out) as folder:
            with run.step("load"):
                scene = load_scene(path, splat=config.splat or None, options=config.data)
                if config.splat and scene.views is not None:
                    from gsencoder.fusion.fit import with_fitting_splat  # with torch

                    scene = with_fitting_splat(scene, config.splat, config.data)
            if scene.gaussians is None:
                with run.step("seeds"):
                    scene = with_gaussians(scene, config.seeds, track=run.track)
            scene, up = with_up(scene)
            run.report_up(scene.name, up)
            if up is None:
                run.print(f"up of {scene.name}: not known, and taken to be z (data.up= states it)")
            assert scene.gaussians is not None
            count, chunk = len(scene.gaussians), config.encode.chunk
            if chunk and count > chunk:
                # Before they are cut, which takes a while where there are thousands.
                least = counted(math.ceil(count / chunk), "chunk")
                run.print(f"{out}: {count:,} Gaussians in {least} or more (encode.chunk={chunk})")
            with error_prefix(scene.name):
                spaces, lines = _encode_into(folder, scene, encoder, config, made_with, run)
            if heads is not None:
                others = [space for space in encoder.spaces.values() if space not in spaces]
                copy_heads(heads, folder / HEADS_FILE, spaces, left_out=others)
        gaussians = counted(run.results["gaussians"], "Gaussian")
        share = run.results.get("expected_share")
        names = "" if share is None else f"; {share:.0%} of their names are expected to be right"
        run.print(f"{out}: features of {gaussians} in {run.timings['encode']:.1f} s{names}")
        where = "this scene" if config.basis_views else "the scenes held out of the training"
        for name, figures in run.results.get("teachers", {"": run.results}).items():
            of = f" for {name}" if name else ""
            run.print(f"{out}: basis of the encoder{of}: {describe_basis(figures['basis'], where)}")
        run.print(*(f"{out}: {line}" for line in lines))

    run.scenes(paths, "features", one)


def _warn_of_missing(encoder: Encoder, file: Path, heads: Path | None, spaces: tuple[str, ...]) -> None:
    """Warns of adapter heads and words that do not lie next to the weights that were trained with them."""
    trained_with = encoder.made_by.get("settings", {}).get("heads") or ()
    missing = []
    if heads is None and trained_with:
        missing.append(
            f"the adapter heads {', '.join(trained_with)} that the encoder was trained with do not lie next to {file}; "
            "head= will not work with its features"
        )
    for name in requested_teachers(encoder, spaces):
        if encoder.spaces[name].text_encoder and name not in encoder.tables:
            missing.append(
                f"no words of {encoder.spaces[name].text_encoder} lie next to {file}, so the features of {name} have "
                "none; `localize` needs words= or text="
            )
    for each in missing:
        warnings.warn(f"weights: {each}", SceneWarning, stacklevel=2)


def _encode_into(
    folder: Path, scene: Scene, encoder: Encoder, config: EncodeCommandConfig, made_with: Mapping[str, str], run: Run
) -> tuple[list[FeatureSpace], list[str]]:
    """Encodes a scene and writes its features and words; returns the spaces written, and a line for each limit."""
    assert scene.gaussians is not None
    unit, budget = unit_of(scene), config.budget
    # Without a known up, as it is: z may or may not be up then.
    gaussians = scene.gaussians if scene.up is None else upright_gaussians(scene.gaussians, scene.up)
    teachers = requested_teachers(encoder, config.spaces)
    budgeted: BudgetEncoding | None = None
    if budget.limits:
        # Of the settings, those that take the most bytes in the files.
        longest = replace(exact_encoding(config.encode), precision="bfloat16")
        budgeted = encode_within(
            gaussians,
            encoder,
            teachers,
            config.encode,
            budget,
            metres_per_unit=unit,
            header={"encode": settings(longest), **made_with},
            track=run.track,
        )
        run.add_seconds({"choose": budgeted.choosing, "encode": budgeted.seconds - budgeted.choosing})
        by_teacher, encoding, ranks = budgeted.features, budgeted.choice.setting, budgeted.ranks
        chosen: dict[str, Any] = {"precision": encoding.precision, "halo": encoding.halo}
        chosen |= {"rank" if len(ranks) == 1 else f"rank of {name}": rank for name, rank in ranks.items()}
        run.report_choice(scene.name, chosen, predicted=budgeted.predicted, notes=budgeted.notes)
    else:
        with run.step("encode"):
            by_teacher = encoder.encode_spaces(gaussians, config.encode, metres_per_unit=unit, track=run.track)
        by_teacher, encoding = {name: by_teacher[name] for name in teachers}, config.encode
    if config.basis_views and all(each.basis is None for each in by_teacher.values()):
        raise InputError("basis_views: the encoder gives all channels, and has no basis; leave it out")
    single, spaces = len(by_teacher) == 1, [features.space for features in by_teacher.values()]
    figures = {
        name: {
            "channels": features.space.channels,
            "rank": features.features.shape[1],
            "basis": _basis_figures(scene, name, features, encoder, config, run),
            "space": features.space.describe(),
            "expected_share": expected_share(features, scene.name),
            "features": file_of_teacher(FEATURES_FILE, None if single else name),
        }
        for name, features in by_teacher.items()
    }
    with run.step("write"):
        save_features(folder, scene, by_teacher, {"encode": settings(encoding), **made_with})
        save_tables(folder, {name: encoder.tables[name] for name in by_teacher if name in encoder.tables}, by_teacher)
    lines = []
    if budgeted is not None:
        sizes = [(folder / str(each["features"])).stat().st_size for each in figures.values()]
        measured = {"seconds": budgeted.seconds, "megabytes": sum(sizes) / MEGABYTE}
        if budget.error is not None and budget.check:
            with run.step("check"):
                errors = realised_error(budgeted, gaussians, encoder, metres_per_unit=unit, track=run.track)
            measured["error"] = max(error.total for error in errors.values())
        lines = run.report_budget(budget, measured)
    first = next(iter(by_teacher.values()))
    run.results.update(
        gaussians=len(first),
        seen=int(first.seen.sum()),
        views=len(scene.views) if scene.views is not None else 0,
        metres_per_unit=unit,
        **made_with,
        **(next(iter(figures.values())) if single else {"teachers": figures}),
    )
    return spaces, lines


def requested_teachers(encoder: Encoder, names: tuple[str, ...]) -> list[str]:
    """The teachers of an encoder that are named, by themselves or by their feature spaces, or all of them."""
    requested = [teacher_of_space(encoder.spaces, name, option="spaces") for name in names]
    return requested or list(encoder.spaces)


def _basis_figures(
    scene: Scene, name: str, features: GaussianFeatures, encoder: Encoder, config: EncodeCommandConfig, run: Run
) -> dict[str, int | float]:
    """The figures of a basis, of this scene with `basis_views`, else of the scenes held out of the training."""
    figures = basis_figures(features.basis, features.features.shape[1])
    if config.basis_views and features.basis is not None:
        with run.step("basis"), error_prefix(f"teacher {name}") if len(encoder.spaces) > 1 else nullcontext():
            return figures | _figures_of_scene(scene, name, features.basis, encoder, config.basis_views)
    stored = encoder.made_by.get("basis", {})
    stored = stored.get(name, stored)
    return figures | {key: value for key, value in stored.items() if key.startswith("other_")}


def _figures_of_scene(scene: Scene, name: str, basis: FeatureBasis, encoder: Encoder, count: int) -> dict[str, float]:
    """How well the encoder's basis represents its teacher's maps of some of a scene's views."""
    # Teachers need torch, which encoding with an exported graph does without.
    from gsencoder.fusion.checkpoint import upright
    from gsencoder.teachers.build import words_by_teacher
    from gsencoder.train.prepare_scenes import SourceConfig

    if scene.views is None:
        raise InputError("basis_views: the scene has no views in which the teacher could be run; leave it out")
    training = encoder.made_by.get("settings", {})
    if not (training.get("teachers") or training.get("teacher")):
        raise InputError("basis_views: the weights do not say which teacher they were made with; leave it out")
    stored = {key: training[key] for key in ("teacher", "teachers", "text") if training.get(key)}
    source = from_dict(SourceConfig, stored)
    teachers = source.teachers_by_name
    only = next(iter(teachers)) if len(teachers) == 1 else name
    teacher = upright(teachers[only].build(scene, words_by_teacher(teachers, source.text).get(only)))
    return project_maps(basis, teacher, scene.views, even_indices(len(scene.views), count).tolist()).fit().figures()
