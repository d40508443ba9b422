"""BLEU, ROUGE-L and CIDEr against cases worked out by hand, and the laws that they obey."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.text_metrics import bleu, cider, python_tokens, rouge_l, score_sentences

SENTENCES = st.lists(st.sampled_from("abcd"), max_size=8).map(" ".join)
SAMPLES = st.lists(st.tuples(SENTENCES, st.lists(SENTENCES, min_size=1, max_size=3)), min_size=1, max_size=6)


def test_a_repeated_word_counts_as_often_as_one_reference_has_it() -> None:
    # Papineni et al. 2002, example 2: of seven "the" two are right. The closest reference has 7 tokens, no penalty.
    corpus, each = bleu(["the the the the the the the"], [["the cat is on the mat", "there is a cat on the mat"]])
    assert corpus[0] == pytest.approx(2 / 7)
    # No bigram is right, so that only the 1e-15 is left: sqrt(2/7 · 1e-15/6).
    assert corpus[1] == pytest.approx(math.sqrt(2 / 7 * 1e-15 / 6))
    assert np.array_equal(each[0], corpus)


def test_bleu_of_a_corpus_sums_counts_and_lengths() -> None:
    # c = 2 + 4 = 6, r = 3 + 4 = 7; every n-gram is right, so that the penalty exp(1 - 7/6) alone is left.
    corpus, each = bleu(["a b", "a b c d"], [["a b c"], ["a b c d"]])
    # Of two references at equal distance the shorter one counts: with r = 4, BLEU-1 would be exp(1 - 4/3).
    assert bleu(["a b c"], [["a b c d", "x y"]])[0][0] == pytest.approx(1.0)
    assert corpus == pytest.approx([math.exp(-1 / 6)] * 4)
    assert each[0, :2] == pytest.approx([math.exp(1 - 3 / 2)] * 2)
    assert each[1] == pytest.approx([1.0] * 4)


def test_rouge_is_the_f_measure_of_the_longest_common_subsequence() -> None:
    # a c d: P = 3/4, R = 3/5, and (1 + 1.44) · 0.45 / (0.6 + 1.44 · 0.75) = 1.098 / 1.68.
    assert rouge_l(["a b c d"], [["a c d e f"]])[0] == pytest.approx(1.098 / 1.68)
    # Precision and recall come from different references; an empty sentence matches an empty one alone.
    assert rouge_l(["a b", "", ""], [["a b c d", "a"], [""], ["word"]]).tolist() == pytest.approx([1, 1, 0])


def test_cider_is_ten_times_the_mean_cosine_over_four_orders() -> None:
    # Each n-gram is in the references of one of two samples: weight ln 2 - ln 1. Sample 0: the cosines are 1, 1, 0, 0.
    # Sample 1: c against c d is 1/√2 for unigrams; there is no bigram in c, one in c d: exp(-1/72).
    scores = cider(["a b", "c"], [["a b"], ["c d"]])
    assert scores[0] == pytest.approx(5.0)
    assert scores[1] == pytest.approx(10 / 4 / math.sqrt(2) * math.exp(-1 / 72))
    # Words of every sample, and a lone sample, are worth nothing.
    assert cider(["a", "a"], [["a"], ["a"]]).tolist() == [0, 0]
    assert cider(["a b c d e"], [["a b c d e"]]).tolist() == [0]


def test_cider_clips_what_a_hypothesis_repeats() -> None:
    # h = (2 ln 2), r = (ln 2): min(h, r) · r / (|h| |r|) = 1/2 for unigrams; a a has a bigram that a has not.
    assert cider(["a a", "b"], [["a"], ["b"]])[0] == pytest.approx(10 / 4 / 2 * math.exp(-1 / 72))


def test_no_samples_have_no_scores_and_samples_need_references() -> None:
    for references in ([["a"]], [["a"], []]):
        with pytest.raises(InputError, match="references of as many samples"):
            bleu(["a", "b"], references)
    corpus, each = bleu([], [])
    assert np.isnan(corpus).all()
    assert each.shape == (0, 4)
    assert len(rouge_l([], [])) == len(cider([], [])) == 0


@settings(max_examples=25)
@given(SAMPLES)
def test_scores_lie_in_their_ranges_and_perfect_ones_at_their_end(samples: list[tuple[str, list[str]]]) -> None:
    hypotheses, references = [each[0] for each in samples], [each[1] for each in samples]
    corpus, each = bleu(hypotheses, references)
    assert ((corpus >= 0) & (corpus <= 1)).all()
    assert ((each >= 0) & (each <= 1)).all()
    ciders = cider(hypotheses, references)
    assert ((ciders >= 0) & (ciders <= 10 + 1e-9)).all()
    assert rouge_l([sentences[0] for sentences in references], references) == pytest.approx(np.ones(len(samples)))


@settings(max_examples=25)
@given(SAMPLES, st.randoms(use_true_random=False))
def test_the_order_of_samples_and_references_decides_nothing(samples, random):
    rows = list(range(len(samples)))
    random.shuffle(rows)  # type: ignore[attr-defined]
    hypotheses, references = [each[0] for each in samples], [each[1] for each in samples]
    others = [hypotheses[row] for row in rows], [references[row][::-1] for row in rows]
    assert bleu(*others)[0] == pytest.approx(bleu(hypotheses, references)[0])
    assert rouge_l(*others) == pytest.approx(rouge_l(hypotheses, references)[rows])
    assert cider(*others) == pytest.approx(cider(hypotheses, references)[rows])


@settings(max_examples=25)
@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=70), st.lists(st.sampled_from("abc"), min_size=1))
def test_the_longest_common_subsequence_is_that_of_the_table(first: list[str], second: list[str]) -> None:
    length = longest_by_table(first, second)
    precision, recall = length / len(first), length / len(second)
    wanted = 2.44 * precision * recall / (recall + 1.44 * precision) if length else 0.0
    assert rouge_l([" ".join(first)], [[" ".join(second)]])[0] == pytest.approx(wanted)


def longest_by_table(first: Sequence[str], second: Sequence[str]) -> int:
    table = np.zeros((len(first) + 1, len(second) + 1), int)
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            table[i + 1, j + 1] = table[i, j] + 1 if a == b else max(table[i, j + 1], table[i + 1, j])
    return int(table[-1, -1])


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        # The right sides are what Stanford's tokenizer of pycocoevalcap gives.
        ("The chair (brown) is here.", "the chair -lrb- brown -rrb- is here"),
        ("don't can't it's John's the chairs' legs", "do n't ca n't it 's john 's the chairs legs"),
        ("I'd gonna cannot wanna", "i 'd gon na can not wan na"),
        ("twenty-three 3.5 1,000 10:30 9 o'clock", "twenty-three 3.5 1,000 10:30 9 o'clock"),
        ("a/b and/or TV's U.S. e.g. etc.", "a/b and/or tv 's u.s. e.g. etc."),
        ("\"quoted\" 'single' `back`", "quoted single back"),
        ("wait... what?! ok -- yes - no", "wait what ?! ok yes no"),
        ("naïve café – dash — em", "naïve café dash em"),
        ("it’s “good”\ta;b:c,d\nno1", "it 's good a b c d no1"),
        ("3D-aware 3x4 2-3", "3d-aware 3x4 2-3"),
        ("cannot (see) [it] {at} all", "can not -lrb- see -rrb- -lsb- it -rsb- -lcb- at -rcb- all"),
        ("Mr. X's table--big... ‘no’", "mr. x 's table big no"),
        ("", ""),
    ],
)
def test_python_tokens_are_those_of_the_penn_treebank_for_plain_texts(text: str, tokens: str) -> None:
    assert python_tokens(text) == tokens


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


def test_sentences_and_references_stay_with_their_samples() -> None:
    scores = score_sentences(
        ["A chair.", "two lamps", "x"], [["A chair."], ["one", "Two lamps!"], ["y z", "x"]], tokens="python",
        tools="no Java here",
    )  # fmt: skip
    assert scores.rouge_l_each.tolist() == pytest.approx([1, 1, 1])
    assert not scores.official
    assert math.isnan(scores.meteor)
    as_given = score_sentences(["A chair."], [["a chair"]], tokens="given", tools="no Java here")
    assert (as_given.official, as_given.tokens, as_given.rouge_l) == (True, "tokens as given", 0)
