"""What scoring writes: results as JSON values, a table beside the papers' rows, and CSV rows by scene and class."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsencoder.evaluate.result_table import ResultTable
from gsencoder.evaluate.scores.means import mean_of


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreReport:
    """The scores of one protocol.

    Attributes:
        results: figures as JSON values, shares and not percent.
        table: the main figures above those that papers print.
        rows: rows of CSV files by their stem, such as "scenes" and "classes".
        line: the main figures in one line.
    """

    results: Mapping[str, Any]
    table: ResultTable
    rows: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    line: str


def spread(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> dict[str, dict[str, float | int]]:
    """Mean and standard deviation over scenes of some columns, and the number of scenes that have a value.

    Args:
        rows: one a scene; NaN and None are no values.
        columns: which.
    """
    figures: dict[str, dict[str, float | int]] = {}
    for column in columns:
        values = [row[column] for row in rows if row.get(column) is not None and not math.isnan(row[column])]
        figures[column] = {
            "scenes": len(values),
            "mean": mean_of(values),
            "std": float(np.std(values, ddof=1)) if len(values) > 1 else math.nan,
        }
    return figures
