"""Probabilities of boxes: the evidence against a plain twin, laws of the model, and words that are absent."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float32
from rooms import splat

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer import localize as module
from gsencoder.infer.localize import (
    LocalizeConfig,
    WordCandidates,
    find_candidates,
    localize,
    select_features,
    words_to_json,
)
from gsencoder.infer.relevancy import (
    LEAST_ATTAINABLE,
    TRAINED,
    UNTRAINED,
    WITH_RIVALS,
    WITHOUT_RIVALS,
    Cluster,
    Evidence,
    Presence,
    ThresholdConfig,
    probability,
    relevancy,
)
from gsencoder.text.table import TextEncoder, TextTable, make_text_table, unit
from gsencoder.types import FeatureBasis, GaussianFeatures, Localization, Scene

WORDS = ("mug", "cup", "chair", "lamp", "spoon")
EVERYTHING = LocalizeConfig(min_probability=0.0)
STEP = 0.02


def make_table() -> TextTable:
    """Five words about a common mean; cup is nearly mug, the others are at right angles."""
    axes = np.eye(16)[1:6]
    axes[1] = 0.9 * axes[0] + math.sqrt(1 - 0.81) * axes[1]
    vectors = axes * 0.4
    vectors[:, 0] = math.sqrt(1 - 0.16)
    return make_text_table(WORDS, vectors, "toy")


TABLE = make_table()


class Phrases:
    """A text encoder that is no table: it has no names."""

    space, mean = TABLE.space, TABLE.mean

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        return TABLE.encode(words)


def make_scene(strength: float = 1.0, *, basis: bool = False) -> Scene:
    """A floor that is no word, a mug on it, and a chair that looks a little like a spoon."""
    rng = np.random.default_rng(7)
    floor = np.stack(np.meshgrid(np.arange(50) * STEP, np.arange(40) * STEP, [0.0]), axis=-1).reshape(-1, 3)
    cube = np.stack(np.meshgrid(*[np.arange(5) * STEP] * 3), axis=-1).reshape(-1, 3)
    places = np.array([[0.2, 0.2, 0.3], [0.7, 0.5, 0.3]])
    means = np.concatenate([floor, cube + places[0], cube + places[1]]).astype(np.float32)
    mug, chair, spoon = (TABLE.embeddings[WORDS.index(word)] - TABLE.mean for word in ("mug", "chair", "spoon"))
    kinds = (0.4 * np.eye(16)[10], strength * mug, chair + spoon / 2)
    away = np.repeat(kinds, (len(floor), 125, 125), axis=0)
    features = (TABLE.mean + away + rng.normal(0, 0.02, away.shape)).astype(np.float32)
    weights = rng.uniform(0.5, 2, len(means)).astype(np.float32)
    space, stored_basis = replace(TABLE.space, teacher="labels"), None
    if basis:
        rows = np.linalg.qr(rng.normal(size=(16, 12)))[0].T.astype(np.float32)
        stored_basis = FeatureBasis(mean=TABLE.mean, components=rows, energy_kept=1.0, space=space)
        features = ((features - TABLE.mean) @ rows.T).astype(np.float32)
    fused = GaussianFeatures(features=features, weights=weights, mean=TABLE.mean, space=space, basis=stored_basis)
    return Scene(name="room", gaussians=splat(means, 0.01), features={"toy": fused})


SCENE = make_scene()


def quietly(scene: Scene, words: Sequence[str], *arguments: object, **named: object) -> Localization:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        return localize(scene, words, *arguments, **named)  # type: ignore[arg-type]


def candidates_of(
    words: list[str], text: TextEncoder, config: LocalizeConfig = EVERYTHING, rivals: TextTable | None = None
) -> list[WordCandidates]:
    return find_candidates(SCENE.gaussians, SCENE.features["toy"], words, text, config, rivals=rivals)[1]  # type: ignore[arg-type]


def plain_evidence(
    features: GaussianFeatures, word: str, rows: np.ndarray, names: Sequence[str]
) -> tuple[float, float]:
    """Mean and margin by decoding every feature."""
    fits = unit(features.decode(rows).astype(float) - features.mean) @ unit(TABLE.encode(names) - TABLE.mean).T
    mean = dict(zip(names, np.average(fits, axis=0, weights=features.weights[rows]), strict=True))
    return mean[word], mean[word] - max(value for name, value in mean.items() if name != word)


@pytest.mark.parametrize("basis", [False, True])
def test_the_evidence_equals_that_of_decoded_features(basis: bool) -> None:
    features = make_scene(basis=basis).features["toy"]
    rows = np.arange(2000, 2125)
    cosines = relevancy(features, TABLE.encode(["mug"]), TABLE.mean)[0]
    cluster = Cluster(rows=rows, score=1.0, weight=1.0, share=0.25)
    (evidence,) = Presence(features, TABLE.mean, TABLE).evidence(TABLE.encode(["mug"])[0], cosines, [cluster])
    # Cup is a synonym: it is no rival.
    mean, margin = plain_evidence(features, "mug", rows, ["mug", "chair", "lamp", "spoon"])
    assert evidence.mean == pytest.approx(mean, abs=1e-5)
    assert evidence.margin == pytest.approx(margin, abs=1e-5)
    median = np.median(cosines)
    spread = 1.4826 * np.median(np.abs(cosines - median))
    assert evidence.prominence == pytest.approx(math.log((cosines[rows].max() - median) / spread), abs=1e-5)
    assert (evidence.size, evidence.share) == (pytest.approx(math.log10(125)), 0.25)


def test_a_word_that_another_answers_better_is_absent_and_boxed_only_when_everything_is() -> None:
    with pytest.warns(SceneWarning, match=r"1 of 2 words have no box \('spoon'\).*\(probability 0\.0"):
        localization = localize(SCENE, ["mug", "spoon"], TABLE)
    assert {box.query for box in localization.boxes} == {"mug"}
    assert list(localization.absent) == ["spoon"]
    assert localization.absent["spoon"] == localization.probabilities[1]
    assert localization.absent["spoon"] < LocalizeConfig().min_probability
    mug, spoon = words_to_json(localization)
    assert (mug["absent"], spoon["absent"], spoon["boxes"]) == (False, True, 0)
    everything = quietly(SCENE, ["mug", "spoon"], TABLE, EVERYTHING)
    assert {box.query for box in everything.boxes} == {"mug", "spoon"}
    np.testing.assert_array_equal(everything.probabilities, localization.probabilities)


def test_a_text_encoder_without_names_gives_probabilities_too() -> None:
    localization = quietly(SCENE, ["mug", "spoon"], Phrases())
    assert localization.boxes[0].query == "mug"
    assert localization.probabilities[0] > 0.5 > localization.probabilities[1]
    # With words to compare with, it is as sure as the table.
    table, phrases = (quietly(SCENE, ["mug"], text, rivals=TABLE) for text in (TABLE, Phrases()))
    assert table.boxes[0].probability == phrases.boxes[0].probability


def test_rivals_of_another_space_are_refused() -> None:
    other = make_text_table(WORDS, TABLE.embeddings, "another")
    with pytest.raises(InputError, match="another"):
        localize(SCENE, ["mug"], TABLE, rivals=other)


def test_evidence_is_of_cosines_however_relevancy_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "NEGATIVES", ("lamp", "chair"))
    fixed = ThresholdConfig(kind="fixed", fixed=0.7)
    configs = (LocalizeConfig(contrast=contrast, threshold=fixed) for contrast in (False, True))
    plain, contrast = (candidates_of(["mug"], TABLE, config)[0] for config in configs)
    np.testing.assert_array_equal(plain.clusters[0].rows, contrast.clusters[0].rows)
    assert replace(plain.evidence[0], share=0.0) == replace(contrast.evidence[0], share=0.0)


def test_words_that_an_encoder_was_trained_on_and_others_have_coefficients_of_their_own() -> None:
    evidence = Evidence(mean=0.3, margin=-0.4, prominence=1.0, size=1.5, share=0.7)
    values = {}
    for trained, coefficients in ((None, WITH_RIVALS), (True, TRAINED), (False, UNTRAINED)):
        logit = coefficients["intercept"] + sum(
            coefficients[name] * getattr(evidence, name) for name in ("mean", "margin", "prominence", "size", "share")
        )
        values[trained] = probability(replace(evidence, trained=trained))
        assert values[trained] == pytest.approx(1 / (1 + math.exp(-logit)))
    # What is better called otherwise is absent if it is a name trained on, and else may be there.
    assert values[True] < values[None] < values[False]
    # Without rivals nothing tells trained words from others.
    alone = replace(evidence, margin=None)
    assert probability(replace(alone, trained=False)) == probability(alone)
    logit = WITHOUT_RIVALS["intercept"] + sum(
        WITHOUT_RIVALS[name] * getattr(alone, name) for name in ("mean", "prominence", "size", "share")
    )
    assert probability(alone) == pytest.approx(1 / (1 + math.exp(-logit)))
    assert 0 <= probability(replace(alone, mean=-1e300)) < probability(replace(alone, mean=1e300)) <= 1


def test_the_vocabulary_states_which_words_the_encoder_was_trained_on() -> None:
    trained = replace(TABLE, trained=("mug", "chair"))
    words = ["mugs", "spoon", "chair"]
    for table, stated in ((trained, [True, False, True]), (TABLE, [None, None, None])):
        candidates = candidates_of(words, table)
        assert [{each.trained for each in word.evidence} for word in candidates] == [{each} for each in stated]
    # Rivals that are given have the last word, as they say what else there is.
    against_rivals = candidates_of(words, Phrases(), rivals=trained)
    assert against_rivals[1].evidence[0].trained is False


@pytest.mark.parametrize("likeness", [0.2, 0.5, 0.8])
def test_a_phrase_is_judged_relative_to_the_name_that_comes_nearest_to_it(likeness: float) -> None:
    features = SCENE.features["toy"]
    rows = np.arange(2000, 2125)
    cluster = Cluster(rows=rows, score=1.0, weight=1.0, share=0.5)

    def evidence(vector: np.ndarray) -> Evidence:
        cosines = relevancy(features, vector[None], TABLE.mean)[0]
        (one,) = Presence(features, TABLE.mean, TABLE).evidence(vector, cosines, [cluster])
        return one

    mug = TABLE.embeddings[WORDS.index("mug")]
    direction = (mug - TABLE.mean) / np.linalg.norm(mug - TABLE.mean)
    # Across everything that is in the scene and all words: channel 14 is in none of them.
    phrase = (TABLE.mean + likeness * direction + math.sqrt(1 - likeness**2) * np.eye(16)[14]).astype(np.float32)
    of_name, of_phrase = evidence(mug), evidence(phrase)
    attainable = max(likeness, LEAST_ATTAINABLE)
    assert of_phrase.mean == pytest.approx(of_name.mean * likeness / attainable, abs=0.02)
    if likeness < LEAST_ATTAINABLE:
        return
    # Mug, and cup beside it, come as near to the phrase as any name does: neither is a rival.
    assert of_phrase.margin == pytest.approx(of_phrase.mean - (of_name.mean - of_name.margin), abs=0.02)


@pytest.mark.parametrize("trained", [None, ("mug",)])
def test_boxes_are_as_probable_as_is_asked_whatever_was_trained_on(trained: tuple[str, ...] | None) -> None:
    table, words = replace(TABLE, trained=trained), ["mug", "spoon", "chair"]
    everything = quietly(SCENE, words, table, EVERYTHING)
    for least in (0.0, *(box.probability for box in everything.boxes), 1.0):
        localization = quietly(SCENE, words, table, LocalizeConfig(min_probability=least))
        expected = [(box.query, box.probability) for box in everything.boxes if box.probability >= least]
        assert [(box.query, box.probability) for box in localization.boxes] == expected
        for word, value in zip(words, localization.probabilities, strict=True):
            likely = [box.probability for box in everything.boxes if box.query == word]
            assert value == pytest.approx(max(likely, default=0))
            ranks = [box.rank for box in localization.boxes if box.query == word]
            assert ranks == list(range(len(ranks)))


def test_of_several_feature_sets_the_named_one_is_asked_by_key_space_or_teacher() -> None:
    own = SCENE.features["toy"]
    space = replace(own.space, name="other", teacher="colors")
    other = replace(own, features=own.features[::-1].copy(), space=space)
    both = replace(SCENE, features={"a": own, "b": other})
    alone = {
        name: quietly(replace(SCENE, features={name: both.features[name]}), ["mug"], TABLE) for name in both.features
    }
    for key, names in (("a", ("a", own.space.name, own.space.teacher)), ("b", ("b", "other", "colors"))):
        for name in names:
            assert select_features(both, name)[1] is both.features[key]
            localization = quietly(both, ["mug"], TABLE, space=name)
            np.testing.assert_array_equal(localization.relevancy, alone[key].relevancy)
    assert not np.array_equal(alone["a"].relevancy, alone["b"].relevancy)
