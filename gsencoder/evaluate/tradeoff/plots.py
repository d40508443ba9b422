"""The plots of a trade-off: a page that answers to the mouse, and a picture."""

import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsencoder.core.files import plain
from gsencoder.evaluate.tradeoff.stages import HIGHER_IS_BETTER
from gsencoder.evaluate.tradeoff.sweep import SettingResult, StageResult

TEMPLATE = Path(__file__).with_name("plot.html")
DATA = "/*DATA*/"
COST_NAMES = {
    "cpu_seconds": "CPU seconds a scene",
    "seconds": "seconds a scene",
    "mib": "MiB of memory",
    "bytes": "bytes",
}


def to_json(stages: Sequence[StageResult], scaling: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """All that a sweep gave as JSON values."""
    return {
        "stages": [
            {
                "stage": each.stage.name,
                "cost": each.stage.cost,
                "accuracy": each.stage.accuracy,
                "matter": list(each.matter),
                "rungs": [
                    {"scenes": rung.scenes, "settings": len(rung.settings), "kept": len(rung.survivors)}
                    for rung in each.rungs
                ],
            }
            for each in stages
        ],
        "settings": [{**result.row, "knobs": dict(result.knobs)} for each in stages for result in each.results],
        "scores": list(HIGHER_IS_BETTER),
        "less_is_better": [name for name, higher in HIGHER_IS_BETTER.items() if not higher],
        "scaling": list(scaling),
    }


def page(results: Mapping[str, Any]) -> bytes:
    """The interactive plot of `to_json`'s values as one HTML file that needs no network."""
    # In a script element `</` would end it, whatever it stands in.
    data = json.dumps(plain(results), ensure_ascii=False).replace("</", "<\\/")
    return TEMPLATE.read_text(encoding="utf-8").replace(DATA, data).encode("utf-8", "backslashreplace")


def picture(stages: Sequence[StageResult]) -> bytes:
    """The same as a PNG: a panel a stage, a color for each changed knob, its value beside each point, the Pareto front
    ringed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(2, len(stages))
    rows = -(-len(stages) // columns)
    figure = Figure(figsize=(7.5 * columns, 5.4 * rows), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, stage in zip(panels, stages, strict=False):
        _panel(axes, stage)
    for axes in panels[len(stages) :]:
        axes.set_visible(False)
    stream = io.BytesIO()
    canvas.print_png(stream)
    return stream.getvalue()


def _panel(axes: Any, result: StageResult) -> None:
    """Draws the settings of a stage whose accuracy is a number."""
    stage = result.stage
    settings = [each for each in result.results if not math.isnan(each.score(stage.accuracy))]
    colors: dict[str, str] = {}
    for each in settings:
        group, point = _group(each), (each.score(stage.cost), each.score(stage.accuracy))
        is_base, is_new = not each.knobs, group not in colors
        axes.scatter(
            *point,
            s=160 if is_base else 30,
            marker="*" if is_base else "o",
            color=colors.setdefault(group, f"C{len(colors)}"),
            label=group if is_new else None,
            zorder=3,
        )
        if each.row["on_front"]:
            axes.scatter(*point, s=180, facecolors="none", edgecolors="black", linewidths=1.1, zorder=4)
        if not is_base and each.row["phase"] != "joint":
            text = ", ".join(map(str, each.knobs.values()))
            axes.annotate(text, point, xytext=(6, 4), textcoords="offset points", fontsize=7)
    axes.set_xlabel(COST_NAMES[stage.cost])
    axes.set_ylabel(stage.accuracy + (" (more is better)" if HIGHER_IS_BETTER[stage.accuracy] else " (less is better)"))
    axes.set_title(f"{stage.name} (ringed: on the Pareto front)")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    if settings:
        axes.legend(fontsize=7)


def _group(result: SettingResult) -> str:
    if not result.knobs:
        return "defaults"
    return next(iter(result.knobs)) if len(result.knobs) == 1 else "several"
