"""Protocols of `gsencoder evaluate` that score what they compute: figures for the summary, and rows of CSV files."""

from dataclasses import asdict, replace
from pathlib import Path

from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluate_sources import scenes_of
from gsencoder.app.commands.evaluated_features import stored_memory
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import about
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.evaluate.grounding import grounding_scores
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
    summary: Summary,
) -> None:
    outcomes = evaluate_localization(
        scenes_of(config), source, words, protocol=protocol, seeds=config.seeds, localization=config.localize
    )
    record(outcomes, summary)
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
    summary: Summary,
) -> None:
    scenes = evaluate_naming(scenes_of(config), source, words, seeds=config.seeds, fusion=config.fusion)
    scores = naming_scores(scenes, protocol)
    for scene in scenes:
        summary.add_seconds(scene.seconds)
    each = []
    for scene in scenes:
        totals = {name: count for name, count in scene.total.items() if name in scores["names"]}
        scene_scores = naming_scores([replace(scene, total=totals)]) if totals else {}
        each.append({"scene": scene.scene, "gaussians": sum(scene.total.values()), **scene_scores})
    summary.results.update(protocol="naming", **scores, names_table="names.csv", scenes=each)
    rows = [{"name": name, **row} for name, row in scores["names"].items()]
    write_bytes(folder / "names.csv", csv_text(rows).encode())


def absent(
    config: EvaluateConfig,
    protocol: AbsentProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    summary: Summary,
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
        summary.add_seconds(scene.seconds)
    summary.results.update(
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
    summary: Summary,
) -> None:
    def memory_of(scene: Scene) -> QueryMemory | None:
        # Outputs of a head are features of their own; the memory holds those of the teacher.
        return stored_memory(config.features, scene) if config.features and not config.head else None

    scenes = evaluate_grounding(
        scenes_of(config), source, words, protocol=protocol, seeds=config.seeds, memory_of=memory_of
    )
    for scene in scenes:
        summary.add_seconds(scene.seconds)
    pairs = [pair for scene in scenes for pair in scene.pairs]
    names = scores_by_phrase(pairs)
    summary.results.update(
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


def record(outcomes: list[SceneOutcome], summary: Summary) -> None:
    """Adds scores, scenes and seconds to the summary."""
    hits = [hit for outcome in outcomes for hit in outcome.hits]
    for outcome in outcomes:
        summary.add_seconds(outcome.seconds)
    summary.results.update(
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
