"""The plot of a trade-off: time against error, and time against localization accuracy."""

import io
from collections.abc import Sequence

from gsencoder.evaluate.boxes import accuracy
from gsencoder.evaluate.tradeoff import REFERENCE, SettingResult

MIN_ERROR = 1e-7
"""Smallest error that is drawn; the axis is logarithmic and cannot show 0."""


def plot_tradeoff(results: Sequence[SettingResult]) -> bytes:
    """Plots results as a PNG: one color per changed setting, its value beside each point, the Pareto front ringed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    has_accuracies = any(result.hits for result in results)
    results = [result for result in results if result.label != REFERENCE]
    figure = Figure(figsize=(14 if has_accuracies else 8, 5.6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    knobs = list(dict.fromkeys(_changed_knob(result) for result in results))
    for column, axes in enumerate(figure.subplots(1, 2 if has_accuracies else 1, squeeze=False)[0]):
        heights = [max(result.error, MIN_ERROR) if column == 0 else accuracy(result.hits, 0.25) for result in results]
        for color, knob in enumerate(knobs):
            points = [i for i, result in enumerate(results) if _changed_knob(result) == knob]
            marker = "*" if knob == "defaults" else "o"
            axes.scatter(
                [results[i].seconds for i in points],
                [heights[i] for i in points],
                s=160 if marker == "*" else 36,
                marker=marker,
                color=f"C{color}",
                label=knob,
                zorder=3,
            )
        for result, height in zip(results, heights, strict=True):
            if column == 0 and result.on_front:
                axes.scatter(
                    result.seconds, height, s=190, facecolors="none", edgecolors="black", linewidths=1.2, zorder=4
                )
            values = ", ".join(f"{value:g}" for value in result.knobs.values())
            axes.annotate(values, (result.seconds, height), xytext=(6, 4), textcoords="offset points", fontsize=8)
        axes.set_xlabel("seconds per scene, without the teacher")
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
        if column == 0:
            axes.set_yscale("log")
            axes.set_ylabel("1 − centered cosine to the reference")
            axes.set_title("error (ringed: on the Pareto front)")
            axes.legend(fontsize=8)
        else:
            axes.set_ylabel("share of objects localized")
            axes.set_title("Acc@0.25")
    stream = io.BytesIO()
    canvas.print_png(stream)
    return stream.getvalue()


def _changed_knob(result: SettingResult) -> str:
    if not result.knobs:
        return "defaults"
    return next(iter(result.knobs)) if len(result.knobs) == 1 else "several"
