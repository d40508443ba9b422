"""Teacher and encoder together: the surer features are taken, Gaussian by Gaussian."""

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import table_basis
from gsencoder.infer.ensemble import surer_features
from gsencoder.infer.relevancy import relevancy
from gsencoder.types import FeatureSpace, GaussianFeatures

RNG = np.random.default_rng(0)
NAMES = RNG.normal(size=(5, 16)).astype(np.float32)
NAMES /= np.linalg.norm(NAMES, axis=1, keepdims=True)
MEAN = (0.1 * RNG.normal(size=16)).astype(np.float32)


def features(
    vectors: np.ndarray, name: str, *, weights: np.ndarray | None = None, basis: bool = False
) -> GaussianFeatures:
    space = FeatureSpace(name=name, channels=16, teacher=name, text_encoder="words")
    weights = np.ones(len(vectors), np.float32) if weights is None else weights
    if not basis:
        return GaussianFeatures(features=vectors, weights=weights, mean=MEAN, space=space)
    of_table = table_basis(vectors, MEAN, space, energy=1.0)
    stored = of_table.coordinates(vectors)
    return GaussianFeatures(features=stored, weights=weights, mean=of_table.mean, space=space, basis=of_table)


def noisy(names: list[int], noise: list[float], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (NAMES[names] + np.array(noise)[:, None] * rng.normal(size=(len(names), 16))).astype(np.float32)


@pytest.mark.parametrize("basis", [False, True])
def test_each_gaussian_has_the_name_of_the_source_that_is_surer(basis: bool) -> None:
    true = [0, 1, 2, 3, 4, 0, 1, 2]
    teacher = features(noisy(true, [0.02] * 4 + [1.0] * 4, 1), "teacher", basis=basis)
    encoder = features(noisy(true, [1.0] * 4 + [0.02] * 4, 2), "encoder", basis=basis)
    together, by_encoder = surer_features(teacher, encoder, NAMES, MEAN)
    assert by_encoder.tolist() == [False] * 4 + [True] * 4
    assert together.space.name == "teacher+encoder"
    assert relevancy(together, NAMES, MEAN).argmax(axis=0).tolist() == true


def test_a_gaussian_that_one_of_them_has_not_seen_has_the_others_features() -> None:
    weights = np.array([0, 1, 0], np.float32)
    vectors = noisy([0, 1, 2], [0.02] * 3, 3)
    vectors[weights == 0] = 0
    teacher = features(vectors, "teacher", weights=weights)
    other = noisy([3, 3, 3], [0.02] * 3, 4)
    other[2] = 0
    encoder = features(other, "encoder", weights=np.array([1, 0, 0], np.float32))
    for bias in (-3.0, 0.0, 3.0):
        together, by_encoder = surer_features(teacher, encoder, NAMES, MEAN, bias=bias)
        assert together.seen.tolist() == [True, True, False]
        assert by_encoder.tolist()[:2] == [True, False]
        assert not together.features[2].any()


def test_with_a_bias_the_encoder_is_taken_more_often() -> None:
    true = RNG.integers(0, 5, 200).tolist()
    teacher, encoder = (features(noisy(true, [0.2] * 200, seed), str(seed)) for seed in (5, 6))
    shares = [surer_features(teacher, encoder, NAMES, MEAN, bias=bias)[1].mean() for bias in (-2.0, -0.05, 0.05, 2.0)]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)


def test_an_encoder_of_somewhat_smaller_cosines_counts_as_surer() -> None:
    """Features that lie between a name and what is across all names, with cosines of 0.7 and of 0.3 to 0.5."""
    across = np.linalg.svd(NAMES - MEAN)[2][-1]
    direction = (NAMES[0] - MEAN) / np.linalg.norm(NAMES[0] - MEAN)

    def between(cosines: list[float]) -> np.ndarray:
        parts = np.array(cosines)[:, None]
        return (MEAN + parts * direction + np.sqrt(1 - parts**2) * across).astype(np.float32)

    teacher = features(between([0.7, 0.7, 0.7]), "teacher")
    _, by_encoder = surer_features(teacher, features(between([0.3, 0.35, 0.5]), "encoder"), NAMES, MEAN)
    assert by_encoder.tolist() == [False, False, True]


def test_words_of_another_text_encoder_are_refused() -> None:
    one = features(NAMES, "teacher")
    space = FeatureSpace(name="labels", channels=16, teacher="labels", text_encoder="others")
    other = GaussianFeatures(features=NAMES, weights=np.ones(5, np.float32), mean=MEAN, space=space)
    with pytest.raises(InputError, match="its words are those of 'others', and the teacher's those of 'words'"):
        surer_features(one, other, NAMES, MEAN)
