"""Retrieval: ranks against a sort, ties and values that are not finite, and the draw of distractors."""

import math

import numpy as np
import pytest
from sklearn.metrics import top_k_accuracy_score
from sklearn.metrics.pairwise import cosine_similarity

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.retrieval import (
    Pooling,
    Retrieval,
    draw,
    image_to_text,
    rank_of_first,
    text_to_image,
    view_scores,
)


def vectors(count: int, seed: int, channels: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, channels)).astype(np.float32)


NAMES = [f"frame {number}" for number in range(12)]
VIEWS = [vectors(5 + number, number) for number in range(12)]
TEXTS, OTHERS = vectors(12, 100), vectors(40, 101)


@pytest.mark.parametrize(("pooling", "pool"), [("max", np.max), ("mean", np.mean)])
def test_the_score_of_a_view_is_the_pooled_cosine_of_its_cells(pooling: str, pool: object) -> None:
    expected = pool(cosine_similarity(VIEWS[3].astype(np.float64), TEXTS.astype(np.float64)), axis=0)  # type: ignore[operator]
    np.testing.assert_allclose(view_scores(VIEWS[3], TEXTS, pooling), expected, atol=1e-12)  # type: ignore[arg-type]


def test_cells_in_chunks_give_the_same_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = [view_scores(VIEWS[5], TEXTS, pooling) for pooling in ("max", "mean")]
    monkeypatch.setattr("gsencoder.evaluate.benchmarks.retrieval.CHUNK_VALUES", 25)
    parts = [view_scores(VIEWS[5], TEXTS, pooling) for pooling in ("max", "mean")]
    np.testing.assert_allclose(parts, whole, atol=1e-14)


@pytest.mark.parametrize("k", [1, 5, 10])
def test_recalls_over_whole_pools_are_those_of_scikit_learn(k: int) -> None:
    count = len(OTHERS)
    there = image_to_text(NAMES, VIEWS, TEXTS, OTHERS, count=count)
    back = text_to_image(NAMES, TEXTS, VIEWS, OTHERS, count=count)
    to_texts = [
        view_scores(view, np.concatenate([text[None], OTHERS])) for view, text in zip(VIEWS, TEXTS, strict=True)
    ]
    to_views = [
        [view_scores(view, text[None])[0], *cosine_similarity(OTHERS, text[None])[:, 0]]
        for view, text in zip(VIEWS, TEXTS, strict=True)
    ]
    for result, scores in ((there, to_texts), (back, to_views)):
        expected = top_k_accuracy_score(np.zeros(12), np.array(scores), k=k, labels=np.arange(1 + count))
        assert result.recall(k) == result.recalls()[f"recall_{k}"] == pytest.approx(expected)


def test_what_belongs_to_a_query_is_found_where_it_is_the_same() -> None:
    views = [np.concatenate([view, 3 * text[None]]) for view, text in zip(VIEWS, TEXTS, strict=True)]
    assert image_to_text(NAMES, views, TEXTS, OTHERS, count=40).ranks.tolist() == [1] * 12
    assert text_to_image(NAMES, TEXTS, views, OTHERS, count=40).ranks.tolist() == [1] * 12


def test_ties_count_against_what_belongs_to_the_query() -> None:
    same = np.ones((40, 6), np.float32)
    assert image_to_text(NAMES, VIEWS, same[:12], same, count=30).ranks.tolist() == [31] * 12
    views = [same[:4]] * 12
    assert text_to_image(NAMES, TEXTS, views, 2 * same, count=30).ranks.tolist() == [31] * 12
    # Also of features of length 0, whose cosine with everything is 0, and where equal vectors stand among others.
    assert image_to_text(NAMES, [0 * view for view in VIEWS], TEXTS, OTHERS, count=30).recall(10) == 0
    views = [text[None] for text in TEXTS]
    twins = np.concatenate([OTHERS, 0.1 * TEXTS])
    assert image_to_text(NAMES, views, TEXTS, twins, count=52).ranks.tolist() == [2] * 12
    assert text_to_image(NAMES, TEXTS, views, twins, count=52).ranks.tolist() == [2] * 12


def test_a_view_that_is_not_finite_comes_last_and_is_counted() -> None:
    views = [view.copy() for view in VIEWS]
    views[4][2, 1] = np.nan
    for result in (
        image_to_text(NAMES, views, TEXTS, OTHERS, count=20),
        text_to_image(NAMES, TEXTS, views, OTHERS, count=20),
        image_to_text(NAMES, views, TEXTS, OTHERS, count=20, pooling="mean"),
    ):
        assert result.ranks[4] == 21
        assert result.not_finite == 1
        assert (result.ranks <= 21).all()
    assert rank_of_first(np.array([0.5, np.nan, 0.1])) == 2


def test_the_order_of_queries_changes_nothing() -> None:
    order = np.random.default_rng(5).permutation(12)
    names, views = [NAMES[row] for row in order], [VIEWS[row] for row in order]
    for seed in (0, 1):
        there = image_to_text(NAMES, VIEWS, TEXTS, OTHERS, count=15, seed=seed).ranks
        assert np.array_equal(
            image_to_text(names, views, TEXTS[order], OTHERS, count=15, seed=seed).ranks, there[order]
        )
        back = text_to_image(NAMES, TEXTS, VIEWS, OTHERS, count=15, seed=seed).ranks
        assert np.array_equal(text_to_image(names, TEXTS[order], views, OTHERS, count=15, seed=seed).ranks, back[order])


@pytest.mark.parametrize("pooling", ["max", "mean"])
@pytest.mark.parametrize("seed", [0, 7])
def test_a_pool_holds_what_the_seed_draws_for_the_name_and_is_pooled_like_the_query(
    pooling: Pooling, seed: int
) -> None:
    pictures = np.stack([OTHERS, vectors(40, 55), vectors(40, 56)], axis=1)
    there = image_to_text(NAMES, VIEWS, TEXTS, OTHERS, count=15, seed=seed, pooling=pooling)
    back = text_to_image(NAMES, TEXTS, VIEWS, pictures, count=15, seed=seed, pooling=pooling)
    for number, name in enumerate(NAMES):
        drawn = draw(name, 40, 15, seed)
        own = view_scores(VIEWS[number], TEXTS[[number]], pooling)[0]
        assert there.ranks[number] == 1 + (view_scores(VIEWS[number], OTHERS[drawn], pooling) >= own).sum()
        others = [view_scores(pictures[row], TEXTS[[number]], pooling)[0] for row in drawn]
        assert back.ranks[number] == 1 + (np.array(others) >= own).sum()
    assert not np.array_equal(there.ranks, image_to_text(NAMES, VIEWS, TEXTS, OTHERS, count=15, seed=seed + 1).ranks)


def test_draws_are_of_different_distractors_and_depend_on_name_and_seed() -> None:
    drawn = draw("frame 1", 50, 20, 3)
    assert len(set(drawn.tolist())) == 20
    assert set(draw("frame 1", 50, 50, 3).tolist()) == set(range(50))
    assert np.array_equal(drawn, draw("frame 1", 50, 20, 3))
    assert not np.array_equal(drawn, draw("frame 2", 50, 20, 3))
    assert not np.array_equal(drawn, draw("frame 1", 50, 20, 4))


def test_each_distractor_is_drawn_as_often_as_any_other() -> None:
    counts = np.bincount(np.concatenate([draw(f"query {number}", 20, 5, 0) for number in range(4000)]), minlength=20)
    expected = 4000 * 5 / 20
    assert ((counts - expected) ** 2 / expected).sum() < 45  # 19 degrees of freedom: above with a probability of 0.001


def test_pictures_may_have_one_vector_or_cells() -> None:
    one = text_to_image(NAMES, TEXTS, VIEWS, OTHERS, count=30)
    assert np.array_equal(text_to_image(NAMES, TEXTS, VIEWS, OTHERS[:, None], count=30).ranks, one.ranks)
    twice = np.stack([OTHERS, OTHERS], axis=1)
    assert np.array_equal(text_to_image(NAMES, TEXTS, VIEWS, twice, count=30).ranks, one.ranks)


def test_the_ends_of_the_range() -> None:
    empty = image_to_text([], [], TEXTS[:0], OTHERS, count=3)
    assert math.isnan(empty.recall(1))
    assert math.isnan(text_to_image([], TEXTS[:0], [], OTHERS, count=3).recall(1))
    # Without distractors everything is found.
    assert image_to_text(NAMES, VIEWS, TEXTS, OTHERS[:0], count=0).recall(1) == 1
    assert text_to_image(NAMES, TEXTS, VIEWS, OTHERS[:0], count=0).recall(1) == 1
    assert Retrieval(ranks=np.array([1, 5, 6, 11]), distractors=20, not_finite=0).recalls() == {
        "recall_1": 0.25,
        "recall_5": 0.5,
        "recall_10": 0.75,
    }


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="1,999 distractors are asked for, and there are 40"):
        image_to_text(NAMES, VIEWS, TEXTS, OTHERS)
    with pytest.raises(InputError, match="41 distractors are asked for, and there are 40"):
        text_to_image(NAMES, TEXTS, VIEWS, OTHERS, count=41)
    with pytest.raises(InputError, match=r"12 names \(11 different\), 12 views and 12 texts"):
        image_to_text([*NAMES[:11], NAMES[0]], VIEWS, TEXTS, OTHERS, count=5)
    with pytest.raises(InputError, match="11 views and 12 texts"):
        text_to_image(NAMES, TEXTS, VIEWS[:11], OTHERS, count=5)
    with pytest.raises(InputError, match="expected distractors of 6 channels, got 5"):
        image_to_text(NAMES, VIEWS, TEXTS, OTHERS[:, :5], count=5)
    with pytest.raises(InputError, match="expected finite distractors"):
        image_to_text(NAMES, VIEWS, TEXTS, np.where(OTHERS > 2, np.nan, OTHERS).astype(np.float32), count=5)
    with pytest.raises(InputError, match="expected finite texts"):
        text_to_image(NAMES, np.where(TEXTS > 1, np.inf, TEXTS).astype(np.float32), VIEWS, OTHERS, count=5)
    with pytest.raises(InputError, match="expected cells of 6 channels"):
        image_to_text(NAMES, [VIEWS[0][:0], *VIEWS[1:]], TEXTS, OTHERS, count=5)
