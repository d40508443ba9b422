"""Files of questions and of answers: JSON lines, one each."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, about, readable
from gsencoder.core.files import MODEL_BYTES, check_written, read_foreign
from gsencoder.data.labels.files import read_checked_text
from gsencoder.infer.ask.ask import Question
from gsencoder.infer.ask.prompts import Task, check_question

MAX_FILE_BYTES = 1 << 26
"""Bytes of a file of questions."""
FIELDS = ("id", "question", "task", "query", "aabb")


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchQuestion:
    """One line of a file of questions.

    Attributes:
        id: of the question; the number of its line where it has none.
        question: what is asked.
    """

    id: str
    question: Question

    def digest(self, settings: Mapping[str, Any]) -> str:
        """Of the question and all that its answer depends on."""
        question_row = [self.question.text, self.question.task, list(self.question.query), list(self.question.aabb)]
        return sha256(json.dumps([question_row, settings], sort_keys=True).encode()).hexdigest()[:16]


def read_questions(path: Path, task: Task = "answer") -> tuple[BatchQuestion, ...]:
    """Reads lines such as {"id": "7", "question": "What is on the table?", "query": "table"}; id, task, query and aabb
    may be left out, empty lines are skipped.

    Args:
        path: of the file.
        task: of lines that name none.

    Raises:
        InputError: no such file, a line that is no such object, an id that comes twice, or no questions.
    """
    with about("questions"):
        lines = read_checked_text(path, max_bytes=MAX_FILE_BYTES).split("\n")
    questions: dict[str, BatchQuestion] = {}
    for number, line in enumerate(lines, start=1):
        if line.strip():
            with about(f"{path}: line {number}"):
                question_row = _parse_line(line, str(number), task)
                if question_row.id in questions:
                    raise InputError(f"id {question_row.id[:40]!r} comes twice")
                questions[question_row.id] = question_row
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
    numbers = isinstance(corners, list) and all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in corners
    )
    if not numbers:
        raise InputError(f"aabb: expected six numbers, got {str(corners)[:40]!r}")
    check_question(row.get("task", task), text)
    try:
        aabb = tuple(float(value) for value in corners)
    except OverflowError as error:
        raise InputError(f"aabb: expected six numbers, got {str(corners)[:40]!r}") from error
    return BatchQuestion(
        id=str(name),
        question=Question(
            text=text,
            task=row.get("task", task),
            query=tuple(word.strip() for word in words),
            aabb=aabb,
        ),
    )


def read_answers(path: Path) -> dict[str, dict[str, Any]]:
    """The finished lines of a file of answers, by id; a last line that was cut off is none.

    Raises:
        InputError: it cannot be read, or holds something else.
    """
    if not path.exists():
        return {}
    check_written(path)
    with readable(path):
        lines = read_foreign(path, MODEL_BYTES).split(b"\n")
    questions = {}
    for number, line in enumerate(lines[:-1], start=1):
        try:
            row = json.loads(line)
            questions[str(row["id"])] = row
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no answer; give resume=false to ask anew") from error
    return questions
