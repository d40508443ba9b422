"""`gsencoder ask FEATURES question=…`: the answer of a VLM that sees the best views of what the question names."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsencoder.app.options import FeaturesConfig, settings
from gsencoder.app.run import Run
from gsencoder.app.scenes import folder_of, load_feature_scene, load_query, load_words
from gsencoder.core.errors import InputError, SceneWarning, counted, listed, printable
from gsencoder.core.files import write_json
from gsencoder.core.process import Clock
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, distinct_paths, kind_of_path
from gsencoder.fusion.folder import holds_features
from gsencoder.infer.ask.ask import AskConfig, Asker, Question, Task, check_question
from gsencoder.infer.ask.batch import (
    ANSWER,
    ANSWERS,
    PROMPT,
    REQUEST,
    ask_question,
    ask_questions,
    predictions,
    write_answers,
)
from gsencoder.infer.ask.questions import (
    BatchQuestion,
    QuestionSet,
    caption_question,
    is_question_set,
    read_question_set,
    read_questions,
)
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body
from gsencoder.infer.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.views.targets import ViewsConfig, best_boxes
from gsencoder.text.table import table_path
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words, closed_table
from gsencoder.types import Scene

PREDICTIONS = "predictions.json"


@dataclass(frozen=True, kw_only=True)
class AskingConfig(FeaturesConfig):
    """The options of commands that make prompts about scenes. Without slots, as `CommonConfig`."""

    ask: AskConfig = field(default_factory=AskConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class AskCommandConfig(AskingConfig):
    """Settings of `ask`."""

    paths: tuple[str, ...] = option(
        (),
        "a folder written by fuse, encode, pack or memory; for a question set several, or a folder that "
        "has one for each scene",
        metavar="FEATURES",
        required=True,
    )
    question: str = option("", "the question")
    questions: str = option(
        "",
        "a file of questions: JSON lines with question and, optionally, id, task, query, aabb; or the JSON "
        "of ScanQA, SQA3D, ScanRefer or Scan2Cap",
    )
    proposals: str = option(
        "",
        "for captions of a question set: a file of boxes as Scan2Cap has them, or localize = boxes of the "
        "objects' names; empty = the boxes of the question set",
    )
    task: Task = option(
        "answer", "answer a question, ground (say which of the marked objects is meant), or caption an object"
    )
    query: tuple[str, ...] = option(
        (), "words to localize; empty = the names of the text table that the question contains"
    )
    aabb: tuple[float, ...] = option((), "a box to show instead of words: lower and upper corner in world coordinates")
    photos: str = option(
        "", "the scene that was fused, or a folder of scenes; its photographs are shown instead of renders"
    )
    dry_run: bool = option(False, "write the prompt and the pictures without sending them")
    resume: bool = option(True, "continue an interrupted batch; false = ask every question again")
    vlm: VlmConfig = field(default_factory=VlmConfig)

    def __post_init__(self) -> None:
        FeaturesConfig.__post_init__(self)
        if len(self.paths) > 1 and not self.questions:
            raise InputError(f"paths: expected one folder of features, got {len(self.paths)}")
        if self.proposals and not self.questions:
            raise InputError("proposals: are boxes for a question set; give questions=, or aabb= for one box")
        if self.questions and (self.question or self.query or self.aabb):
            raise InputError("questions: the file contains the questions; leave out question=, query= and aabb=")
        if not self.questions:
            self.single_question()

    def single_question(self) -> Question:
        """The question on the command line."""
        return Question(text=self.question, task=self.task, query=self.query, aabb=self.aabb)


def run(config: AskCommandConfig, run: Run) -> None:
    """Localizes the words of the question, chooses and renders views, asks the VLM, and writes everything."""
    server = None if config.dry_run else VlmServer(config.vlm)
    request_body([], config.vlm, named=server is not None)
    if config.questions and is_question_set(Path(config.questions)):
        ask_set(config, read_question_set(Path(config.questions), config.task, config.proposals), server, run)
        return
    if len(config.paths) > 1 or config.proposals:
        raise InputError(
            f"paths, proposals: {config.questions} holds questions about one scene, one a line; give one folder of "
            "features and no proposals"
        )
    folder = Path(config.paths[0])
    questions = read_questions(Path(config.questions), config.task) if config.questions else ()
    if not questions:
        check_question(config.task, config.question)
    with run.step("load"):
        asker = build_asker(config, config.vlm, load_feature_scene(folder, config.photos, config.data), folder)
    out = run.out(asker.scene.name, "answers" if questions else "answer")
    clock = Clock()
    if questions:
        with run.resumable(out, "answers", resume=config.resume) as (target, work):
            rows = ask_questions(
                questions, asker, server, work, made_from=answer_settings(config), clock=clock, track=run.track
            )
            write_answers(target, work, rows)
            run.add_seconds(clock.seconds)
            run.results.update(questions=len(questions), answers=ANSWERS)
        run.print(f"{out}: {counted(len(questions), 'question')}, {ANSWERS}")
        return
    with run.folder(out) as target:
        row = ask_question(config.single_question(), asker, server, target, clock)
        run.add_seconds(clock.seconds)
        run.results.update(row)
    if server is not None:
        run.print(printable(row["answer"]), soft_wrap=True)
    run.print(
        f"{out}: {counted(len(row['views']), 'picture')}, {PROMPT}, {REQUEST}" + (f", {ANSWER}" if server else "")
    )


def answer_settings(config: AskCommandConfig) -> dict[str, Any]:
    """Settings that answers depend on and the asker does not know."""
    values = settings(config)
    return {name: values[name] for name in ("space", "photos", "data")}


def ask_set(config: AskCommandConfig, question_set: QuestionSet, server: VlmServer | None, run: Run) -> None:
    """Asks the questions of a benchmark about each scene that there are features of, and writes predictions.

    The features of one scene are in memory at a time. Questions that have no answer are counted and named, and so are
    scenes without features.
    """
    out, file = run.out(question_set.benchmark), config.questions
    question_counts = question_set.scenes()
    asked = (
        f"questions: {file} asks about {counted(len(question_counts), 'scene')} ({listed(sorted(question_counts), 3)})"
    )
    folders = scene_folders(config.paths, question_counts)
    if not folders:
        raise InputError(f"{asked}, and none of them has features in {', '.join(config.paths)}")
    clock = Clock()
    answered: list[tuple[BatchQuestion, dict[str, Any]]] = []
    silent: list[BatchQuestion] = []
    unanswered: dict[str, str] = {}
    counts: dict[str, int] = {}
    with run.resumable(out, "answers", resume=config.resume) as (folder, work):
        for path in folders:
            with run.step("load"):
                photos = str(folder_of(config.photos, path.name)) if config.photos else ""
                asker = build_asker(config, config.vlm, load_feature_scene(path, photos, config.data), path)
            name = asker.scene.name
            if name in counts:
                raise InputError(f"{path}: holds features of scene {name}, and so does another folder; give one")
            counts[name] = 0
            if name not in question_counts:
                continue
            names = question_set.names.get(name)
            questions = localized_captions(asker, names) if names else question_set.of_scene(name)
            state = work / name
            state.mkdir(exist_ok=True)
            rows = ask_questions(
                questions,
                asker,
                server,
                state,
                made_from=answer_settings(config),
                unanswered=unanswered,
                clock=clock,
                track=run.track,
            )
            (folder / name).mkdir()
            write_answers(folder / name, state, rows)
            by_id = {row["id"]: row for row in rows}
            answered += [(each, by_id[each.id]) for each in questions if each.id in by_id]
            silent += [each for each in questions if each.id not in by_id]
            counts[name] = len(questions)
            run.print(f"{name}: {len(rows)} of {len(questions)} questions")
        run.add_seconds(clock.seconds)
        if not any(counts.values()):
            raise InputError(f"{asked}, and there are features of others ({listed(sorted(counts), 3)})")
        others = {name: count for name, count in question_counts.items() if name not in counts}
        if unasked := [name for name in counts if name not in question_counts]:
            message = f"{file} asks nothing about {counted(len(unasked), 'scene')} with features: {listed(unasked)}"
            warnings.warn(message, SceneWarning, stacklevel=2)
        run.results.update(
            benchmark=question_set.benchmark,
            questions=sum(counts.values()),
            answered=len(answered),
            unanswered=unanswered,
            scenes={name: count for name, count in counts.items() if count},
            scenes_without_questions=sorted(name for name, count in counts.items() if not count),
            other_scenes=others,
        )
        if server is not None:
            entries = predictions(question_set.benchmark, answered, silent)
            write_json(folder / PREDICTIONS, entries)
            predicted = sum(map(len, entries.values())) if isinstance(entries, dict) else len(entries)
            run.results.update(predictions=PREDICTIONS, predicted=predicted)
    if unanswered:
        first = next(iter(unanswered.values()))
        message = f"{len(unanswered)} of {sum(counts.values())} questions have no answer: {first}"
        warnings.warn(message, SceneWarning, stacklevel=2)
    if others:
        run.print(
            f"not asked, for want of features: {counted(sum(others.values()), 'question')} about "
            f"{counted(len(others), 'scene')}: {listed(sorted(others), 3)}"
        )
    kind, last = ("answer", PREDICTIONS) if server else ("request", REQUEST)
    run.print(f"{out}: {counted(len(answered), kind)}, {last}")


def build_asker(config: AskingConfig, vlm: VlmConfig, scene: Scene, folder: Path) -> Asker:
    """The asker of a scene that was loaded from a folder of features. A box can be asked about without words."""
    words: Words | None
    if config.head:
        scene, words = load_query(
            scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
        )
    else:
        space = select_features(scene, config.space or None)[1].space
        has_own_words = config.words or not isinstance(config.text, TableTextConfig)
        has_words = has_own_words or table_path(folder, space.text_encoder) is not None
        words = load_words(folder, space, config.words, config.text) if has_words else None
    return Asker(
        scene,
        words,
        space=None if config.head else config.space or None,
        config=config.ask,
        localization=config.localize,
        views=config.choose,
        vlm=vlm,
    )


def scene_folders(paths: Sequence[str], scenes: Collection[str]) -> list[Path]:
    """The folders of features at paths: each path, or the folders in it that are called like one of the scenes."""
    folders: list[Path] = []
    for path in map(Path, paths):
        inner = [path] if holds_features(path) else []
        if not inner and path.is_dir():
            inner = sorted(filter(holds_features, path.iterdir()))
        if not inner:
            raise InputError(
                f"{path}: {kind_of_path(path)}; expected a folder of features, which `gsencoder fuse`, `encode`, "
                "`memory` and `pack` write, or a folder of such folders"
            )
        folders += [folder for folder in inner if folder is path or folder.name in scenes]
    return list(distinct_paths(folders))


def localized_captions(asker: Asker, names: Sequence[str]) -> tuple[BatchQuestion, ...]:
    """Questions for captions of the best boxes of names, `ask.boxes` for each; names that no table knows have none.

    Warns:
        SceneWarning: names that no table knows, or none of which has a box.
    """
    if asker.words is None:
        raise InputError(
            f"proposals=localize: there is no text table for the features of {asker.scene.name}; give words="
        )
    table = closed_table(asker.words)
    known_names = [name for name in names if table is None or table.find(name) is not None]
    if len(known_names) < len(names):
        unknown = [name for name in names if name not in known_names]
        warnings.warn(
            f"proposals=localize: {asker.scene.name}: the text table lacks {len(unknown)} of {len(names)} names of "
            f"objects, of which there are no captions: {listed(unknown)}; give a text tower (text=)",
            SceneWarning,
            stacklevel=2,
        )
    if not known_names:
        return ()
    localization = localize(asker.scene, known_names, asker.words, asker.localization, space=asker.space)
    questions = []
    for number, box in enumerate(best_boxes(localization, asker.config.boxes)):
        low, high = box.aabb_min.tolist(), box.aabb_max.tolist()
        aabb = ((low[0], low[1], low[2]), (high[0], high[1], high[2]))
        keys = {"obj_prob": [1 - float(box.probability), float(box.probability)]}
        if (box.aabb_min < box.aabb_max).all():
            questions.append(caption_question(asker.scene.name, str(number), aabb, keys))
    if not questions:
        warnings.warn(
            f"proposals=localize: {asker.scene.name}: no name of an object has a box there ({listed(known_names)}), so "
            "that there is nothing to caption",
            SceneWarning,
            stacklevel=2,
        )
    return tuple(questions)
