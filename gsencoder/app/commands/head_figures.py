"""Figures of adapter heads for summaries and people: what the basis of the features costs each of them."""

from typing import Any

from gsencoder.fusion.measured_heads import HeadSet


def head_figures(heads: HeadSet) -> dict[str, Any]:
    """For each head by name: channels and scale of its outputs; mean and worst 5 % of the cosine, about the mean, of
    its outputs for vectors in the basis with those for the teacher's full vectors; number of the cells compared."""
    return {head.name: head.figures() for head in heads.heads}


def describe_heads(heads: HeadSet) -> list[str]:
    """One line for each head."""
    return [
        f"head {head.head.describe()}: {head.channels} channels; behind the basis its outputs keep "
        f"{head.fit.describe()}"
        for head in heads.heads
    ]
