"""`gsencoder ask FEATURES question=…`: the answer of a VLM that sees the best views of what the question names."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsencoder.app.inputs import load_asker, localized_captions, photos_of, scene_folders
from gsencoder.app.options import FeaturesConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, SceneWarning, counted, listed, printable
from gsencoder.core.files import write_json
from gsencoder.core.process import Clock
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig
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
    SetQuestion,
    is_question_set,
    read_question_set,
    read_questions,
)
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig

PREDICTIONS = "predictions.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class AskCommandConfig(FeaturesConfig):
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
    ask: AskConfig = field(default_factory=AskConfig)
    vlm: VlmConfig = field(default_factory=VlmConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

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
        asker = load_asker(config, folder, config.photos)
    out = run.out(asker.scene.name, "answers" if questions else "answer")
    if questions:
        ask_file(out, questions, asker, server, config, run)
        return
    clock = Clock()
    with run.folder(out) as target:
        row = ask_question(config.single_question(), asker, server, target, clock)
        run.add_seconds(clock.seconds)
        run.results.update(row)
    if server is not None:
        run.print(printable(row["answer"]), soft_wrap=True)
    run.print(
        f"{out}: {counted(len(row['views']), 'picture')}, {PROMPT}, {REQUEST}" + (f", {ANSWER}" if server else "")
    )


def made_from(config: AskCommandConfig) -> dict[str, Any]:
    """Settings that answers depend on and the asker does not know."""
    values = settings(config)
    return {name: values[name] for name in ("space", "photos", "data")}


def ask_file(
    out: Path,
    questions: Sequence[BatchQuestion],
    asker: Asker,
    server: VlmServer | None,
    config: AskCommandConfig,
    run: Run,
) -> None:
    """Asks the questions of a file; the answers of an interrupted run stay in a folder beside out=."""
    clock = Clock()
    with run.resumable(out, "answers", resume=config.resume) as (folder, work):
        rows = ask_questions(questions, asker, server, work, made_from=made_from(config), clock=clock, track=run.track)
        write_answers(folder, work, rows)
        run.add_seconds(clock.seconds)
        run.results.update(questions=len(questions), answers=ANSWERS)
    run.print(f"{out}: {counted(len(questions), 'question')}, {ANSWERS}")


def ask_set(config: AskCommandConfig, question_set: QuestionSet, server: VlmServer | None, run: Run) -> None:
    """Asks the questions of a benchmark about each scene that there are features of, and writes predictions.

    The features of one scene are in memory at a time. Questions that have no answer are counted and named, and so are
    scenes without features.
    """
    out = run.out(question_set.benchmark)
    question_counts = question_set.scenes()
    folders = scene_folders(config.paths, question_counts)
    if not folders:
        raise InputError(
            f"questions: {config.questions} asks about {counted(len(question_counts), 'scene')} "
            f"({listed(sorted(question_counts), 3)}), and none of "
            f"them has features in {', '.join(config.paths)}"
        )
    clock = Clock()
    answered: list[tuple[SetQuestion, dict[str, Any]]] = []
    silent: list[SetQuestion] = []
    unanswered: dict[str, str] = {}
    counts: dict[str, int] = {}
    with run.resumable(out, "answers", resume=config.resume) as (folder, work):
        for path in folders:
            with run.step("load"):
                asker = load_asker(config, path, photos_of(config.photos, path))
            name = asker.scene.name
            if name in counts:
                raise InputError(f"{path}: holds features of scene {name}, and so does another folder; give one")
            if name not in question_counts:
                counts[name] = 0
                continue
            questions = (
                localized_captions(asker, question_set.names[name])
                if question_set.names
                else question_set.of_scene(name)
            )
            state = work / name
            state.mkdir(exist_ok=True)
            rows = ask_questions(
                [each.question for each in questions],
                asker,
                server,
                state,
                made_from=made_from(config),
                unanswered=unanswered,
                clock=clock,
                track=run.track,
            )
            (folder / name).mkdir()
            write_answers(folder / name, state, rows)
            by_id = {row["id"]: row for row in rows}
            answered += [(each, by_id[each.question.id]) for each in questions if each.question.id in by_id]
            silent += [each for each in questions if each.question.id not in by_id]
            counts[name] = len(questions)
            run.print(f"{name}: {len(rows)} of {len(questions)} questions")
        run.add_seconds(clock.seconds)
        if not any(counts.values()):
            raise InputError(
                f"questions: {config.questions} asks about {counted(len(question_counts), 'scene')} "
                f"({listed(sorted(question_counts), 3)}), and "
                f"there are features of others ({listed(sorted(counts), 3) or 'none'})"
            )
        others = {name: count for name, count in question_counts.items() if name not in counts}
        unasked = [name for name in counts if name not in question_counts]
        if unasked:
            warnings.warn(
                f"{config.questions} asks nothing about {counted(len(unasked), 'scene')} with features: "
                f"{listed(unasked)}",
                SceneWarning,
                stacklevel=2,
            )
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
        warnings.warn(
            f"{len(unanswered)} of {sum(counts.values())} questions have no answer: {first}",
            SceneWarning,
            stacklevel=2,
        )
    if others:
        run.print(
            f"not asked, for want of features: {counted(sum(others.values()), 'question')} about "
            f"{counted(len(others), 'scene')}: "
            f"{listed(sorted(others), 3)}"
        )
    run.print(
        f"{out}: "
        + (
            f"{counted(len(answered), 'answer')}, {PREDICTIONS}"
            if server
            else f"{counted(len(answered), 'request')}, {REQUEST}"
        )
    )
