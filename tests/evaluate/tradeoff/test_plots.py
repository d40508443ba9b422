"""Pictures of a trade-off."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gsencoder.evaluate.tradeoff.plots import Label, label_points


def drawn(labels: list[Label]) -> tuple[list[str], int]:
    """The labels that have room on a panel, and how many of them touch."""
    figure = Figure(figsize=(4, 3))
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.scatter(*zip((0, 0), (1, 1), *(point for _, point in labels), strict=True))
    canvas.draw()
    notes = label_points(axes, labels)
    boxes = [note.get_window_extent() for note in notes]
    touching = sum(box.count_overlaps(boxes) - 1 for box in boxes)
    return [note.get_text() for note in notes], touching


@pytest.mark.parametrize("step", [0.0, 0.004, 0.02, 0.2])
def test_labels_never_cover_each_other_and_stay_where_there_is_room(step: float) -> None:
    labels = [(f"0.{number}, coverage", (0.4 + step * number, 0.4 + step * number)) for number in range(3)]
    assert drawn(labels) == ([text for text, _ in labels], 0)


def test_a_label_without_room_is_left_out_and_equal_texts_are_not() -> None:
    texts, touching = drawn([("same", (0.5, 0.5))] * 6)
    assert (texts, touching) == (["same"] * 4, 0)
