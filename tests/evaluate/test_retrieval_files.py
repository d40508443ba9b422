"""Retrieval from files: ranks worked out by hand and by the functions for features, and files that do not fit."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.metrics import top_k_accuracy_score

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.retrieval import (
    ScoredPairs,
    draw,
    rank_of_first,
    read_texts,
    read_view_captions,
    retrieve,
    score,
    write_scored_pairs,
)

NAMES = [f"room/frame_{number}" for number in range(7)]


def vectors(*shape: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def captions(folder: Path, texts: list[str]) -> Path:
    rows = [{"scene_id": "room", "view": f"frame_{number}", "caption": text} for number, text in enumerate(texts)]
    (folder / "truth.json").write_text(json.dumps(rows))
    return folder / "truth.json"


def scored(scores: Any, distractors: Any = ()) -> ScoredPairs:
    scores = np.array(scores, np.float64)
    return ScoredPairs(
        queries=tuple(NAMES[: len(scores)]),
        scores=scores,
        distractors=np.array(distractors, np.float64).reshape(-1, len(scores)),
    )


def test_without_distractors_the_pool_is_what_belongs_to_the_other_queries() -> None:
    # Row 0: its text has 0.9, the best. Row 1: 0.5 comes after 0.8. Row 2: 0.3 comes after 0.7, and ties with 0.3.
    # Column 0: 0.9 comes first. Column 1: 0.5 comes after 0.7. Column 2: 0.3 comes after 0.4.
    there, back = retrieve(scored([[0.9, 0.1, 0.2], [0.8, 0.5, 0.4], [0.3, 0.7, 0.3]]), ["a", "b", "c"])
    assert there.ranks.tolist() == [1, 2, 3]
    assert back.ranks.tolist() == [1, 2, 2]
    # Views with one text are no rivals: row 1 loses its 0.8, and column 0 of that text ranks row 1 no more.
    there, back = retrieve(scored([[0.6, 0.1, 0.2], [0.8, 0.5, 0.4], [0.3, 0.7, 0.3]]), ["a", "a", "c"])
    assert there.ranks.tolist() == [1, 1, 3]
    assert back.ranks.tolist() == [1, 2, 2]


def test_a_score_that_is_not_finite_comes_last() -> None:
    there, back = retrieve(scored([[np.nan, 0.1], [0.2, 0.3]]), ["a", "b"])
    assert (there.ranks.tolist(), back.ranks.tolist()) == ([2, 1], [2, 1])
    assert there.not_finite == back.not_finite == 1
    assert rank_of_first(np.array([0.5, np.nan, 0.1])) == 2


def test_ties_count_against_what_belongs_to_the_query_but_for_rounding() -> None:
    there, back = retrieve(scored(np.ones((3, 9)), np.ones((5, 3))), ["a", "b", "c"])
    assert (there.ranks.tolist(), back.ranks.tolist()) == ([7] * 3, [6] * 3)
    assert (there.distractors, back.distractors) == (6, 5)
    assert rank_of_first(np.array([0.5, 0.5 - 1e-12, 0.5 - 1e-6])) == 2


@pytest.mark.parametrize("k", [1, 5, 10])
def test_recalls_over_whole_pools_are_those_of_scikit_learn(k: int) -> None:
    scores, distractors = vectors(7, 47, seed=1), vectors(40, 7, seed=2)
    there, back = retrieve(scored(scores, distractors), NAMES)
    own = np.diag(scores)[:, None]
    for result, others in ((there, scores[:, 7:]), (back, distractors.T)):
        expected = top_k_accuracy_score(np.zeros(7), np.concatenate([own, others], 1), k=k, labels=np.arange(41))
        assert (result.ranks <= k).mean() == pytest.approx(expected)


def test_a_pool_holds_what_the_name_draws() -> None:
    pairs = scored(vectors(7, 47, seed=1), vectors(40, 7, seed=2))
    there, back = retrieve(pairs, NAMES, count=15)
    for number, name in enumerate(NAMES):
        drawn, own = draw(name, 40, 15), pairs.scores[number, number]
        assert there.ranks[number] == 1 + (pairs.scores[number, 7 + drawn] >= own).sum()
        assert back.ranks[number] == 1 + (pairs.distractors[drawn, number] >= own).sum()


def test_draws_are_of_different_distractors_and_each_is_drawn_as_often_as_any_other() -> None:
    assert len(set(draw("frame 1", 50, 20).tolist())) == 20
    assert np.array_equal(draw("frame 1", 50, 20), draw("frame 1", 50, 20))
    counts = np.bincount(np.concatenate([draw(f"query {number}", 20, 5) for number in range(1000)]), minlength=20)
    # 19 degrees of freedom: above with a probability of 0.001.
    assert ((counts - 250) ** 2 / 250).sum() < 45


def test_the_order_of_queries_in_the_file_does_not_matter(tmp_path: Path) -> None:
    truth = captions(tmp_path, [f"text {number}" for number in range(7)])
    pairs = scored(vectors(7, 9, seed=5), vectors(4, 7, seed=6))
    order = np.array([3, 0, 6, 1, 5, 2, 4])
    turned = ScoredPairs(
        queries=tuple(NAMES[row] for row in order),
        scores=pairs.scores[np.ix_(order, [*order, 7, 8])],
        distractors=pairs.distractors[:, order],
    )
    reports = []
    for name, each in (("a", pairs), ("b", turned)):
        write_scored_pairs(tmp_path / f"{name}.npz", each)
        reports.append(score(tmp_path / f"{name}.npz", truth, ScoreOptions()))
    assert reports[0].results == reports[1].results
    assert reports[0].rows == reports[1].rows
    assert reports[0].results["pools"] == {
        "i2t": {"distractors": 2, "of": "distractors"},
        "t2i": {"distractors": 4, "of": "distractors"},
    }
    assert "| M3 (published) | " in reports[0].table.markdown()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"scores": np.ones((2, 2))}, "no query of 1 view with a caption: room/frame_2"),
        ({"queries": [*NAMES[:3], "room/x"], "scores": np.ones((4, 4))}, "1 query of no view with a caption"),
        ({"scores": np.ones((3, 2))}, "3 queries need scores of 3 × 3 or more.*got 3 × 2"),
        ({"queries": [NAMES[0]] * 3, "scores": np.ones((3, 3))}, "'room/frame_0' is there twice"),
        ({"scores": np.ones((3, 3), int)}, "scores: expected 2 axes of floating point, got 3 × 3 of int64"),
    ],
)
def test_predictions_that_do_not_fit_are_refused(arrays: dict[str, Any], message: str, tmp_path: Path) -> None:
    truth = captions(tmp_path, ["a", "b", "c"])
    count = len(next(iter(arrays.values()), "abc"))
    np.savez(tmp_path / "a.npz", **{"queries": np.array(NAMES[:count])} | arrays)
    with pytest.raises(InputError, match=message) as error:
        score(tmp_path / "a.npz", truth, ScoreOptions())
    assert str(tmp_path / "a.npz") in str(error.value)


def test_swapped_files_and_more_distractors_than_there_are_are_refused(tmp_path: Path) -> None:
    truth = captions(tmp_path, ["a", "b"])
    write_scored_pairs(tmp_path / "a.npz", scored(np.ones((2, 5))))
    with pytest.raises(InputError, match="expected an .npz with queries and scores"):
        score(truth, truth, ScoreOptions())
    with pytest.raises(InputError, match="is an archive"):
        score(tmp_path / "a.npz", tmp_path / "a.npz", ScoreOptions())
    with pytest.raises(InputError, match="4 distractors are asked for, and there are 3"):
        score(tmp_path / "a.npz", truth, ScoreOptions(distractors=4))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "holds no captions"),
        ([{"scene_id": "room", "view": "a", "caption": ""}], "caption is empty"),
        ([{"scene_id": "room", "view": 3, "caption": "a"}], "view must be a text"),
        ([{"scene_id": "room", "view": "a", "caption": "a"}] * 2, "entries 0 and 1 have one view: room/a"),
    ],
)
def test_captions_that_are_none_are_refused(rows: list[Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(rows))
    with pytest.raises(InputError, match=message):
        read_view_captions(tmp_path / "a.json")


def test_lines_of_texts_are_read_once_each(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("a cat \n\na dog\na cat\n")
    assert read_texts(tmp_path / "a.txt") == ("a cat", "a dog")
    (tmp_path / "a.txt").write_text("\n")
    with pytest.raises(InputError, match="holds no text"):
        read_texts(tmp_path / "a.txt")
