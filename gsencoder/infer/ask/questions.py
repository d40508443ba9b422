"""Files of questions and of answers: JSON lines, one each."""

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError, SceneWarning, counted, error_prefix, listed, readable
from gsencoder.core.files import MODEL_BYTES, open_foreign, read_foreign, warn_if_modified
from gsencoder.data.labels.expressions import Expression, read_scanrefer
from gsencoder.data.labels.files import (
    Corner,
    corner_bounds,
    entries_of,
    object_of,
    read_benchmark_json,
    read_checked_text,
    scene_name,
)
from gsencoder.data.labels.questions import Question as TruthQuestion
from gsencoder.data.labels.questions import read_questions as read_truth
from gsencoder.infer.ask.ask import Question, Task, check_question

MAX_FILE_BYTES = 1 << 26
"""Bytes of a file of questions."""
FIELDS = ("id", "question", "task", "query", "aabb")


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchQuestion:
    """A question of a file.

    Attributes:
        id: unique in the file; the number of its line where it has none.
        scene: that it is about; empty for lines about one scene.
        keys: by which a benchmark's predictions name it, such as question_id.
    """

    id: str
    question: Question
    scene: str = ""
    keys: Mapping[str, Any] = field(default_factory=dict)

    def digest(self, settings: Mapping[str, Any]) -> str:
        """Of the question and all that its answer depends on."""
        asked = self.question
        row = [asked.text, asked.task, list(asked.query), list(asked.aabb)]
        return sha256(json.dumps([row, settings], sort_keys=True).encode()).hexdigest()[:16]


def read_questions(path: Path, task: Task = "answer") -> tuple[BatchQuestion, ...]:
    """Reads lines such as {"id": "7", "question": "What is on the table?", "query": "table"}; id, task, query and aabb
    may be left out."""
    with error_prefix("questions"):
        lines = read_checked_text(path, max_bytes=MAX_FILE_BYTES).split("\n")
    questions: dict[str, BatchQuestion] = {}
    for number, line in enumerate(lines, start=1):
        if line.strip():
            with error_prefix(f"{path}: line {number}"):
                question = _parse_line(line, str(number), task)
                if question.id in questions:
                    raise InputError(f"id {question.id[:40]!r} comes twice")
                questions[question.id] = question
    if not questions:
        raise InputError(f"questions: {path} holds none")
    return tuple(questions.values())


def _parse_line(line: str, number: str, task: Task) -> BatchQuestion:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"is no JSON: {error}") from error
    if not isinstance(row, dict):
        raise InputError(f"expected an object, got {type(row).__name__}")
    unknown = sorted(set(row) - set(FIELDS))
    if unknown:
        field = unknown[0] if unknown[0].isprintable() and len(unknown[0]) <= 40 else repr(unknown[0][:40])
        raise InputError(f"{field}: no such field; there are {', '.join(FIELDS)}")
    name, text, query = row.get("id", number), row.get("question", ""), row.get("query", [])
    if not isinstance(name, (str, int)) or isinstance(name, bool):
        raise InputError(f"id: expected text or a number, got {str(name)[:40]!r}")
    if not isinstance(text, str):
        raise InputError(f"question: expected text, got {str(text)[:40]!r}")
    words = [query] if isinstance(query, str) else query
    if not isinstance(words, list) or not all(isinstance(word, str) and word.strip() for word in words):
        raise InputError(f"query: expected a word or a list of words, got {str(query)[:40]!r}")
    corners = row.get("aabb", [])
    try:
        if not isinstance(corners, list) or any(type(value) not in (int, float) for value in corners):
            raise ValueError
        aabb = tuple(map(float, corners))
    except (OverflowError, ValueError) as error:
        raise InputError(f"aabb: expected six numbers, got {str(corners)[:40]!r}") from error
    task = row.get("task", task)
    check_question(task, text)
    query = tuple(word.strip() for word in words)
    return BatchQuestion(id=str(name), question=Question(text=text, task=task, query=query, aabb=aabb))


def read_answers(path: Path) -> dict[str, dict[str, Any]]:
    """The finished lines of a file of answers, by id; a last line that was cut off is none."""
    if not path.exists():
        return {}
    warn_if_modified(path)
    with readable(path):
        lines = read_foreign(path, MODEL_BYTES).split(b"\n")
    rows = {}
    for number, line in enumerate(lines[:-1], start=1):
        try:
            row = json.loads(line)
            rows[str(row["id"])] = row
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no answer; give resume=false to ask again") from error
    return rows


Benchmark = Literal["scanqa", "sqa3d", "scanrefer", "scan2cap"]


@dataclass(frozen=True, slots=True, kw_only=True)
class QuestionSet:
    """The questions of a benchmark's file, whose form the predictions have; for captions without given boxes the names
    of the objects of each scene, whose boxes are localized."""

    benchmark: Benchmark
    questions: tuple[BatchQuestion, ...]
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def of_scene(self, scene: str) -> tuple[BatchQuestion, ...]:
        return tuple(each for each in self.questions if each.scene == scene)

    def scenes(self) -> dict[str, int]:
        """The scenes, and how many questions there are about each: with `names` the number of these."""
        counts: dict[str, int] = {scene: len(names) for scene, names in self.names.items()}
        for each in self.questions:
            counts[each.scene] = counts.get(each.scene, 0) + 1
        return counts


def is_question_set(path: Path) -> bool:
    """Whether a file holds one JSON value, as the benchmarks' do, and not one question a line.

    A file that cannot be read is no set; whoever reads it as lines says what is wrong.
    """
    try:
        with open_foreign(path) as stream:
            start = stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
            if not start.startswith(b"{"):
                return start.startswith(b"[")
            stream.seek(0)
            content = json.loads(stream.read().decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return False
    return "question" not in content and "query" not in content and "aabb" not in content


def read_question_set(path: Path, task: Task = "answer", proposals: str = "") -> QuestionSet:
    """Reads a benchmark's file, recognized by its content.

    Questions of ScanQA and SQA3D are answered; a situation is said before its question. Descriptions of ScanRefer are
    grounded or, with `task="caption"`, the objects described are captioned: in the boxes of the file (`bbox`, as
    Scan2Cap's has them), in those of `proposals`, or in those that are localized. Answers in the file are not read.

    Args:
        task: "answer" stands for what the benchmark asks.
        proposals: a file of boxes, {scene: [{"box": eight corners}, …]} as Scan2Cap's predictions have them;
            "localize" = the boxes of the objects' names; empty = those of the file.
    """
    content = read_benchmark_json(path)
    first = content[0] if isinstance(content, list) and content and isinstance(content[0], dict) else {}
    if isinstance(content, dict) and "questions" not in content and "annotations" not in content:
        keys = listed([name[:40] for name in content], 4)
        for key, rows in content.items():
            if not isinstance(rows, list) or not all(isinstance(row, dict) and "box" in row for row in rows):
                raise InputError(
                    f"{path}: expected a list of ScanQA's or ScanRefer's entries, SQA3D's object with questions, or "
                    f"Scan2Cap's {{scene: [{{box}}, …]}}; got an object with {keys}, and no list of boxes "
                    f"as {key[:40]}"
                )
        _check_task(path, "Scan2Cap's boxes", task, ("answer", "caption"))
        return QuestionSet(benchmark="scan2cap", questions=_captions(_read_boxes(content, path)))
    if isinstance(content, list) and not content:
        raise InputError(f"questions: {path} holds none")
    if "description" in first:
        _check_task(path, "ScanRefer's descriptions", task, ("answer", "ground", "caption"))
        expressions = read_scanrefer(path)
        return _captioned(expressions, path, proposals) if task == "caption" else _grounded(expressions)
    questions = read_truth(path, answered=False)
    benchmark: Benchmark = questions[0].dataset if questions else "scanqa"
    _check_task(path, "ScanQA's questions" if benchmark == "scanqa" else "SQA3D's questions", task, ("answer",))
    if proposals:
        raise InputError("proposals: are for captions; leave it out")
    return QuestionSet(benchmark=benchmark, questions=tuple(map(_answered, questions)))


def caption_question(scene: str, name: str, aabb: tuple[Corner, Corner], keys: Mapping[str, Any]) -> BatchQuestion:
    """The question for a caption of what is in a box, lower and upper corner in world coordinates; keys are what the
    prediction says besides caption and box, such as probabilities."""
    question = Question(task="caption", aabb=(*aabb[0], *aabb[1]))
    return BatchQuestion(id=f"{scene}/{name}", question=question, scene=scene, keys=keys)


def _check_task(path: Path, subject: str, task: Task, allowed: Sequence[str]) -> None:
    if task not in allowed:
        raise InputError(f"task={task}: {path} holds {subject}; expected task={' or '.join(allowed)}")


def _answered(question: TruthQuestion) -> BatchQuestion:
    keys = {"scene_id": question.scene, "question_id": question.id}
    if question.situation:
        keys |= {"situation": question.situation, "question": question.text}
    asked = Question(text=question.situated_text)
    return BatchQuestion(id=question.id, question=asked, scene=question.scene, keys=keys)


def _grounded(expressions: Sequence[Expression]) -> QuestionSet:
    questions = tuple(
        BatchQuestion(
            id=f"{each.scene}/{each.object_id}/{each.annotation}",
            question=Question(text=each.text, task="ground"),
            scene=each.scene,
            keys={"scene_id": each.scene, "object_id": str(each.object_id), "ann_id": each.annotation},
        )
        for each in expressions
    )
    return QuestionSet(benchmark="scanrefer", questions=questions)


def _captioned(expressions: Sequence[Expression], path: Path, proposals: str) -> QuestionSet:
    if proposals == "localize":
        names: dict[str, tuple[str, ...]] = {}
        for each in expressions:
            name = each.object_name.replace("_", " ")
            names[each.scene] = tuple(dict.fromkeys((*names.get(each.scene, ()), name)))
        return QuestionSet(benchmark="scan2cap", questions=(), names=names)
    if proposals:
        proposed = read_benchmark_json(Path(proposals))
        boxes = _read_boxes(object_of(proposed, proposals, "the boxes of each scene"), Path(proposals))
        scenes = dict.fromkeys(each.scene for each in expressions)
        chosen = {name: rows for name, rows in boxes.items() if name in scenes}
        if not chosen:
            raise InputError(
                f"proposals: {proposals} has boxes in {listed(sorted(boxes), 3)}, and {path} describes objects of "
                f"{listed(sorted(scenes), 3)}; expected the same scenes"
            )
        _warn_of_others([name for name in scenes if name not in boxes], f"{proposals} has no boxes in")
        _warn_of_others([name for name in boxes if name not in scenes], f"{path} describes no object of")
        return QuestionSet(benchmark="scan2cap", questions=_captions(chosen))
    unboxed = [each for each in expressions if each.aabb is None]
    if unboxed:
        raise InputError(
            f"{path}: {len(unboxed)} of {len(expressions)} descriptions have no bbox to be captioned; give proposals= "
            "(a file of boxes, or localize)"
        )
    objects = {(each.scene, each.object_id): each.aabb for each in expressions}
    questions = (caption_question(name, str(number), aabb, {}) for (name, number), aabb in objects.items() if aabb)
    return QuestionSet(benchmark="scan2cap", questions=tuple(questions))


def _warn_of_others(scenes: Sequence[str], why: str) -> None:
    """Says which scenes have no captions."""
    if scenes:
        warnings.warn(
            f"proposals: {why} {counted(len(scenes), 'scene')}, of which there are no captions: {listed(scenes)}",
            SceneWarning,
            stacklevel=4,
        )


def _read_boxes(
    content: Mapping[str, Any], path: Path
) -> dict[str, list[tuple[tuple[Corner, Corner], dict[str, Any]]]]:
    """The boxes of each scene, and what else a prediction says of them; captions are not looked at."""
    boxes: dict[str, list[tuple[tuple[Corner, Corner], dict[str, Any]]]] = {}
    for name, rows in content.items():
        scene = scene_name(name, str(path))
        for entry, where in entries_of(rows, path, "a box of eight corners", key=scene):
            keys = {key: entry[key] for key in ("sem_prob", "obj_prob") if key in entry}
            boxes.setdefault(scene, []).append((corner_bounds(entry.get("box"), where, "box"), keys))
    if not boxes:
        raise InputError(f"{path}: holds no boxes")
    return boxes


def _captions(
    boxes: Mapping[str, Sequence[tuple[tuple[Corner, Corner], Mapping[str, Any]]]],
) -> tuple[BatchQuestion, ...]:
    return tuple(
        caption_question(scene, str(number), aabb, keys)
        for scene, rows in boxes.items()
        for number, (aabb, keys) in enumerate(rows)
    )
