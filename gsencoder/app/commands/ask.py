"""`gsencoder ask FEATURES question=…`: a VLM's answer from the views that show best what the question is about."""

import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from gsencoder.app.commands.query_words import words_of
from gsencoder.app.commands.views import shown_scene, views_to_json, write_pictures
from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.printable import printable
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.runs.work_folder import WorkFolder
from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.core.errors import InputError, SceneWarning, about
from gsencoder.core.files.json_values import plain, write_bytes, write_json
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.splats import fingerprint
from gsencoder.fusion.store.folder import WORDS_FILE
from gsencoder.infer.ask.ask import AskConfig, Asker, Prompt, Question, meant, prompt_messages
from gsencoder.infer.ask.prompts import Task, check_question
from gsencoder.infer.ask.questions import Asked, read_answers, read_questions
from gsencoder.infer.ask.reply import Reply, ServerError
from gsencoder.infer.ask.server import MODEL_VARIABLE, URL_VARIABLE, VlmConfig, VlmServer, request_body
from gsencoder.infer.localize.localize import LocalizeConfig, box_to_json
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.text.table import TextTable
from gsencoder.types import Scene

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
    many = read_questions(Path(config.questions), config.task) if config.questions else ()
    if not many:
        check_question(config.task, config.question)
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
        side=config.vlm.image_side,
    )
    out = config.out or Path("outputs") / scene.name / ("answers" if many else "answer")
    if many:
        _ask_many(out, many, scene, asker, server, config, summary, _depends_on(config, scene, table))
        return
    with output_folder(out, overwrite=config.overwrite, summary=summary) as target:
        row = _ask_one(target, config.asked(), scene, asker, server, config, summary)
        summary.results.update(row)
    screen = console(config.quiet)
    if server is not None:
        screen.print(printable(row["answer"]), soft_wrap=True)
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
        "targets": targets_to_json(question, prompt),
        "views": views,
    }
    if server is not None:
        with summary.step("ask"):
            reply = server.ask(body)
        row |= _told(question, prompt, reply)
        write_json(folder / ANSWER, row)
    return row


def targets_to_json(question: Question, prompt: Prompt) -> list[dict[str, Any]]:
    """What the pictures are of, in the order of the marks, in world coordinates: boxes that words found, or the one
    that was given."""
    if prompt.boxes:
        return [box_to_json(box) for box in prompt.boxes]
    return [{"aabb_min": list(question.aabb[:3]), "aabb_max": list(question.aabb[3:])} for _ in prompt.targets]


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
        told["box"] = targets_to_json(question, prompt)[told["mark"] - 1] if told["mark"] else None
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
    depends: Mapping[str, Any],
) -> None:
    """Asks question by question; each answer is on the disk before the next question, in a folder beside out= that
    stays where the run is cut off. A question that cannot be answered does not keep the others from it."""
    real = Path(os.path.realpath(out))
    track = Progress(quiet=config.quiet)
    digests = {asked.id: asked.digest(depends) for asked in many}
    failed: list[str] = []
    with (
        WorkFolder(real.with_name(f"{real.name}.answers")) as kept,
        output_folder(out, overwrite=config.overwrite, summary=summary) as folder,
    ):
        kept.take(anew=not config.resume)
        file = kept.path / ANSWERS
        rows = read_answers(file)
        done = {
            name: rows[name]
            for name, digest in digests.items()
            if name in rows and rows[name].get("digest") == digest and (kept.path / digest).is_dir()
        }
        # Lines of other settings, and one that was cut off, go before new ones come.
        try:
            write_bytes(file, b"".join(_line(row) for row in done.values()))
        except RecursionError as error:
            raise InputError(f"{file}: an answer is nested too deep; give resume=false to ask anew") from error
        for asked in track(many, "asking"):
            if asked.id in done:
                continue
            place = kept.path / digests[asked.id]
            if place.exists():
                shutil.rmtree(place)
            place.mkdir()
            try:
                with about(f"question {asked.id[:40]}"), warnings_about(f"question {asked.id[:40]}") as told:
                    row = _ask_one(place, asked.question, scene, asker, server, config, summary)
            except ServerError as error:
                raise InputError(f"{error}; {len(done)} of {len(many)} answers are kept in {file}") from error
            except InputError as error:
                failed.append(str(error))
                continue
            row = {"id": asked.id, "digest": digests[asked.id], "warnings": told, **row}
            with file.open("ab") as stream:
                stream.write(_line(row))
                stream.flush()
                os.fsync(stream.fileno())
            done[asked.id] = row
        if failed:
            raise InputError(
                f"{len(failed)} of {len(many)} questions have no answer: {failed[0]}{' …' if len(failed) > 1 else ''}; "
                f"the other answers are kept in {file}; mend or remove those lines, and run this again"
            )
        lines = []
        for number, asked in enumerate(many, start=1):
            place = folder / f"{number:05d}"
            shutil.copytree(kept.path / digests[asked.id], place)
            lines.append(_line(done[asked.id] | {"folder": place.name}))
        write_bytes(folder / ANSWERS, b"".join(lines))
        summary.results.update(questions=len(many), answers=ANSWERS)
    console(config.quiet).print(f"{out}: {len(many)} questions, {ANSWERS}")


@contextmanager
def warnings_about(what: str) -> Iterator[list[str]]:
    """Scene warnings of the block say what they are about; it gives their texts, too."""
    told: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield told
        finally:
            told += [str(each.message) for each in caught if issubclass(each.category, SceneWarning)]
    for each in caught:
        if issubclass(each.category, SceneWarning):
            warnings.warn(f"{what}: {each.message}", SceneWarning, stacklevel=3)
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


def _depends_on(config: AskCommandConfig, scene: Scene, table: TextTable | None) -> dict[str, Any]:
    """What makes an answer what it is: the settings, and what the folders hold."""
    given = settings(config)
    patience = ("key", "timeout", "longest", "retries", "stream")
    vlm = {name: value for name, value in given["vlm"].items() if name not in patience}
    named = {name: os.environ.get(name, "") for name in (URL_VARIABLE, MODEL_VARIABLE)}
    others = {name: given[name] for name in ("space", "photos", "dry_run", "ask", "choose", "data", "localize")}
    held = sha256()
    if scene.gaussians is not None:
        held.update(fingerprint(scene.gaussians).encode())
    for name, features in sorted(scene.features.items()):
        held.update(name.encode() + features.features.tobytes() + features.mean.tobytes())
    if scene.views is not None:
        held.update(scene.views.cameras.cam_from_world.tobytes())
    if table is not None:
        held.update("\n".join(table.names).encode() + table.embeddings.tobytes())
    return {"scene": held.hexdigest(), "vlm": vlm, **named, **others}


def _line(row: Mapping[str, Any]) -> bytes:
    return json.dumps(plain(row), ensure_ascii=False).encode("utf-8", "backslashreplace") + b"\n"
