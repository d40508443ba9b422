"""Predicted answers in the files of ScanQA and SQA3D.

ScanQA (scripts/predict.py; its benchmark's submission): a list of {scene_id, question_id, answer_top10, bbox}, the box
being optional. SQA3D (LLM/eval_sqa3d_llm.py): a list of {scene_id, situation, question, answer, agent_rot, agent_pos},
which are recognized by these five, or by a question_id where there is one; equal questions are
answered in their order. Both scripts write pickles besides; those are refused.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError, SceneWarning, counted
from gsencoder.core.files import write_json
from gsencoder.data.labels.files import (
    Corner,
    box_corners,
    entries_of,
    id_value,
    number,
    object_of,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
    shown,
    text_list,
    text_value,
)
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.scores.answers import TOP

EXPECTED = "question_id and answer_top10, or scene_id, situation, question and answer"


def read_answer_predictions(path: str | Path, questions: Sequence[Question]) -> dict[str, tuple[str, ...]]:
    """Reads predicted answers to a question set.

    Args:
        path: the file; see the module for what may be in it.
        questions: of the set; they need no right answers.

    Returns:
        One to ten answers, best first, by the id of the question. Questions without an entry are not there.

    Raises:
        InputError: not such a file, truth in its place, or an entry for another question or scene, for one that has an
            entry already, or with something else than texts.
    """
    file = Path(path)
    rows = read_benchmark_json(file)
    if isinstance(rows, dict) and ("questions" in rows or "annotations" in rows):
        raise InputError(
            f"{file}: expected a list of objects with {EXPECTED}, got SQA3D's truth; were predictions and truth "
            "swapped?"
        )
    finder = _Finder(questions)
    answers = [
        (finder.question(entry, where).id, _answers(entry, where)) for entry, where in entries_of(rows, file, EXPECTED)
    ]
    if finder.equal:
        warnings.warn(
            f"{file}: {counted(finder.equal, 'entry', 'entries')} without question_id could be those of several equal "
            "questions, and were taken in the order of the truth",
            SceneWarning,
            stacklevel=2,
        )
    refuse_repeated(file, [name for name, _ in answers], lambda name: name[:60], what="question_id")
    return dict(answers)


def write_answer_predictions(
    path: str | Path,
    questions: Sequence[Question],
    predictions: Mapping[str, Sequence[str]],
    *,
    boxes: Mapping[str, tuple[Corner, Corner]] | None = None,
) -> None:
    """Writes predicted answers as the data set's own scripts take them; SQA3D's entries have the question_id besides.

    Args:
        path: the file.
        questions: of one data set; those without a prediction are left out.
        predictions: by the id of the question, one to ten answers, best first. SQA3D's files have the first alone.
        boxes: by the id of the question, of the object that ScanQA asks for, where there is one.

    Raises:
        InputError: predictions for other questions, none or more than ten answers, or the file cannot be written.
    """
    ids = {each.id for each in questions}
    wrong = next((name for name in [*predictions, *(boxes or {})] if name not in ids), None)
    if wrong is not None:
        raise InputError(f"{path}: question {wrong[:60]} is predicted and is none of the set")
    counts = next((name for name, answers in predictions.items() if not 1 <= len(answers) <= TOP), None)
    if counts is not None:
        raise InputError(f"{path}: question {counts[:60]} has {len(predictions[counts])} answers; expected 1 to {TOP}")
    answered = [each for each in questions if each.id in predictions]
    write_json(path, [_written(each, predictions[each.id], (boxes or {}).get(each.id)) for each in answered])


def _written(question: Question, answers: Sequence[str], box: tuple[Corner, Corner] | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"scene_id": question.scene, "question_id": question.id}
    if question.dataset == "scanqa":
        return entry | {"answer_top10": list(answers)} | ({"bbox": box_corners(*box)} if box else {})
    entry |= {"situation": question.situation, "question": question.text, "answer": answers[0]}
    if question.position is not None and question.rotation is not None:
        w, x, y, z = question.rotation
        entry["agent_rot"] = {"_x": x, "_y": y, "_z": z, "_w": w}
        entry["agent_pos"] = dict(zip("xyz", question.position, strict=True))
    return entry


def _answers(entry: Mapping[str, Any], where: str) -> tuple[str, ...]:
    if "answers" in entry and "answer_top10" not in entry and "answer" not in entry:
        raise InputError(
            f"{where}: expected predicted answers as answer_top10, got answers, which truth has; were predictions and "
            "truth swapped?"
        )
    if "answer_top10" not in entry:
        return (text_value(entry.get("answer"), where, "answer", empty=True),)
    answers = text_list(entry["answer_top10"], where, "answer_top10", empty=True)
    if not 1 <= len(answers) <= TOP:
        raise InputError(f"{where}: answer_top10 has {len(answers)} answers, expected 1 to {TOP}")
    return answers


class _Finder:
    """Finds the question that an entry is about."""

    def __init__(self, questions: Sequence[Question]) -> None:
        self.by_id = {each.id: each for each in questions}
        self.scenes = {each.scene for each in questions}
        self.equal = 0
        self._answered: set[str] = set()
        self.by_words: dict[tuple[str, str | None, str], list[Question]] = {}
        for each in questions:
            self.by_words.setdefault((each.scene, each.situation, each.text), []).append(each)

    def question(self, entry: Mapping[str, Any], where: str) -> Question:
        scene = scene_name(entry["scene_id"], where) if "scene_id" in entry else None
        if scene is not None and scene not in self.scenes:
            raise InputError(f"{where}: is about {scene}, of which the truth has no questions")
        if "question_id" not in entry:
            return self._by_words(entry, scene, where)
        name = id_value(entry["question_id"], where, "question_id")
        question = self.by_id.get(name)
        if question is None:
            raise InputError(f"{where}: question_id {name[:60]} is not in the truth")
        if scene not in (None, question.scene):
            raise InputError(f"{where}: question {name[:60]} is about {question.scene}, got {scene}")
        return question

    def _by_words(self, entry: Mapping[str, Any], scene: str | None, where: str) -> Question:
        if scene is None or "question" not in entry or "situation" not in entry:
            raise InputError(f"{where}: says not which question it answers; expected {EXPECTED}")
        text = text_value(entry["question"], where, "question")
        situation = text_value(entry["situation"], where, "situation")
        position = _numbers(entry, "agent_pos", ("x", "y", "z"), where)
        turns = _numbers(entry, "agent_rot", ("_w", "_x", "_y", "_z"), where)
        fitting = [
            each
            for each in self.by_words.get((scene, situation, text), [])
            if None in (position, each.position) or (position == each.position and turns in (None, each.rotation))
        ]
        # SQA3D's test split has pairs of questions that differ in nothing but their ids.
        if len(fitting) > 1 and len({(each.position, each.rotation) for each in fitting}) == 1:
            self.equal += 1
            fitting = [each for each in fitting if each.id not in self._answered][:1] or fitting[:1]
            self._answered.add(fitting[0].id)
        if len(fitting) != 1:
            fault = f"{len(fitting)} questions; give its question_id" if fitting else "no question of the truth"
            raise InputError(f"{where}: scene, situation, question and place are those of {fault}: {shown(text)}")
        return fitting[0]


def _numbers(entry: Mapping[str, Any], key: str, names: Sequence[str], where: str) -> tuple[float, ...] | None:
    if key not in entry:
        return None
    values = object_of(entry[key], where, f"{', '.join(names)} as {key}")
    return tuple(number(values.get(name), where, f"{key}.{name}") for name in names)
