"""Retrieval of features: ranks against a sort, ties and values that are not finite, and the draw of distractors."""

from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import top_k_accuracy_score
from sklearn.metrics.pairwise import cosine_similarity

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.files import Pooling
from gsencoder.evaluate.benchmarks.retrieval import (
    Retrieval,
    draw,
    rank_of_first,
    read_scored_pairs,
    retrieve,
    view_scores,
)


def vectors(*shape: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


NAMES = [f"frame {number}" for number in range(12)]
VIEWS, TEXTS, OTHERS = vectors(12, 5, 6, seed=1), vectors(12, 6, seed=100), vectors(40, 6, seed=101)
PICTURES = vectors(40, 3, 6, seed=102)


def retrieved(
    folder: Path,
    views: np.ndarray = VIEWS,
    texts: np.ndarray = TEXTS,
    others: np.ndarray = OTHERS,
    pictures: np.ndarray = PICTURES,
    *,
    order: np.ndarray | None = None,
    count: int = 0,
    pooling: Pooling = "max",
) -> tuple[Retrieval, Retrieval]:
    """Ranks of texts for views, and of views for texts, of a file of features."""
    order = np.arange(len(views)) if order is None else order
    arrays = {"views": views[order], "texts": texts[order], "text_distractors": others, "view_distractors": pictures}
    np.savez(folder / "features.npz", queries=np.array(NAMES)[order], **arrays)
    pairs = read_scored_pairs(folder / "features.npz", pooling=pooling)
    return retrieve(pairs, [f"text {row}" for row in order], count=count)


@pytest.mark.parametrize(("pooling", "pool"), [("max", np.max), ("mean", np.mean)])
def test_the_score_of_a_view_is_the_pooled_cosine_of_its_cells(
    pooling: Pooling, pool: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pool(cosine_similarity(VIEWS[3].astype(np.float64), TEXTS.astype(np.float64)), axis=0)  # type: ignore[operator]
    np.testing.assert_allclose(view_scores(VIEWS[3], TEXTS, pooling), expected, atol=1e-12)
    monkeypatch.setattr("gsencoder.evaluate.benchmarks.retrieval.CHUNK_VALUES", 25)
    np.testing.assert_allclose(view_scores(VIEWS[3], TEXTS, pooling), expected, atol=1e-12)


@pytest.mark.parametrize("k", [1, 5, 10])
def test_recalls_over_whole_pools_are_those_of_scikit_learn(k: int, tmp_path: Path) -> None:
    there, back = retrieved(tmp_path)
    to_texts = [view_scores(view, np.stack([text, *OTHERS])) for view, text in zip(VIEWS, TEXTS, strict=True)]
    to_views = [
        [view_scores(view, text[None])[0], *(view_scores(each, text[None])[0] for each in PICTURES)]
        for view, text in zip(VIEWS, TEXTS, strict=True)
    ]
    for result, scores in ((there, to_texts), (back, to_views)):
        expected = top_k_accuracy_score(np.zeros(12), np.array(scores), k=k, labels=np.arange(41))
        assert result.recall(k) == pytest.approx(expected)


def test_ties_count_against_what_belongs_to_the_query(tmp_path: Path) -> None:
    same = np.ones((40, 6), np.float32)
    there, _ = retrieved(tmp_path, texts=same[:12], others=same, count=30)
    assert there.ranks.tolist() == [31] * 12
    _, back = retrieved(tmp_path, np.ones_like(VIEWS), pictures=2 * np.ones_like(PICTURES), count=30)
    assert back.ranks.tolist() == [31] * 12
    # Also of features of length 0, whose cosine with everything is 0, and where equal vectors stand among others.
    assert retrieved(tmp_path, 0 * VIEWS, count=30)[0].recall(10) == 0
    twins = np.concatenate([OTHERS, 0.1 * TEXTS])
    there, back = retrieved(tmp_path, TEXTS[:, None], others=twins, pictures=twins[:, None])
    assert there.ranks.tolist() == back.ranks.tolist() == [2] * 12
    assert retrieved(tmp_path, TEXTS[:, None])[0].ranks.tolist() == [1] * 12


@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_a_view_that_is_not_finite_comes_last_and_is_counted(pooling: Pooling, tmp_path: Path) -> None:
    views = VIEWS.copy()
    views[4, 2, 1] = np.nan
    for result in retrieved(tmp_path, views, count=20, pooling=pooling):
        assert (result.ranks[4], result.not_finite) == (21, 1)
    assert rank_of_first(np.array([0.5, np.nan, 0.1])) == 2


@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_a_pool_holds_what_the_name_draws_in_any_order_of_queries(pooling: Pooling, tmp_path: Path) -> None:
    there, back = retrieved(tmp_path, count=15, pooling=pooling)
    assert (there.distractors, back.distractors) == (15, 15)
    for number, name in enumerate(NAMES):
        drawn = draw(name, 40, 15)
        own = view_scores(VIEWS[number], TEXTS[[number]], pooling)[0]
        assert there.ranks[number] == 1 + (view_scores(VIEWS[number], OTHERS[drawn], pooling) >= own).sum()
        others = [view_scores(PICTURES[row], TEXTS[[number]], pooling)[0] for row in drawn]
        assert back.ranks[number] == 1 + (np.array(others) >= own).sum()
    order = np.random.default_rng(5).permutation(12)
    moved = retrieved(tmp_path, order=order, count=15, pooling=pooling)
    assert [side.ranks.tolist() for side in moved] == [there.ranks[order].tolist(), back.ranks[order].tolist()]


def test_draws_are_of_different_distractors_and_each_is_drawn_as_often_as_any_other() -> None:
    assert len(set(draw("frame 1", 50, 20).tolist())) == 20
    assert set(draw("frame 1", 50, 50).tolist()) == set(range(50))
    assert np.array_equal(draw("frame 1", 50, 20), draw("frame 1", 50, 20))
    counts = np.bincount(np.concatenate([draw(f"query {number}", 20, 5) for number in range(4000)]), minlength=20)
    expected = 4000 * 5 / 20
    assert ((counts - expected) ** 2 / expected).sum() < 45  # 19 degrees of freedom: above with a probability of 0.001


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="41 distractors are asked for, and there are 40"):
        retrieved(tmp_path, count=41)
    with pytest.raises(InputError, match="texts have 6 channels, and text_distractors 5"):
        retrieved(tmp_path, others=OTHERS[:, :5])
    with pytest.raises(InputError, match="expected cells of 6 channels"):
        view_scores(VIEWS[0][:0], TEXTS)
