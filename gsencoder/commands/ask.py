"""`gsencoder ask FEATURES question=…`: a VLM's answer from the views that show best what the question is about."""

import json
import os
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsencoder.commands.asked import words_of
from gsencoder.commands.views import shown_scene, views_to_json, write_pictures
from gsencoder.config import CommonConfig, settings
from gsencoder.data.scenes import SceneConfig
from gsencoder.errors import InputError, SceneWarning, about
from gsencoder.fusion.store import WORDS_FILE
from gsencoder.infer.ask import AskConfig, Asker, Prompt, Question, meant, prompt_messages
from gsencoder.infer.localize import LocalizeConfig, box_to_json
from gsencoder.infer.prompts import Task
from gsencoder.infer.questions import Asked, read_answers, read_questions
from gsencoder.infer.view_set import ViewsConfig
from gsencoder.infer.vlm import MODEL_VARIABLE, URL_VARIABLE, Reply, VlmConfig, VlmServer, request_body
from gsencoder.outputs import output_folder, write_bytes, write_json
from gsencoder.progress import Progress, console
from gsencoder.summary import Summary, plain
from gsencoder.types import Scene
from gsencoder.work_folder import WorkFolder

ANSWER, ANSWERS, PROMPT, REQUEST = "answer.json", "answers.jsonl", "prompt.txt", "request.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class AskCommandConfig(CommonConfig):
    """Settings of `ask`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": "a folder that fuse, encode or pack made", "metavar": "FEATURES", "required": True},
    )
    question: str = field(default="", metadata={"help": "what to ask"})
    questions: str = field(
        default="", metadata={"help": "a file of many: JSON lines with question and, if need be, id, task, query, aabb"}
    )
    task: Task = field(
        default="answer",
        metadata={"help": "answer a question, ground (say which of the marked things is meant), or caption one thing"},
    )
    query: tuple[str, ...] = field(
        default=(), metadata={"help": "words to look for; empty = those of the table that the question holds"}
    )
    aabb: tuple[float, ...] = field(
        default=(), metadata={"help": "a box to look at in place of words: lower and upper corner in world coordinates"}
    )
    words: str = field(default="", metadata={"help": "text table; empty = the one beside the features"})
    space: str = field(default="", metadata={"help": "which features, where the folder holds several"})
    photos: str = field(
        default="", metadata={"help": "the scene that was fused: frames are shown as its photographs, not as renders"}
    )
    dry_run: bool = field(default=False, metadata={"help": "write the prompt and the pictures, and ask nobody"})
    resume: bool = field(default=True, metadata={"help": "keep the answers of a run that was cut off"})
    ask: AskConfig = field(default_factory=AskConfig)
    vlm: VlmConfig = field(default_factory=VlmConfig)
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one folder of features, got {len(self.paths)}")
        if self.questions and (self.question or self.query or self.aabb):
            raise InputError("questions: the file says what is asked; leave out question=, query= and aabb=")
        if not self.questions:
            self.asked()

    def asked(self) -> Question:
        """The one question of the command line."""
        return Question(text=self.question, task=self.task, query=self.query, aabb=self.aabb)


def run(config: AskCommandConfig, summary: Summary) -> None:
    """Finds what the question is about, chooses and renders views, asks, and writes all of it."""
    folder = Path(config.paths[0])
    server = None if config.dry_run else VlmServer(config.vlm)
    request_body([], config.vlm, named=server is not None)
    many = read_questions(Path(config.questions)) if config.questions else ()
    with summary.step("load"):
        scene = shown_scene(folder, config.photos, config.data)
        table = words_of(folder, config.words) if config.words or (folder / WORDS_FILE).is_file() else None
    asker = Asker(
        scene,
        table,
        space=config.space or None,
        config=config.ask,
        localization=config.localize,
        views=config.choose,
    )
    out = config.out or Path("outputs") / scene.name / ("answers" if many else "answer")
    if many:
        _ask_many(out, many, scene, asker, server, config, summary)
        return
    with output_folder(out, overwrite=config.overwrite, summary=summary) as target:
        row = _ask_one(target, config.asked(), scene, asker, server, config, summary)
        summary.results.update(row)
    screen = console(config.quiet)
    if server is not None:
        screen.print(printable(row["answer"]))
    screen.print(f"{out}: {len(row['views'])} pictures, {PROMPT}, {REQUEST}" + (f", {ANSWER}" if server else ""))


def _ask_one(
    folder: Path,
    question: Question,
    scene: Scene,
    asker: Asker,
    server: VlmServer | None,
    config: AskCommandConfig,
    summary: Summary,
) -> dict[str, Any]:
    """Asks one question and writes into a folder what was sent and what came back; the answer's row."""
    with summary.step("views"):
        prompt = asker.prompt(question)
    views = views_to_json(scene, prompt.views)
    body = request_body(prompt_messages(prompt, config.vlm), config.vlm, named=server is not None)
    with summary.step("write"):
        write_pictures(folder, scene, prompt.views, views, prompt.pictures, prompt.boxes)
        write_bytes(folder / PROMPT, prompt.text.encode() + b"\n")
        write_json(folder / REQUEST, body)
    row = {
        "question": question.text,
        "task": question.task,
        "words": list(prompt.words),
        "targets": [target.name for target in prompt.targets],
        "views": views,
    }
    if server is not None:
        with summary.step("ask"):
            reply = server.ask(body)
        row |= _told(question, prompt, reply)
        write_json(folder / ANSWER, row)
    return row


def _told(question: Question, prompt: Prompt, reply: Reply) -> dict[str, Any]:
    told: dict[str, Any] = {
        "answer": reply.text.strip(),
        "model": reply.model,
        "finish": reply.finish,
        "tokens": reply.tokens,
        "seconds": round(reply.seconds, 3),
    }
    if question.task == "ground":
        told["mark"] = meant(prompt, reply.text)
        told["box"] = None
        if told["mark"] and prompt.boxes:
            told["box"] = box_to_json(prompt.boxes[told["mark"] - 1])
    if reply.finish == "length":
        warnings.warn("the answer ends where vlm.max_tokens cut it off", SceneWarning, stacklevel=2)
    return told


def _ask_many(
    out: Path,
    many: Sequence[Asked],
    scene: Scene,
    asker: Asker,
    server: VlmServer | None,
    config: AskCommandConfig,
    summary: Summary,
) -> None:
    """Asks question by question; each answer is on the disk before the next question, in a folder beside out= that
    stays where the run is cut off."""
    real = Path(os.path.realpath(out))
    track = Progress(quiet=config.quiet)
    depends = _depends_on(config)
    with (
        WorkFolder(real.with_name(f"{real.name}.answers")) as kept,
        output_folder(out, overwrite=config.overwrite, summary=summary) as folder,
    ):
        kept.take(anew=not config.resume)
        file = kept.path / ANSWERS
        rows = read_answers(file)
        done = {asked.id: rows[asked.id] for asked in many if _same(asked, rows, depends, kept.path)}
        # Lines of other settings, and one that was cut off, go before new ones come.
        write_bytes(file, b"".join(_line(row) for row in done.values()))
        for number, asked in enumerate(track(many, "asking"), start=1):
            if asked.id in done:
                continue
            place = kept.path / f"{number:05d}"
            place.mkdir(exist_ok=True)
            try:
                with about(f"question {asked.id}"):
                    row = _ask_one(place, asked.question, scene, asker, server, config, summary)
            except InputError as error:
                raise InputError(f"{error}; {len(done)} of {len(many)} answers are kept in {file}") from error
            row = {"id": asked.id, "digest": asked.digest(depends), "folder": place.name, **row}
            with file.open("ab") as stream:
                stream.write(_line(row))
                stream.flush()
                os.fsync(stream.fileno())
            done[asked.id] = row
        for row in done.values():
            shutil.copytree(kept.path / row["folder"], folder / row["folder"])
        write_bytes(folder / ANSWERS, b"".join(_line(done[asked.id]) for asked in many))
        summary.results.update(questions=len(many), answers=ANSWERS)
    console(config.quiet).print(f"{out}: {len(many)} questions, {ANSWERS}")


def printable(text: str) -> str:
    """Text without the control characters by which a terminal could be told to do other things than to show it."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "\N{REPLACEMENT CHARACTER}" for letter in text)


def _same(asked: Asked, rows: Mapping[str, Any], depends: Mapping[str, Any], kept: Path) -> bool:
    row = rows.get(asked.id)
    return bool(row and row.get("digest") == asked.digest(depends) and (kept / str(row.get("folder"))).is_dir())


def _depends_on(config: AskCommandConfig) -> dict[str, Any]:
    """The settings that make an answer what it is."""
    given = settings(config)
    patience = ("key", "timeout", "longest", "retries", "stream")
    vlm = {name: value for name, value in given["vlm"].items() if name not in patience}
    named = {name: os.environ.get(name, "") for name in (URL_VARIABLE, MODEL_VARIABLE)}
    others = {
        name: given[name] for name in ("words", "space", "photos", "dry_run", "ask", "choose", "data", "localize")
    }
    return {"features": str(Path(config.paths[0]).resolve()), "vlm": vlm, **named, **others}


def _line(row: Mapping[str, Any]) -> bytes:
    return json.dumps(plain(row), ensure_ascii=False).encode("utf-8", "backslashreplace") + b"\n"
