"""Exact matches of answers against cases worked out by hand from ScanQA's and LEO's scripts."""

import math
import sys
from types import ModuleType

import numpy as np
import pytest

from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.benchmarks.answers import (
    clean_answer,
    match_cleaned,
    mean_answers,
    scanqa_kind,
    score_answers,
    sqa3d_kind,
)
from gsencoder.evaluate.benchmarks.text_metrics import f_value, score_sentences, sentence_figures, wordnet_lemmatizer

NO_JAVA = "no Java here"
NO_WORDNET = "no WordNet here"


def singular(word: str) -> str:
    """A lemmatizer of nouns with s."""
    return word.removesuffix("s")


def question(name: str, *answers: str) -> Question:
    return Question(dataset="sqa3d", id=name, scene="s0", text="What?", answers=answers)


@pytest.mark.parametrize(
    ("text", "cleaned"),
    [
        ("  The Brown   chair. ", "brown chair"),
        ("on the left of a table", "on left of table"),
        ("2", "two"),
        ("23 chairs and 24", "twenty-three chairs and 24"),
        ("None", "zero"),
        ("no1 mat2 a12", "no mat a12"),
        ("3 o'  clock, 3 oclock", "three o'clock, three o'clock"),
        ("tv on the letf", "TV on left"),
        ("go backwards", "go backward"),
        ("the the chair", "the chair"),
        ("black & white", "black  white"),
    ],
)
def test_answers_are_cleaned_as_leo_cleans_them(text: str, cleaned: str) -> None:
    assert clean_answer(text) == cleaned


@pytest.mark.parametrize(
    ("answer", "references", "match"),
    [
        ("Brown.", ["brown"], (True, True)),
        ("brown wood", ["brown"], (False, True)),
        ("book shelf", ["bookshelf"], (False, True)),
        ("red", ["brown", "green"], (False, False)),
        # The first reference that matches in any way decides, and hides the equal one behind it.
        ("chair", ["brown chair", "chair"], (False, True)),
        ("chair", ["chair", "brown chair"], (True, True)),
        # Every text contains an empty one.
        ("", ["chair"], (False, True)),
        ("...", ["chair"], (False, True)),
    ],
)
def test_the_refined_match_is_leos(answer: str, references: list[str], match: tuple[bool, bool]) -> None:
    assert match_cleaned(answer, references) == match


@pytest.mark.parametrize(
    ("text", "kind"), [("  whatever", "what"), ("Isn't it?", "is"), ("HOW many", "how"), ("", "other")]
)
def test_the_kind_of_an_sqa3d_question_is_its_first_letters(text: str, kind: str) -> None:
    assert sqa3d_kind(text) == kind


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("Where is it?", "Place"),
        ("where is it?", "Other"),
        ("How many chairs?", "Number"),
        ("What is the color of it?", "Color"),
        ("What kind of chair is it?", "Object nature"),
        ("What is it?", "Object"),
        ("In the corner, What is it?", "Object"),
        ("How is it?", "Other"),
    ],
)
def test_the_kind_of_a_scanqa_question_is_the_first_that_has_a_phrase_of_it(text: str, kind: str) -> None:
    assert scanqa_kind(text) == kind


def test_a_missing_answer_counts_in_the_sentence_scores_as_an_empty_one() -> None:
    questions = [question("a", "brown chair"), question("b", "red table")]
    scores = score_answers(questions, {"a": ["brown chair"]}, tools=NO_JAVA, lemmatize=NO_WORDNET).sentences
    # c = 2 and r = 4, and what is said is right: exp(1 - 4/2).
    assert scores.bleu[0] == pytest.approx(np.exp(-1))
    assert scores.rouge_l == pytest.approx(0.5)
    assert scores.cider_each[1] == 0


def test_the_f_value_is_one_for_an_equal_answer_and_else_the_best_f1_of_lemmas() -> None:
    assert f_value("brown chairs", ["brown chairs"], singular) == 1
    # Against "brown chair": both lemmas are there; against "two brown tables": P = 1/2, R = 1/3.
    assert f_value("brown chairs", ["brown chair"], singular) == 1
    assert f_value("brown chairs", ["two brown tables"], singular) == pytest.approx(2 * (1 / 2) * (1 / 3) / (5 / 6))
    # Of "a a b" two words are in "a c", of which one of two is in the answer: 2 · (1/2 · 2/3) / (1/2 + 2/3).
    assert f_value("a a b", ["a c"], str) == f_value("a c", ["a a b"], str) == pytest.approx(4 / 7)
    assert f_value("a b", ["x", "b y z"], str) == pytest.approx(2 / 5)
    assert f_value("Red", ["red"], singular) == 0
    assert f_value("", ["red"], singular) == f_value("red", [""], singular) == f_value("a", [], str) == 0
    assert f_value("", [""], str) == 1


def test_the_f_value_of_a_set_is_the_mean_with_zero_for_a_missing_answer() -> None:
    questions = [question("a", "two chairs"), question("b", "x")]
    scores = score_answers(questions, {"a": ["chair"]}, tools=NO_JAVA, lemmatize=singular)
    assert mean_answers(scores.rows)["f_value"] == pytest.approx((2 / 3) / 2)
    assert [row["f_value"] for row in scores.rows] == [pytest.approx(2 / 3), 0]


def test_without_nltk_or_its_data_the_reason_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nltk.stem", None)
    assert "nltk is not installed" in str(wordnet_lemmatizer())

    class WordNetLemmatizer:
        data = True

        def lemmatize(self, word: str) -> str:
            if not self.data:
                raise LookupError("Resource wordnet not found")
            return singular(word)

    stem = ModuleType("nltk.stem")
    stem.WordNetLemmatizer = WordNetLemmatizer  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "nltk", ModuleType("nltk"))
    monkeypatch.setitem(sys.modules, "nltk.stem", stem)
    lemmatizer = wordnet_lemmatizer()
    assert not isinstance(lemmatizer, str)
    assert lemmatizer("chairs") == "chair"
    WordNetLemmatizer.data = False
    assert "no data of WordNet" in str(wordnet_lemmatizer())


def test_figures_on_other_tokens_say_so_in_their_names() -> None:
    here = sentence_figures(score_sentences(["a chair"], [["a chair"]], tools=NO_JAVA))
    assert list(here)[:2] == ["bleu_1 (Python tokens)", "bleu_2 (Python tokens)"]
    assert math.isnan(here["meteor (Python tokens)"])
    given_tokens = sentence_figures(score_sentences(["a chair"], [["a chair"]], tokens="given", tools=NO_JAVA))
    assert list(given_tokens) == ["bleu_1", "bleu_2", "bleu_3", "bleu_4", "meteor", "rouge_l", "cider"]


LEO_WORDS = """
letf left, let left, tehre there, rigth right, rght right, behine behind, tv TV, chai chair, wasing washing,
waslked walked, oclock o'clock, none zero, 0 zero, 1 one, 2 two, 3 three, 4 four, 5 five, 6 six, 7 seven, 8 eight,
9 nine, 10 ten, 11 eleven, 12 twelve, 13 thirteen, 14 fourteen, 15 fifteen, 16 sixteen, 17 seventeen, 18 eighteen,
19 nineteen, 20 twenty, 23 twenty-three, backwards backward, 21 21, 22 22, 24 24, right right, bright bright
"""


@pytest.mark.parametrize(("wrong", "right"), [tuple(each.split()) for each in LEO_WORDS.split(",")])
def test_words_are_mended_as_leos_and_sqa3ds_scripts_mend_them(wrong: str, right: str) -> None:
    assert clean_answer(wrong) == right
    assert clean_answer(f"to {wrong}, side") == f"to {right}, side"
    # A part of a word is none; a digit after letters goes.
    for word in (f"b{wrong}", f"{wrong}s"):
        if not wrong.isdigit():
            assert clean_answer(word) == word
