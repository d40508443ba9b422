"""`gsencoder tradeoff SCENE…`: seconds and accuracy of each setting of fusion, as a table and a plot."""

from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.core.errors import InputError
from gsencoder.core.files.csv_text import csv_text
from gsencoder.core.files.json_values import write_bytes
from gsencoder.data.scenes import SceneConfig, find_scenes
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.protocols.localization import LocalizationProtocol
from gsencoder.evaluate.tradeoff import (
    BudgetConfig,
    SettingResult,
    SweepConfig,
    measure_tradeoff,
    pick_within_budget,
    sweep_settings,
    table_row,
)
from gsencoder.evaluate.tradeoff_plot import plot_tradeoff
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.teachers.build import TeacherConfig
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.localize.localize import LocalizeConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class TradeoffConfig(CommonConfig):
    """Settings of `tradeoff`."""

    paths: tuple[str, ...] = field(
        default=(), metadata={"help": "scenes, or folders of scenes", "metavar": "SCENE", "required": True}
    )
    sweep: SweepConfig = field(default_factory=SweepConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    asked: LocalizationProtocol = field(default_factory=LocalizationProtocol)
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


def run(config: TradeoffConfig, summary: Summary) -> None:
    """Measures all settings, prints and writes the table with a plot, and names the setting for a budget."""
    sweep_settings(config.sweep, config.fusion)  # A setting out of range is an error before hours of work.
    out = config.out or Path("outputs") / "tradeoff"
    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        with summary.step("sweep"):
            trades = measure_tradeoff(
                find_scenes(config.paths),
                teacher=config.teacher,
                sweep=config.sweep,
                base=config.fusion,
                protocol=config.asked,
                data=config.data,
                seeds=config.seeds,
                localization=config.localize,
                track=Progress(quiet=config.quiet),
            )
        rows = [table_row(trade) for trade in trades]
        write_bytes(folder / "tradeoff.csv", csv_text(rows).encode())
        with summary.step("plot"):
            write_bytes(folder / "tradeoff.png", plot_tradeoff(trades))
        summary.results.update(settings=rows, table="tradeoff.csv", plot="tradeoff.png")
        summary.results["picked"] = advice = _advice(trades, config.budget)
    screen = console(config.quiet)
    screen.print(_table(trades))
    if advice:
        screen.print(advice)
    screen.print(f"{out}: tradeoff.csv and tradeoff.png")


def _advice(trades: list[SettingResult], budget: BudgetConfig) -> str:
    """The setting within the budget, or a message that there is none; the measurements are written in both cases."""
    if budget.seconds is None and budget.error is None:
        return ""
    try:
        chosen = pick_within_budget(trades, budget)
    except InputError as error:
        return str(error)
    options = " ".join(
        f"fusion.{'blend.' if name in ('rays_per_patch', 'min_weight', 'stop_transmittance') else ''}{name}={value}"
        for name, value in chosen.knobs.items()
    )
    return f"budget: {options or 'the defaults'} ({chosen.seconds:.3g} s a scene, error {chosen.error:.3g})"


def _table(trades: list[SettingResult]) -> Table:
    table = Table(title="● = on the Pareto front of seconds and error", title_justify="left")
    table.add_column("setting")
    for title in ("seconds", "MiB", "rank", "error", "covered", "Acc@0.25", "Acc@0.5", ""):
        table.add_column(title, justify="right")
    for row in map(table_row, trades):
        accuracies = (f"{row['acc_25']:.3f}", f"{row['acc_50']:.3f}") if row["objects"] else ("", "")
        figures = (f"{row['seconds']:.3f}", f"{row['mib']:.0f}", f"{row['rank']:.1f}", f"{row['error']:.5f}")
        table.add_row(row["setting"], *figures, f"{row['covered']:.4f}", *accuracies, "●" if row["on_front"] else "")
    return table
