"""Validation on prepared scenes, with an encoder that knows, and with ones that do not."""

import numpy as np
import pytest
from training_scenes import prepared, small_encoder

from gsencoder.evaluate import validation
from gsencoder.evaluate.validation import ClassAccuracy, nearest_classes, validate_encoder
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.models.output_space import OutputSpaces
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.types import GaussianFeatures


def test_choices_are_those_that_occur_in_the_scene() -> None:
    codebook = np.eye(3, dtype=np.float32)
    assert nearest_classes(codebook, codebook, np.array([0, 2])).tolist()[::2] == [0, 2]


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[PreparedScene], OutputSpaces, np.ndarray]:
    dataset, names = prepared(tmp_path_factory.mktemp("prepared"), count=2)
    outputs, codebook = dataset.load_space()
    assert codebook is not None
    return dataset.scenes(names), OutputSpaces(by_teacher={"sides": outputs}), codebook


def judged(
    walls: tuple[list[PreparedScene], OutputSpaces, np.ndarray], monkeypatch: pytest.MonkeyPatch, answers: object
) -> ClassAccuracy:
    """Validation of an encoder that answers with what a function makes of the targets of each scene in turn."""
    scenes, outputs, codebook = walls
    turn, space = iter(scenes), outputs["sides"]

    def encode(*_: object, **__: object) -> GaussianFeatures:
        scene = next(turn)
        values = answers(scene.targets(np.arange(len(scene))))  # type: ignore[operator]
        weights = np.ones(len(scene), np.float32)
        return GaussianFeatures(
            features=space.restore(values), weights=weights, mean=space.mean, space=space.space, basis=None
        )

    monkeypatch.setattr(validation, "encode", encode)
    return validate_encoder(scenes, small_encoder(), outputs, "sides", codebook)


def test_who_gives_the_targets_is_always_right(
    walls: tuple[list[PreparedScene], OutputSpaces, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = judged(walls, monkeypatch, lambda targets: targets)
    assert found.score == 1
    assert found.cosine_named == pytest.approx(1, abs=1e-5)
    assert found.total.sum() == sum(int((scene.weights > 0).sum()) for scene in walls[0])


def test_who_always_says_the_same_is_right_about_one_kind_and_who_says_the_opposite_about_none(
    walls: tuple[list[PreparedScene], OutputSpaces, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    codebook = walls[2]
    found = judged(walls, monkeypatch, lambda targets: np.broadcast_to(codebook[1], targets.shape).copy())
    assert found.accuracies()[1] == 1
    assert found.score == pytest.approx(1 / np.isfinite(found.accuracies()).sum())
    opposite = judged(walls, monkeypatch, lambda targets: -targets)
    assert opposite.cosine_named == pytest.approx(-1, abs=1e-5)
    assert opposite.score < 0.2


@pytest.mark.slow
def test_an_encoder_is_drawn_beside_the_truth(
    walls: tuple[list[PreparedScene], OutputSpaces, np.ndarray],
) -> None:
    scenes, outputs, codebook = walls
    found = validate_encoder(
        scenes, small_encoder(), outputs, "sides", codebook, EncodeConfig(precision="float32"), pictured=1
    )
    assert found.sheet is not None
    assert found.sheet.shape[2] == 3
    assert len(np.unique(found.sheet.reshape(-1, 3), axis=0)) > 10
