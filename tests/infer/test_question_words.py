"""The words of a question that are looked for in a scene."""

import numpy as np

from gsencoder.text.question_words import words_in
from gsencoder.text.table import make_text_table


def test_words_of_a_question_are_found_with_the_longest_name_first() -> None:
    table = make_text_table(["pen", "pen holder", "mug", "box"], np.eye(4, dtype=np.float32), "t")
    assert words_in("Is the mug's pen-holder near BOXES, or a pen?", table) == ("mug", "pen holder", "box", "pen")
    assert words_in("What is the mug on?", table) == ("mug",)
    assert words_in("A mug-like pen, holder of ink", table) == ("mug", "pen")
    assert words_in("", table) == ()
    assert words_in("How far?", table) == ()


def test_words_that_only_look_like_names_are_not_looked_for() -> None:
    names = [
        "can",
        "chair",
        "orange",
        "watch",
        "table",
        "lamp",
        "table lamp",
        "caf\u00e9",
        "\u0915\u0941\u0930\u094d\u0938\u0940",
        "big red dining room table",
    ]
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
