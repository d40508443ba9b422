"""Exact match of answers to questions about scenes, as ScanQA, SQA3D and LEO count it.

- EM@1 and EM@10 (ScanQA, scripts/score.py): the first answer, or any of the first ten, is one of the right ones,
  letter for letter.
- EM and refined EM of cleaned answers (LEO, evaluator/scanqa_eval.py; the columns EM and EM-R of later papers): both
  sides go through `clean_answer`, then the right answers are gone through in order, and the first that is equal, or
  contains or is contained without blanks, decides. So EM can be 0 where a later right answer is equal, and an answer
  that is empty when cleaned is refined right, since every text contains it; a note counts those.
- The F-value and the sentence scores of `gsencoder.evaluate.benchmarks.text_metrics`.

A question without a prediction scores 0 everywhere, and counts.

Labels are a question set of ScanQA or SQA3D with its answers. Predictions are ScanQA's (scripts/predict.py; its
benchmark's submission), a list of {scene_id, question_id, answer_top10, bbox}, the box being optional; or SQA3D's
(LLM/eval_sqa3d_llm.py), a list of {scene_id, situation, question, answer, agent_rot, agent_pos}, which are found by
these five, or by a question_id where there is one; equal questions are answered in their order. `ask` writes both.
"""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gsencoder.core.errors import InputError, SceneWarning, counted
from gsencoder.data.labels.files import (
    brief,
    entries_of,
    id_value,
    number,
    object_of,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
    text_list,
    text_value,
)
from gsencoder.data.labels.questions import Question, read_questions
from gsencoder.evaluate.benchmarks.files import ScoreOptions, refuse_missing
from gsencoder.evaluate.benchmarks.text_metrics import (
    JavaTools,
    Lemmatize,
    SentenceScores,
    Tokens,
    f_value,
    score_sentences,
    sentence_figures,
    wordnet_lemmatizer,
)
from gsencoder.evaluate.tables import ScoreReport, grouped, mean_of, spread, table_of

OPTIONS = ("java", "allow_missing")
TOP = 10
"""Most answers of a question."""
_NUMBERS = (
    *("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"),
    *("thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty"),
)
_WORDS = (
    ("letf", "left"),
    ("let", "left"),
    ("tehre", "there"),
    ("rigth", "right"),
    ("rght", "right"),
    ("behine", "behind"),
    ("tv", "TV"),
    ("chai", "chair"),
    ("wasing", "washing"),
    ("waslked", "walked"),
    ("oclock", "o'clock"),
    ("o'[ ]+clock", "o'clock"),
    ("0", "zero"),
    ("none", "zero"),
    *((str(value), name) for value, name in enumerate(_NUMBERS) if value),
    ("23", "twenty-three"),
)
"""Words that LEO replaces, in this order."""
_CLEANING = (
    (re.compile(r"[ ]+$"), ""),
    (re.compile(r"^[ ]+"), ""),
    (re.compile(r" {2,}"), " "),
    (re.compile(r"[^a-zA-Z0-9,'\s\-:]+"), ""),
    *((re.compile(rf"\b{word}\b"), right) for word, right in _WORDS),
    (re.compile(r"\b([a-zA-Z]+)([0-9])\b"), r"\g<1>"),
    *((re.compile(rf"\b{article}\b ([a-zA-Z]+)"), r"\g<1>") for article in ("a", "an", "the")),
    (re.compile(r"\bbackwards\b"), "backward"),
)


AnswerRow = dict[str, Any]
"""The scores of one question: em1, em10 (whether the first answer, or one of ten, is right letter for letter),
em_cleaned, em_refined (LEO's matches) and f_value (None where WordNet is missing); all are 0 without an answer."""


class AnswerScores(NamedTuple):
    """Scores of a question set: a row a question, in their order, those of the first answers as sentences, and why a
    column has no value."""

    rows: list[AnswerRow]
    sentences: SentenceScores
    absent: dict[str, str]


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Scores of answers to a question set."""
    questions = read_questions(labels)
    if not questions:
        raise InputError(f"{labels}: nothing to score: it holds no questions")
    answers = read_answer_predictions(predictions, questions)
    missing = [each.id for each in questions if each.id not in answers]
    refuse_missing(missing, "question", predictions, options)
    tools = None if options.java else "Java was not asked for (java=false)"
    rows, sentences, absent = score_answers(
        questions, answers, tokens="auto" if options.java else "python", tools=tools
    )
    means = mean_answers(rows) | ({"em_10": math.nan} if "EM@10" in absent else {})
    overall = means | sentence_figures(sentences)
    by_scene, by_kind = (
        [{name: key, "questions": len(each), **mean_answers(each)} for key, each in grouped(rows, name).items()]
        for name in ("scene", "kind")
    )
    by_scene.sort(key=lambda row: row["scene"])
    by_kind.sort(key=lambda row: KINDS.index(row["kind"]))
    notes = [f"{column} is absent: {reason}." for column, reason in absent.items()]
    if blank := sum(not clean_answer(each[0]).split() for each in answers.values()):
        notes.append(f"{counted(blank, 'answer')} without a word once cleaned: right in the refined match.")
    # Measured columns, then those of papers that rest on other tokens.
    columns = dict.fromkeys((*overall, "em_1", "em_refined", "bleu_4", "meteor", "rouge_l", "cider"))
    return ScoreReport(
        results={
            "protocol": "answers",
            "questions": len(rows),
            "missing": len(missing),
            "tokens": sentences.tokens,
            "absent": absent,
            **overall,
            "kinds": {row["kind"]: row for row in by_kind},
            "spread": spread(by_scene, list(means)),
        },
        table=table_of(
            "Answers", {options.method: overall}, published="splatdistill_3_answers", columns=columns, notes=notes
        ),
        rows={"scenes": by_scene, "kinds": by_kind, "questions": rows},
        line=f"{counted(len(rows), 'question')}, {len(missing)} without an answer: EM@1 {overall['em_1']:.3f}, refined "
        f"{overall['em_refined']:.3f}, CIDEr {100 * sentences.cider:.1f}",
    )


def clean_answer(text: str) -> str:
    """An answer as LEO compares it: lower case but for TV, no punctuation but , ' - and :, typing errors mended, whole
    numbers to 20 and 23 in words, articles left out (data/data_utils.py; its steps that change nothing are not here).
    """
    text = text.lower()
    for pattern, replacement in _CLEANING:
        text = pattern.sub(replacement, text)
    return text


def match_cleaned(answer: str, references: Sequence[str]) -> tuple[bool, bool]:
    """LEO's exact match and refined match of an answer, both sides cleaned by `clean_answer` here."""
    cleaned = clean_answer(answer)
    short = "".join(cleaned.split())
    for reference in map(clean_answer, references):
        if cleaned == reference:
            return True, True
        other = "".join(reference.split())
        if short in other or other in short:
            return False, True
    return False, False


def sqa3d_kind(question: str) -> str:
    """What, is, how, can, which or other: SQA3D's kinds, by the letters that a question begins with, in any case."""
    start = question.lstrip().lower()
    return next((kind for kind in SQA3D_KINDS if start.startswith(kind)), "other")


def scanqa_kind(question: str) -> str:
    """ScanQA's kinds (scripts/score.py), by words anywhere in a question, in the case in which a sentence has them."""
    return next((kind for kind, phrases in _SCANQA for phrase in phrases if phrase in question), "Other")


SQA3D_KINDS = ("what", "is", "how", "can", "which")
_SCANQA = (
    ("Place", ("Where",)),
    ("Number", ("How many",)),
    ("Color", ("What color", "What is the color")),
    ("Object nature", ("What shape", "What type", "What kind")),
    ("Object", ("What is",)),
)
KINDS = (*SQA3D_KINDS, *(kind for kind, _ in _SCANQA), "other", "Other")


def score_answers(
    questions: Sequence[Question],
    predictions: Mapping[str, Sequence[str]],
    *,
    tokens: Tokens = "auto",
    tools: JavaTools | str | None = None,
    lemmatize: Lemmatize | str | None = None,
) -> AnswerScores:
    """Scores the answers to all questions of a set.

    Args:
        questions: with right answers, each id once.
        predictions: by the id of the question, one to ten answers, best first; a question that is missing scores 0.
        lemmatize: of `wordnet_lemmatizer`, a reason for going without, or None = look for it.
    """
    lemmatize = wordnet_lemmatizer() if lemmatize is None else lemmatize
    absent = {"F-value": lemmatize} if isinstance(lemmatize, str) else {}
    if all(len(answers) == 1 for answers in predictions.values()):
        absent["EM@10"] = "no question has more than one predicted answer"
    rows, first_answers = [], []
    for each in questions:
        answers = predictions.get(each.id, ())
        first = answers[0] if answers else ""
        cleaned, refined = match_cleaned(first, each.answers) if answers else (False, False)
        value = None if isinstance(lemmatize, str) else f_value(first, each.answers, lemmatize) if answers else 0.0
        rows.append(
            {
                "question_id": each.id,
                "scene": each.scene,
                "kind": sqa3d_kind(each.text) if each.dataset == "sqa3d" else scanqa_kind(each.text),
                "predicted": bool(answers),
                "em1": bool(answers) and first in each.answers,
                "em10": any(answer in each.answers for answer in answers),
                "em_cleaned": cleaned,
                "em_refined": refined,
                "f_value": value,
            }
        )
        first_answers.append(first)
    sentences = score_sentences(first_answers, [each.answers for each in questions], tokens=tokens, tools=tools)
    return AnswerScores(rows, sentences, absent | sentences.absent)


def mean_answers(rows: Sequence[AnswerRow]) -> dict[str, float]:
    """Means over questions, of one scene or kind, say; NaN without any."""
    columns = {"em_1": "em1", "em_10": "em10", "em_cleaned": "em_cleaned", "em_refined": "em_refined"}
    means = {column: mean_of([float(row[name]) for row in rows]) for column, name in columns.items()}
    values = [math.nan if row["f_value"] is None else row["f_value"] for row in rows]
    return means | {"f_value": mean_of(values)}


EXPECTED = "question_id and answer_top10, or scene_id, situation, question and answer"


def read_answer_predictions(path: Path, questions: Sequence[Question]) -> dict[str, tuple[str, ...]]:
    """Reads predicted answers to a question set.

    Returns:
        One to ten answers, best first, by the id of the question. Questions without an entry are not there.
    """
    rows = read_benchmark_json(path)
    if isinstance(rows, dict) and ("questions" in rows or "annotations" in rows):
        raise InputError(
            f"{path}: expected a list of objects with {EXPECTED}, got SQA3D's truth; were predictions and truth "
            "swapped?"
        )
    by_id, by_words = {each.id: each for each in questions}, grouped(questions, "scene", "situation", "text")
    answers: dict[str, tuple[str, ...]] = {}
    names, equal = [], 0
    for entry, where in entries_of(rows, path, EXPECTED):
        fitting = _questions_of(entry, where, by_id, by_words)
        # SQA3D's test split has pairs of questions that differ in nothing but their ids.
        equal += len(fitting) > 1
        name = next((each.id for each in fitting if each.id not in answers), fitting[0].id)
        names.append(name)
        answers[name] = _answers(entry, where)
    if equal:
        warnings.warn(
            f"{path}: {counted(equal, 'entry', 'entries')} without question_id could be those of several equal "
            "questions, and were taken in the order of the truth",
            SceneWarning,
            stacklevel=2,
        )
    refuse_repeated(path, names, lambda name: name[:60], what="question_id")
    return answers


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


def _questions_of(
    entry: Mapping[str, Any], where: str, by_id: Mapping[str, Question], by_words: Mapping[Any, Sequence[Question]]
) -> Sequence[Question]:
    """The question that an entry is about, or several that differ in nothing but their ids."""
    scene = scene_name(entry["scene_id"], where) if "scene_id" in entry else None
    if scene is not None and scene not in {key[0] for key in by_words}:
        raise InputError(f"{where}: is about {scene}, of which the truth has no questions")
    if "question_id" in entry:
        name = id_value(entry["question_id"], where, "question_id")
        if name not in by_id:
            raise InputError(f"{where}: question_id {name[:60]} is not in the truth")
        if scene not in (None, by_id[name].scene):
            raise InputError(f"{where}: question {name[:60]} is about {by_id[name].scene}, got {scene}")
        return [by_id[name]]
    if scene is None or "question" not in entry or "situation" not in entry:
        raise InputError(f"{where}: says not which question it answers; expected {EXPECTED}")
    text = text_value(entry["question"], where, "question")
    situation = text_value(entry["situation"], where, "situation")
    position = _numbers(entry, "agent_pos", ("x", "y", "z"), where)
    turns = _numbers(entry, "agent_rot", ("_w", "_x", "_y", "_z"), where)
    fitting = [
        each
        for each in by_words.get((scene, situation, text), ())
        if None in (position, each.position) or (position == each.position and turns in (None, each.rotation))
    ]
    if len({(each.position, each.rotation) for each in fitting}) != 1:
        fault = f"{len(fitting)} questions; give its question_id" if fitting else "no question of the truth"
        raise InputError(f"{where}: scene, situation, question and place are those of {fault}: {brief(text)}")
    return fitting


def _numbers(entry: Mapping[str, Any], key: str, names: Sequence[str], where: str) -> tuple[float, ...] | None:
    if key not in entry:
        return None
    values = object_of(entry[key], where, f"{', '.join(names)} as {key}")
    return tuple(number(values.get(name), where, f"{key}.{name}") for name in names)
