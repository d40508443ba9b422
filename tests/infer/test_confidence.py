"""Confidence of an encoder's names: the posterior of its contrast, by regions, in files, and what is told of it."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from feature_fields import make_features, plain_features
from rooms import merged
from scipy.special import log_softmax, logsumexp
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splats.files import save_splat
from gsencoder.fusion.folder import features_bytes, load_features, principal_axes, save_features
from gsencoder.fusion.package import save_index_package, save_package
from gsencoder.infer.encode import MANY_GAUSSIANS, MANY_NAMES, Encoder, name_confidence, name_evidence
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.onnx.runtime import from_metadata, to_metadata
from gsencoder.infer.relevancy import expected_share
from gsencoder.memory.index import index_features
from gsencoder.models.encoder import load_weights, save_weights
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureBasis, FeatureSpace, Scene

COEFFICIENTS = (0.3, 0.8, -0.2, 0.5, 0.1)
SPACE = FeatureSpace(name="six", channels=6, text_encoder="words-6")
WORDS = TextTable(
    names=("mug", "plant", "chair"),
    embeddings=np.eye(6, dtype=np.float32)[:3],
    space=SPACE,
    mean=np.zeros(6, np.float32),
)


@pytest.fixture
def confident(weights: Path, tmp_path: Path) -> Path:
    """A folder of weights that state their confidence."""
    network, outputs, made_by = load_weights(str(weights))
    stated = {name: replace(each, confidence=COEFFICIENTS) for name, each in outputs.by_teacher.items()}
    folder = tmp_path / "confident"
    folder.mkdir()
    save_weights(folder / "encoder.safetensors", network, OutputSpaces(by_teacher=stated), made_by)
    (folder / "words.safetensors").write_bytes((weights / "words.safetensors").read_bytes())
    return folder


@pytest.mark.parametrize("basis", [False, True])
def test_odds_are_those_of_the_softmax_over_distances(basis, rng, monkeypatch):
    monkeypatch.setattr("gsencoder.infer.encode.NAME_ROWS", 16)
    mean = rng.normal(size=6).astype(np.float32)
    components = np.linalg.qr(rng.normal(size=(6, 4)))[0].T.astype(np.float32)
    within = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE) if basis else None
    outputs = OutputSpace(space=SPACE, mean=mean, scale=2.0, basis=within)
    names = rng.normal(size=(5, 6)).astype(np.float32)
    restored = rng.normal(size=(40, outputs.channels)).astype(np.float32)
    coordinates = (names - mean) @ components.T if basis else names
    squares = ((restored[:, None].astype(float) - coordinates[None]) ** 2).sum(axis=2) / outputs.unit**2
    logs = np.sort(log_softmax(-squares / (2 * outputs.channels * 0.1), axis=1), axis=1)
    evidence = name_evidence(outputs, names, restored, np.zeros(40, np.int64))
    assert evidence[:, 0] == pytest.approx(logs[:, -1] - logsumexp(logs[:, :-1], axis=1), abs=1e-4)
    # A synonym has the same vector, and is no rival.
    twice = name_evidence(outputs, np.concatenate([names, names[:2]]), restored, np.zeros(40, np.int64))
    assert np.array_equal(twice, evidence)


def test_a_feature_far_from_all_names_and_one_at_a_name_have_finite_odds() -> None:
    outputs = OutputSpace(space=SPACE, mean=np.zeros(6, np.float32), scale=1e-3)
    rows = np.array([WORDS.embeddings[0], np.full(6, 1e4), np.full(6, -1e4)], np.float32)
    with np.errstate(over="raise", invalid="raise"):
        evidence = name_evidence(outputs, WORDS.embeddings, rows, np.zeros(3, np.int64))
        confidence = name_confidence(evidence, COEFFICIENTS)
    assert np.isfinite(confidence).all()
    assert (confidence >= 0).all()
    assert (confidence <= 1).all()


def named(*names: int) -> tuple[OutputSpace, np.ndarray]:
    """Features that are the vectors of names."""
    return OutputSpace(space=SPACE, mean=np.zeros(6, np.float32), scale=1.0), np.eye(6, dtype=np.float32)[list(names)]


def test_evidence_of_a_region_is_the_mean_of_its_odds_the_entropy_of_its_names_and_its_size() -> None:
    outputs, rows = named(0, 1, 0, 1, 2, 2, 2, 2)
    evidence = name_evidence(outputs, WORDS.embeddings, rows, np.array([0, 0, 0, 0, 1, 1, 1, 1]))
    assert evidence[:, 1] == pytest.approx(np.repeat(evidence[:, 0].reshape(2, 4).mean(axis=1), 4))
    assert evidence[:, 2] == pytest.approx([np.log(2)] * 4 + [0] * 4, abs=1e-6)
    assert evidence[:, 3] == pytest.approx(np.log10(4))


def test_evidence_of_large_regions_of_many_names_is_limited() -> None:
    outputs = OutputSpace(space=SPACE, mean=np.zeros(6, np.float32), scale=1.0)
    names = np.random.default_rng(0).normal(size=(100, 6)).astype(np.float32)
    evidence = name_evidence(outputs, names, np.tile(names, (400, 1)), np.zeros(40_000, np.int64))
    assert evidence[0, 2] == MANY_NAMES < np.log(100)
    assert evidence[0, 3] == MANY_GAUSSIANS < np.log10(40_000)


def test_evidence_of_a_region_does_not_depend_on_another(rng: np.random.Generator) -> None:
    outputs = OutputSpace(space=SPACE, mean=np.zeros(6, np.float32), scale=1.0)
    rows, regions = rng.normal(size=(50, 6)).astype(np.float32), np.arange(50) % 2
    changed = np.where(regions[:, None] == 1, rows[::-1], rows)
    before, after = (name_evidence(outputs, WORDS.embeddings, each, regions) for each in (rows, changed))
    assert np.array_equal(before[regions == 0], after[regions == 0])
    assert not np.allclose(before[regions == 1, 1], after[regions == 1, 1])
    alone = name_evidence(outputs, WORDS.embeddings, rows[regions == 0], np.zeros(25, np.int64))
    assert before[regions == 0] == pytest.approx(alone, abs=1e-6)


def test_confidence_is_logistic_in_the_evidence() -> None:
    evidence = np.array([[1, 2, 0.5, 4], [0, 0, 0, 0]], np.float32)
    logits = np.array([0.3 + 0.8 - 0.4 + 0.25 + 0.4, 0.3])
    assert name_confidence(evidence, COEFFICIENTS) == pytest.approx(1 / (1 + np.exp(-logits)))


def test_an_encoder_states_confidence_if_its_weights_do(weights: Path, confident: Path) -> None:
    cloud = random_gaussians(300)
    plain, stated = (Encoder.load(str(folder)).encode(cloud) for folder in (weights, confident))
    assert plain.confidence is None
    assert stated.confidence is not None
    assert stated.confidence.shape == (300,)
    assert np.array_equal(plain.features, stated.features)
    encoder = Encoder.load(str(confident))
    # Chair is a word that it was not trained on.
    trained = encoder.tables["labels"].embeddings[:2]
    evidence = name_evidence(encoder.outputs["labels"], trained, stated.features, np.zeros(300, np.int64))
    assert stated.confidence == pytest.approx(name_confidence(evidence, COEFFICIENTS))
    rooms = [replace(each := random_gaussians(1000, seed), means=each.means + np.float32(99 * seed)) for seed in (0, 1)]
    alone = [encoder.encode(room).confidence for room in rooms]
    assert encoder.encode(merged(*rooms)).confidence == pytest.approx(np.concatenate(alone), abs=1e-5)


def test_a_graph_carries_the_coefficients(confident: Path) -> None:
    header = Encoder.load(str(confident)).network.header
    assert from_metadata(to_metadata(header)).outputs["labels"].confidence == COEFFICIENTS


@pytest.mark.parametrize("wrong", [(1.0, 2.0, 3.0), (1.0, 2.0, 3.0, 4.0, np.nan)])
def test_wrong_coefficients_are_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="five finite numbers"):
        OutputSpace(space=SPACE, mean=np.zeros(6, np.float32), scale=1.0, confidence=wrong)


def test_files_keep_confidence_and_their_size_is_known(tmp_path: Path, rng: np.random.Generator) -> None:
    features = make_features(200)
    stated = np.where(features.seen, rng.uniform(size=200), 0).astype(np.float32)
    features = replace(features, confidence=stated)
    save_features(tmp_path, Scene(name="s", gaussians=random_gaussians(200)), features)
    (read,) = load_features(tmp_path).features.values()
    assert read.confidence == pytest.approx(stated, abs=5e-4)
    size = (tmp_path / "features.safetensors").stat().st_size
    assert features_bytes(features.space, int(features.seen.sum()), 6, confidence=True) == pytest.approx(size, abs=64)
    assert np.array_equal(features.select(np.arange(0, 200, 3)).confidence, stated[::3])  # type: ignore[arg-type]
    fewer = principal_axes(features).reduced(features, 3)
    assert fewer.confidence is not None
    assert np.array_equal(fewer.confidence, stated)


def test_packages_keep_confidence(tmp_path: Path, rng: np.random.Generator) -> None:
    features = replace(make_features(200), confidence=rng.uniform(size=200).astype(np.float32))
    scene = Scene(name="s", gaussians=random_gaussians(200))
    for name in ("compact", "index"):
        (tmp_path / name).mkdir()
    save_package(tmp_path / "compact", scene, features, error=0.1)
    indexed = index_features(features).features
    save_index_package(tmp_path / "index", scene, indexed, error=0.1)
    for name in ("compact", "index"):
        (read,) = load_features(tmp_path / name).features.values()
        assert read.confidence == pytest.approx(features.confidence, abs=0.5 / 255 + 1e-6)


def two_things(confidence: float | None) -> Scene:
    """A mug of 60 Gaussians and a plant of 60, a metre apart."""
    gaussians = random_gaussians(120)
    means = gaussians.means * np.float32(0.05)
    means[60:, 0] += 1
    features = plain_features(np.repeat(WORDS.embeddings[:2], 60, axis=0), SPACE)
    if confidence is not None:
        stated = np.concatenate([np.clip(confidence + np.tile([-0.1, 0.1], 30), 0, 1), np.ones(60)])
        features = replace(features, confidence=stated.astype(np.float32))
    return Scene(name="s", gaussians=replace(gaussians, means=means), features={"six": features})


@pytest.mark.parametrize("confidence", [0.0, 0.125, 0.25])
def test_boxes_are_less_probable_where_fewer_than_half_of_the_names_are_expected_to_be_right(confidence: float) -> None:
    config = LocalizeConfig(min_probability=0.0)
    plain, doubtful = (localize(two_things(each), ["mug", "plant"], WORDS, config) for each in (None, confidence))
    by_word = {box.query: box.probability for box in doubtful.boxes if box.rank == 0}
    before = {box.query: box.probability for box in plain.boxes if box.rank == 0}
    (features,) = two_things(confidence).features.values()
    assert features.confidence is not None
    assert by_word["mug"] == pytest.approx(2 * features.confidence[:60].mean() * before["mug"])
    assert by_word["plant"] == before["plant"]
    assert doubtful.probabilities[0] == pytest.approx(by_word["mug"])


def test_boxes_where_half_of_the_names_are_expected_to_be_right_are_as_probable_as_without_doubt() -> None:
    config = LocalizeConfig(min_probability=0.0)
    plain, doubtful = (localize(two_things(each), ["mug", "plant"], WORDS, config) for each in (None, 0.6))
    assert [box.probability for box in doubtful.boxes] == [box.probability for box in plain.boxes]


def test_a_scene_of_which_less_than_half_is_expected_to_be_right_is_warned_of() -> None:
    scene = two_things(0.0)
    (features,) = scene.features.values()
    less = replace(features, confidence=np.full(120, 0.41, np.float32))
    with pytest.warns(SceneWarning, match="scene s: the encoder expects 41% .*gsencoder fuse"):
        localize(replace(scene, features={"six": less}), ["plant"], WORDS)


def test_a_known_scene_is_not_warned_of() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", SceneWarning)
        localize(two_things(0.9), ["plant"], WORDS)
        localize(two_things(None), ["plant"], WORDS)
    (features,) = two_things(0.9).features.values()
    assert expected_share(features, "s") == pytest.approx(0.95)
    unseen = replace(features, weights=np.repeat(np.float32([1, 0]), 60))
    assert expected_share(unseen, "s") == pytest.approx(0.9)


def test_encode_writes_the_share_and_warns(confident: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_splat(tmp_path / "splat.ply", random_gaussians(300))
    out = tmp_path / "features"
    assert cli.main(["encode", str(tmp_path / "splat.ply"), f"weights={confident}", f"out={out}"]) == 0
    (features,) = load_features(out).features.values()
    assert features.confidence is not None
    share = features.confidence.mean()
    printed = capsys.readouterr()
    assert f"{share:.0%} of their names" in printed.out
    assert ("fewer than half" in printed.err) == (share < 0.5)
