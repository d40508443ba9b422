"""Memories of features that an encoder predicts: they take the place of fused ones if they are of the same space."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory_scenes import PREPARE, BlendedTeacher
from training_scenes import scene as wall

from gsencoder.app.commands.memory import fit_errors, in_space
from gsencoder.core.errors import InputError
from gsencoder.evaluate.sources import RenderedTally
from gsencoder.memory.attention import render_queries
from gsencoder.memory.bank import BankConfig
from gsencoder.render import BlendConfig, blend
from gsencoder.train.memory import (
    MemoryConfig,
    MemoryScene,
    memory_training,
    prepare_memory,
    train_memory,
    untrained_memory,
)
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures


def predicted_features(name: str = "hidden", seed: int = 0) -> GaussianFeatures:
    """What an encoder might say of the wall: unlike the features that a fusion gives."""
    rng = np.random.default_rng(seed)
    teacher = BlendedTeacher(wall(0), name)
    weights = rng.uniform(0.5, 1, 400).astype(np.float32)
    weights[::9] = 0
    values = (5 * rng.normal(size=(400, 12)) + 2).astype(np.float32)
    values[weights == 0] = 0
    return GaussianFeatures(
        features=values, weights=weights, mean=np.full(12, 2, np.float32), space=teacher.space
    )  # fmt: skip


def prepared(folder: Path, predicted: GaussianFeatures | None) -> MemoryScene:
    scene = wall(0)
    return prepare_memory(
        scene, BlendedTeacher(scene), folder, BankConfig(threshold=0.9), PREPARE, predicted=predicted
    )  # fmt: skip


def test_predicted_features_take_the_place_of_fused_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fused(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.fuse", fused)
    predicted = predicted_features()
    made = prepared(tmp_path / "made", predicted)
    features = made.fused_features()
    np.testing.assert_array_equal(features.weights, predicted.weights)
    np.testing.assert_array_equal(features.mean, predicted.mean)
    np.testing.assert_array_equal(features.features[~predicted.seen], 0)
    np.testing.assert_allclose(features.features, predicted.features, atol=0.01)
    # Standard units are those of the Gaussians that have features: their mean square is one.
    targets = made.prepared.targets(np.flatnonzero(predicted.seen))
    assert np.square(targets.astype(np.float64)).mean() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("init", ["fused", "random"])
def test_gaussians_without_a_feature_have_no_query_before_and_after_the_training(tmp_path: Path, init: str) -> None:
    predicted = predicted_features()
    made = prepared(tmp_path / "made", predicted)
    config = MemoryConfig(channels=4, points=50, init=init)  # type: ignore[arg-type]
    training = replace(memory_training(), steps=2, warmup=1, learning_rate=0.1)
    trained = train_memory({"a": made}, config, training, work=tmp_path)[0]["a"]
    for memory in (trained, untrained_memory(made, config)):
        np.testing.assert_array_equal(memory.weights, predicted.weights)
        np.testing.assert_array_equal(memory.queries[~predicted.seen], 0)
        assert memory.queries[predicted.seen].all(axis=1).all()


def test_a_folder_that_was_prepared_with_other_predictions_is_refused(tmp_path: Path) -> None:
    prepared(tmp_path / "made", predicted_features())
    prepared(tmp_path / "made", predicted_features())
    for other in (None, predicted_features(seed=1)):
        with pytest.raises(InputError, match="predicted="):
            prepared(tmp_path / "made", other)


def test_a_preparation_that_was_cut_off_is_not_continued_with_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Maps and a sample say nothing of what they were made from."""

    def cut_off(*arguments: object, **settings: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("gsencoder.train.memory.write_prepared", cut_off)
        with pytest.raises(KeyboardInterrupt):
            prepared(tmp_path / "made", predicted_features())
    with pytest.raises(InputError, match="was begun with predicted=.*resume=false"):
        prepared(tmp_path / "made", predicted_features(seed=1))
    made = prepared(tmp_path / "made", predicted_features())
    np.testing.assert_array_equal(made.fused_features().weights, predicted_features().weights)


def test_predictions_of_another_space_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the predicted features are of \(other.*, and the teacher's of \(hidden"):
        prepared(tmp_path, predicted_features("other"))


def test_of_the_predictions_of_several_teachers_those_of_the_space_are_taken() -> None:
    first, second = predicted_features("first"), predicted_features("second", seed=1)
    both = {"a": first, "b": second}
    assert in_space(both, second.space, "weights") is second
    assert in_space(both, first.space, "weights") is first
    other = replace(first.space, text_encoder="clip")
    with pytest.raises(
        InputError, match=r"weights=w: this encoder gives features of \(first .*; second .*\), and the teacher"
    ):
        in_space(both, other, "w")
    with pytest.raises(InputError, match=r"third"):
        in_space(both, FeatureSpace(name="third", channels=12), "w")


def in_a_basis(predicted: GaussianFeatures) -> GaussianFeatures:
    """The same features in coordinates of all directions."""
    components = np.linalg.qr(np.random.default_rng(3).normal(size=(12, 12)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=predicted.mean, components=components, energy_kept=1.0, space=predicted.space)
    coordinates = ((predicted.features - predicted.mean) @ components.T).astype(np.float32)
    return replace(predicted, features=coordinates * predicted.seen[:, None], basis=basis)


@pytest.mark.parametrize("basis", [True, False])
@pytest.mark.parametrize("least", [0.2, 0.5, 0.8])
def test_the_fit_is_how_far_rendered_features_are_from_the_teachers_maps_in_all_views(
    tmp_path: Path, basis: bool, least: float
) -> None:
    predicted = predicted_features()
    made = prepared(tmp_path / "made", in_a_basis(predicted) if basis else predicted)
    assert (made.outputs.basis is not None) == basis
    # With products, where the length of a query matters.
    config = MemoryConfig(channels=12, scoring="dot", temperature=20.0)
    memory = untrained_memory(made, config)
    scene = wall(0)
    assert scene.gaussians is not None
    assert scene.views is not None
    teacher, tally = BlendedTeacher(scene), RenderedTally(memory.mean)
    for view in range(2):
        target = teacher.feature_map(scene.views, view)
        assert target.features is not None
        truth = target.features.reshape(-1, 12)
        b = blend(scene.gaussians, scene.views.cameras, view, like=target, config=BlendConfig(rays_per_patch=4))
        queries, alpha = render_queries(memory, b)
        good = (alpha >= least) & np.isfinite(truth[:, 0])
        tally.add(memory.attend(queries[good]), truth[good])
    expected, errors = tally.errors(), fit_errors(memory, made, least)
    assert errors.cells == pytest.approx(expected.cells, abs=3)
    assert (errors.pictures, errors.not_finite) == (2, 0)
    assert errors.cosine == pytest.approx(expected.cosine, abs=2e-3)
    assert errors.centered == pytest.approx(expected.centered, abs=5e-3)
    assert errors.l2 == pytest.approx(expected.l2, rel=2e-2)
