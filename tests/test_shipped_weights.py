"""The weights that come with the package: small, whole, and good for what they were made for."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.evaluate.benchmarks.naming import NamingProtocol, naming_scores
from gsencoder.evaluate.benchmarks.protocol import Evaluation
from gsencoder.fusion.basis import field_error
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.localize import localize
from gsencoder.models.encoder import load_weights
from gsencoder.models.output_space import SHIPPED_WEIGHTS
from gsencoder.text.table import TextTable, load_tables
from gsencoder.text.vocabulary import words_of_table
from gsencoder.train.loop import CHANGEABLE_ON_RESUME
from gsencoder.train.samples import Augmentation
from gsencoder.types import GaussianFeatures, Scene

pytestmark = pytest.mark.slow

WEIGHTS = {"rooms": ["labels"], "house": ["labels", "dinov2_s14"]}
"""The weights, and the teachers of each."""
TRAINED = {"rooms": 698, "house": 63}
"""Number of names that they were trained on."""


@pytest.mark.parametrize("name", WEIGHTS)
def test_they_are_small_and_say_how_they_were_made(name: str) -> None:
    folder = SHIPPED_WEIGHTS / name
    assert sum(path.stat().st_size for path in folder.iterdir()) < (25e6 if name == "rooms" else 14e6)
    _, outputs, made_by = load_weights(name)
    assert list(outputs) == WEIGHTS[name]
    tables = load_tables(folder, outputs)
    assert list(tables) == ["labels"]
    words = tables["labels"]
    assert outputs["labels"].space.text_encoder == words.space.text_encoder
    assert len(words.trained or ()) == TRAINED[name]
    assert (words.is_trained("mugs"), words.is_trained("zebra")) == (True, False)
    # `rooms` was trained in several runs, of which the last one ends the stages.
    asked, done = made_by["settings"]["train"]["steps"], made_by["steps"]
    assert made_by["stages"][-1].startswith(f"{done} steps") and done <= asked if "stages" in made_by else done == asked
    assert not any(Path(path).is_absolute() for path in made_by["settings"]["paths"])


def agree(stored: object, current: object) -> bool:
    """Whether settings are equal; options that became constants since, and new ones, are left out."""
    if isinstance(stored, dict) and isinstance(current, dict):
        return all(agree(stored[name], current[name]) for name in stored.keys() & current.keys())
    return stored == current


def test_those_of_several_teachers_have_the_settings_of_their_experiment() -> None:
    _, _, made_by = load_weights("house")
    settings = plain(compose("train", TrainCommandConfig, ["MIX", "experiment=house", "out=house"]))
    made_with = made_by["settings"]
    for section in ("teachers", "text", "model", "sampling", "loss", "prepare", "splat"):
        assert agree(made_with[section], settings[section]), section
    # The weights were made before some options became constants with the same values.
    constants = {"clip": 1.0, "final_rate": 0.01, "weight_decay": 0.05, "compile": False}
    for name, value in made_with["train"].items():
        if name not in CHANGEABLE_ON_RESUME:
            assert value == {**constants, **settings["train"]}[name], name
    assert settings["augment"]
    # These were added since, and turns had any angle.
    later = {"recolor", "spread", "lift", "fade", "askew", "bend"}
    augmentation = {name: value for name, value in asdict(Augmentation(turn=180.0)).items() if name not in later}
    assert made_with["augment"] == augmentation


def unseen_room(shared: Path, number: int, *, views: int) -> Scene:
    folder = shared / "scenes" / "house" / f"train_{number:03d}"
    return with_gaussians(load_scene(folder, options=SceneConfig(max_views=views)))


def accuracy(scene: Scene, features: GaussianFeatures, words: TextTable) -> float:
    counts = NamingProtocol().start(Evaluation(words=words)).predict(scene, features)
    return naming_scores([counts])["accuracy"]


def test_an_unseen_room_is_named_and_found_by_phrases(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSENCODER_MODELS", str(shared / "models"))
    encoder, scene = Encoder.load("house"), unseen_room(shared, 45, views=3)
    encoded = encoder.encode_spaces(scene.gaussians)
    assert accuracy(scene, encoded["labels"], encoder.tables["labels"]) >= 0.7
    words = words_of_table(encoder.tables["labels"])
    localization = localize(replace(scene, features=encoded), ["something to sit on"], words, space="labels")
    best = localization.boxes[0]
    seats = [each for each in scene.objects if each.name in ("chair", "sofa")]
    assert max(aabb_iou(best.aabb_min, best.aabb_max, each.aabb_min, each.aabb_max) for each in seats) >= 0.25
    # DINOv2 has no words.
    with pytest.raises(InputError, match="dinov2-s14"):
        localize(replace(scene, features=encoded), ["mug"], words, space="dinov2_s14")


def test_the_default_weights_name_a_room_of_a_house_of_which_they_saw_others(shared: Path) -> None:
    encoder, scene = Encoder.load(""), unseen_room(shared, 42, views=3)
    features = encoder.encode(scene.gaussians, up=scene.up)
    assert accuracy(scene, features, encoder.tables["labels"]) >= 0.7
    assert features.confidence is not None
    assert features.confidence.mean() >= 0.5


def test_an_unseen_room_is_named_in_parts_as_in_one(shared: Path) -> None:
    encoder, scene = Encoder.load("house"), unseen_room(shared, 40, views=2)
    # Several parts, of which each has neighbors.
    assert len(scene.gaussians) > 2 * 10_000
    whole, parts = (encoder.encode(scene.gaussians, EncodeConfig(chunk=chunk), space="labels") for chunk in (0, 10_000))
    in_one, in_parts = (accuracy(scene, features, encoder.tables["labels"]) for features in (whole, parts))
    assert in_one >= 0.7
    assert in_parts >= in_one - 0.01
    assert 0 < field_error(parts, whole).centered <= 0.02
