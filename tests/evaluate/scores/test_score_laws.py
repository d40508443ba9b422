"""Limits and ties of scores: the last case that counts, the first that does not, and which of equal ones is taken."""

import math

import numpy as np
import pytest

from gsencoder.data.labels.files import box_ious
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.benchmarks.answers import clean_answer, match_cleaned, score_answers
from gsencoder.evaluate.benchmarks.captions import (
    CaptionedBox,
    CaptionedObject,
    NamedCaption,
    score_box_captions,
    score_named_captions,
    wrapped_caption,
)
from gsencoder.evaluate.benchmarks.text_metrics import bleu, cider, f_value, python_tokens, score_sentences

NO_JAVA = "no Java here"

# Boxes and captions


def test_the_iou_of_boxes_of_all_sizes_in_every_axis_is_by_hand() -> None:
    one = np.array([[0, 0, 0], [2, 3, 4]], np.float64)
    # Common volumes 1 · 2 · 3, 2 · 3 · 2, 0 (they touch); volumes 24 and 64, 12, 24.
    others = np.array([[[1, 1, 1], [5, 5, 5]], [[0, 0, 2], [2, 3, 4]], [[2, 0, 0], [4, 3, 4]]], np.float64)
    np.testing.assert_allclose(box_ious(others, one), [6 / (82 + 1e-8), 12 / (24 + 1e-8), 0], rtol=1e-12)


def boxed(number: int, low: float, scene: str = "s") -> CaptionedObject:
    return CaptionedObject(
        scene=scene,
        object_id=number,
        object_name="x",
        captions=(f"sos thing {number} eos",),
        aabb=((float(low), 0.0, 0.0), (low + 1.0, 1.0, 1.0)),
    )


def test_rows_of_boxes_are_those_of_the_whole_list_in_every_scene() -> None:
    objects = [boxed(1, 0, "s"), boxed(2, 0, "t"), boxed(3, 5, "t")]
    boxes = [
        CaptionedBox(scene=scene, caption=f"thing {number}", aabb=((low, 0.0, 0.0), (low + 1, 1.0, 1.0)))
        for scene, number, low in (("s", 1, 0.0), ("t", 3, 5.1), ("s", 9, 9.0), ("t", 2, 0.1), ("t", 8, 0.4))
    ]
    scores = score_box_captions(objects, boxes, tools=NO_JAVA)
    assert scores.ious == pytest.approx([1, 0.9 / 1.1, 0.9 / 1.1])
    assert scores.sentences.rouge_l_each == pytest.approx([1, 1, 1])
    assert scores.missing == 0
    # Half of the box: between a quarter and the half that is asked for unless something else is said.
    third = [CaptionedBox(scene="s", caption="x", aabb=((0.5, 0.0, 0.0), (1.5, 1.0, 1.0)))]
    assert score_box_captions(objects[:1], third, tools=NO_JAVA).missing == 1
    assert score_box_captions(objects[:1], boxes[:1], min_iou=1.0, tools=NO_JAVA).missing == 1
    assert score_box_captions(objects[:1], boxes[:1], min_iou=0.0, tools=NO_JAVA).missing == 0


def test_a_caption_belongs_to_its_object_and_scene() -> None:
    objects = [boxed(1, 0, "s"), boxed(1, 0, "t"), boxed(2, 0, "t")]
    captions = [
        NamedCaption(scene="t", object_id=2, caption="thing 2"),
        NamedCaption(scene="s", object_id=1, caption="no"),
    ]
    scores = score_named_captions(objects, captions, tools=NO_JAVA)
    assert scores.sentences.rouge_l_each[2] == pytest.approx(1)
    assert (scores.missing, scores.ious) == (1, None)
    assert wrapped_caption("sos a. b") == "sos sos a . b eos"


# Answers


def test_answers_are_cleaned_before_blanks_are_counted_and_the_first_match_decides() -> None:
    assert match_cleaned("the chair", ["a wooden chair", "chair"]) == (False, True)
    assert match_cleaned("a wooden chair", ["chair"]) == (False, True)
    assert clean_answer("23 and 24") == "twenty-three and 24"
    assert clean_answer("20 0 10") == "twenty zero ten"
    arguments = [
        Question(dataset="scanqa", id=str(number), scene="s", text="What is it?", answers=("no", "yes"))
        for number in range(3)
    ]
    predictions = {"0": ["?!"], "1": ["yes"], "2": ["."]}
    scores = score_answers(arguments, predictions, lemmatize="no WordNet", tools=NO_JAVA)
    assert (scores.blank, scores.overall.em1) == (2, 1 / 3)
    assert scores.absent == {
        "F-value": "no WordNet",
        "EM@10": "no question has more than one predicted answer",
        "METEOR": NO_JAVA,
    }


def test_the_f_value_takes_precision_from_the_answer_and_recall_from_the_reference() -> None:
    # Of "a a b" two words are in "a c", of which one of two is in the answer: 2 · (1/2 · 2/3) / (1/2 + 2/3).
    assert f_value("a a b", ["a c"], str) == pytest.approx(4 / 7)
    assert f_value("a c", ["a a b"], str) == pytest.approx(4 / 7)
    assert f_value("a b", ["x", "b y z"], str) == pytest.approx(2 / 5)
    # An equal answer is right even where its lemmas are none.
    assert f_value("", [""], str) == 1
    assert f_value("a", [""], str) == f_value("", ["a"], str) == f_value("a", [], str) == 0


# N-grams


def test_a_reference_counts_an_ngram_as_often_as_it_has_it_and_a_document_counts_once_a_sample() -> None:
    corpus, _ = bleu(["a a a"], [["a", "a a"]])
    # Two of three: no reference has a three times, and they are not added. Lengths are 3 and 2.
    assert corpus[0] == pytest.approx(2 / 3)
    # "a" is in both references of the first sample: in one of two documents. Its weight is log 2 beside that of b.
    both = cider(["a", "b"], [["a", "a"], ["b"]])
    assert both == pytest.approx([10 / 4, 10 / 4])
    # The lengths that count are numbers of bigrams: 0 and 2, so exp(-4 / 72), and cosines of a in "a b c".
    scores = cider(["a", "x"], [["a b c"], ["y"]])
    assert scores[0] == pytest.approx(10 / 4 * math.exp(-4 / 72) / math.sqrt(3))


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        ("The T.V. isn't on", "the t.v. is n't on"),
        ("It's 3.5 m, 10:30 o'clock", "it 's 3.5 m 10:30 o'clock"),
        ("cannot (see) [it] {at} all", "can not -lrb- see -rrb- -lsb- it -rsb- -lcb- at -rcb- all"),
        ("Mr. X's table--big... “yes” ‘no’", "mr. x 's table big yes no"),
        ("twenty-three 1,000 and/or", "twenty-three 1,000 and/or"),
        ("what?! a---b a.b@c.d", "what ?! a b a.b@c.d"),
    ],
)
def test_python_tokens_of_marks_and_contractions(text: str, tokens: str) -> None:
    assert python_tokens(text) == tokens


def test_sentences_and_references_stay_with_their_samples() -> None:
    scores = score_sentences(
        ["A chair.", "two lamps", "x"],
        [["A chair."], ["one", "Two lamps!"], ["y z", "x"]],
        tokens="python",
        tools=NO_JAVA,
    )
    assert scores.rouge_l_each.tolist() == pytest.approx([1, 1, 1])
    assert not scores.official
    assert math.isnan(scores.meteor)
    as_given = score_sentences(["A chair."], [["a chair"]], tokens="given", tools=NO_JAVA)
    assert (as_given.official, as_given.tokens, as_given.rouge_l) == (True, "tokens as given", 0)
