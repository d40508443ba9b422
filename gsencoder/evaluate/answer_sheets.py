"""What a scripted answerer needs to know, from the truth of a question set and a dry run of `ask` over it.

A dry run (`dry_run=true`) writes the requests that a real one sends, picture by picture and bit by bit, since pictures
are deterministic; so the truth of each picture can be computed before it is sent.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from gsencoder.core.files import read_foreign
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.made_questions import kind_of
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.picture_truth import PictureTruth
from gsencoder.evaluate.scripted_answerer import AnswerSheet, Fact, SentPicture, request_digest, request_pictures
from gsencoder.infer.ask.batch import ANSWERS, REQUEST
from gsencoder.infer.ask.questions import read_answers


def add_questions(sheet: AnswerSheet, questions: Iterable[Question]) -> None:
    """Adds the right answers of questions, and the objects that each is about.

    Of questions that `gsencoder questions` made, "Is there …" needs any one of the objects, the others all.
    """
    for each in questions:
        text = each.situated_text
        sheet.facts[each.scene, text.strip()] = Fact(
            answer=each.answers[0], needed=each.object_ids, any_of=kind_of(each) == "is_there"
        )


def add_expressions(sheet: AnswerSheet, expressions: Sequence[Expression]) -> None:
    """Adds which object each description means, and the first description of each object as its caption."""
    for each in expressions:
        sheet.facts[each.scene, each.text.strip()] = Fact(answer="", needed=(each.object_id,))
        sheet.captions.setdefault((each.scene, each.object_id), each.text)


def add_pictures(sheet: AnswerSheet, dry: Path, truth: PictureTruth) -> None:
    """Adds the truth of all pictures and marks of a dry run.

    Args:
        sheet: that is added to.
        dry: the folder of the dry run's answers, `answers.jsonl`, about one scene.
        truth: of that scene.
    """
    for row in read_answers(dry / ANSWERS).values():
        body = json.loads(read_foreign(dry / row["folder"] / REQUEST))
        digests = request_pictures(body)
        for digest, view in zip(digests, row["views"], strict=True):
            sheet.pictures[digest] = SentPicture(scene=truth.scene.name, pixels=truth.pixels(view))
        instances = tuple(truth.instance_in(each["aabb_min"], each["aabb_max"]) for each in row["targets"])
        sheet.marks[request_digest(digests)] = instances
