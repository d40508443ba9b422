"""`gsencoder score PROTOCOL predictions=… truth=…`: files of any method's predictions against a benchmark's truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.markdown import Markdown

from gsencoder.app.options import CommonConfig
from gsencoder.app.output import Summary
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.core.settings import option
from gsencoder.data.labels.classes import COLUMNS, DEFAULT_COLUMN, ids_of_benchmark, read_label_map
from gsencoder.data.labels.files import read_split
from gsencoder.evaluate.benchmarks.files import load_classes
from gsencoder.evaluate.benchmarks.instances import MIN_REGION
from gsencoder.evaluate.benchmarks.referring import score_referring
from gsencoder.evaluate.benchmarks.retrieval import Pooling, score_retrieval
from gsencoder.evaluate.benchmarks.score import (
    score_answer_files,
    score_caption_files,
    score_instances,
    score_recognition,
    score_semantics,
)
from gsencoder.evaluate.benchmarks.semantics import BACKGROUND
from gsencoder.evaluate.tables import ScoreReport

TABLE = "table.md"
MOST_COLUMNS = 10
"""Columns that are printed; more do not fit a terminal."""
DECIMALS = 6
"""Of figures in CSV files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreConfig(CommonConfig):
    """Settings of `score`."""

    paths: tuple[str, ...] = option(
        (),
        "what is scored: instances, semantics, recognition, referring, answers, captions or retrieval",
        metavar="PROTOCOL",
        required=True,
    )
    predictions: str = option("", "file or folder of the predictions, in the benchmark's format", required=True)
    truth: str = option(
        "",
        "file or folder of the truth, in the benchmark's format; of instances and semantics also a folder "
        "of scans of ScanNet or ScanNet++, with label_map=",
        required=True,
    )
    method: str = option("predictions", "name of the predictions in the table")
    classes: str = option(
        "",
        "of instances, semantics and recognition: scannet20, scannet200, a CSV file with the columns id, "
        "name and, if there are any, group, or ScanNet++'s top100.txt; empty for recognition = all names of the "
        "truth",
    )
    label_map: str = option(
        "",
        "scannetv2-labels.combined.tsv, or ScanNet++'s map_benchmark.csv: of instances and semantics it "
        "gives the objects of truth=SCANS a class, of referring it tells unique from multiple where "
        "the truth does not",
    )
    scans: str = option("", "of referring: folder of ScanNet's scans, whose labels have the boxes that truth= has not")
    scenes: str = option("", "of instances and semantics: a split, one scene a line; empty = all scenes of the truth")
    class_agnostic: bool = option(False, "of instances: leave the classes of masks out of account")
    min_region: int = option(
        MIN_REGION, "of instances: smallest number of vertices of a true object and of a mask that count", ge=1
    )
    excluded: tuple[str, ...] = option(BACKGROUND, "of semantics: classes that are not of the foreground", names=True)
    ks: tuple[int, ...] = option(
        (1, 5), "of recognition and referring: numbers of names or boxes of which the best counts", ge=1
    )
    allow_missing: bool = option(
        False,
        "of recognition, referring, answers and captions: count what has no prediction as wrong, instead "
        "of refusing the file",
    )
    min_iou: float = option(0.5, "of captions: IoU that a box must be above for its caption to count", ge=0, le=1)
    distractors: int = option(
        0, "of retrieval: texts or pictures of others in a query's pool, drawn by its name; 0 = all", ge=0
    )
    seed: int = option(0, "of retrieval: of their draw")
    pooling: Pooling = option("max", "of retrieval, where predictions are features: over the cells of a view")
    java: bool = option(
        True, "of answers and captions: use Java's tokenizer and METEOR where they are there; without, columns say so"
    )

    report: bool = option(False, "write report.html, a page with tables")

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if not self.paths:
            return
        if len(self.paths) > 1 or self.paths[0] not in PROTOCOLS:
            raise InputError(f"score: expected one protocol, {', '.join(PROTOCOLS)}; got {', '.join(self.paths)}")
        if not self.ks:
            raise InputError("ks: expected numbers from 1, got none")
        options = TAKEN[self.paths[0]]
        defaults = type(self).__dataclass_fields__
        for name in dict.fromkeys(each for names in TAKEN.values() for each in names):
            if name not in options and getattr(self, name) != defaults[name].default:
                raise InputError(f"{name}: {self.paths[0]} has no such setting; it takes {', '.join(options)}")


def run(config: ScoreConfig, run: Run) -> None:
    """Scores the predictions, prints the table, and writes it with rows by scene and class."""
    (protocol,) = config.paths
    with run.step("score"):
        report = PROTOCOLS[protocol](config)
    out = run.out("score", protocol)
    with run.folder(out) as folder:
        write_report(folder, report, run, page=config.report)
    print_report(out, report, run)


def write_report(folder: Path, report: ScoreReport, summary: Summary, *, page: bool) -> None:
    """Writes the table as Markdown and CSV, the rows by scene and class, and a page where it is asked for, and adds the
    results to the summary."""
    write_bytes(folder / TABLE, report.table.markdown().encode())
    # What is 0 but for rounding reads 0; the summary has all digits.
    tables = {"table": report.table.csv_rows(), **report.rows}
    for name, rows in tables.items():
        rounded = [
            {key: round(value, DECIMALS) if isinstance(value, float) else value for key, value in row.items()}
            for row in rows
        ]
        write_bytes(folder / f"{name}.csv", csv_text(rounded).encode())
    summary.results.update(report.results)
    if page:
        from gsencoder.app.reports import report_benchmark

        report_benchmark(folder, report, summary)


def print_report(out: Path, report: ScoreReport, run: Run) -> None:
    """Prints the measured rows and the main figures."""
    table = report.table.measured().without_classes()
    if report.table.by_class:
        run.print(f"The figures of {counted(len(report.table.by_class), 'class', 'classes')} are in {TABLE}.")
    if len(table.columns) > MOST_COLUMNS:
        table = replace(table, columns=table.columns[:MOST_COLUMNS])
        run.print(f"The first {MOST_COLUMNS} of {len(report.table.columns)} columns; all are in {TABLE}.")
    run.print(Markdown(table.markdown()))
    run.print(f"{out}: {report.line}")


def _instances(config: ScoreConfig) -> ScoreReport:
    return score_instances(
        Path(config.predictions),
        Path(config.truth),
        load_classes(_given_classes(config), instances=True),
        method=config.method,
        scenes=_split(config),
        raw_ids=_raw_ids(config),
        class_agnostic=config.class_agnostic,
        min_region=config.min_region,
    )


def _semantics(config: ScoreConfig) -> ScoreReport:
    return score_semantics(
        Path(config.predictions),
        Path(config.truth),
        load_classes(_given_classes(config)),
        method=config.method,
        scenes=_split(config),
        raw_ids=_raw_ids(config),
        excluded=config.excluded,
    )


def _recognition(config: ScoreConfig) -> ScoreReport:
    return score_recognition(
        Path(config.predictions),
        Path(config.truth),
        classes=load_classes(config.classes).names if config.classes else (),
        method=config.method,
        ks=config.ks,
        allow_missing=config.allow_missing,
    )


def _referring(config: ScoreConfig) -> ScoreReport:
    return score_referring(
        Path(config.predictions),
        Path(config.truth),
        method=config.method,
        ks=[k for k in config.ks if k > 1],
        label_map=Path(config.label_map) if config.label_map else None,
        scans=Path(config.scans) if config.scans else None,
        allow_missing=config.allow_missing,
    )


def _answers(config: ScoreConfig) -> ScoreReport:
    return score_answer_files(
        Path(config.predictions),
        Path(config.truth),
        method=config.method,
        java=config.java,
        allow_missing=config.allow_missing,
    )


def _captions(config: ScoreConfig) -> ScoreReport:
    return score_caption_files(
        Path(config.predictions),
        Path(config.truth),
        method=config.method,
        min_iou=config.min_iou,
        java=config.java,
        allow_missing=config.allow_missing,
    )


def _retrieval(config: ScoreConfig) -> ScoreReport:
    return score_retrieval(
        Path(config.predictions),
        Path(config.truth),
        method=config.method,
        count=config.distractors,
        seed=config.seed,
        pooling=config.pooling,
    )


def _given_classes(config: ScoreConfig) -> str:
    if not config.classes:
        raise InputError("classes= is missing: scannet20, scannet200, or a CSV file with the columns id and name")
    return config.classes


def _raw_ids(config: ScoreConfig) -> dict[str, int] | None:
    """Class ids of the raw names of ScanNet's or ScanNet++'s objects."""
    if not config.label_map:
        return None
    if Path(config.label_map).suffix.lower() == ".csv":
        return ids_of_benchmark(Path(config.label_map), load_classes(_given_classes(config)))
    return read_label_map(Path(config.label_map), COLUMNS.get(config.classes, DEFAULT_COLUMN))


def _split(config: ScoreConfig) -> tuple[str, ...] | None:
    return read_split(Path(config.scenes)) if config.scenes else None


PROTOCOLS: dict[str, Callable[[ScoreConfig], ScoreReport]] = {
    "instances": _instances,
    "semantics": _semantics,
    "recognition": _recognition,
    "referring": _referring,
    "answers": _answers,
    "captions": _captions,
    "retrieval": _retrieval,
}
"""What can be scored."""
TAKEN = {
    "instances": ("classes", "label_map", "scenes", "class_agnostic", "min_region"),
    "semantics": ("classes", "label_map", "scenes", "excluded"),
    "recognition": ("classes", "ks", "allow_missing"),
    "referring": ("label_map", "scans", "ks", "allow_missing"),
    "answers": ("java", "allow_missing"),
    "captions": ("min_iou", "java", "allow_missing"),
    "retrieval": ("distractors", "seed", "pooling"),
}
"""Settings of each protocol beside those that all have."""
