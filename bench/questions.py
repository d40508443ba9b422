"""Questions, situations and expressions with their answers, made from the labels of scenes.

    python bench/questions.py OUT SCENE … [--seed 0] [--per-kind 10] [--min-pixels 200] [--per-object 3] [--objects 0]
    gsencoder ask FEATURES questions=OUT/questions.json photos=SCENES out=answers
    gsencoder score answers predictions=answers/predictions.json truth=OUT/questions.json

OUT/questions.json has ScanQA's form, OUT/situated_questions.json with its annotations SQA3D's, and OUT/expressions.json
ScanRefer's, with bbox, unique_multiple and others. Positions are in meters from the middle of all boxes.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from errors import one_line_errors, output_folder, positive
from made_questions import KINDS, kind_of, make_expressions, make_questions, make_situations
from seen_objects import see_objects

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.data.labels.expressions import write_scanrefer
from gsencoder.data.labels.files import refuse_repeated
from gsencoder.data.labels.questions import SITUATED, Question
from gsencoder.data.scenes import check_names, find_scenes, load_scene


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=output_folder)
    parser.add_argument("scenes", nargs="+", help="scenes with photographs, instance maps and objects.json")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--per-kind", type=positive, default=10, help="most questions of a kind about a scene, from 2")
    parser.add_argument(
        "--min-pixels", type=positive, default=200, help="that a photograph shows of what is asked about"
    )
    parser.add_argument("--per-object", type=positive, default=3, help="most expressions that mean one object")
    parser.add_argument("--objects", type=int, default=0, help="most objects of a scene with expressions; 0 = all")
    arguments = parser.parse_args(words)
    if min(arguments.seed, arguments.objects, arguments.per_kind - 2) < 0:
        parser.error("expected --seed and --objects of 0 or more, and --per-kind of 2 or more")
    paths = find_scenes(arguments.scenes)
    check_names(paths)
    scenes = [see_objects(load_scene(path), arguments.min_pixels) for path in paths]
    drawn = {"seed": arguments.seed, "per_kind": arguments.per_kind}
    questions, situations = make_questions(scenes, **drawn), make_situations(scenes, **drawn)
    expressions = make_expressions(
        scenes, seed=arguments.seed, per_object=arguments.per_object, per_scene=arguments.objects
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_scanqa(arguments.out / "questions.json", questions)
    write_sqa3d(arguments.out / "situated_questions.json", situations)
    write_scanrefer(arguments.out / "expressions.json", expressions)
    counts = Counter(str(kind_of(each)) for each in questions)
    counts.update(each.id.rsplit("-", 2)[1] for each in situations)
    for kind in (*KINDS, *sorted(key for key in counts if key not in KINDS)):
        print(f"{kind:>10}: {counts[kind]}")
    print(f"{arguments.out}: {len(questions)} questions, {len(situations)} situated, {len(expressions)} expressions")


def write_scanqa(path: str | Path, questions: Sequence[Question]) -> None:
    """Writes questions as ScanQA's files have them."""
    refuse_repeated(Path(path), [each.id for each in questions], lambda each: each[:60], what="question_id")
    rows = [
        {
            "scene_id": each.scene,
            "question_id": each.id,
            "question": each.text,
            "answers": list(each.answers),
            "object_ids": list(each.object_ids),
            "object_names": list(each.object_names),
        }
        for each in questions
    ]
    write_json(path, [{k: v for k, v in row.items() if k != "answers" or v} for row in rows])


def write_sqa3d(path: str | Path, questions: Sequence[Question]) -> Path:
    """Writes situated questions as SQA3D's two files have them.

    Args:
        path: of the file of questions, whose name must have "questions" in it.

    Returns:
        The file of annotations next to it, where `read_questions` looks for it.
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
                "position": dict(zip("xyz", each.position, strict=True)),
            }
        )
    write_json(file, {"task_type": "Situated question answering", "questions": rows})
    write_json(annotations, {"annotations": answers})
    return annotations


if __name__ == "__main__":
    with one_line_errors():
        main()
