"""`gsencoder evaluate SCENE… protocol=…`: a metric on labeled scenes, of fused features or of an encoder's."""

from dataclasses import asdict, replace
from pathlib import Path

from rich.table import Table

from gsencoder.app.evaluate_settings import (
    EvaluateConfig,
    scenes_of,
    source_of_head,
    stored_features,
    stored_memory,
    teacher_or_encoder,
)
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, about, counted
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.core.process import refuse_several
from gsencoder.data.scenes import check_names, find_scenes
from gsencoder.evaluate.benchmark_files import BenchmarkProtocol
from gsencoder.evaluate.benchmarks.retrieval import RetrievalProtocol
from gsencoder.evaluate.protocols.absent import (
    AbsentProtocol,
    absent_scores,
    evaluate_absent,
    names_of,
    probabilities_by_word,
)
from gsencoder.evaluate.protocols.grounding import (
    GroundingProtocol,
    evaluate_grounding,
    grounding_scores,
    phrase_mean,
    scores_by_phrase,
)
from gsencoder.evaluate.protocols.localization import (
    LocalizationProtocol,
    SceneOutcome,
    evaluate_localization,
    scores,
    scores_by_name,
)
from gsencoder.evaluate.protocols.naming import NamingProtocol, evaluate_naming, naming_scores
from gsencoder.evaluate.sources import (
    FeatureSource,
)
from gsencoder.text.vocabulary import Words, check_known
from gsencoder.types import QueryMemory, Scene


def localization(
    config: EvaluateConfig,
    protocol: LocalizationProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    run: Run,
) -> None:
    outcomes = evaluate_localization(
        scenes_of(config), source, words, protocol=protocol, seeds=config.seeds, localization=config.localize
    )
    record(outcomes, run)
    hits = [hit for outcome in outcomes for hit in outcome.hits]
    rows = [{"scene": h.scene, "name": h.name, "iou": h.iou, "oracle_iou": h.oracle_iou} for h in hits]
    write_bytes(folder / "hits.csv", csv_text(rows).encode())
    names = [{"name": name, **row} for name, row in scores_by_name(hits).items()]
    write_bytes(folder / "names.csv", csv_text(names).encode())


def naming(
    config: EvaluateConfig,
    protocol: NamingProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    run: Run,
) -> None:
    scenes = evaluate_naming(scenes_of(config), source, words, seeds=config.seeds, fusion=config.fusion)
    scores = naming_scores(scenes, protocol)
    for scene in scenes:
        run.add_seconds(scene.seconds)
    each = []
    for scene in scenes:
        totals = {name: count for name, count in scene.total.items() if name in scores["names"]}
        scene_scores = naming_scores([replace(scene, total=totals)]) if totals else {}
        each.append({"scene": scene.scene, "gaussians": sum(scene.total.values()), **scene_scores})
    run.results.update(protocol="naming", **scores, names_table="names.csv", scenes=each)
    rows = [{"name": name, **row} for name, row in scores["names"].items()]
    write_bytes(folder / "names.csv", csv_text(rows).encode())


def absent(
    config: EvaluateConfig,
    protocol: AbsentProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    run: Run,
) -> None:
    with about("protocol.vocabulary"):
        check_known(words, protocol.vocabulary)
    vocabulary = protocol.vocabulary or names_of(scene for scene, _ in scenes_of(config))
    scenes = evaluate_absent(
        scenes_of(config),
        source,
        words,
        vocabulary,
        protocol=protocol,
        seeds=config.seeds,
        localization=config.localize,
    )
    for scene in scenes:
        run.add_seconds(scene.seconds)
    run.results.update(
        protocol="absent",
        **absent_scores(scenes),
        names=probabilities_by_word(scenes),
        scenes=[scene.scene for scene in scenes],
        words_table="words.csv",
    )
    rows = [
        {"scene": w.scene, "word": w.word, "present": w.present, "probability": w.probability, "boxed": w.boxed}
        for scene in scenes
        for w in scene.words
    ]
    write_bytes(folder / "words.csv", csv_text(rows).encode())


def grounding(
    config: EvaluateConfig,
    protocol: GroundingProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    run: Run,
) -> None:
    def memory_of(scene: Scene) -> QueryMemory | None:
        # Outputs of a head are features of their own; the memory holds those of the teacher.
        return stored_memory(config.features, scene) if config.features and not config.head else None

    scenes = evaluate_grounding(
        scenes_of(config), source, words, protocol=protocol, seeds=config.seeds, memory_of=memory_of
    )
    for scene in scenes:
        run.add_seconds(scene.seconds)
    pairs = [pair for scene in scenes for pair in scene.pairs]
    names = scores_by_phrase(pairs)
    run.results.update(
        protocol="grounding",
        **asdict(grounding_scores(pairs)),
        miou_names=phrase_mean(names),
        small=sum(scene.small for scene in scenes),
        names=names,
        scenes=[
            {
                "scene": scene.scene,
                "views": scene.views,
                "gaussians": scene.gaussians,
                "small": scene.small,
                **asdict(grounding_scores(scene.pairs)),
            }
            for scene in scenes
        ],
        pairs_table="pairs.csv",
        names_table="names.csv",
    )
    rows = [
        {"scene": scene.scene, "view": pair.view, "name": pair.phrase, "iou": pair.iou, "finite": pair.finite}
        for scene in scenes
        for pair in scene.pairs
    ]
    write_bytes(folder / "pairs.csv", csv_text(rows).encode())
    write_bytes(folder / "names.csv", csv_text([{"name": name, **row} for name, row in names.items()]).encode())


def record(outcomes: list[SceneOutcome], run: Run) -> None:
    """Adds scores, scenes and seconds to the run."""
    hits = [hit for outcome in outcomes for hit in outcome.hits]
    for outcome in outcomes:
        run.add_seconds(outcome.seconds)
    run.results.update(
        protocol="localization",
        **scores(hits),
        boxless=sum(outcome.boxless for outcome in outcomes),
        names=scores_by_name(hits),
        scenes=[
            {
                "scene": outcome.scene,
                "gaussians": outcome.gaussians,
                "seen": outcome.seen,
                "rank": outcome.rank,
                "seconds": sum(outcome.seconds.values()),
                **scores(outcome.hits),
            }
            for outcome in outcomes
        ],
        hits="hits.csv",
        names_table="names.csv",
    )


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


__all__ = ["EvaluateConfig", "run"]


def run(config: EvaluateConfig, run: Run) -> None:
    """Evaluates, prints the scores, and writes them with one row for each object, name or class."""
    if not isinstance(config.protocol, BenchmarkProtocol):
        advice = "start it once; recognition, instances, semantics and referring are what processes share the scenes of"
        refuse_several(f"protocol={config.protocol.name}", advice)
    if config.space and not (config.weights or config.features):
        raise InputError("space: names a teacher of weights= or features=; leave it out, or give one of the two")
    check_names(find_scenes(config.paths))
    if config.features:
        source, words = stored_features(config)
    else:
        source, words = source_of_head(config) if config.head else teacher_or_encoder(config)
    out = run.out("evaluate", config.protocol.name)
    if isinstance(config.protocol, BenchmarkProtocol):
        from gsencoder.app.commands.evaluate_benchmarks import run_benchmark

        run_benchmark(config, config.protocol, source, words, out, run)
        return
    if isinstance(config.protocol, RetrievalProtocol):
        from gsencoder.app.commands.evaluate_benchmarks import run_retrieval

        run_retrieval(config, config.protocol, source, words, out, run)
        return
    with run.folder(out) as folder:
        if isinstance(config.protocol, NamingProtocol):
            naming(config, config.protocol, source, words, folder, run)
        elif isinstance(config.protocol, AbsentProtocol):
            absent(config, config.protocol, source, words, folder, run)
        elif isinstance(config.protocol, GroundingProtocol):
            grounding(config, config.protocol, source, words, folder, run)
        else:
            localization(config, config.protocol, source, words, folder, run)
        if config.report:
            from gsencoder.app.reports import report_scores

            report_scores(folder, run)
    run.print(names_table(run.results), f"{out}: {scores_line(run.results)}")
