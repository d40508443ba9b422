"""The picture of a trade-off: seconds against error, and against the share of objects found."""

import io
from collections.abc import Sequence

from gsencoder.evaluate.boxes import accuracy
from gsencoder.evaluate.tradeoff import REFERENCE, Trade

LEAST_ERROR = 1e-7
"""Errors are drawn on a logarithmic scale, which has no place for 0."""


def plot_trades(trades: Sequence[Trade]) -> bytes:
    """A PNG: one color a knob, the settings on the Pareto front ringed, each point with its value beside it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    asked = any(trade.hits for trade in trades)
    trades = [trade for trade in trades if trade.label != REFERENCE]
    figure = Figure(figsize=(14 if asked else 8, 5.6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    knobs = list(dict.fromkeys(_knob(trade) for trade in trades))
    for place, axes in enumerate(figure.subplots(1, 2 if asked else 1, squeeze=False)[0]):
        heights = [max(t.error, LEAST_ERROR) if place == 0 else accuracy(t.hits, 0.25) for t in trades]
        for color, knob in enumerate(knobs):
            chosen = [i for i, trade in enumerate(trades) if _knob(trade) == knob]
            marker = "*" if knob == "defaults" else "o"
            axes.scatter(
                [trades[i].seconds for i in chosen],
                [heights[i] for i in chosen],
                s=160 if marker == "*" else 36,
                marker=marker,
                color=f"C{color}",
                label=knob,
                zorder=3,
            )
        for trade, height in zip(trades, heights, strict=True):
            if place == 0 and trade.on_front:
                axes.scatter(
                    trade.seconds, height, s=190, facecolors="none", edgecolors="black", linewidths=1.2, zorder=4
                )
            values = ", ".join(f"{value:g}" for value in trade.knobs.values())
            axes.annotate(values, (trade.seconds, height), xytext=(6, 4), textcoords="offset points", fontsize=8)
        axes.set_xlabel("seconds a scene, without the teacher")
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
        if place == 0:
            axes.set_yscale("log")
            axes.set_ylabel("1 − centered cosine to the reference")
            axes.set_title("error (ringed: on the Pareto front)")
            axes.legend(fontsize=8)
        else:
            axes.set_ylabel("share of objects found")
            axes.set_title("Acc@0.25")
    stream = io.BytesIO()
    canvas.print_png(stream)
    return stream.getvalue()


def _knob(trade: Trade) -> str:
    if not trade.knobs:
        return "defaults"
    return next(iter(trade.knobs)) if len(trade.knobs) == 1 else "several"
