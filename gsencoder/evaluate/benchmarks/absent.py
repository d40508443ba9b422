"""Absent words: how well the probabilities of words tell those that are in a room from those that are not.

In each scene two groups of words are asked: the names of objects that are seen well enough (small ones and furniture),
which are present, and the names of the other scenes' objects that this one does not have, which are absent. A name of
which the scene has only objects that are hardly seen is in neither group. The probability of a word is that of
`gsencoder.types.Localization`.
"""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.errors import InputError, SceneWarning, counted, error_prefix
from gsencoder.core.settings import option
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.evaluate.benchmarks.localization import is_seen
from gsencoder.evaluate.benchmarks.protocol import Benchmark, Evaluation, Protocol, SceneResult, names_of
from gsencoder.evaluate.tables import ScoreReport, grouped, mean_of, table_of
from gsencoder.infer.localize import localize
from gsencoder.text.vocabulary import check_known
from gsencoder.types import GaussianFeatures, Scene, SceneObject

BINS = 10
"""Bins of probability, of equal width, of the calibration error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AbsentProtocol(Protocol):
    """Selection of the words that are asked."""

    name: Literal["absent"] = "absent"
    vocabulary: tuple[str, ...] = option(
        (), "names that may be absent; empty = the names of all scenes' objects", names=True
    )
    min_views: int = option(5, "smallest number of views in which an object must be seen to be present", ge=0)
    min_pixels: int = option(60, "smallest area in its best view that an object must have to be present, pixels", ge=0)

    def start(self, evaluation: Evaluation) -> "AbsentBenchmark":
        return AbsentBenchmark(self, evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class WordPresence:
    """One word asked in one scene: whether an object has this name, the probability by `localize`, and whether there is
    a box."""

    word: str
    present: bool
    probability: float
    boxed: bool


Asked = tuple[WordPresence, ...]
"""The words asked in one scene."""


class AbsentBenchmark(Benchmark[Asked]):
    def __init__(self, protocol: AbsentProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation
        with error_prefix("protocol.vocabulary"):
            check_known(evaluation.words, protocol.vocabulary)
        self.vocabulary = protocol.vocabulary or names_of(evaluation.scenes())

    def check(self, scene: Scene) -> Scene:
        return with_counted_views(scene)

    def predict(self, scene: Scene, features: GaussianFeatures) -> Asked:
        present, absent = words_to_ask(
            scene.objects, self.vocabulary, min_views=self.protocol.min_views, min_pixels=self.protocol.min_pixels
        )
        if not (names := [*present, *absent]):
            return ()
        asked_scene = replace(scene, features={features.space.name: features})
        with warnings.catch_warnings():
            # That words have no box is the result here, not a fault.
            warnings.filterwarnings("ignore", ".*words have no box", SceneWarning)
            result = localize(asked_scene, names, self.evaluation.words, self.evaluation.localization)
        boxless = result.absent
        return tuple(
            WordPresence(
                word=name, present=row < len(present), probability=float(probability), boxed=name not in boxless
            )
            for row, (name, probability) in enumerate(zip(names, result.probabilities, strict=True))
        )

    def report(self, results: Sequence[SceneResult[Asked]]) -> ScoreReport:
        scenes = [result.value for result in results]
        scores, names = absent_scores(scenes), probabilities_by_word(scenes)
        shares = ("auroc", "calibration_error", "brier", "boxed_present", "boxed_absent")
        return ScoreReport(
            results={"protocol": "absent", **scores, "names": names, "scenes": [result.scene for result in results]},
            table=table_of("Absent words", {self.evaluation.method: {name: scores[name] for name in shares}}),
            rows={
                "names": [{"name": name, **row} for name, row in names.items()],
                "words": [{"scene": result.scene, **asdict(word)} for result in results for word in result.value],
            },
            line=f"{scores['present']} present and {counted(scores['absent'], 'absent word')} in "
            f"{counted(len(results), 'scene')}: AUROC {scores['auroc']:.3f} ± {scores['auroc_se']:.3f}, calibration "
            f"error {scores['calibration_error']:.3f}, Brier {scores['brier']:.3f}; given a box: "
            f"{scores['boxed_present']:.3f} of the present, {scores['boxed_absent']:.3f} of the absent",
        )


def words_to_ask(
    objects: Sequence[SceneObject], vocabulary: Iterable[str], *, min_views: int = 5, min_pixels: int = 60
) -> tuple[list[str], list[str]]:
    """The present and the absent words of a scene, each in alphabetical order."""
    with_names = [each for each in objects if each.name]
    present = {each.name for each in with_names if is_seen(each, min_views=min_views, min_pixels=min_pixels)}
    return sorted(name for name in present if name), sorted(set(vocabulary) - {each.name for each in with_names})


def auroc(present: Bool[np.ndarray, " n"], probability: Float64[np.ndarray, " n"]) -> float:
    """Area under the ROC curve: the share of pairs (present, absent) in which the present word is more probable, ties
    counting one half; NaN where one group is empty."""
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(present, probability)) if present.any() and not present.all() else math.nan


def auroc_standard_error(
    present: Bool[np.ndarray, " n"], probability: Float64[np.ndarray, " n"], scene: Int64[np.ndarray, " n"]
) -> float:
    """Standard error of the AUROC over scenes, by leaving out one at a time (jackknife): words of one scene are not
    independent of each other. NaN with fewer than two scenes."""
    scenes = np.unique(scene)
    if len(scenes) < 2:
        return math.nan
    values = np.array([auroc(present[scene != each], probability[scene != each]) for each in scenes])
    return float(np.sqrt((len(scenes) - 1) / len(scenes) * ((values - values.mean()) ** 2).sum()))


def reliability(
    present: Bool[np.ndarray, " n"], probability: Float64[np.ndarray, " n"], bins: int = BINS
) -> list[dict[str, Any]]:
    """Of each bin of probability, all of equal width: its words, their mean probability, and the share that is present.

    A probability on an edge belongs to the bin above; 1 to the last one. Empty bins are left out.
    """
    number = np.minimum((probability * bins).astype(np.int64), bins - 1)
    return [
        {
            "from": index / bins,
            "to": (index + 1) / bins,
            "words": int((number == index).sum()),
            "probability": float(probability[number == index].mean()),
            "present": float(present[number == index].mean()),
        }
        for index in np.unique(number).tolist()
    ]


def calibration_error(
    present: Bool[np.ndarray, " n"], probability: Float64[np.ndarray, " n"], bins: int = BINS
) -> float:
    """Expected calibration error (Naeini et al. 2015): the distance of mean probability and share present, averaged
    over bins of equal width by the words in them; NaN without words."""
    if not len(present):
        return math.nan
    rows = reliability(present, probability, bins)
    return sum(row["words"] * abs(row["probability"] - row["present"]) for row in rows) / len(present)


def absent_scores(scenes: Sequence[Asked]) -> dict[str, Any]:
    """The metrics of the protocol over all words of all scenes.

    Returns:
        present and absent (numbers of words), auroc and auroc_se, calibration_error, brier (mean squared difference of
        probability and presence), boxed_present and boxed_absent (shares of the words that were given a box), and
        reliability.
    """
    words = [word for scene in scenes for word in scene]
    present = np.array([word.present for word in words], bool)
    probability = np.array([word.probability for word in words], np.float64)
    boxed = np.array([word.boxed for word in words], bool)
    scene = np.array([number for number, each in enumerate(scenes) for _ in each], np.int64)
    if present.all() or not present.any():
        raise InputError(
            f"absent: expected words that are present and words that are absent, got {int(present.sum())} and "
            f"{int((~present).sum())}; give more scenes, or names that they do not have as protocol.vocabulary="
        )
    return {
        "present": int(present.sum()),
        "absent": int((~present).sum()),
        "auroc": auroc(present, probability),
        "auroc_se": auroc_standard_error(present, probability, scene),
        "calibration_error": calibration_error(present, probability),
        "brier": float(((probability - present) ** 2).mean()),
        "boxed_present": float(boxed[present].mean()),
        "boxed_absent": float(boxed[~present].mean()),
        "reliability": reliability(present, probability),
    }


def probabilities_by_word(scenes: Sequence[Asked]) -> dict[str, dict[str, Any]]:
    """For each word the numbers of scenes in which it is present and absent, and its mean probability in both; the
    words that these tell least apart come first. Means without scenes are NaN."""
    table = {}
    for word, asked in grouped((word for scene in scenes for word in scene), "word").items():
        present, absent = ([each.probability for each in asked if each.present == there] for there in (True, False))
        table[word] = {
            "present": len(present),
            "absent": len(absent),
            "probability_present": mean_of(present),
            "probability_absent": mean_of(absent),
        }

    def gap(word: str) -> float:
        row = table[word]
        present = row["probability_present"] if row["present"] else 1.0
        return float(present - (row["probability_absent"] if row["absent"] else 0.0))

    return {word: table[word] for word in sorted(table, key=lambda word: (gap(word), word))}
