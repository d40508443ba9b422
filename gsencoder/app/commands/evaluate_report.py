"""What `evaluate` prints: the main figures in one line, and a table of names."""

from rich.table import Table

from gsencoder.core.errors import counted

SHOWN_NAMES = 15
COLUMNS = {
    "localization": {
        "objects": "objects",
        "Acc@0.25": "acc_25",
        "Acc@0.5": "acc_50",
        "mean IoU": "mean_iou",
        "best box": "oracle_mean_iou",
    },
    "naming": {"gaussians": "gaussians", "accuracy": "accuracy"},
    "grounding": {"views": "pairs", "mIoU": "miou", "cIoU": "ciou", "P@0.5": "p50", "P@0.6": "p60"},
    "absent": {
        "present in": "present",
        "absent in": "absent",
        "probability where present": "probability_present",
        "where absent": "probability_absent",
    },
}
"""Columns of the table of names, and the fields of a row that they show, by protocol."""


def scores_line(results: dict) -> str:
    """The main figures in one line."""
    if results["protocol"] == "naming":
        return (
            f"{counted(len(results['names']), 'name')} in {counted(len(results['scenes']), 'scene')}: accuracy "
            f"{results['accuracy']:.3f} "
            f"averaged over names, {results['accuracy_gaussians']:.3f} over Gaussians, centered cosine "
            f"{results['cosine']:.3f}"
        )
    if results["protocol"] == "absent":
        return (
            f"{results['present']} present and {counted(results['absent'], 'absent word')} in "
            f"{counted(len(results['scenes']), 'scene')}: "
            f"AUROC {results['auroc']:.3f} ± {results['auroc_se']:.3f}, calibration error "
            f"{results['calibration_error']:.3f}, Brier {results['brier']:.3f}; given a box: "
            f"{results['boxed_present']:.3f} of the present, {results['boxed_absent']:.3f} of the absent"
        )
    if results["protocol"] == "grounding":
        faults = f", {counted(results['not_finite'], 'map')} not finite" if results["not_finite"] else ""
        return (
            f"{counted(results['pairs'], 'pair')} of a view and a name in "
            f"{counted(len(results['scenes']), 'scene')}: mIoU "
            f"{results['miou']:.3f} (averaged over names {results['miou_names']:.3f}), cIoU {results['ciou']:.3f}, "
            f"P@0.5 {results['p50']:.3f}, P@0.6 {results['p60']:.3f}; {counted(results['small'], 'pair')} too "
            f"small{faults}"
        )
    return (
        f"{counted(results['objects'], 'object')} in {counted(len(results['scenes']), 'scene')}: Acc@0.25 "
        f"{results['acc_25']:.3f}, "
        f"Acc@0.5 {results['acc_50']:.3f}, mean IoU {results['mean_iou']:.3f} (best of all boxes: "
        f"{results['oracle_acc_25']:.3f}, {results['oracle_acc_50']:.3f}, {results['oracle_mean_iou']:.3f})"
    )


def names_table(results: dict) -> Table:
    """A table of the names with the lowest scores."""
    names = results["names"]
    table = Table(title="hardest names" if len(names) > SHOWN_NAMES else "names", title_justify="left")
    columns = COLUMNS[results["protocol"]]
    for title in ("name", *columns):
        table.add_column(title, justify="left" if title == "name" else "right")
    for name, row in list(names.items())[:SHOWN_NAMES]:
        figures = (row[key] for key in columns.values())
        table.add_row(name, *(f"{figure:,}" if isinstance(figure, int) else f"{figure:.3f}" for figure in figures))
    return table
