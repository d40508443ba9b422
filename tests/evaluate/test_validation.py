"""Validation on prepared scenes, with an encoder that knows, and with ones that do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from training_scenes import prepared, small_encoder

from gsencoder.evaluate import validation
from gsencoder.evaluate.validation import ClassAccuracy, nearest_classes, validate_encoder, validate_names
from gsencoder.infer.encode import EncodeConfig
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.train.prepared import PreparedScene
from gsencoder.train.samples import TrainingScene
from gsencoder.types import FeatureSpace, GaussianFeatures


def test_choices_are_those_that_occur_in_the_scene() -> None:
    codebook = np.eye(3, dtype=np.float32)
    assert nearest_classes(codebook, codebook, np.array([0, 2])).tolist()[::2] == [0, 2]


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[TrainingScene], OutputSpaces, np.ndarray]:
    dataset, names = prepared(tmp_path_factory.mktemp("prepared"), count=2)
    outputs, codebook = dataset.load_space()
    scenes = [TrainingScene([scene]) for scene in dataset.scenes(names)]
    return scenes, OutputSpaces(by_teacher={"sides": outputs}), codebook


def judged(
    walls: tuple[list[TrainingScene], OutputSpaces, np.ndarray], monkeypatch: pytest.MonkeyPatch, answers: object
) -> ClassAccuracy:
    """Validation of an encoder that answers with what a function makes of the targets of each scene in turn."""
    scenes, outputs, codebook = walls
    turn, space = iter(scenes), outputs["sides"]

    def encode_spaces(*_: object, **__: object) -> dict[str, GaussianFeatures]:
        (scene,) = next(turn).parts
        values = answers(scene.targets(np.arange(len(scene))))  # type: ignore[operator]
        weights = np.ones(len(scene), np.float32)
        features = space.restore(values)
        return {"sides": GaussianFeatures(features=features, weights=weights, mean=space.mean, space=space.space)}

    monkeypatch.setattr(validation.Encoder, "encode_spaces", encode_spaces)
    return validate_encoder(scenes, small_encoder(), outputs, {"sides": codebook})["sides"]


def test_who_gives_the_targets_is_always_right(walls, monkeypatch):
    results = judged(walls, monkeypatch, lambda targets: targets)
    assert results.score == 1
    assert results.cosine_named == pytest.approx(1, abs=1e-5)
    parts = [part for scene in walls[0] for part in scene.parts if part is not None]
    assert results.total.sum() == sum(int((part.weights > 0).sum()) for part in parts)


def test_who_always_says_the_same_is_right_about_one_kind_and_who_says_the_opposite_about_none(walls, monkeypatch):
    codebook = walls[2]
    results = judged(walls, monkeypatch, lambda targets: np.broadcast_to(codebook[1], targets.shape).copy())
    assert results.accuracies()[1] == 1
    assert results.score == pytest.approx(1 / np.isfinite(results.accuracies()).sum())
    opposite = judged(walls, monkeypatch, lambda targets: -targets)
    assert opposite.cosine_named == pytest.approx(-1, abs=1e-5)
    assert opposite.score < 0.2


def test_counts_and_the_cosine_are_those_of_the_definition(rng, monkeypatch):
    mean = rng.normal(size=4).astype(np.float32)
    space = OutputSpace(space=FeatureSpace(name="s", channels=4), mean=mean, scale=3.0)
    codebook = rng.normal(size=(6, 4)).astype(np.float32)
    accuracy, correct, total, cosines = ClassAccuracy(space, codebook), np.zeros(6), np.zeros(6), []
    for classes in ([0, 1, 2], [2, 3, 4]):
        targets = (codebook[rng.choice(classes, 300)] * rng.uniform(0.2, 1.5, (300, 1))).astype(np.float32)
        predicted = targets + rng.normal(size=(300, 4)).astype(np.float32)
        weights = np.where(np.arange(300) % 7 == 3, 0, rng.uniform(1, 2, 300))
        # Exactly half the root mean square distance from the mean; and a prediction that is the mean.
        targets[:2] = [0, 0, 1, 0], [3, 0, 0, 0]
        predicted[1] = 0
        monkeypatch.setattr(PreparedScene, "weights", weights)
        monkeypatch.setattr(PreparedScene, "targets", lambda _, rows, targets=targets: targets[rows])
        accuracy.add(PreparedScene(Path("a")), space.restore(predicted))
        seen = weights > 0
        to_targets, to_predicted = (
            np.square(x[seen, None] - codebook).sum(axis=2, dtype=np.float64) for x in (targets, predicted)
        )
        true = to_targets.argmin(axis=1)
        absent = np.setdiff1d(np.arange(6), true)
        to_predicted[:, absent] = np.inf
        np.add.at(total, true, 1)
        np.add.at(correct, true, to_predicted.argmin(axis=1) == true)
        for target, guess in zip(targets[seen], predicted[seen], strict=True):
            if np.sqrt(np.square(target).sum()) >= 1:
                cosines.append(target @ guess / max(np.linalg.norm(target) * np.linalg.norm(guess), 1e-12))
    assert accuracy.scenes == 2
    np.testing.assert_array_equal(accuracy.total, total)
    np.testing.assert_array_equal(accuracy.correct, correct)
    assert 0 < correct.sum() < total.sum()
    assert accuracy.cosine_named == pytest.approx(np.mean(cosines), abs=1e-5)


@pytest.mark.slow
def test_an_encoder_is_drawn_beside_the_truth(walls: tuple[list[TrainingScene], OutputSpaces, np.ndarray]) -> None:
    scenes, outputs, codebook = walls
    config = EncodeConfig(precision="float32")
    accuracy = validate_encoder(scenes, small_encoder(), outputs, {"sides": codebook}, config, pictured=1)["sides"]
    assert accuracy.sheet.shape[2] == 3
    assert len(np.unique(accuracy.sheet.reshape(-1, 3), axis=0)) > 10


@pytest.mark.slow
def test_teachers_are_scored_together_as_each_alone_over_the_scenes_that_have_them(walls):
    scenes, outputs, codebook = walls
    first, second = (part for scene in scenes for part in scene.parts)
    sides, encoder = outputs["sides"], small_encoder((outputs.channels, outputs.channels))
    other = replace(sides, space=replace(sides.space, name="other"))
    both, codebooks = OutputSpaces(by_teacher={"a": sides, "b": other}), {"a": codebook, "b": codebook}
    config = EncodeConfig(precision="float32")
    scenes = [TrainingScene([first, None]), TrainingScene([second, second])]
    together = validate_names(scenes, encoder, both, codebooks, config)
    assert list(together.scores) == ["a/names", "a/cosine_named", "b/names", "b/cosine_named"]
    assert list(together.pictures) == ["a_features", "b_features"]
    alone = validate_encoder([TrainingScene([None, second])], encoder, both, codebooks, config)
    assert list(alone) == ["b"]
    assert alone["b"].score == together.scores["b/names"]
    of_first, of_second = (
        validate_encoder([TrainingScene([part, None])], encoder, both, codebooks, config)["a"]
        for part in (first, second)
    )
    correct, total = of_first.correct + of_second.correct, of_first.total + of_second.total
    assert together.scores["a/names"] == pytest.approx(float(np.nanmean(correct[total > 0] / total[total > 0])))
