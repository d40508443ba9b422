"""What a prompt says and shows, and what its answer means."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.ask.ask import number_in, prompt_messages, prompt_text
from gsencoder.infer.views.pictures import PictureKind

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


def test_prompts_say_what_the_pictures_are() -> None:
    told = {
        kinds: prompt_text("answer", "x", [], marks=(), kinds=kinds).splitlines()[0]
        for kinds in (("render",) * 2, ("photograph",) * 2, ("render", "photograph"))
    }
    assert "They are rendered" in told[("render",) * 2]
    assert "They are photographs" in told[("photograph",) * 2]
    assert "Some are photographs" in told[("render", "photograph")]
    assert "black" not in told[("photograph",) * 2]


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


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("2", 2),
        ("Mark 3.", 3),
        ("**Mark #3**", 3),
        ("No.2", 2),
        ("It is number 1, not 2", 1),
        ("In view 1, mark 2", 2),
        ("There are 3 chairs; it is mark 2.", 2),
        ("There are 2 crates; the far one is mark 1.", 1),
        ("5 marks are shown; 2", 2),
        ("<think>\nMark 1 is near, but the far one is 2.\n</think>\n\n2", 2),
        ("thinking of 1</think>3", 3),
        ("0", 0),
        ("none", 0),
        ("None of the marks 1 or 2 is meant.", 0),
        ("zero", 0),
        ("Two.", 2),
        ("the one by the window", None),
        ("not 1 but 2", None),
        ("1 or 2", None),
        ("mark 1 or mark 2", None),
        ("4", None),
        ("four", None),
        ("1.5", None),
        ("1/3", None),
        ("1-2", None),
        ("-1", None),
        ("1,000", None),
        ("", None),
        ("the 12th", None),
        ("02", 2),
        ("9" * 5000, None),
    ],
)
def test_the_mark_that_an_answer_names_is_found_or_nothing_is_guessed(text: str, number: int | None) -> None:
    assert number_in(text, 3) == number
