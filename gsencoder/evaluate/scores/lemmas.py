"""The F-value of ScanQA: F1 over lemmas, which WordNet knows where nltk and its data are installed."""

from collections.abc import Callable, Sequence
from importlib import import_module

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

    Args:
        answer: the predicted one.
        references: right ones.
        lemmatize: of `wordnet_lemmatizer`.
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
