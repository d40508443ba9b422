"""Selections of Gaussians by words: laws, and what is taken along or left."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from selected_rooms import MUG, circling, permuted, selected_room, with_more, words

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.infer import select as module
from gsencoder.infer.select import SelectConfig, Selection, sample_views, select, threshold_parts, votes
from gsencoder.render import blend
from gsencoder.types import Scene

SCENE, KINDS = selected_room()


def chosen(scene: Scene = SCENE, *names: str, config: SelectConfig = SelectConfig(), **options: object) -> Selection:
    return select(scene, names or ("mug",), words(), config, **options)[0]  # type: ignore[arg-type]


def test_an_object_is_selected_with_its_rims_and_without_what_it_stands_on() -> None:
    selection = chosen()
    assert ((selection.labels == 1) == (KINDS == 0)).all()
    assert selection.views == 8
    assert not selection.placed


def test_several_words_give_a_labelling_of_the_scene_and_none_where_no_word_fits() -> None:
    selection = chosen(SCENE, "book", "mug")
    assert (selection.labels == np.array([2, 1, 0])[KINDS]).all()
    everything_but_the_mug = chosen(SCENE, "table", "book")
    assert (everything_but_the_mug.labels[KINDS == 0] == 0).all()


def test_the_order_of_gaussians_and_words_does_not_matter() -> None:
    order = np.random.default_rng(3).permutation(len(KINDS))
    moved = chosen(permuted(SCENE, order), "book", "mug")
    plain = chosen(SCENE, "book", "mug").labels
    assert (moved.labels == plain[order]).all()
    # That of the words changes numbers alone.
    assert (np.array([0, 2, 1])[plain] == chosen(SCENE, "mug", "book").labels).all()


def test_a_larger_threshold_never_selects_more_seeds() -> None:
    config = SelectConfig(grow=False)
    before = np.ones(len(KINDS), bool)
    for threshold in (-1.0, 0.0, 0.2, 0.4, 0.6, 0.8, 0.94):
        try:
            seeds = chosen(SCENE, config=config, threshold=threshold).labels > 0
        except InputError as error:
            assert threshold == -1.0
            assert "every one of the" in str(error)
            continue
        assert not (seeds & ~before).any()
        before = seeds
    assert before.any()
    assert not before.all()


def test_gaussians_without_features_go_with_the_pixels_that_they_are_in() -> None:
    mug = MUG + np.array([[0.0, 0.0, 0.075]])  # A half-transparent floater above the mug,
    table = np.array([[-0.1, -0.1, 0.01]])  # one on the table within reach of it,
    far = np.array([[-0.35, -0.35, 0.01]])  # and one out of reach.
    scene = with_more(SCENE, np.concatenate([mug, table, far]), opacity=0.3)
    assert chosen(scene).labels[-3:].tolist() == [1, 0, 0]


def test_what_no_view_shows_goes_with_what_is_around_it() -> None:
    inside, below = MUG + np.array([0.0, 0.0, 0.03]), MUG * np.array([1, 1, 0]) - np.array([0.0, 0.0, 0.02])
    scene = with_more(SCENE, np.stack([inside, below]), opacity=0.99)
    assert chosen(scene).labels[-2:].tolist() == [1, 0]
    # Nor do features and places alone tell anything else.
    assert chosen(scene, config=SelectConfig(views=0)).labels[-2:].tolist() == [1, 0]


def test_without_growing_the_gaussians_of_the_boxes_are_taken() -> None:
    selection, localization = select(SCENE, ("mug", "book"), words(), SelectConfig(grow=False))
    assert (selection.labels == selection.seeds).all()
    grown = chosen(SCENE, "mug", "book")
    assert (grown.seeds == selection.seeds).all()
    assert selection.views == 0
    for number in (0, 1):
        boxes = [box.rows for box in localization.boxes if box.query == selection.words[number]]
        assert set(selection.rows(number).tolist()) <= set(np.concatenate(boxes).tolist())


def test_a_gaussian_that_several_words_take_goes_to_the_most_relevant_one_and_the_first_of_equal_ones() -> None:
    relevancy = np.array([[0.9, 0.4, 0.7, np.nan], [0.8, 0.6, 0.7, np.nan]], np.float32)
    parts = threshold_parts(("a", "b"), relevancy, 0.3)
    assert module.labels_of_parts(parts, relevancy).tolist() == [1, 2, 1, 0]


def test_a_splat_without_views_is_looked_at_from_placed_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ORBITS", 6)
    with pytest.warns(SceneWarning, match="has no views; the selection is checked from 6 cameras"):
        selection = chosen(replace(SCENE, views=None))
    assert selection.placed
    assert selection.views == 6
    assert ((selection.labels == 1) == (KINDS == 0)).mean() > 0.99
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = chosen(replace(SCENE, views=None), config=SelectConfig(views=0))
    assert alone.views == 0
    assert ((alone.labels == 1) == (KINDS == 0)).mean() > 0.99


def test_votes_are_the_blending_weights_of_the_views() -> None:
    gaussians, cameras = SCENE.gaussians, circling(count=3)
    assert gaussians is not None
    every = sample_views(cameras, 3)
    votes_of_gaussians = votes(gaussians, cameras, (KINDS == 0).astype(np.int32), 1, every, spacing=np.inf)
    expected = sum(blend(gaussians, cameras, view).lift(torch.ones(96 * 72)) for view in range(3))
    assert np.allclose(votes_of_gaussians.present.sum(axis=1), np.asarray(expected), rtol=1e-4, atol=1e-4)
    # What has no label covers no less when that which has one is gone; what has one is gone.
    left = KINDS != 0
    assert (votes_of_gaussians.removed.sum(axis=1)[left] >= votes_of_gaussians.present.sum(axis=1)[left] - 1e-3).all()
    assert not votes_of_gaussians.removed[~left].any()
    # Without a label nothing is removed.
    nothing = votes(gaussians, cameras, np.zeros(len(KINDS), np.int32), 1, every, spacing=0.02)
    assert (nothing.present == nothing.removed).all()
    assert not nothing.present[:, 1].any()


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (("mug",), {"boxes": (0,), "threshold": 0.5}, "box= and threshold= are two ways"),
        (("mug",), {"boxes": (7,)}, r"box=7: 'mug' has one box, number 0"),
        (("mug",), {"boxes": (-1,)}, "box=-1"),
        (("lamp",), {"boxes": (0,)}, r"box=0: 'lamp' has no box: absent"),
        (("mug",), {"threshold": 1.5}, r"threshold=1.5: no Gaussian is as relevant"),
        (("lamp",), {"threshold": 0.99}, "no Gaussian is as relevant; the best are 'lamp'"),
        (("lamp",), {}, r"no Gaussian of table is selected; absent: 'lamp' \(probability"),
        (("mug",), {"threshold": -1.0}, "every one of the .* Gaussians of table is selected"),
        (("teapot",), {}, "teapot"),
        (("mug", "The Mugs"), {}, "'mug' and 'The Mugs' stand for the same vector; give one of them"),
        (tuple(f"word {number}" for number in range(65)), {}, "at most 64 words"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_what_cannot_be_selected_is_refused(names: tuple[str, ...], options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        chosen(SCENE, *names, config=SelectConfig(grow=False), **options)
