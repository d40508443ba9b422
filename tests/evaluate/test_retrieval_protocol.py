"""The retrieval protocol: what views score with texts, against numpy, and what the command writes and refuses."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_runs import refusal, results_of
from memory_samples import make_bank, memory_of_features
from named_rooms import write_words
from rooms import room

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.benchmarks.retrieval import STRIDE, RetrievalProtocol, score_views
from gsencoder.infer.relevancy import word_directions
from gsencoder.memory.attention import render_queries
from gsencoder.render import blend
from gsencoder.text.table import load_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, Scene

TEXTS = np.random.default_rng(1).normal(size=(70, 3)).astype(np.float32)


def featured() -> tuple[Scene, GaussianFeatures]:
    scene, cube = room()
    which = torch.zeros(len(scene.gaussians), dtype=torch.long)
    which[cube] = 1
    values = np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.5]], np.float32)[which.numpy()]
    space = FeatureSpace(name="s", channels=3, text_encoder="words")
    weights = np.ones(len(which), np.float32)
    return scene, GaussianFeatures(features=values, weights=weights, mean=np.full(3, 0.3, np.float32), space=space)


@pytest.mark.parametrize("pooling", ["max", "mean"])
@pytest.mark.parametrize("mode", ["centered", "raw"])
def test_scores_are_pooled_cosines_of_rendered_pixels(pooling: Any, mode: Any) -> None:
    scene, features = featured()
    protocol = RetrievalProtocol(pooling=pooling, mode=mode)
    text_mean = TEXTS.mean(axis=0)
    directions = word_directions(TEXTS, text_mean, mode)
    views = [2, 0]
    scores = score_views(scene, features, views, directions, protocol)
    assert scores.shape == (2, 70)
    for row, view in enumerate(views):
        b = blend(scene.gaussians, scene.views.cameras, view, stride=STRIDE)
        rendered = b.render(torch.from_numpy(features.features)).numpy().astype(np.float64)
        alpha = b.alpha.numpy().astype(np.float64)
        pixels = rendered[alpha > 0] / alpha[alpha > 0, None] - (features.mean if mode == "centered" else 0)
        texts = TEXTS.astype(np.float64) - (text_mean if mode == "centered" else 0)
        units = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in (pixels, texts)]
        cosines = units[0] @ units[1].T
        expected = cosines.max(axis=0) if pooling == "max" else cosines.mean(axis=0)
        np.testing.assert_allclose(scores[row], expected, atol=2e-3)


def test_a_memory_is_scored_by_what_pixels_attend_to() -> None:
    scene, features = featured()
    rows = np.unique(features.features, axis=0)
    bank = make_bank(rows / np.linalg.norm(rows, axis=1, keepdims=True), features.mean, features.space)
    memory = memory_of_features(features, bank, channels=2)
    directions = word_directions(TEXTS, TEXTS.mean(axis=0), "raw")
    protocol = RetrievalProtocol(mode="raw", pooling="mean")
    (scores,) = score_views(scene, features, [1], directions, protocol, memory=memory)
    queries, alpha = render_queries(memory, blend(scene.gaussians, scene.views.cameras, 1, stride=STRIDE))
    pixels = memory.attend(queries[alpha > 0]).astype(np.float64)
    units = pixels / np.linalg.norm(pixels, axis=1, keepdims=True)
    np.testing.assert_allclose(scores, (units @ directions.T).mean(axis=0), atol=1e-5)
    # Not by the features that are passed beside it.
    (plain,) = score_views(scene, features, [1], directions, protocol)
    assert np.abs(scores - plain).max() > 1e-3


def test_a_view_that_shows_no_feature_has_no_score() -> None:
    scene, features = featured()
    blind = replace(features, weights=np.zeros(len(features), np.float32), features=features.features * 0)
    assert np.isnan(score_views(scene, blind, [0], word_directions(TEXTS, TEXTS.mean(axis=0)))).all()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms, their words, and captions of views: words, since a table knows no sentences."""
    folder = tmp_path_factory.mktemp("rooms")
    made = [make_room(number, objects=3, views=3, width=80, height=60) for number in range(2)]
    for number, each in enumerate(made):
        write_room(each, folder / f"room_{number}")
    write_words(folder / "words.safetensors", *made)
    names = load_text_table(folder / "words.safetensors").names
    rows = []
    for number in range(2):
        frames = json.loads((folder / f"room_{number}" / "transforms.json").read_text())["frames"]
        rows += [
            {"scene_id": f"room_{number}", "view": frame["file_path"], "caption": names[2 * number + index]}
            for index, frame in enumerate(frames[:2])
        ]
    (folder / "captions.json").write_text(json.dumps([*rows, {"scene_id": "hall", "view": "1", "caption": "wall"}]))
    (folder / "others.txt").write_text("\n".join(names))
    return folder


def words_of(home: Path, out: Path, *more: str) -> list[str]:
    usual = ["evaluate", str(home / "room_0"), str(home / "room_1"), "protocol=retrieval"]
    return [*usual, f"teacher.words={home / 'words.safetensors'}", f"out={out}", *more]


@pytest.mark.slow
def test_the_files_that_evaluate_writes_have_the_scores_that_it_reports(home: Path, tmp_path: Path) -> None:
    options = [f"protocol.captions={home / 'captions.json'}", f"protocol.distractors={home / 'others.txt'}"]
    assert cli.main(words_of(home, tmp_path / "a", *options, "quiet=true")) == 0
    results = results_of(tmp_path / "a")
    assert results["views"] == 4
    assert results["pools"]["t2i"] == {"distractors": 3, "of": "queries"}
    # Captions are no distractors of themselves.
    others = len((home / "others.txt").read_text().splitlines()) - 4
    assert results["pools"]["i2t"] == {"distractors": others, "of": "distractors"}
    files = [f"predictions={tmp_path / 'a' / 'predictions.npz'}", f"truth={tmp_path / 'a' / 'truth.json'}"]
    assert cli.main(["score", "retrieval", *files, f"out={tmp_path / 'b'}", "quiet=true"]) == 0
    del results["gaussians"]
    assert results_of(tmp_path / "b") == results
    assert {row["scene_id"] for row in json.loads((tmp_path / "a" / "truth.json").read_text())} == {"room_0", "room_1"}


def test_captions_that_do_not_fit_are_refused_before_features_are_made(home, tmp_path, capsys, monkeypatch):
    def refused(*more: str) -> str:
        return refusal(capsys, *words_of(home, tmp_path / "out", *more))

    def write(*rows: dict[str, str]) -> str:
        (tmp_path / "c.json").write_text(json.dumps(rows))
        return f"protocol.captions={tmp_path / 'c.json'}"

    monkeypatch.setattr("gsencoder.evaluate.benchmarks.protocol.with_features", None)
    assert "protocol.captions= is missing" in refused()
    hall = {"scene_id": "hall", "view": "1", "caption": "wall"}
    assert "none of the captions in " in refused(write(hall))
    strange = {"scene_id": "room_0", "view": "images/000.png", "caption": "a sentence about zebras"}
    assert "sentences need the tower that made the words" in refused(write(strange))
    view = {"scene_id": "room_0", "view": "nowhere.png", "caption": "ball"}
    assert "scene room_0 has no view called nowhere.png; its views are " in refused(write(view))
    captions = f"protocol.captions={home / 'captions.json'}"
    assert "3 distractors are asked for, and protocol.distractors= has 0" in refused(captions, "protocol.count=3")
