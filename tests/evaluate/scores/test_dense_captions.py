"""Scan2Cap's m@kIoU against cases worked out by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression, wrapped_caption
from gsencoder.evaluate.benchmarks.captions import (
    BoxCaptions,
    CaptionedObject,
    captioned_objects,
    score_box_captions,
    score_named_captions,
)

NO_JAVA = "no Java here"


def true_object(number: int, low: float, *captions: str, scene: str = "s0", side: float = 1.0) -> CaptionedObject:
    return CaptionedObject(
        scene=scene, object_id=number, object_name="chair", captions=captions or (f"sos object {number} eos",),
        aabb=((low, 0.0, 0.0), (low + side, side, side)),
    )  # fmt: skip


def boxes_of(*boxes: tuple[float, str], scene: str = "s0") -> BoxCaptions:
    return {scene: [(caption, ((low, 0.0, 0.0), (low + 1, 1.0, 1.0))) for low, caption in boxes]}


def test_the_caption_of_the_best_box_counts_where_it_overlaps_enough() -> None:
    objects = [true_object(1, 0.0, "sos a red chair eos"), true_object(2, 10.0, "sos a table eos")]
    # IoU of unit boxes shifted by d: (1 - d) / (1 + d): 0.1 -> 0.818, 0.2 -> 0.667, 0.5 -> 1/3.
    boxes = boxes_of((0.2, "wrong"), (0.1, "a red chair"), (10.5, "a table"))
    scores = score_box_captions(objects, boxes, min_iou=0.5, tools=NO_JAVA)
    assert scores.ious == pytest.approx([0.9 / 1.1, 0.5 / 1.5])
    assert scores.missing == 1
    # Object 2 says "sos eos" against four words: c = 5 + 2, r = 5 + 4, all unigrams right: exp(1 - 9/7).
    assert scores.sentences.bleu[0] == pytest.approx(np.exp(1 - 9 / 7))
    assert scores.sentences.bleu_each[0] == pytest.approx([1.0] * 4)
    # LCS of "sos eos": P = 1, R = 1/2.
    assert scores.sentences.rouge_l_each == pytest.approx([1.0, 2.44 * 0.5 / (0.5 + 1.44)])
    lower = score_box_captions(objects, boxes, min_iou=0.25, tools=NO_JAVA)
    assert lower.missing == 0
    assert lower.sentences.bleu[3] == pytest.approx(1.0)
    assert lower.sentences.absent == {"METEOR": NO_JAVA}


def test_an_iou_of_k_is_not_enough() -> None:
    # Half of a box in a whole one: 0.5 / (1 + 1e-8), and 1 in two with k = 0.
    objects = [true_object(1, 0.0)]
    half: BoxCaptions = {"s0": [("x", ((0.0, 0.0, 0.0), (0.5, 1.0, 1.0)))]}
    assert score_box_captions(objects, half, min_iou=0.5, tools=NO_JAVA).missing == 1
    assert score_box_captions(objects, half, min_iou=0.499, tools=NO_JAVA).missing == 0
    assert score_box_captions(objects, boxes_of((5.0, "x")), min_iou=0.0, tools=NO_JAVA).missing == 1


def test_of_equal_boxes_the_first_counts_and_one_box_may_serve_two_objects() -> None:
    objects = [true_object(1, 0.0, "sos first eos"), true_object(2, 0.0, "sos first eos")]
    scores = score_box_captions(objects, boxes_of((0.0, "first"), (0.0, "second")), tools=NO_JAVA)
    assert scores.sentences.bleu[0] == pytest.approx(1.0)


def test_boxes_of_another_scene_do_not_count() -> None:
    objects = [true_object(1, 0.0), true_object(1, 0.0, scene="s1")]
    scores = score_box_captions(objects, boxes_of((0.0, "object 1"), scene="s1"), tools=NO_JAVA)
    assert scores.ious == pytest.approx([0, 1])
    assert score_box_captions(objects, {}, tools=NO_JAVA).missing == 2


def test_expressions_of_one_object_become_its_references() -> None:
    def expression(number: int, annotation: str, words: str) -> Expression:
        return Expression(
            scene="s0", object_id=number, object_name="chair", annotation=annotation, text=words,
            tokens=tuple(words.split()),
        )  # fmt: skip

    expressions = [expression(3, "0", "a chair ."), expression(1, "0", "b"), expression(3, "1", " ".join("w" * 40))]
    objects = captioned_objects(expressions)
    assert [each.object_id for each in objects] == [3, 1]
    assert objects[0].captions == ("sos a chair . eos", f"sos {' '.join('w' * 30)} eos")


@pytest.mark.parametrize(
    ("text", "wrapped"),
    [
        ("a chair. it is red.", "sos a chair . it is red . eos"),
        ("sos a chair eos", "sos a chair eos"),
        ("sos a chair", "sos sos a chair eos"),
        ("", "sos  eos"),
    ],
)
def test_captions_are_wrapped_once(text: str, wrapped: str) -> None:
    assert wrapped_caption(text) == wrapped


def test_captions_of_given_objects_need_no_boxes() -> None:
    objects = [
        CaptionedObject(scene="s0", object_id=4, object_name="x", captions=("sos a b eos",)),
        true_object(4, 0.0, scene="s1"),
    ]
    scores = score_named_captions(objects, {("s0", 4): "a b"}, tools=NO_JAVA)
    assert (scores.missing, scores.ious) == (1, None)
    assert scores.sentences.bleu_each[0] == pytest.approx([1.0] * 4)
    with pytest.raises(InputError, match="object 4 of s0 has no box"):
        score_box_captions(objects, {}, tools=NO_JAVA)


@settings(max_examples=25)
@given(st.permutations(range(6)))
def test_the_order_of_boxes_and_objects_decides_nothing(rows: list[int]) -> None:
    objects = [true_object(number, number * 0.7) for number in range(6)]
    boxes = [(number * 0.7 + 0.01 * number, f"object {number}") for number in range(6)]
    first = score_box_captions(objects, boxes_of(*boxes), tools=NO_JAVA)
    turned = boxes_of(*(boxes[row] for row in rows[::-1]))
    other = score_box_captions([objects[row] for row in rows], turned, tools=NO_JAVA)
    assert other.ious == pytest.approx(first.ious[rows])
    assert other.sentences.cider_each == pytest.approx(first.sentences.cider_each[rows])
    assert other.sentences.bleu == pytest.approx(first.sentences.bleu)
