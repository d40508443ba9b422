"""Situated questions, written as SQA3D's files have them."""

from collections.abc import Sequence
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.data.truth.entries import Corner
from gsencoder.data.truth.questions import SITUATED, Question


def write_sqa3d(path: str | Path, questions: Sequence[Question]) -> Path:
    """Writes situated questions as SQA3D's two files have them.

    Args:
        path: of the file of questions, whose name must have "questions" in it.
        questions: with situation, position and rotation.

    Returns:
        The file of annotations beside it, where `read_questions` looks for it.

    Raises:
        InputError: another name, a question without a situation, or a file cannot be written.
    """
    file = Path(path)
    annotations = file.with_name(file.name.replace("questions", SITUATED))
    if annotations == file:
        raise InputError(f"{file}: expected a name with questions in it")
    rows, answers = [], []
    for each in questions:
        if each.situation is None or each.position is None or each.rotation is None:
            raise InputError(f"{file}: question {each.id[:60]} has no situation")
        w, x, y, z = each.rotation
        rows.append(
            {
                "scene_id": each.scene,
                "situation": each.situation,
                "alternative_situation": [],
                "question": each.text,
                "question_id": each.id,
            }
        )
        answers.append(
            {
                "scene_id": each.scene,
                "question_type": "N/A",
                "answer_type": "other",
                "question_id": each.id,
                "answers": [
                    {"answer": answer, "answer_confidence": "yes", "answer_id": number}
                    for number, answer in enumerate(each.answers, start=1)
                ],
                "rotation": {"_x": x, "_y": y, "_z": z, "_w": w},
                "position": _axes(each.position),
            }
        )
    write_json(file, {"task_type": "Situated question answering", "questions": rows})
    write_json(annotations, {"annotations": answers})
    return annotations


def _axes(position: Corner) -> dict[str, float]:
    return dict(zip("xyz", position, strict=True))
