"""BLEU, METEOR, ROUGE-L and CIDEr of a set of sentences, and a statement of the tokens that they were counted on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.evaluate.scores.java_metrics import PTB_TOKENS, JavaTools, find_java_tools, meteor, ptb_tokens
from gsencoder.evaluate.scores.means import mean_of
from gsencoder.evaluate.scores.ngrams import ORDER, PYTHON_TOKENS, bleu, cider, python_tokens, rouge_l

Tokens = Literal["auto", "ptb", "python", "given"]
"""How texts become tokens: "ptb" through Java, "python" without, "auto" = "ptb" where Java is there, else "python";
"given" = they are tokens with blanks between them already."""
GIVEN_TOKENS = "tokens as given"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SentenceScores:
    """Scores of N samples; those of the corpus are NaN without samples, and fractions: tables show 100 times as much.

    Attributes:
        tokens: name of the tokens that all scores rest on.
        official: whether they are those of the official script. If not, `columns` names them in every head.
        bleu: BLEU-1 to 4 of the corpus.
        meteor: of the corpus; None where Java is missing.
        rouge_l: mean of the samples.
        cider: mean of the samples, in [0, 10].
        bleu_each: BLEU-1 to 4 of each sample alone.
        meteor_each: of each sample; None where Java is missing.
        rouge_l_each: of each sample.
        cider_each: of each sample, with the document frequencies of all.
        absent: why a column has no value.
    """

    tokens: str
    official: bool
    bleu: tuple[float, float, float, float]
    meteor: float | None
    rouge_l: float
    cider: float
    bleu_each: Float64[np.ndarray, "N 4"]
    meteor_each: Float64[np.ndarray, "N"] | None
    rouge_l_each: Float64[np.ndarray, "N"]
    cider_each: Float64[np.ndarray, "N"]
    absent: dict[str, str]

    def columns(self) -> dict[str, float | None]:
        """Head and value of each column; None where it is absent."""
        values: dict[str, float | None] = {f"BLEU-{n + 1}": self.bleu[n] for n in range(ORDER)}
        values |= {"METEOR": self.meteor, "ROUGE-L": self.rouge_l, "CIDEr": self.cider}
        return {name if self.official else f"{name} ({self.tokens})": value for name, value in values.items()}


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
        tokens: see `Tokens`.
        tools: of `find_java_tools`, a reason for going without, or None = look for them.

    Raises:
        InputError: "ptb" without Java, or samples without references.
    """
    tools = find_java_tools() if tools is None else tools
    if tokens == "ptb" and isinstance(tools, str):
        raise InputError(f"PTB tokens need Java and its archives: {tools}; or take tokens=python")
    ptb = tokens in ("auto", "ptb") and not isinstance(tools, str)
    if tokens == "given":
        candidates, truths = list(hypotheses), [list(sentences) for sentences in references]
    else:
        candidates, truths = _tokenized(hypotheses, references, tools if ptb else None)
    each_bleu = bleu(candidates, truths)
    each_rouge, each_cider = rouge_l(candidates, truths), cider(candidates, truths)
    corpus_meteor, candidate_meteors = (None, None) if isinstance(tools, str) else meteor(candidates, truths, tools)
    b1, b2, b3, b4 = each_bleu[0].tolist()
    return SentenceScores(
        tokens=GIVEN_TOKENS if tokens == "given" else PTB_TOKENS if ptb else PYTHON_TOKENS,
        official=ptb or tokens == "given",
        bleu=(b1, b2, b3, b4),
        meteor=corpus_meteor,
        rouge_l=mean_of(each_rouge),
        cider=mean_of(each_cider),
        bleu_each=each_bleu[1],
        meteor_each=candidate_meteors,
        rouge_l_each=each_rouge,
        cider_each=each_cider,
        absent={"METEOR": tools} if isinstance(tools, str) else {},
    )


def _tokenized(
    hypotheses: Sequence[str], references: Sequence[Sequence[str]], tools: JavaTools | str | None
) -> tuple[list[str], list[list[str]]]:
    """All sentences at once, since Java takes a second to start."""
    texts = [*hypotheses, *(sentence for sentences in references for sentence in sentences)]
    cut = ptb_tokens(texts, tools) if isinstance(tools, JavaTools) else [python_tokens(text) for text in texts]
    rest = iter(cut[len(hypotheses) :])
    return cut[: len(hypotheses)], [[next(rest) for _ in sentences] for sentences in references]
