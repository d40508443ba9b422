"""`gsencoder tradeoff SCENE…`: cost and accuracy of the knobs of each stage, as a table and plots."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from rich.table import Table

from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import csv_text, json_bytes, write_bytes
from gsencoder.core.settings import option
from gsencoder.data.scenes import find_scenes
from gsencoder.evaluate.tradeoff.measure import Records
from gsencoder.evaluate.tradeoff.scaling import ScalingConfig, scaling
from gsencoder.evaluate.tradeoff.stages import HIGHER_IS_BETTER, STAGES, Inputs, StageName, make_stage
from gsencoder.evaluate.tradeoff.sweep import (
    HalvingConfig,
    SettingResult,
    StageResult,
    SweepConfig,
    check_sweep,
    plot_page,
    plot_picture,
    scene_row,
    sweep_stage,
    to_json,
)

TABLE, SCENES, RESULTS, PAGE, PICTURE, EXPONENTS = (
    "tradeoff.csv",
    "scenes.csv",
    "tradeoff.json",
    "tradeoff.html",
    "tradeoff.png",
    "exponents.csv",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TradeoffConfig(Inputs, CommonConfig):
    """Settings of `tradeoff`."""

    paths: tuple[str, ...] = option((), "scenes, or folders of scenes", metavar="SCENE", required=True)
    stages: tuple[StageName, ...] = option(("fusion",), f"stages whose knobs are turned: {', '.join(STAGES)}")
    resume: bool = option(True, "continue an interrupted sweep; false = start again")
    sweep: SweepConfig = field(default_factory=SweepConfig)
    halving: HalvingConfig = field(default_factory=HalvingConfig)
    scaling: ScalingConfig = field(default_factory=ScalingConfig)

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if not self.stages or len(set(self.stages)) < len(self.stages):
            raise InputError(f"stages: expected one or more of {', '.join(STAGES)}, each once, got {list(self.stages)}")


def run(config: TradeoffConfig, run: Run) -> None:
    """Measures all settings, prints and writes tables and plots."""
    stages = [make_stage(name, config) for name in config.stages]
    check_sweep(stages, config.sweep)
    paths = [Path(os.path.realpath(path)) for path in find_scenes(config.paths)]
    if repeated := first_repeated([path.name for path in paths]):
        raise InputError(f"paths: two scenes are called {repeated[0]}, and results are named by scene; rename one")
    out = run.out("tradeoff")
    with run.resumable(out, "tradeoff", resume=config.resume) as (folder, work):
        inputs = {each.name: settings(getattr(config, each.name)) for each in fields(Inputs)}
        records = Records(work, {"inputs": inputs, "scenes": {path.name: str(path) for path in paths}})
        run.results["continued"] = len(records)
        results = []
        for stage in stages:
            with run.step(stage.name):
                results.append(sweep_stage(stage, paths, records, config.sweep, config.halving, run.track))
        exponents: list[dict[str, Any]] = []
        if config.scaling.points:
            with run.step("exponents"):
                exponents = scaling(config.stages, paths, config, config.scaling.points, track=run.track)
        _write(folder, results, exponents, run)
    for each in results:
        run.print(_table(each))
        run.print(f"knobs that matter: {', '.join(each.matter) or 'none'}")
        for rung in each.rungs:
            more = "" if rung is each.rungs[-1] else f"; the best {len(rung.survivors)} went on"
            run.print(f"{counted(len(rung.settings), 'setting')} on {counted(rung.scenes, 'scene')}{more}")
    for row in exponents:
        power = f"{row['size']}^{row['exponent']:.2f}"
        run.print(f"{row['stage']}: CPU time grows as {power} (95 %: {row['low']:.2f} to {row['high']:.2f})")
    run.print(f"{out}: {TABLE}, {SCENES}, {RESULTS}, {PAGE} and {PICTURE}")


def _write(folder: Path, results: Sequence[StageResult], exponents: Sequence[dict[str, Any]], run: Run) -> None:
    rows = [each.row for result in results for each in result.results]
    write_bytes(folder / TABLE, _csv_of_stages(rows))
    write_bytes(folder / SCENES, _csv_of_stages([scene_row(each) for result in results for each in result.records]))
    everything = to_json(results, exponents)
    write_bytes(folder / RESULTS, json_bytes(everything)[0])
    if exponents:
        write_bytes(folder / EXPONENTS, csv_text(exponents).encode())
    with run.step("plot"):
        write_bytes(folder / PAGE, plot_page(everything))
        write_bytes(folder / PICTURE, plot_picture(results))
    run.results.update(
        settings=rows,
        matter={each.stage.name: list(each.matter) for each in results},
        exponents=exponents,
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
    stage = result.stage
    table = Table(title=f"{stage.name}: ● = on the Pareto front of {stage.cost} and {stage.accuracy}")
    table.title_justify = "left"
    table.add_column("setting")
    scores = [name for name in HIGHER_IS_BETTER if any(name in each.row for each in result.results)]
    for title in ("scenes", "CPU s", "± %", "of defaults", "seconds", "MiB", "kB", *scores, ""):
        table.add_column(title, justify="right")
    for each in result.results:
        row = each.row
        figures = [f"{row['scenes']}", f"{row['cpu_seconds']:.3g}", f"{100 * row['spread']:.0f}", f"{row['ratio']:.3f}"]
        figures += [f"{row['seconds']:.3g}", f"{row['mib']:.0f}", f"{row['bytes'] / 1000:.0f}"]
        table.add_row(
            row["setting"], *figures, *(_score(each, name) for name in scores), "●" if row["on_front"] else ""
        )
    return table


def _score(result: SettingResult, name: str) -> str:
    """A score with its standard error, or with its difference from the defaults on the same scenes and that one's."""
    value, error = result.score(name), result.score(f"{name}_error")
    text = "" if math.isnan(value) else f"{value:.4g}"
    if f"{name}_difference" not in result.row:
        return text + ("" if math.isnan(error) else f" ± {error:.2g}")
    difference, error = result.score(f"{name}_difference"), result.score(f"{name}_difference_error")
    if math.isnan(difference):
        return text
    return f"{text} ({difference:+.2g}" + (")" if math.isnan(error) else f" ± {error:.2g})")
