"""BLEU-1 to 4, ROUGE-L and CIDEr of sentences, as pycocoevalcap 1.2 counts them.

Sentences are tokens with a blank between them; `python_tokens` makes such of a text without Java. All scores are of a
corpus of samples, each with one hypothesis and one or more references:

- BLEU-n (Papineni et al. 2002): exp(min(0, 1 - r/c)) · (Π_k p_k)^(1/n), where p_k is the number of k-grams of all
  hypotheses that their references have, each at most as often as in the reference that has it most often, by the number
  of k-grams; c is the number of tokens of all hypotheses, and r the sum of the reference lengths that are closest to
  each hypothesis, the shorter of two. Nothing is smoothed; 1e-15 and 1e-9 keep the ratios defined.
- ROUGE-L (Lin 2004): (1 + β²) P R / (R + β² P), β = 1.2, with the largest P and the largest R over the references,
  which may be of different ones; P and R are the longest common subsequence by the length of hypothesis and reference.
- CIDEr, in the variant that the package computes (CIDEr-D, Vedantam et al. 2015): 10 times the mean over n = 1…4 and
  the references of exp(-δ² / 72) · min(h, r)·r / (|h| |r|), with h and r the tf-idf vectors of the n-grams, δ the
  difference of the numbers of bigrams, and the document frequencies over the references of the corpus, so that a score
  depends on all samples, and is 0 where there is only one.
"""

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError

ORDER = 4
"""Longest n-grams."""
BETA = 1.2
SIGMA = 6.0
TINY, SMALL = 1e-15, 1e-9
PUNCTUATION = frozenset(("''", "'", "``", "`", ".", "?", "!", ",", ":", "-", "--", "...", ";"))
"""Tokens that are left out. The package lists brackets, too, but as -LRB-, which its lower-cased tokens never equal;
they are kept, as it keeps them."""
PYTHON_TOKENS = "Python tokens"
"""Name of what `python_tokens` gives, for the heads of columns."""

Ngram = tuple[str, ...]

_BRACKETS = {"(": "-lrb-", ")": "-rrb-", "[": "-lsb-", "]": "-rsb-", "{": "-lcb-", "}": "-rcb-"}
_PLAIN = str.maketrans({"’": "'", "‘": "`", "“": '"', "”": '"', "–": "--", "—": "--", "…": "..."})
_TOKEN = re.compile(
    r"""
    (?:[^\W\d_]\.){2,}                              # u.s.  a.m.
    | (?:mr|mrs|ms|dr|jr|sr|st|vs|etc)\.            # abbreviations with their dot
    | o'clock\b
    | '(?:s|d|m|re|ve|ll)\b                         # what is left of a contraction
    | [^\W_]+(?:(?:[-/.@'_]|(?<=\d)[,:](?=\d))[^\W_]+)*  # words and numbers: twenty-three  3.5  10:30  a/b
    | \.{2,} | [?!]+ | -+ | \*+ | [^\w\s] | _
    """,
    re.VERBOSE,
)
_CONTRACTION = re.compile(r"(.+?)(n't|'(?:s|d|m|re|ve|ll))")
_FUSED = {
    "cannot": "can not",
    "gonna": "gon na",
    "wanna": "wan na",
    "gotta": "got ta",
    "gimme": "gim me",
    "lemme": "lem me",
}


def python_tokens(text: str) -> str:
    """Tokens of an English text in the manner of the Penn Treebank, lower case, without the `PUNCTUATION`.

    It follows Stanford's PTB tokenizer on what answers and captions are made of: words with hyphens stay whole
    (twenty-three), contractions are cut (do n't, table 's), so is punctuation at the end of a word. It is another
    tokenizer all the same: scores that rest on it say so.

    Args:
        text: of one sample; line breaks count as blanks.

    Returns:
        The tokens with one blank between them; empty where nothing is left.
    """
    tokens: list[str] = []
    for match in _TOKEN.findall(text.lower().translate(_PLAIN)):
        if match in _BRACKETS:
            tokens.append(_BRACKETS[match])
        elif match in _FUSED:
            tokens += _FUSED[match].split()
        elif set(match) == {"-"}:
            tokens.append(match[:2])
        elif set(match) == {"."}:
            tokens.append("...")
        elif match != "o'clock" and (parts := _CONTRACTION.fullmatch(match)):
            tokens += parts.groups()
        else:
            tokens += _apart(match)
    return " ".join(token for token in tokens if token not in PUNCTUATION and token != '"')


def _apart(word: str) -> list[str]:
    """A word with an apostrophe inside that is no contraction, such as rock'n'roll, at the apostrophes."""
    return [word] if word == "o'clock" or "'" not in word.strip("'") else re.findall(r"'?[^']+", word)


def bleu(
    hypotheses: Sequence[str], references: Sequence[Sequence[str]]
) -> tuple[Float64[np.ndarray, "4"], Float64[np.ndarray, "N 4"]]:
    """BLEU-1 to 4 of a corpus, and of each sample alone.

    Args:
        hypotheses: tokens of each sample with blanks between them.
        references: one or more such sentences for each sample.

    Returns:
        Scores in [0, 1]: of the corpus, NaN without samples, and one row a sample, of which that of the corpus is no
        mean.

    Raises:
        InputError: another number of references than of hypotheses, or a sample without references.
    """
    _check(hypotheses, references)
    correct, guessed = np.zeros((2, len(hypotheses), ORDER), np.int64)
    lengths = np.zeros((len(hypotheses), 2), np.int64)
    for row, (hypothesis, sentences) in enumerate(zip(hypotheses, references, strict=True)):
        tokens = hypothesis.split()
        most: Counter[Ngram] = Counter()
        for sentence in sentences:
            most |= _ngrams(sentence.split())
        for ngram, count in _ngrams(tokens).items():
            correct[row, len(ngram) - 1] += min(most[ngram], count)
        guessed[row] = np.maximum(len(tokens) - np.arange(ORDER), 0)
        closest = min((abs(len(s.split()) - len(tokens)), len(s.split())) for s in sentences)[1]
        lengths[row] = len(tokens), closest
    each = _bleu(correct, guessed, lengths)
    corpus = _bleu(correct.sum(0, keepdims=True), guessed.sum(0, keepdims=True), lengths.sum(0, keepdims=True))[0]
    return (corpus if len(hypotheses) else np.full(ORDER, np.nan)), each


def rouge_l(hypotheses: Sequence[str], references: Sequence[Sequence[str]]) -> Float64[np.ndarray, "N"]:
    """ROUGE-L of each sample, whose mean is the score of the corpus; arguments and errors as of `bleu`.

    A sentence is cut at every single blank here, as the package does, so that an empty one is one empty token, and
    equals another empty one.
    """
    _check(hypotheses, references)
    scores = np.zeros(len(hypotheses))
    for row, (hypothesis, sentences) in enumerate(zip(hypotheses, references, strict=True)):
        tokens = hypothesis.split(" ")
        others = [sentence.split(" ") for sentence in sentences]
        common = [_common_subsequence(tokens, other) for other in others]
        precision = max(common) / len(tokens)
        recall = max(count / len(other) for count, other in zip(common, others, strict=True))
        if precision and recall:
            scores[row] = (1 + BETA**2) * precision * recall / (recall + BETA**2 * precision)
    return scores


def cider(hypotheses: Sequence[str], references: Sequence[Sequence[str]]) -> Float64[np.ndarray, "N"]:
    """CIDEr of each sample, in [0, 10], whose mean is the score of the corpus; arguments and errors as of `bleu`."""
    _check(hypotheses, references)
    counts = [[_ngrams(sentence.split()) for sentence in sentences] for sentences in references]
    documents = Counter(ngram for sample in counts for ngram in set().union(*sample))
    total = np.log(max(len(hypotheses), 1))
    values = {count: float(total - np.log(count)) for count in set(documents.values())}
    weights = {ngram: values[count] for ngram, count in documents.items()}
    scores = np.zeros(len(hypotheses))
    for row, (hypothesis, sample) in enumerate(zip(hypotheses, counts, strict=True)):
        vector, norms, length = _tf_idf(_ngrams(hypothesis.split()), weights, float(total))
        for other in sample:
            terms, other_norms, other_length = _tf_idf(other, weights, float(total))
            products = np.zeros(ORDER)
            for ngram, value in vector.items():
                if ngram in terms:
                    products[len(ngram) - 1] += min(value, terms[ngram]) * terms[ngram]
            scale = norms * other_norms
            cosines = np.divide(products, scale, out=products.copy(), where=scale != 0)
            scores[row] += cosines.mean() * np.exp(-((length - other_length) ** 2) / (2 * SIGMA**2))
        scores[row] *= 10 / len(sample)
    return scores


def _check(hypotheses: Sequence[str], references: Sequence[Sequence[str]]) -> None:
    if len(hypotheses) != len(references):
        raise InputError(f"{len(hypotheses)} hypotheses and references of {len(references)} samples; expected as many")
    without = next((row for row, sentences in enumerate(references) if not len(sentences)), None)
    if without is not None:
        raise InputError(f"sample {without} has no references; expected one or more sentences")


def _ngrams(tokens: Sequence[str]) -> Counter[Ngram]:
    """How often each n-gram of 1 to 4 tokens is there."""
    sizes = range(1, min(ORDER, len(tokens)) + 1)
    return Counter(tuple(tokens[at : at + size]) for size in sizes for at in range(len(tokens) - size + 1))


def _bleu(correct: np.ndarray, guessed: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    precisions = np.cumprod((correct + TINY) / (guessed + SMALL), axis=1)
    scores = precisions ** (1 / np.arange(1, ORDER + 1))
    ratios = (lengths[:, :1] + TINY) / (lengths[:, 1:] + SMALL)
    return scores * np.exp(np.minimum(1 - 1 / ratios, 0))


def _common_subsequence(first: Sequence[str], second: Sequence[str]) -> int:
    """Length of the longest common subsequence, a bit of one integer for each token of `first` (Hyyrö 2004)."""
    positions: dict[str, int] = {}
    for row, token in enumerate(first):
        positions[token] = positions.get(token, 0) | 1 << row
    every = (1 << len(first)) - 1
    state = every
    for token in second:
        matches = state & positions.get(token, 0)
        state = ((state + matches) | (state - matches)) & every
    return len(first) - state.bit_count()


def _tf_idf(
    counts: Counter[Ngram], weights: dict[Ngram, float], unseen: float
) -> tuple[dict[Ngram, float], np.ndarray, int]:
    """The vector of a sentence, its norm for each n, and the number of bigrams."""
    vector = {ngram: count * weights.get(ngram, unseen) for ngram, count in counts.items()}
    squares = np.zeros(ORDER)
    for ngram, value in vector.items():
        squares[len(ngram) - 1] += value**2
    return vector, np.sqrt(squares), sum(count for ngram, count in counts.items() if len(ngram) == 2)
