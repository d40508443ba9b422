"""`gsencoder ask FEATURES question=…`: the answer of a VLM that sees the best views of what the question names."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gsencoder.app.commands.query_words import asked_scene, load_words
from gsencoder.app.commands.shown_scene import shown_scene
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.printable import printable
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.runs.work_folder import WorkFolder
from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.core.errors import InputError
from gsencoder.core.runtime.clock import Clock
from gsencoder.data.scenes import SceneConfig
from gsencoder.fusion.store.words import table_path
from gsencoder.infer.ask.ask import AskConfig, Asker, Question
from gsencoder.infer.ask.batch import ANSWER, ANSWERS, PROMPT, REQUEST, ask_question, ask_questions, write_answers
from gsencoder.infer.ask.prompts import Task, check_question
from gsencoder.infer.ask.questions import BatchQuestion, read_questions
from gsencoder.infer.ask.server import VlmConfig, VlmServer, request_body
from gsencoder.infer.localize.localize import LocalizeConfig, select_features
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.text.build import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class AskCommandConfig(CommonConfig):
    """Settings of `ask`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "a folder written by fuse, encode, pack or memory", "metavar": "FEATURES", "required": True},
    )
    question: str = field(default="", metadata={"help": "the question"})
    questions: str = field(
        default="",
        metadata={"help": "a file of questions: JSON lines with question and, optionally, id, task, query, aabb"},
    )
    task: Task = field(
        default="answer",
        metadata={"help": "answer a question, ground (say which of the marked objects is meant), or caption an object"},
    )
    query: tuple[str, ...] = field(
        default=(),
        metadata={"help": "words to localize; empty = the names of the text table that the question contains"},
    )
    aabb: tuple[float, ...] = field(
        default=(), metadata={"help": "a box to show instead of words: lower and upper corner in world coordinates"}
    )
    words: str = field(default="", metadata={"help": "text table; empty = the one in the folder of the features"})
    space: str = field(default="", metadata={"help": "name of the feature space, if the folder holds several"})
    head: str = field(
        default="",
        metadata={
            "help": "adapter head whose outputs are compared with the words of text=, such as siglip; empty = the "
            "features themselves are"
        },
    )
    photos: str = field(
        default="", metadata={"help": "the scene that was fused; its photographs are shown instead of renders"}
    )
    dry_run: bool = field(default=False, metadata={"help": "write the prompt and the pictures without sending them"})
    resume: bool = field(
        default=True, metadata={"help": "continue an interrupted batch; false = ask every question again"}
    )
    ask: AskConfig = field(default_factory=AskConfig)
    vlm: VlmConfig = field(default_factory=VlmConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one folder of features, got {len(self.paths)}")
        if self.questions and (self.question or self.query or self.aabb):
            raise InputError("questions: the file contains the questions; leave out question=, query= and aabb=")
        if not self.questions:
            self.single_question()

    def single_question(self) -> Question:
        """The question on the command line."""
        return Question(text=self.question, task=self.task, query=self.query, aabb=self.aabb)


def run(config: AskCommandConfig, summary: Summary) -> None:
    """Localizes the words of the question, chooses and renders views, asks the VLM, and writes everything."""
    folder = Path(config.paths[0])
    server = None if config.dry_run else VlmServer(config.vlm)
    request_body([], config.vlm, named=server is not None)
    questions = read_questions(Path(config.questions), config.task) if config.questions else ()
    if not questions:
        check_question(config.task, config.question)
    with summary.step("load"):
        scene = shown_scene(folder, config.photos, config.data)
        scene, words = _scene_and_words(scene, folder, config)
    asker = Asker(
        scene,
        words,
        space=None if config.head else config.space or None,
        config=config.ask,
        localization=config.localize,
        views=config.choose,
        vlm=config.vlm,
    )
    out = config.out or Path("outputs") / scene.name / ("answers" if questions else "answer")
    if questions:
        ask_file(out, questions, asker, server, config, summary)
        return
    clock = Clock()
    with output_folder(out, overwrite=config.overwrite, summary=summary) as target:
        row = ask_question(config.single_question(), asker, server, target, clock)
        summary.add_seconds(clock.seconds)
        summary.results.update(row)
    screen = console(config.quiet)
    if server is not None:
        screen.print(printable(row["answer"]), soft_wrap=True)
    screen.print(f"{out}: {len(row['views'])} pictures, {PROMPT}, {REQUEST}" + (f", {ANSWER}" if server else ""))


def _scene_and_words(scene: Scene, folder: Path, config: AskCommandConfig) -> tuple[Scene, Words | None]:
    """The scene with the features that are asked, and the words; a box can be asked about without words."""
    if config.head:
        return asked_scene(scene, folder, head=config.head, space=config.space, given=config.words, text=config.text)
    space = select_features(scene, config.space or None)[1].space
    stated = config.words or not isinstance(config.text, TableTextConfig)
    known = stated or table_path(folder, space.text_encoder) is not None
    return scene, load_words(folder, space, config.words, config.text) if known else None


def ask_file(
    out: Path,
    questions: Sequence[BatchQuestion],
    asker: Asker,
    server: VlmServer | None,
    config: AskCommandConfig,
    summary: Summary,
) -> None:
    """Asks the questions of a file; the answers of an interrupted run stay in a folder beside out=."""
    target, clock = Path(os.path.realpath(out)), Clock()
    given = settings(config)
    made_from = {name: given[name] for name in ("space", "photos", "data")}
    with (
        WorkFolder(target.with_name(f"{target.name}.answers")) as work,
        output_folder(out, overwrite=config.overwrite, summary=summary) as folder,
    ):
        work.take(anew=not config.resume)
        track = Progress(quiet=config.quiet)
        rows = ask_questions(questions, asker, server, work.path, made_from=made_from, clock=clock, track=track)
        write_answers(folder, work.path, rows)
        summary.add_seconds(clock.seconds)
        summary.results.update(questions=len(questions), answers=ANSWERS)
    console(config.quiet).print(f"{out}: {len(questions)} questions, {ANSWERS}")
