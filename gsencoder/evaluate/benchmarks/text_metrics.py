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

The PTB tokenizer and METEOR exist in Java only, and run where Java and the package pycocoevalcap are installed. The
package brings Stanford's tokenizer (CoreNLP 3.4.1) and METEOR 1.5 as archives, which are run with the options that its
own code gives them; none of its Python code is imported. METEOR (Denkowski and Lavie 2014) of a corpus comes from the
counts of all samples, and is no mean of theirs.
"""

import math
import os
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.evaluate.tables import mean_of

ORDER = 4
"""Longest n-grams."""
BETA = 1.2
SIGMA = 6.0
TINY, SMALL = 1e-15, 1e-9
PUNCTUATION = frozenset(("''", "'", "``", "`", ".", "?", "!", ",", ":", "-", "--", "...", ";"))
"""Tokens that are left out. The package lists brackets, too, but as -LRB-, which its lower-cased tokens never equal;
they are kept, as it keeps them."""

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
            # A word with an apostrophe inside that is no contraction, such as rock'n'roll, is cut at the apostrophes.
            whole = match == "o'clock" or "'" not in match.strip("'")
            tokens += [match] if whole else re.findall(r"'?[^']+", match)
    return " ".join(token for token in tokens if token not in PUNCTUATION and token != '"')


def bleu(
    hypotheses: Sequence[str], references: Sequence[Sequence[str]]
) -> tuple[Float64[np.ndarray, "4"], Float64[np.ndarray, "N 4"]]:
    """BLEU-1 to 4 of a corpus, and of each sample alone.

    Args:
        hypotheses: tokens of each sample with blanks between them.
        references: one or more such sentences for each sample.

    Returns:
        Of the corpus, NaN without samples, and one row a sample, of which that of the corpus is no mean.
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
    """ROUGE-L of each sample, whose mean is the score of the corpus; arguments as of `bleu`.

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
    """CIDEr of each sample, in [0, 10], whose mean is the score of the corpus; arguments as of `bleu`."""
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
    if len(hypotheses) != len(references) or not all(map(len, references)):
        raise InputError(f"{len(hypotheses)} hypotheses: expected references of as many samples, one or more of each")


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


PACKAGE = "pycocoevalcap"
TOKENIZER, METEOR = "tokenizer/stanford-corenlp-3.4.1.jar", "meteor/meteor-1.5.jar"
SECONDS = 1800
"""Longest time that Java may take for all sentences."""
# The system's encoding decides otherwise, so that é is two characters under one locale and one under another.
ENCODING = ("-Dfile.encoding=UTF-8", "-Dstdout.encoding=UTF-8", "-Duser.language=en")
_BREAKS = re.compile(r"[\r\n\v\f\x1c-\x1e\x85\u2028\u2029]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class JavaTools:
    """Where Java and the archives are."""

    java: str
    folder: Path


def find_java_tools() -> JavaTools | str:
    """Java and the archives, or the reason why they cannot be run, as a clause."""
    java = shutil.which("java")
    if java is None:
        return "no Java: the program java is not in the path"
    spec = find_spec(PACKAGE)
    folder = next(iter(spec.submodule_search_locations or ()), None) if spec else None
    if folder is None:
        return f"the package {PACKAGE} is not installed (pip install {PACKAGE}==1.2)"
    absent = next((name for name in (TOKENIZER, METEOR) if not (Path(folder) / name).is_file()), None)
    return f"{folder} lacks {absent}" if absent else JavaTools(java=java, folder=Path(folder))


def ptb_tokens(texts: Sequence[str], tools: JavaTools) -> list[str]:
    """Tokens of the Penn Treebank, lower case, without punctuation, with one blank between them, as
    pycocoevalcap's PTBTokenizer gives them.

    Line breaks inside a text count as blanks. The package replaces \\n alone and reads other breaks as ends of a text,
    after which all later ones belong to the wrong samples.
    """
    lines = [" ".join(_BREAKS.sub(" ", text).split()) for text in texts]
    rows = [row for row, line in enumerate(lines) if line]
    tokens = [""] * len(texts)
    if not rows:
        return tokens
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sentences.txt"
        file.write_bytes("\n".join(lines[row] for row in rows).encode("utf-8", "replace"))
        command = [tools.java, *ENCODING, "-cp", str(tools.folder / TOKENIZER)]
        command += ["edu.stanford.nlp.process.PTBTokenizer", "-preserveLines", "-lowerCase", str(file)]
        output = _run(command, "the PTB tokenizer")
    cut = output.removesuffix("\n").split("\n")
    if len(cut) != len(rows):
        raise InputError(f"the PTB tokenizer gave {len(cut):,} lines for {len(rows):,} texts; expected as many")
    for row, line in zip(rows, cut, strict=True):
        tokens[row] = " ".join(token for token in line.rstrip().split(" ") if token not in PUNCTUATION)
    return tokens


def meteor(hypotheses: Sequence[str], references: Sequence[Sequence[str]], tools: JavaTools) -> float:
    """METEOR 1.5 for English of a corpus, NaN without samples; arguments as of `bleu`."""
    if not hypotheses:
        return math.nan
    lines = [
        "SCORE ||| " + " ||| ".join([*map(_field, sentences), _field(hypothesis).replace("  ", " ")])
        for hypothesis, sentences in zip(hypotheses, references, strict=True)
    ]
    command = [tools.java, *ENCODING, "-Xmx2G", "-jar", str(tools.folder / METEOR)]
    command += ["-", "-", "-stdio", "-l", "en", "-norm"]
    # The counts of all samples make the score of the corpus, so METEOR runs once for each.
    counts = _run(command, "METEOR", lines).splitlines()
    scores = _run(command, "METEOR", [" ||| ".join(["EVAL", *map(str.strip, counts)])]).splitlines()
    if not len(counts) == len(scores) - 1 == len(lines):
        raise InputError(f"METEOR gave {len(counts):,} counts and {len(scores):,} scores for {len(lines):,} samples")
    return float(scores[-1])


def _field(sentence: str) -> str:
    """A sentence as METEOR's protocol takes one: no line breaks, and not what separates two sentences."""
    return _BREAKS.sub(" ", sentence).replace("|||", "")


def _run(command: Sequence[str], subject: str, lines: Sequence[str] = ()) -> str:
    """What a program writes, given lines of input."""
    data = "".join(f"{line}\n" for line in lines).encode("utf-8", "replace")
    # Options for Java say what they do in the output.
    options = ("JAVA_TOOL_OPTIONS", "_JAVA_OPTIONS")
    environment = {name: value for name, value in os.environ.items() if name not in options}
    try:
        process = subprocess.run(
            command, input=data, capture_output=True, timeout=SECONDS, env=environment, check=False
        )
    except (subprocess.TimeoutExpired, OSError) as error:
        raise InputError(f"{subject}: Java cannot be run, or not within {SECONDS:,} seconds: {error}") from error
    if process.returncode:
        end = " ".join(process.stderr.decode("utf-8", "replace").split())[-200:]
        raise InputError(f"{subject}: Java ended with code {process.returncode}: {end or 'it said nothing'}")
    return process.stdout.decode("utf-8", "replace")


Tokens = Literal["auto", "python", "given"]
"""How texts become tokens: "auto" = PTB tokens where Java is there, else as "python"; "given" = they are tokens with
blanks between them already."""
TOKEN_NAMES = {"auto": "PTB tokens", "python": "Python tokens", "given": "tokens as given"}
"""For the heads of columns."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SentenceScores:
    """Scores of a corpus and of each of its N samples, as fractions; those of the corpus are NaN without samples.

    Attributes:
        tokens: name of the tokens that all scores rest on.
        official: whether they are those of the official script. If not, columns name them.
        bleu: BLEU-1 to 4.
        meteor: NaN where Java is missing.
        cider: in [0, 10].
        absent: why a column has no value.
    """

    tokens: str
    official: bool
    bleu: tuple[float, ...]
    meteor: float
    rouge_l: float
    cider: float
    bleu_each: Float64[np.ndarray, "N 4"]
    rouge_l_each: Float64[np.ndarray, "N"]
    cider_each: Float64[np.ndarray, "N"]
    absent: dict[str, str]


def sentence_figures(scores: SentenceScores) -> dict[str, float]:
    """The figures by column; columns name their tokens where these are not those of the official script."""
    figures = {f"bleu_{n}": value for n, value in enumerate(scores.bleu, start=1)}
    figures |= {"meteor": scores.meteor, "rouge_l": scores.rouge_l, "cider": scores.cider}
    return figures if scores.official else {f"{name} ({scores.tokens})": value for name, value in figures.items()}


def score_sentences(
    hypotheses: Sequence[str],
    references: Sequence[Sequence[str]],
    *,
    tokens: Tokens = "auto",
    tools: JavaTools | str | None = None,
) -> SentenceScores:
    """Scores one sentence a sample against its references.

    Args:
        hypotheses: one a sample; empty where there is none, which scores 0 and counts as a sample.
        references: one or more for each sample.
        tools: of `find_java_tools`, a reason for going without, or None = look for them.
    """
    tools = find_java_tools() if tools is None else tools
    if tokens == "auto" and isinstance(tools, str):
        tokens = "python"
    if tokens != "given":
        # All sentences at once, since Java takes a second to start.
        texts = [*hypotheses, *(sentence for sentences in references for sentence in sentences)]
        if isinstance(tools, JavaTools) and tokens == "auto":
            cut = ptb_tokens(texts, tools)
        else:
            cut = list(map(python_tokens, texts))
        rest = iter(cut)
        hypotheses = [next(rest) for _ in hypotheses]
        references = [[next(rest) for _ in sentences] for sentences in references]
    corpus_bleu, each_bleu = bleu(hypotheses, references)
    each_rouge, each_cider = rouge_l(hypotheses, references), cider(hypotheses, references)
    return SentenceScores(
        tokens=TOKEN_NAMES[tokens],
        official=tokens != "python",
        bleu=tuple(corpus_bleu.tolist()),
        meteor=math.nan if isinstance(tools, str) else meteor(hypotheses, references, tools),
        rouge_l=mean_of(each_rouge),
        cider=mean_of(each_cider),
        bleu_each=each_bleu,
        rouge_l_each=each_rouge,
        cider_each=each_cider,
        absent={"METEOR": tools} if isinstance(tools, str) else {},
    )


Lemmatize = Callable[[str], str]


def wordnet_lemmatizer() -> Lemmatize | str:
    """The noun lemma of a word by nltk's WordNetLemmatizer, or the reason why there is none, as a clause."""
    try:
        lemmatize: Lemmatize = import_module("nltk.stem").WordNetLemmatizer().lemmatize
    except ImportError:
        return "the package nltk is not installed (pip install nltk)"
    try:
        lemmatize("chairs")
    except (LookupError, OSError):
        return "nltk has no data of WordNet (python -m nltk.downloader wordnet)"
    return lemmatize


def f_value(answer: str, references: Sequence[str], lemmatize: Lemmatize) -> float:
    """ScanQA's F-value of an answer (scripts/score.py): 1 if it is one of the references, else its best F1 with one.

    With the lemmas of the words between blanks, in the case they are written in: precision is the share of the answer's
    words that the reference has, recall that of the reference's words that the answer has; repeated words count
    repeatedly. It is 0 where one of both has no words, where the script ends with an error.
    """
    if answer in references:
        return 1.0
    words = [lemmatize(word) for word in answer.split()]
    return max((_f1(words, [lemmatize(word) for word in each.split()]) for each in references), default=0.0)


def _f1(first: Sequence[str], second: Sequence[str]) -> float:
    if not first or not second:
        return 0.0
    precision = sum(word in second for word in first) / len(first)
    recall = sum(word in first for word in second) / len(second)
    return 2 * (recall * precision) / (recall + precision) if recall + precision else 0.0
