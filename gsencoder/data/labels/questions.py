"""Questions about scenes: ScanQA and SQA3D in their own files.

ScanQA (Azuma et al. 2022): ScanQA_v1.0_{train,val,test_w_obj,test_wo_obj}.json, a list of {scene_id, question_id,
question, answers, object_ids, object_names}; the test sets have no answers. SQA3D (Ma et al. 2023): a file of
questions, v1_balanced_questions_SPLIT_scannetv2.json, and one of annotations,
v1_balanced_sqa_annotations_SPLIT_scannetv2.json.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import PREDICTED
from gsencoder.data.labels.files import (
    Corner,
    brief,
    entries_of,
    id_value,
    number,
    object_id,
    object_of,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
    text_list,
    text_value,
)

SCANQA, SQA3D = "scene_id, question_id, question and answers", "scene_id, question_id, situation and question"
SITUATED = "sqa_annotations"
"""What the name of SQA3D's file of annotations has where that of the questions has `questions`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A question about a scene.

    Situations are those of SQA3D.
    """

    dataset: Literal["scanqa", "sqa3d"]
    id: str
    scene: str
    text: str
    answers: tuple[str, ...] = ()  # right ones; none in a test set
    object_ids: tuple[int, ...] = ()  # `objectId`s of ScanNet's aggregation file; none where unknown
    object_names: tuple[str, ...] = ()
    situation: str | None = None  # where the one who asks stands, in words
    position: Corner | None = None  # the same in the axes of the scan, metres from the center of its mesh's box; z is 0
    rotation: tuple[float, float, float, float] | None = None  # wxyz, a turn about z

    @property
    def situated_text(self) -> str:
        """What is asked of a model: the situation, where there is one, and then the question."""
        return f"{self.situation} {self.text}" if self.situation else self.text


def read_questions(path: str | Path, *, answered: bool = True) -> tuple[Question, ...]:
    """Reads ScanQA's file or SQA3D's file of questions, by what is in it.

    Args:
        path: the file; SQA3D's annotations lie next to it.
        answered: whether answers are needed; without, SQA3D's annotations are not read.
    """
    file = Path(path)
    content = read_benchmark_json(file)
    if isinstance(content, list):
        return _scanqa(content, file, answered)
    if isinstance(content, dict) and "questions" in content:
        return _sqa3d(content, file, answered)
    hint = "; these are SQA3D's annotations: give the file of questions next to them"
    raise InputError(
        f"{file}: expected ScanQA's list of questions or SQA3D's object with questions, got {brief(content)}"
        + (hint if isinstance(content, dict) and "annotations" in content else "")
    )


def _scanqa(rows: Any, path: Path, answered: bool) -> tuple[Question, ...]:
    questions = []
    for entry, where in entries_of(rows, path, SCANQA):
        swapped = next((key for key in PREDICTED if key in entry), None)
        if swapped:
            raise InputError(f"{where}: expected a question, got {swapped}: these are predictions; were both swapped?")
        ids = entry.get("object_ids", [])
        if not isinstance(ids, list):
            raise InputError(f"{where}: object_ids must be a list of whole numbers, got {brief(ids)}")
        questions.append(
            Question(
                dataset="scanqa",
                id=id_value(entry.get("question_id"), where, "question_id"),
                scene=scene_name(entry.get("scene_id"), where),
                text=text_value(entry.get("question"), where, "question"),
                answers=text_list(entry["answers"], where, "answers", empty=True) if "answers" in entry else (),
                object_ids=tuple(object_id(each, where, f"object_ids[{row}]") for row, each in enumerate(ids)),
                object_names=text_list(entry.get("object_names", []), where, "object_names"),
            )
        )
    _refuse_repeated(path, [each.id for each in questions])
    silent = [each.id for each in questions if not each.answers]
    if answered and silent:
        raise InputError(
            f"{path}: {len(silent):,} of {len(questions):,} questions have no answers, such as {silent[0][:60]}; "
            "expected answers, which ScanQA's test sets do not have"
        )
    return tuple(questions)


def _sqa3d(content: Mapping[str, Any], path: Path, answered: bool) -> tuple[Question, ...]:
    questions = [
        Question(
            dataset="sqa3d",
            id=id_value(entry.get("question_id"), where, "question_id"),
            scene=scene_name(entry.get("scene_id"), where),
            text=text_value(entry.get("question"), where, "question"),
            situation=text_value(entry.get("situation"), where, "situation"),
        )
        for entry, where in entries_of(content["questions"], path, SQA3D, key="questions")
    ]
    _refuse_repeated(path, [each.id for each in questions])
    if not answered:
        return tuple(questions)
    annotations = path.with_name(path.name.replace("questions", SITUATED))
    if annotations == path or not annotations.is_file():
        raise InputError(
            f"{path}: no answers next to it; expected a file called like it, with {SITUATED} for questions, such as "
            "v1_balanced_sqa_annotations_test_scannetv2.json"
        )
    content = read_benchmark_json(annotations)
    if not isinstance(content, dict) or "annotations" not in content:
        raise InputError(f"{annotations}: expected SQA3D's object with a list of annotations, got {brief(content)}")
    rows = entries_of(content["annotations"], annotations, "question_id and answers", key="annotations")
    ids = [id_value(entry.get("question_id"), where, "question_id") for entry, where in rows]
    _refuse_repeated(annotations, ids)
    row_of = dict(zip(ids, rows, strict=True))
    missing = [each.id for each in questions if each.id not in row_of]
    extra = set(ids) - {each.id for each in questions}
    if missing or extra:
        name = missing[0] if missing else min(extra)
        raise InputError(
            f"{annotations}: belongs to other questions than {path}: {len(missing)} of these have no annotation and "
            f"{len(extra)} annotations no question, such as {name[:60]}"
        )
    return tuple(_annotated(each, *row_of[each.id]) for each in questions)


def _annotated(question: Question, entry: Mapping[str, Any], where: str) -> Question:
    if scene_name(entry.get("scene_id"), where) != question.scene:
        raise InputError(
            f"{where}: question {question.id} is about {question.scene}, and its annotation about "
            f"{entry['scene_id'][:60]}"
        )
    rows = entry.get("answers")
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{where}: answers must be a list of objects with an answer, got {brief(rows)}")
    answers = (object_of(row, where, "an answer").get("answer") for row in rows)
    position = object_of(entry.get("position"), where, "x, y and z as its position")
    rotation = object_of(entry.get("rotation"), where, "_x, _y, _z and _w as its rotation")
    x, y, z = (number(position.get(axis), where, f"position.{axis}") for axis in "xyz")
    qw, qx, qy, qz = (number(rotation.get(f"_{axis}"), where, f"rotation._{axis}") for axis in "wxyz")
    return replace(
        question,
        answers=tuple(text_value(answer, where, "answer", empty=True) for answer in answers),
        position=(x, y, z),
        rotation=(qw, qx, qy, qz),
    )


def _refuse_repeated(path: Path, ids: Sequence[str]) -> None:
    refuse_repeated(path, ids, lambda each: each[:60], what="question_id")
