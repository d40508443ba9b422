"""Questions to a VLM, one or a file of them: prompt, pictures, request and answer on disk; a batch can be continued."""

import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, SceneWarning, WriteError, about
from gsencoder.core.files import plain, sealed, unsealed, write_bytes, write_json
from gsencoder.core.process import Clock, Track, untracked
from gsencoder.data.splats.files import fingerprint
from gsencoder.infer.ask.ask import Asker, Prompt, Question, chosen_mark, prompt_messages
from gsencoder.infer.ask.questions import BatchQuestion, read_answers
from gsencoder.infer.ask.reply import Reply, ServerError
from gsencoder.infer.ask.server import MODEL_VARIABLE, URL_VARIABLE, VlmServer, request_body
from gsencoder.infer.localize.localization_json import box_to_json
from gsencoder.infer.views.write import views_to_json, write_pictures

ANSWER, ANSWERS, PROMPT, REQUEST = "answer.json", "answers.jsonl", "prompt.txt", "request.json"
TRANSPORT = ("key", "timeout", "longest", "retries", "stream")
"""Settings of the server that no answer depends on."""


def ask_question(
    question: Question, asker: Asker, server: VlmServer | None, folder: Path, clock: Clock | None = None
) -> dict[str, Any]:
    """Asks one question, and writes what was sent and what came back.

    Args:
        question: see there.
        asker: of the scene that the question is about.
        server: None = a dry run, which writes prompt, request and pictures, and asks nobody.
        folder: an existing one.
        clock: counts the seconds of the steps "views", "write" and "ask".

    Returns:
        The row of the answer as JSON values: question, task, words, absent, targets, views and, from a server, answer,
        model, finish, tokens, seconds, and for task=ground the mark and its box.

    Raises:
        InputError: a question that cannot be asked of this scene.
        ServerError: a fault of the server.
        WriteError: the disk is full, or the system refuses.

    Warns:
        SceneWarning: nothing was found, or the answer was cut off or names no mark.
    """
    clock = clock or Clock()
    scene, vlm = asker.scene, asker.vlm
    with clock("views"):
        prompt = asker.prompt(question)
    views = views_to_json(scene, prompt.views)
    body = request_body(prompt_messages(prompt, vlm), vlm, named=server is not None)
    with clock("write"):
        write_pictures(folder, scene, prompt.views, views, prompt.pictures, prompt.boxes)
        write_bytes(folder / PROMPT, prompt.text.encode() + b"\n")
        write_json(folder / REQUEST, body)
    row: dict[str, Any] = {
        "question": question.text,
        "task": question.task,
        "words": list(prompt.words),
        "absent": [{"query": word, "probability": value} for word, value in prompt.absent.items()],
        "targets": targets_to_json(question, prompt),
        "views": views,
    }
    if server is not None:
        with clock("ask"):
            reply = server.ask(body)
        row |= reply_to_json(question, prompt, reply)
        write_json(folder / ANSWER, row)
    return row


def targets_to_json(question: Question, prompt: Prompt) -> list[dict[str, Any]]:
    """What the pictures are of, in the order of the marks, in world coordinates: boxes that words found, or the one
    that was given."""
    if prompt.boxes:
        return [box_to_json(box) for box in prompt.boxes]
    return [{"aabb_min": list(question.aabb[:3]), "aabb_max": list(question.aabb[3:])} for _ in prompt.targets]


def reply_to_json(question: Question, prompt: Prompt, reply: Reply) -> dict[str, Any]:
    """The fields of a row that come from the server's reply."""
    row: dict[str, Any] = {
        "answer": reply.text.strip(),
        "model": reply.model,
        "finish": reply.finish,
        "tokens": reply.tokens,
        "seconds": round(reply.seconds, 3),
    }
    if question.task == "ground":
        row["mark"] = chosen_mark(prompt, reply.text)
        row["box"] = targets_to_json(question, prompt)[row["mark"] - 1] if row["mark"] else None
    if reply.finish == "length":
        warnings.warn("the answer ends where vlm.max_tokens cut it off", SceneWarning, stacklevel=3)
    return row


def ask_questions(
    questions: Sequence[BatchQuestion],
    asker: Asker,
    server: VlmServer | None,
    work: Path,
    *,
    made_from: Mapping[str, Any] = {},
    unanswered: dict[str, str] | None = None,
    clock: Clock | None = None,
    track: Track = untracked,
) -> list[dict[str, Any]]:
    """Asks questions one by one. Each answer is on the disk before the next question is asked; a call that was
    interrupted is continued by the next with the same `work`, and asks no question twice.

    Args:
        questions: of `read_questions`.
        asker: of the scene that they are about.
        server: None = a dry run.
        work: an existing folder for the rows so far, `answers.jsonl`, and one folder a question, named by its digest.
        made_from: what else answers depend on, as JSON values, such as the folders that the scene was read from.
        unanswered: collects the ids of questions that have no answer, and why; None = these are an error.
        clock: as in `ask_question`.
        track: progress.

    Returns:
        One row a question, in their order, each with its digest; none for those in `unanswered`.

    Raises:
        InputError: questions that have no answer, after all others were asked; the first is named. A fault of the
            server, or a file that cannot be written: no further question is asked.
    """
    depends_on = _depends_on(asker, server is None, made_from)
    digests = {each.id: each.digest(depends_on) for each in questions}
    file = work / ANSWERS
    done = _answered(work, digests)
    failures: dict[str, str] = {}
    # Rows of other settings, and one that was cut off, are removed before new ones are appended.
    try:
        write_bytes(file, b"".join(_line(sealed(row)) for row in done.values()))
    except RecursionError as error:
        raise InputError(f"{file}: an answer is nested too deep; give resume=false to ask anew") from error
    for each in track(questions, "asking"):
        if each.id in done:
            continue
        folder = work / digests[each.id]
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
        label = f"question {each.id[:40]}"
        try:
            with about(label), warnings_about(label) as messages:
                row = ask_question(each.question, asker, server, folder, clock)
        except (ServerError, WriteError) as error:
            raise InputError(f"{error}; {len(done)} of {len(questions)} answers are kept in {file}") from error
        except InputError as error:
            failures[each.id] = str(error)
            continue
        row = {"id": each.id, "digest": digests[each.id], "warnings": messages, **row}
        try:
            with file.open("ab") as stream:
                stream.write(_line(sealed(row)))
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise InputError(f"{file}: cannot write: {error.strerror or error}") from error
        done[each.id] = row
    if unanswered is not None:
        unanswered.update(failures)
    elif failures:
        raise InputError(
            f"{len(failures)} of {len(questions)} questions have no answer: {next(iter(failures.values()))}"
            f"{' …' if len(failures) > 1 else ''}; the other answers are kept in {file}; mend or remove those lines, "
            "and run this again"
        )
    return [done[each.id] for each in questions if each.id in done]


def write_answers(folder: Path, work: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the rows of `ask_questions` as `answers.jsonl`, and the folder of each question as `00001`, `00002`, …

    Args:
        folder: an existing one to write into.
        work: the folder that `ask_questions` filled.
        rows: its result.
    """
    lines = []
    for number, row in enumerate(rows, start=1):
        target = folder / f"{number:05d}"
        shutil.copytree(work / row["digest"], target)
        lines.append(_line({**row, "folder": target.name}))
    write_bytes(folder / ANSWERS, b"".join(lines))


def _answered(work: Path, digests: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """The rows of an earlier call that answer these questions under the same settings."""
    rows = {}
    for name, row in read_answers(work / ANSWERS).items():
        try:
            rows[name] = unsealed(row)
        except (ValueError, RecursionError) as error:
            message = f"{work / ANSWERS}: the answer to {name[:40]} is not as it was written"
            raise InputError(f"{message}; give resume=false to ask anew") from error
    return {
        name: rows[name]
        for name, digest in digests.items()
        if name in rows and rows[name].get("digest") == digest and (work / digest).is_dir()
    }


@contextmanager
def warnings_about(label: str) -> Iterator[list[str]]:
    """Puts a label before the scene warnings of the block; yields a list that their texts are added to."""
    messages: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield messages
        finally:
            messages += [str(each.message) for each in caught if issubclass(each.category, SceneWarning)]
    for each in caught:
        if issubclass(each.category, SceneWarning):
            warnings.warn(f"{label}: {each.message}", SceneWarning, stacklevel=3)
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


def _depends_on(asker: Asker, dry_run: bool, made_from: Mapping[str, Any]) -> dict[str, Any]:
    """What an answer depends on besides its question: settings, scene, features and words."""
    vlm = {name: value for name, value in plain(asker.vlm).items() if name not in TRANSPORT}
    variables = {name: os.environ.get(name, "") for name in (URL_VARIABLE, MODEL_VARIABLE)}
    configs = {"ask": asker.config, "choose": asker.views, "localize": asker.localization}
    scene, table = asker.scene, asker.table
    digest = sha256()
    if scene.gaussians is not None:
        digest.update(fingerprint(scene.gaussians).encode())
    for name, features in sorted(scene.features.items()):
        digest.update(name.encode() + features.features.tobytes() + features.mean.tobytes())
        if features.index is not None:
            digest.update(features.index.tobytes())
    if scene.views is not None:
        digest.update(scene.views.cameras.cam_from_world.tobytes())
    if table is not None:
        digest.update("\n".join(table.names).encode() + table.embeddings.tobytes())
    return {
        "scene": digest.hexdigest(),
        "dry_run": dry_run,
        "vlm": vlm,
        **variables,
        **{name: plain(config) for name, config in configs.items()},
        **made_from,
    }


def _line(row: Mapping[str, Any]) -> bytes:
    return json.dumps(plain(row), ensure_ascii=False).encode("utf-8", "backslashreplace") + b"\n"
