"""The error of every numeric routine at every extreme: remakes tests/stability/errors.csv, docs/numerics.png, and the
measured errors in docs/numerics.md, whose table says each routine's bound.

    python bench/numerics.py [--check]

`--check` measures and prints what differs from the table, and writes nothing.
"""

import argparse
import math
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from json_option import add_json_option, write_figures  # noqa: E402
from stability import routines  # noqa: E402
from stability.extremes import EXTREMES  # noqa: E402
from stability.registry import DOCUMENT, ROUTINES, TABLE, committed, error_of, most, write_table  # noqa: E402

assert routines
Errors = dict[tuple[str, str], float]


def measured() -> Errors:
    errors: Errors = {}
    for routine in ROUTINES.values():
        start = time.perf_counter()
        for extreme in EXTREMES:
            if routine.why_not(extreme) is None:
                errors[routine.name, extreme.name] = error_of(routine, extreme)
        worst = max(error for (name, _), error in errors.items() if name == routine.name)
        over = "" if worst <= routine.bound else "  ABOVE"
        print(f"{routine.name:55s} {worst:8.1e} of {routine.bound:7.1e}  {time.perf_counter() - start:5.2f} s{over}")
    return errors


def document(errors: Errors) -> None:
    text = DOCUMENT.read_text()
    for routine in ROUTINES.values():
        cells = {extreme.name: errors.get((routine.name, extreme.name)) for extreme in EXTREMES}
        at, worst = max(((name, error) for name, error in cells.items() if error is not None), key=lambda pair: pair[1])
        (before,) = (line for line in text.splitlines() if line.startswith(f"| {routine.name} | "))
        kept = before.strip("| ").split(" | ")[:5]
        text = text.replace(before, f"| {' | '.join(kept)} | {worst:.1e} | {at if worst else ''} |")
    DOCUMENT.write_text(text)


def picture(errors: Errors) -> None:
    """log10 of the error: a row a routine, a column an extreme, and the bound in the last one."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt
    import numpy as np

    names, columns = list(ROUTINES), [extreme.name for extreme in EXTREMES]
    values = np.full((len(names), len(columns) + 2), np.nan)
    for row, name in enumerate(names):
        for column, extreme in enumerate(columns):
            error = errors.get((name, extreme))
            if error is not None:
                values[row, column] = math.log10(max(error, 1e-18))
        values[row, -1] = math.log10(max(ROUTINES[name].bound, 1e-18))
    figure, axes = plt.subplots(figsize=(13, 0.27 * len(names) + 2))
    colors = plt.get_cmap("viridis").copy()
    colors.set_bad("0.93")
    image = axes.imshow(values, cmap=colors, vmin=-17, vmax=-1, aspect="auto")
    ticks = [*range(len(columns)), len(columns) + 1]
    axes.set_xticks(ticks, [*columns, "bound"], rotation=60, ha="left")
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(names)), names)
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            label = f"{value:.0f}" if value > -18 else "0"
            axes.text(column, row, label, ha="center", va="center", fontsize=6, color="w" if value < -8 else "k")
    figure.colorbar(image, label="log10 of the error", fraction=0.02, pad=0.01)
    figure.savefig(ROOT / "docs" / "numerics.png", dpi=110, bbox_inches="tight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with the table, and write nothing")
    add_json_option(parser)
    options = parser.parse_args()
    errors = measured()
    broken = [key for key, error in errors.items() if not error <= ROUTINES[key[0]].bound]
    cells = len(ROUTINES) * len(EXTREMES)
    print(
        f"{len(ROUTINES)} routines × {len(EXTREMES)} extremes: {len(errors)} of {cells} cells apply, {len(broken)} over"
    )
    counts = {"routines": len(ROUTINES), "cells": len(errors), "over": len(broken)}
    write_figures(options.json, counts)
    for name, extreme in broken:
        print(f"over its bound: {name} at {extreme}")
    if options.check:
        for (name, extreme), before in committed().items():
            error = errors.get((name, extreme))
            if error is not None and (before is None or not error <= most(ROUTINES[name], before)):
                print(f"worse than {TABLE.name}: {name} at {extreme}: {error:.1e}, was {before}")
    elif not broken:
        write_table(errors)
        document(errors)
        picture(errors)
    sys.exit(bool(broken))


if __name__ == "__main__":
    main()
