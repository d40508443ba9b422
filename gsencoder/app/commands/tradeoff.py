"""`gsencoder tradeoff SCENE…`: cost and accuracy of the knobs of each stage, as a table and plots."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import csv_text, json_bytes, write_bytes
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, find_scenes
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.benchmarks.localization import LocalizationProtocol
from gsencoder.evaluate.tradeoff.measure import Records
from gsencoder.evaluate.tradeoff.plots import page, picture, to_json
from gsencoder.evaluate.tradeoff.scaling import ScalingConfig, ScalingResult, scaling
from gsencoder.evaluate.tradeoff.stage import HIGHER_IS_BETTER, Inputs, StageName
from gsencoder.evaluate.tradeoff.sweep import (
    STAGES,
    HalvingConfig,
    SettingResult,
    StageResult,
    SweepConfig,
    check_sweep,
    scene_row,
    sweep_stage,
)
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.teachers.build import TeacherConfig
from gsencoder.teachers.labels import LabelsConfig

TABLE, SCENES, RESULTS, PAGE, PICTURE, EXPONENTS = (
    "tradeoff.csv",
    "scenes.csv",
    "tradeoff.json",
    "tradeoff.html",
    "tradeoff.png",
    "exponents.csv",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TradeoffConfig(CommonConfig):
    """Settings of `tradeoff`."""

    paths: tuple[str, ...] = option((), "scenes, or folders of scenes", metavar="SCENE", required=True)
    stages: tuple[StageName, ...] = option(("fusion",), f"stages whose knobs are turned: {', '.join(STAGES)}")
    resume: bool = option(True, "continue an interrupted sweep; false = start again")
    sweep: SweepConfig = field(default_factory=SweepConfig)
    halving: HalvingConfig = field(default_factory=HalvingConfig)
    scaling: ScalingConfig = field(default_factory=ScalingConfig)
    asked: LocalizationProtocol = field(default_factory=LocalizationProtocol)
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if not self.stages or len(set(self.stages)) < len(self.stages):
            raise InputError(f"stages: expected one or more of {', '.join(STAGES)}, each once, got {list(self.stages)}")


def run(config: TradeoffConfig, run: Run) -> None:
    """Measures all settings, prints and writes tables and plots."""
    inputs = Inputs(
        teacher=config.teacher,
        protocol=config.asked,
        data=config.data,
        seeds=config.seeds,
        fusion=config.fusion,
        localize=config.localize,
        encode=config.encode,
        views=config.choose,
    )
    stages = [STAGES[name](inputs) for name in config.stages]
    check_sweep(stages, config.sweep)
    paths = [Path(os.path.realpath(path)) for path in find_scenes(config.paths)]
    _check_names(paths)
    out = run.out("tradeoff")
    with run.resumable(out, "tradeoff", resume=config.resume) as (folder, work):
        identity = {
            "inputs": settings(inputs),
            "scenes": {p.name: str(p) for p in paths},
        }
        records = Records(work, identity)
        run.results["continued"] = len(records)
        results = []
        for stage in stages:
            with run.step(stage.name):
                results.append(sweep_stage(stage, paths, records, config.sweep, config.halving, run.track))
        exponents: list[ScalingResult] = []
        if config.scaling.points:
            with run.step("exponents"):
                exponents = scaling(
                    config.stages, paths, inputs, config.scaling, seed=config.sweep.seed, track=run.track
                )
        _write(folder, results, exponents, run)
    for each in results:
        run.print(_table(each))
        run.print(f"knobs that matter: {', '.join(each.matter) or 'none'}")
        for rung in each.rungs:
            more = "" if rung is each.rungs[-1] else f"; the best {len(rung.survivors)} went on"
            run.print(f"{counted(len(rung.settings), 'setting')} on {counted(rung.scenes, 'scene')}{more}")
    for scaled in exponents:
        value, low, high, *_ = scaled.exponent
        run.print(f"{scaled.stage}: CPU time grows as {scaled.factor}^{value:.2f} (95 %: {low:.2f} to {high:.2f})")
    run.print(f"{out}: {TABLE}, {SCENES}, {RESULTS}, {PAGE} and {PICTURE}")


def _check_names(paths: Sequence[Path]) -> None:
    names = [path.name for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"paths: two scenes are called {name}, and results are named by scene; rename one")


def _write(folder: Path, results: Sequence[StageResult], exponents: Sequence[ScalingResult], run: Run) -> None:
    rows = [each.row() for result in results for each in result.results]
    write_bytes(folder / TABLE, _csv_of_stages(rows))
    write_bytes(folder / SCENES, _csv_of_stages([scene_row(each) for result in results for each in result.records]))
    everything = to_json(results, exponents)
    write_bytes(folder / RESULTS, json_bytes(everything)[0])
    if exponents:
        write_bytes(folder / EXPONENTS, csv_text([each.row() for each in exponents]).encode())
    with run.step("plot"):
        write_bytes(folder / PAGE, page(results, exponents))
        write_bytes(folder / PICTURE, picture(results))
    run.results.update(
        settings=rows,
        matter={each.stage.name: list(each.matter) for each in results},
        exponents=[each.row() for each in exponents],
        table=TABLE,
        scenes=SCENES,
        page=PAGE,
        plot=PICTURE,
    )


def _csv_of_stages(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows as CSV with the columns of all stages, which give different scores."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return csv_text([{name: row.get(name) for name in columns} for row in rows]).encode()


def _table(result: StageResult) -> Table:
    accuracy = result.stage.accuracy
    table = Table(title=f"{result.stage.name}: ● = on the Pareto front of {result.cost} and {accuracy}")
    table.title_justify = "left"
    table.add_column("setting")
    scores = [name for name in HIGHER_IS_BETTER if any(name in each.scores for each in result.results)]
    for title in ("scenes", "CPU s", "± %", "of defaults", "seconds", "MiB", "kB", *scores, ""):
        table.add_column(title, justify="right")
    for each in result.results:
        figures = [f"{each.scenes}", f"{each.cpu_seconds:.3g}", f"{100 * each.spread:.0f}", f"{each.ratio:.3f}"]
        figures += [f"{each.seconds:.3g}", f"{each.mib:.0f}", f"{each.bytes / 1000:.0f}"]
        figures += [_score(each, name) for name in scores]
        table.add_row(each.label, *figures, "●" if each.on_front else "")
    return table


def _score(result: SettingResult, name: str) -> str:
    """A score with its standard error, or with its difference from the defaults on the same scenes and that one's."""
    if name not in result.scores:
        return ""
    value, error, _ = result.scores[name]
    text = "" if math.isnan(value) else f"{value:.4g}"
    if name not in result.differences:
        return text + ("" if math.isnan(error) else f" ± {error:.2g}")
    difference, error, _ = result.differences[name]
    if math.isnan(difference):
        return text
    return f"{text} ({difference:+.2g}" + (")" if math.isnan(error) else f" ± {error:.2g})")
