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

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning, WriteError, error_prefix
from gsencoder.core.files import plain, with_checksum, without_checksum, write_bytes, write_json
from gsencoder.core.process import Clock, Track, untracked
from gsencoder.data.labels.expressions import wrapped_caption
from gsencoder.data.labels.files import box_corners
from gsencoder.data.prompts import PromptStore, StoredPrompt
from gsencoder.data.splats.files import fingerprint
from gsencoder.infer.ask.ask import THOUGHT, Asker, Question, chosen_mark, encoded_picture, prompt_messages
from gsencoder.infer.ask.questions import BatchQuestion, Benchmark, read_answers
from gsencoder.infer.ask.server import MODEL_VARIABLE, URL_VARIABLE, ServerError, VlmServer, request_body
from gsencoder.infer.localize import box_to_json
from gsencoder.infer.views.pictures import Fit, feature_tokens, token_blends, views_to_json, write_pictures
from gsencoder.render import BlendConfig
from gsencoder.types import GaussianFeatures

ANSWER, ANSWERS, PROMPT, REQUEST = "answer.json", "answers.jsonl", "prompt.txt", "request.json"
TRANSPORT = ("key", "timeout", "longest", "retries")
"""Settings of the server that no answer depends on."""


def ask_question(
    question: Question, asker: Asker, server: VlmServer | None, folder: Path, clock: Clock | None = None
) -> dict[str, Any]:
    """Asks one question, and writes what was sent and what came back; the row of the answer as JSON values.

    Args:
        server: None = a dry run, which writes prompt, request and pictures, and asks nobody.
        clock: counts the seconds of the steps "views", "write" and "ask".
    """
    clock = clock or Clock()
    scene, vlm = asker.scene, asker.vlm
    with clock("views"):
        prompt = asker.prompt(question)
    views = views_to_json(scene, prompt.views)
    messages = prompt_messages(prompt.text, prompt.pictures, side=vlm.image_side)
    body = request_body(messages, vlm, named=server is not None)
    with clock("write"):
        write_pictures(folder, scene, prompt.views, views, prompt.pictures, prompt.boxes)
        write_bytes(folder / PROMPT, prompt.text.encode() + b"\n")
        write_json(folder / REQUEST, body)
    # In the order of the marks, in world coordinates: boxes that words found, or the one that was given.
    given = {"aabb_min": list(question.aabb[:3]), "aabb_max": list(question.aabb[3:])}
    targets = [box_to_json(box) for box in prompt.boxes] or [given for _ in prompt.targets]
    row: dict[str, Any] = {
        "question": question.text,
        "task": question.task,
        "words": list(prompt.words),
        "absent": [{"query": word, "probability": value} for word, value in prompt.absent.items()],
        "targets": targets,
        "views": views,
    }
    if server is not None:
        with clock("ask"):
            reply = server.ask(body)
        row |= {"answer": reply.text.strip(), "model": reply.model, "finish": reply.finish, "tokens": reply.tokens}
        row["seconds"] = round(reply.seconds, 3)
        if question.task == "ground":
            row["mark"] = mark = chosen_mark(prompt, reply.text)
            row["box"] = targets[mark - 1] if mark else None
        if reply.finish == "length":
            warnings.warn("the answer ends where vlm.max_tokens cut it off", SceneWarning, stacklevel=2)
        write_json(folder / ANSWER, row)
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
        server: None = a dry run.
        work: an existing folder for the rows so far, `answers.jsonl`, and one folder a question, named by its digest.
        made_from: what else answers depend on, as JSON values, such as the folders that the scene was read from.
        unanswered: collects the ids of questions that have no answer, and why; None = these are an error.
    """
    depends_on = _depends_on(asker, server is None, made_from)
    digests = {each.id: each.digest(depends_on) for each in questions}
    file = work / ANSWERS
    done = _answered(work, digests)
    failures: dict[str, str] = {}
    # Rows of other settings, and one that was cut off, are removed before new ones are appended.
    write_bytes(file, b"".join(_line(with_checksum(row)) for row in done.values()))
    for each in track(questions, "asking"):
        if each.id in done:
            continue
        folder = work / digests[each.id]
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
        label = f"question {each.id[:40]}"
        try:
            with error_prefix(label), warnings_about(label) as messages:
                row = ask_question(each.question, asker, server, folder, clock)
        except (ServerError, WriteError) as error:
            raise InputError(f"{error}; {len(done)} of {len(questions)} answers are kept in {file}") from error
        except InputError as error:
            failures[each.id] = str(error)
            continue
        row = {"id": each.id, "digest": digests[each.id], "warnings": messages, **row}
        try:
            with file.open("ab") as stream:
                stream.write(_line(with_checksum(row)))
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
    """Writes the rows of `ask_questions` as `answers.jsonl` into a folder, and that of each question as `00001`, …"""
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
            rows[name] = without_checksum(row)
        except (ValueError, RecursionError) as error:
            message = f"{work / ANSWERS}: the answer to {name[:40]} is not as it was written"
            raise InputError(f"{message}; give resume=false to ask again") from error
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


CLASSES = 18
"""Classes of ScanNet's benchmark, over which `sem_prob` of Scan2Cap's predictions is even: `ask` names none."""


def predictions(
    benchmark: Benchmark,
    answered: Sequence[tuple[BatchQuestion, Mapping[str, Any]]],
    unanswered: Sequence[BatchQuestion] = (),
) -> Any:
    """What a benchmark takes.

    - ScanQA: a list of {scene_id, question_id, answer_top10: [the answer], bbox}, the box being that of the best target
      where there is one.
    - SQA3D: a list of {scene_id, question_id, situation, question, answer}.
    - ScanRefer: a list of {scene_id, object_id, ann_id, bbox, bboxes}: the box of the mark that the answer names, and
      the same before those of the other marks; null and none where it names no mark, and for what is unanswered.
    - Scan2Cap: for each scene a list of {caption, box, obj_prob, sem_prob}, captions in lower case,
      between "sos" and "eos".

    Boxes are eight corners. Of an answer the case and a full stop at its end are left out (`short_answer`). Questions
    come with the rows of `ask_questions`; those without, besides ScanRefer's, have no entry.
    """
    if benchmark == "scan2cap":
        captions: dict[str, list[dict[str, Any]]] = {}
        for question, row in answered:
            probabilities = {"obj_prob": [0.0, 1.0], "sem_prob": [1 / CLASSES] * CLASSES} | dict(question.keys)
            entry = {
                "caption": wrapped_caption(answer_text(row["answer"]).lower()),
                "box": target_corners(row["targets"][0]),
                **probabilities,
            }
            captions.setdefault(question.scene, []).append(entry)
        return captions
    if benchmark == "scanrefer":
        missing: list[tuple[BatchQuestion, Mapping[str, Any]]] = [(question, {}) for question in unanswered]
        return [{**question.keys, **_referred(row)} for question, row in (*answered, *missing)]
    if benchmark == "sqa3d":
        return [{**question.keys, "answer": short_answer(row["answer"])} for question, row in answered]
    rows = []
    for question, row in answered:
        box = {"bbox": target_corners(row["targets"][0])} if row["targets"] else {}
        rows.append({**question.keys, "answer_top10": [short_answer(row["answer"])], **box})
    return rows


def _referred(row: Mapping[str, Any]) -> dict[str, Any]:
    """The box that an answer means, and after it the others that it might have meant."""
    if not row.get("mark"):
        return {"bbox": None, "bboxes": []}
    corners = [target_corners(target) for target in row["targets"]]
    meant = corners.pop(row["mark"] - 1)
    return {"bbox": meant, "bboxes": [meant, *corners]}


def target_corners(target: Mapping[str, Any]) -> list[list[float]]:
    """The eight corners of a target's axis-aligned box."""
    low, high = ([float(value) for value in target[name]] for name in ("aabb_min", "aabb_max"))
    return box_corners((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def answer_text(answer: str) -> str:
    """An answer without what a model thought before it, on one line."""
    return " ".join(THOUGHT.sub("", answer).split())


def short_answer(answer: str) -> str:
    """An answer as the benchmarks write answers: `answer_text` in lower case and without a full stop at its end."""
    return answer_text(answer).lower().rstrip(".").strip()


def store_prompt(
    store: PromptStore,
    key: str,
    asker: Asker,
    question: Question,
    *,
    features: GaussianFeatures | None = None,
    grid: tuple[int, int] = (1, 1),
    fit: Fit = "stretch",
) -> StoredPrompt:
    """Writes the prompt that `ask` would send for a question, under a key that states all that it is made from;
    features of the scene's Gaussians are rendered in each view as tokens of a vision tower."""
    prompt = asker.prompt(question)
    pictures = [encoded_picture(each, side=asker.vlm.image_side) for each in prompt.pictures]
    if features is None:
        return store.add(key, prompt.text, pictures)
    assert asker.scene.gaussians is not None
    config = BlendConfig(near=min(BlendConfig().near, prompt.views.near))
    blends = token_blends(asker.scene.gaussians, prompt.views.cameras, grid, fit=fit, config=config)
    limit = float(np.finfo(np.float16).max)
    tokens = feature_tokens(blends, features).clamp(-limit, limit).numpy().astype(np.float16)
    return store.add(key, prompt.text, pictures, tokens, features.space.describe())
