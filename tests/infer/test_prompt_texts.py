"""What a prompt says and shows, what its answer means, and which words of a question are looked for."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.ask.ask import number_in, prompt_messages, prompt_text
from gsencoder.infer.views.pictures import PictureKind
from gsencoder.text.question_words import words_in
from gsencoder.text.table import make_text_table

pytest.importorskip("openai")


RENDERS: tuple[PictureKind, ...] = ("render",)


@pytest.mark.parametrize(("shape", "size"), [((30, 40), (40, 30)), ((300, 400), (64, 48)), ((400, 1), (1, 64))])
def test_pictures_are_sent_no_larger_than_asked(shape: tuple[int, int], size: tuple[int, int]) -> None:
    picture = np.full((*shape, 3), 200, np.uint8)
    (message,) = prompt_messages("what?", [picture], side=64)
    head, _, data = message["content"][0]["image_url"]["url"].partition(",")
    assert head == "data:image/jpeg;base64"
    image = Image.open(io.BytesIO(base64.b64decode(data)))
    assert image.size == size
    assert np.abs(np.asarray(image).astype(int) - 200).max() < 3


def test_prompts_say_how_sure_the_search_is_and_what_it_did_not_find() -> None:
    sure = {"probabilities": [0.97, 0.5], "absent": {"zebra": 0.03}}
    marked = prompt_text("ground", "the left one", ["mug", "cup"], marks=(1, 2), kinds=RENDERS, **sure)
    assert "Probability that the name is right: mark 1 0.97, mark 2 0.50." in marked
    plain = prompt_text("answer", "Is there a zebra?", ["mug", "cup"], marks=(), kinds=RENDERS, **sure)
    assert "Probability" not in plain
    assert "Looked for and probably absent: zebra (probability 0.03)." in plain


def test_prompts_hold_the_question_and_the_names_of_the_marks() -> None:
    text = prompt_text("answer", " What's red? ", ["mug", "mug"], marks=(1, 2), kinds=RENDERS)
    assert "Question: What's red?" in text
    assert "1 = mug; 2 = mug." in text
    assert "1 = " not in prompt_text("answer", "x", ["mug"], marks=(), kinds=RENDERS)
    assert "Meant is: the left one" in prompt_text("ground", "the left one", ["mug"], marks=(1,), kinds=RENDERS)
    caption = prompt_text("caption", "", ["mug"], marks=(1,), kinds=RENDERS)
    assert "The thing is the mug." in caption
    assert "mark 1" in caption


@pytest.mark.parametrize(
    ("task", "question", "names", "marked", "problem"),
    [
        ("answer", " ", ["a"], True, "question= is missing"),
        ("ground", "", ["a"], True, "question= is missing"),
        ("ground", "x", [], True, "nothing was found"),
        ("caption", "", [], True, "nothing was found"),
        ("ground", "x", ["a"], False, "needs marks"),
    ],
)
def test_prompts_without_what_they_need_are_refused(task, question, names, marked, problem):
    with pytest.raises(InputError, match=problem):
        prompt_text(task, question, names, marks=(1,) if marked else (), kinds=RENDERS)


ANSWERS = {
    0: ("0", "none", "None of the marks 1 or 2 is meant."),
    1: ("It is number 1, not 2", "There are 2 crates; the far one is mark 1."),
    2: ("2", "Two.", "In view 1, mark 2", "There are 3 chairs; it is mark 2."),
    3: ("Mark 3.", "**Mark #3**", "<think>\nMark 1 is near, but the far one is 3.\n</think>\n\n3"),
    None: ("", "by the window", "not 1 but 2", "1 or 2", "4", "1.5", "1-2", "-1", "1,000", "the 12th", "9" * 5000),
}


@pytest.mark.parametrize("number", ANSWERS)
def test_the_mark_that_an_answer_names_is_found_or_nothing_is_guessed(number: int | None) -> None:
    for text in ANSWERS[number]:
        assert number_in(text, 3) == number, text


def test_words_of_a_question_are_found_with_the_longest_name_first() -> None:
    table = make_text_table(["pen", "pen holder", "mug", "box"], np.eye(4, dtype=np.float32), "t")
    assert words_in("Is the mug's pen-holder near BOXES, or a pen?", table) == ("mug", "pen holder", "box", "pen")
    assert words_in("What is the mug on?", table) == ("mug",)
    assert words_in("A mug-like pen, holder of ink", table) == ("mug", "pen")
    assert words_in("", table) == ()
    assert words_in("How far?", table) == ()


def test_words_that_only_look_like_names_are_not_looked_for() -> None:
    names = ["can", "chair", "orange", "watch", "table", "lamp", "table lamp", "caf\u00e9"]
    names += ["\u0915\u0941\u0930\u094d\u0938\u0940", "big red dining room table"]
    table = make_text_table(names, np.eye(len(names), dtype=np.float32), "t")
    for text, words in (
        ("Can you tell me how many chairs there are?", ("chair",)),
        ("Is there a can on the chair?", ("can", "chair")),
        ("Which one can I watch from?", ()),
        ("Whose watch is it?", ("watch",)),
        ("Is there a table, lamp or chair?", ("table", "lamp", "chair")),
        ("Where is the table lamp?", ("table lamp",)),
        ("What is on the orange chair?", ("chair",)),
        ("Is there an orange on the chair?", ("orange", "chair")),
        ("Is it orange? Chair or table?", ("orange", "chair", "table")),
        ("the big red dining room table", ("big red dining room table",)),
        ("a chair\u2019s leg", ("chair",)),
        ("the cafe\u0301", ("caf\u00e9",)),
        ("\u0915\u0941\u0930\u094d\u0938\u0940 ?", ("\u0915\u0941\u0930\u094d\u0938\u0940",)),
    ):
        assert words_in(text, table) == words, text
