"""`gsencoder evaluate SCENE… protocol=…`: a metric on labeled scenes, of fused features or of an encoder's."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from gsencoder.app.commands.evaluate_report import names_table, scores_line
from gsencoder.app.commands.evaluated_features import stored_memory, stored_source, stored_words, with_stored_features
from gsencoder.app.commands.score import print_report, write_report
from gsencoder.app.commands.through_head import words_of_head
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.core.errors import InputError
from gsencoder.core.files.csv_text import csv_text
from gsencoder.core.files.json_values import write_bytes
from gsencoder.core.runtime.heap import retain_freed_memory
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats import READABLE
from gsencoder.data.truth.label_sets import COLUMNS, read_label_map
from gsencoder.evaluate.benchmark_files import BenchmarkProtocol, score_written, write_predictions
from gsencoder.evaluate.files.class_files import load_classes, write_classes
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
from gsencoder.evaluate.protocols.instances import InstancesProtocol
from gsencoder.evaluate.protocols.localization import (
    LocalizationProtocol,
    SceneOutcome,
    evaluate_localization,
    scores,
    scores_by_name,
)
from gsencoder.evaluate.protocols.naming import NamingProtocol, evaluate_naming, naming_scores
from gsencoder.evaluate.protocols.recognition import RecognitionProtocol
from gsencoder.evaluate.protocols.referring import ReferringProtocol
from gsencoder.evaluate.protocols.semantics import SemanticsProtocol, classes_of
from gsencoder.evaluate.score_report import ScoreReport
from gsencoder.evaluate.scores.class_table import ClassTable
from gsencoder.evaluate.sources import (
    FeatureSource,
    encoder_source,
    fused_head_source,
    fusion_source,
    head_source,
    load_scenes,
    space_of_words,
    table_beside,
)
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.heads.of_teacher import heads_of
from gsencoder.fusion.heads.store import find_head, load_heads
from gsencoder.fusion.store.heads_file import heads_beside
from gsencoder.fusion.teachers.build import TeacherConfig, words_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.load_encoder import file_of_encoder, load_encoder
from gsencoder.infer.localize.localize import LocalizeConfig
from gsencoder.text.build import TableTextConfig, TextConfig, Words, stating_trained, words_of_table
from gsencoder.types import QueryMemory, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig(CommonConfig):
    """Settings of `evaluate`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "labeled scenes, or folders of scenes", "metavar": "SCENE", "required": True},
    )
    weights: str = field(
        default="",
        metadata={
            "help": "encoder whose features are evaluated (see encode); empty = the fused features of the teacher"
        },
    )
    features: str = field(
        default="",
        metadata={
            "help": "features that are evaluated in place of those: a folder written by fuse, encode, pack or memory, "
            "or one with such a folder for each scene"
        },
    )
    space: str = field(
        default="",
        metadata={
            "help": "of an encoder or features of several teachers, the one that is evaluated; empty = that of the "
            "words"
        },
    )
    head: str = field(
        default="",
        metadata={
            "help": "adapter head whose outputs are evaluated, such as siglip, with the words of text=; empty = the "
            "features themselves"
        },
    )
    protocol: (
        LocalizationProtocol
        | NamingProtocol
        | AbsentProtocol
        | GroundingProtocol
        | RecognitionProtocol
        | InstancesProtocol
        | SemanticsProtocol
        | ReferringProtocol
    ) = field(default_factory=LocalizationProtocol)
    classes: str = field(
        default="",
        metadata={
            "help": "of recognition, instances and semantics: scannet20, scannet200, or a CSV file with the columns "
            "id, name and group; empty = the names of the scenes' objects"
        },
    )
    label_map: str = field(
        default="",
        metadata={
            "help": "scannetv2-labels.combined.tsv, which gives the raw names of ScanNet's objects a class of classes="
        },
    )
    splat: str = field(default="", metadata={"help": f"Gaussians of the scenes; empty = seeds. {READABLE}"})
    report: bool = field(default=False, metadata={"help": "write report.html, a page with pictures and figures"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    text: TextConfig = field(default_factory=TableTextConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


CLASS_IDS = "class_ids.csv"
"""The classes of benchmarks, as `score` takes them."""


def run(config: EvaluateConfig, summary: Summary) -> None:
    """Evaluates, prints the scores, and writes them with one row for each object or name."""
    if config.features:
        source, words = _stored(config)
    else:
        source, words = _source_of_head(config) if config.head else _source(config)
    out = config.out or Path("outputs") / "evaluate" / config.protocol.name
    report = None
    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        if isinstance(config.protocol, NamingProtocol):
            _naming(config, config.protocol, source, words, folder, summary)
        elif isinstance(config.protocol, AbsentProtocol):
            _absent(config, config.protocol, source, words, folder, summary)
        elif isinstance(config.protocol, GroundingProtocol):
            _grounding(config, config.protocol, source, words, folder, summary)
        elif isinstance(config.protocol, BenchmarkProtocol):
            report = _benchmark(config, config.protocol, source, words, folder, summary)
        else:
            _localization(config, config.protocol, source, words, folder, summary)
        if config.report:
            from gsencoder.app.reports.results import report_scores

            report_scores(folder, summary)
    if report is not None:
        print_report(out, report, quiet=config.quiet)
        return
    screen = console(config.quiet)
    screen.print(names_table(summary.results))
    screen.print(f"{out}: {scores_line(summary.results)}")


def _source(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of the features, and the words that they are compared with: those of teacher= and text=, or where
    neither is given, those beside the weights."""
    if config.weights:
        retain_freed_memory()
        encoder = load_encoder(config.weights, config.encode.device)
        table = table_beside(encoder, config.space)
        if table is not None and config.teacher == LabelsConfig() and config.text == TableTextConfig():
            words: Words = words_of_table(table)
        else:
            words = _given_words(config)
        space = config.space or space_of_words(encoder, words)
        words = stating_trained(words, table_beside(encoder, space))
        return encoder_source(encoder, config.encode, space), words
    words = _given_words(config)
    return fusion_source(config.teacher, words, config.fusion), words


def _stored(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of features of a folder, and the words that they are compared with."""
    if config.weights or config.splat or config.teacher != LabelsConfig():
        raise InputError("features: a folder has its own Gaussians and words; leave out weights=, splat= and teacher=")
    first = next(iter(find_scenes(config.paths)))
    scene = load_scene(first, options=config.data)
    options = {"head": config.head, "space": config.space}
    return stored_source, stored_words(config.features, scene.name, text=config.text, **options)


def _given_words(config: EvaluateConfig) -> Words:
    words = words_of(config.teacher, config.text)
    if words is None:
        raise InputError(
            f"evaluate: no words lead into the space of teacher {config.teacher.name}; give teacher.words= or text="
        )
    return words


def _source_of_head(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of the outputs of an adapter head, and the words that they are compared with."""
    table = getattr(config.teacher, "words", "") if isinstance(config.text, TableTextConfig) else ""
    if config.weights:
        path = heads_beside(file_of_encoder(config.weights))
        if path is None:
            raise InputError(
                f"head={config.head}: no adapter heads lie beside the weights {config.weights}; train with "
                f"heads=[{config.head}]"
            )
        heads = load_heads(path)
        head = find_head(heads, config.head)
        words = words_of_head(head.head, table, config.text)
        retain_freed_memory()
        encoder = load_encoder(config.weights, config.encode.device)
        source = encoder_source(encoder, config.encode, config.space or heads.space.name)
        return head_source(source, heads, head, words.space.text_encoder), words
    (own,) = heads_of(config.teacher, [config.head], "head")
    words = words_of_head(own, table, config.text)
    return fused_head_source(config.teacher, own, words.space.text_encoder, config.fusion), words


def _scenes(config: EvaluateConfig) -> Iterator[tuple[Scene, float]]:
    scenes = load_scenes(find_scenes(config.paths), config.data, config.splat, Progress(quiet=config.quiet))
    if config.features:
        options = {"head": config.head, "space": config.space}
        return with_stored_features(scenes, config.features, text=config.text, **options)
    return scenes


def _localization(
    config: EvaluateConfig,
    protocol: LocalizationProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    summary: Summary,
) -> None:
    outcomes = evaluate_localization(
        _scenes(config), source, words, protocol=protocol, seeds=config.seeds, localization=config.localize
    )
    record(outcomes, summary)
    hits = [hit for outcome in outcomes for hit in outcome.hits]
    rows = [{"scene": h.scene, "name": h.name, "iou": h.iou, "oracle_iou": h.oracle_iou} for h in hits]
    write_bytes(folder / "hits.csv", csv_text(rows).encode())
    names = [{"name": name, **row} for name, row in scores_by_name(hits).items()]
    write_bytes(folder / "names.csv", csv_text(names).encode())


def _naming(
    config: EvaluateConfig,
    protocol: NamingProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    summary: Summary,
) -> None:
    scenes = evaluate_naming(_scenes(config), source, words, seeds=config.seeds, fusion=config.fusion)
    scores = naming_scores(scenes, protocol)
    for scene in scenes:
        summary.add_seconds(scene.seconds)
    each = []
    for scene in scenes:
        counted = {name: count for name, count in scene.total.items() if name in scores["names"]}
        scene_scores = naming_scores([replace(scene, total=counted)]) if counted else {}
        each.append({"scene": scene.scene, "gaussians": sum(scene.total.values()), **scene_scores})
    summary.results.update(protocol="naming", **scores, names_table="names.csv", scenes=each)
    rows = [{"name": name, **row} for name, row in scores["names"].items()]
    write_bytes(folder / "names.csv", csv_text(rows).encode())


def _absent(
    config: EvaluateConfig,
    protocol: AbsentProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    summary: Summary,
) -> None:
    vocabulary = protocol.vocabulary or names_of(scene for scene, _ in _scenes(config))
    scenes = evaluate_absent(
        _scenes(config),
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


def _grounding(
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
        _scenes(config), source, words, protocol=protocol, seeds=config.seeds, memory_of=memory_of
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


def _benchmark(
    config: EvaluateConfig,
    protocol: BenchmarkProtocol,
    source: FeatureSource,
    words: Words,
    folder: Path,
    summary: Summary,
) -> ScoreReport:
    classes, class_names = _classes(config)
    done = write_predictions(
        _scenes(config),
        source,
        words,
        classes,
        folder,
        protocol=protocol,
        class_names=class_names,
        seeds=config.seeds,
        localization=config.localize,
    )
    write_classes(folder / CLASS_IDS, classes)
    for scene in done:
        summary.add_seconds(scene.seconds)
    report = score_written(folder, protocol, classes, "fused" if not config.weights else "encoded")
    write_report(folder, report, summary)
    summary.results["gaussians"] = {scene.scene: scene.gaussians for scene in done}
    return report


def _classes(config: EvaluateConfig) -> tuple[ClassTable, dict[str, str] | None]:
    """The classes that can be predicted, and where a label map is given the class of each raw name."""
    if not config.classes:
        if config.label_map:
            raise InputError("label_map: leads to the ids of a benchmark; give classes=scannet20 or classes=scannet200")
        return classes_of(names_of(scene for scene, _ in _scenes(config))), None
    classes = load_classes(config.classes)
    if not config.label_map:
        return classes, None
    name_of = dict(zip(classes.ids, classes.names, strict=True))
    ids = read_label_map(Path(config.label_map), COLUMNS.get(config.classes, "id"))
    return classes, {raw: name_of[number] for raw, number in ids.items() if number in name_of}


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
