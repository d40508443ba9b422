"""What the lines that scripts about budgets of error print say together."""

from collections.abc import Mapping, Sequence
from typing import Any


def summary_of(lines: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Promises of error and how many were kept, the largest error by its promise, and the CPU time of choosing.

    Args:
        lines: with `promise`, `realised` and `choosing_of_exact`.
    """
    return {
        "promises": len(lines),
        "kept": sum(line["realised"] <= line["promise"] for line in lines),
        "largest error of its promise": max(line["realised"] / line["promise"] for line in lines),
        "largest share of choosing": max(line["choosing_of_exact"] for line in lines),
    }
