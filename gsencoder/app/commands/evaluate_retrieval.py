"""`gsencoder evaluate SCENE… protocol=retrieval`: scores of rendered views with texts, written and scored as files."""

import warnings
from pathlib import Path

import numpy as np

from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluate_sources import method_name, scenes_of
from gsencoder.app.commands.evaluated_features import stored_memory
from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError, SceneWarning, advised, counted, listed
from gsencoder.data.labels.captions import read_texts, read_view_captions, write_view_captions
from gsencoder.data.scenes import find_scenes, load_scene, scene_name
from gsencoder.evaluate.benchmarks.retrieval import ScoredPairs, score_retrieval, write_scored_pairs
from gsencoder.evaluate.protocols.retrieval import RetrievalProtocol, evaluate_retrieval, views_of
from gsencoder.evaluate.sources import FeatureSource
from gsencoder.text.vocabulary import Words, check_known
from gsencoder.types import QueryMemory, Scene

PREDICTIONS, TRUTH = "predictions.npz", "truth.json"


def run_retrieval(
    config: EvaluateConfig,
    protocol: RetrievalProtocol,
    source: FeatureSource,
    words: Words,
    out: Path,
    summary: Summary,
) -> None:
    """Compares the views of all scenes with all texts, and scores what it wrote."""
    if not protocol.captions:
        raise InputError("protocol.captions= is missing: a JSON list of {scene_id, view, caption}")
    provided = read_view_captions(Path(protocol.captions))
    names = [scene_name(path) for path in find_scenes(config.paths)]
    captions = [each for name in names for each in provided if each.scene == name]
    if not captions:
        raise InputError(
            f"protocol.captions: none of the captions in {protocol.captions} is about a scene "
            f"that is evaluated ({listed(names, 3)}); first {provided[0].scene}"
        )
    if len(captions) < len(provided):
        warnings.warn(
            f"{len(provided) - len(captions)} of {counted(len(provided), 'caption')} do not count: they are about "
            "scenes that are not evaluated",
            SceneWarning,
            stacklevel=2,
        )
    others = read_texts(Path(protocol.distractors)) if protocol.distractors else ()
    others = tuple(text for text in others if text not in {each.caption for each in captions})
    if protocol.count > len(others):
        raise InputError(
            f"protocol.count: {protocol.count:,} distractors are asked for, and protocol.distractors= has "
            f"{len(others):,}"
        )
    texts = [*(each.caption for each in captions), *others]
    with advised("sentences need the tower that made the words (text=)"):
        check_known(words, texts)
    for path in find_scenes(config.paths):
        loaded = load_scene(path, options=config.data)
        views_of(loaded, [each for each in captions if each.scene == loaded.name])

    def memory_of(scene: Scene) -> QueryMemory | None:
        # Outputs of a head are features of their own; the memory holds those of the teacher.
        return stored_memory(config.features, scene) if config.features and not config.head else None

    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        scenes = evaluate_retrieval(
            scenes_of(config),
            source,
            words,
            captions,
            texts,
            protocol=protocol,
            seeds=config.seeds,
            memory_of=memory_of,
        )
        for scene in scenes:
            summary.add_seconds(scene.seconds)
        pairs = ScoredPairs(
            queries=tuple(each.name for scene in scenes for each in scene.captions),
            scores=np.concatenate([scene.scores for scene in scenes]),
            distractors=np.zeros((0, len(captions))),
        )
        write_scored_pairs(folder / PREDICTIONS, pairs)
        write_view_captions(folder / TRUTH, captions)
        report = score_retrieval(
            folder / PREDICTIONS, folder / TRUTH, method=method_name(config), count=protocol.count, seed=protocol.seed
        )
        write_report(folder, report, summary, page=config.report)
        summary.results["gaussians"] = {scene.scene: scene.gaussians for scene in scenes}
    print_report(out, report, quiet=config.quiet)
