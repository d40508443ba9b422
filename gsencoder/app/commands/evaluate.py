"""`gsencoder evaluate SCENE… protocol=…`: a metric on labeled scenes, of fused features or of an encoder's."""

from pathlib import Path

from gsencoder.app.commands.evaluate_protocols import absent, grounding, localization, naming
from gsencoder.app.commands.evaluate_report import names_table, scores_line
from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluate_sources import source_of_head, stored_features, teacher_or_encoder
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import console
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError
from gsencoder.core.process import refuse_several
from gsencoder.data.scenes import check_names, find_scenes
from gsencoder.evaluate.benchmark_files import BenchmarkProtocol
from gsencoder.evaluate.protocols.absent import (
    AbsentProtocol,
)
from gsencoder.evaluate.protocols.grounding import (
    GroundingProtocol,
)
from gsencoder.evaluate.protocols.naming import NamingProtocol
from gsencoder.evaluate.protocols.retrieval import RetrievalProtocol

__all__ = ["EvaluateConfig", "run"]


def run(config: EvaluateConfig, summary: Summary) -> None:
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
    out = config.out or Path("outputs") / "evaluate" / config.protocol.name
    if isinstance(config.protocol, BenchmarkProtocol):
        from gsencoder.app.commands.evaluate_benchmark import run_benchmark

        run_benchmark(config, config.protocol, source, words, out, summary)
        return
    if isinstance(config.protocol, RetrievalProtocol):
        from gsencoder.app.commands.evaluate_retrieval import run_retrieval

        run_retrieval(config, config.protocol, source, words, out, summary)
        return
    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        if isinstance(config.protocol, NamingProtocol):
            naming(config, config.protocol, source, words, folder, summary)
        elif isinstance(config.protocol, AbsentProtocol):
            absent(config, config.protocol, source, words, folder, summary)
        elif isinstance(config.protocol, GroundingProtocol):
            grounding(config, config.protocol, source, words, folder, summary)
        else:
            localization(config, config.protocol, source, words, folder, summary)
        if config.report:
            from gsencoder.app.reports.results import report_scores

            report_scores(folder, summary)
    screen = console(config.quiet)
    screen.print(names_table(summary.results))
    screen.print(f"{out}: {scores_line(summary.results)}")
