"""The weights that come with the package: small, whole, and good for what they were made for."""

from pathlib import Path

import pytest

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.evaluate.protocols.naming import evaluate_naming, naming_scores
from gsencoder.fusion.feature_error import field_error
from gsencoder.fusion.store.folder import WORDS_FILE
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.encode.encode import TorchEncoder
from gsencoder.models.weights import SHIPPED_WEIGHTS, load_weights
from gsencoder.text.table import load_text_table

pytestmark = pytest.mark.slow

FOLDER = SHIPPED_WEIGHTS / "house_cpu"


def test_they_take_less_than_ten_megabytes_and_say_how_they_were_made() -> None:
    assert (FOLDER / "encoder.safetensors").stat().st_size < 10e6
    _, outputs, made_by = load_weights("house_cpu")
    words = load_text_table(FOLDER / WORDS_FILE)
    assert outputs.select().space.text_encoder == words.space.text_encoder
    assert made_by["steps"] == made_by["settings"]["train"]["steps"]
    assert not any(Path(path).is_absolute() for path in made_by["settings"]["paths"])


@pytest.mark.parametrize("number", [40, 45])
def test_rooms_that_they_never_saw_are_named_in_parts_as_in_one(shared: Path, number: int) -> None:
    encoder = TorchEncoder("house_cpu")
    words = load_text_table(FOLDER / WORDS_FILE)
    scene = with_gaussians(load_scene(shared / "scenes" / "house" / f"train_{number:03d}"))
    assert scene.gaussians is not None
    accuracies, features = [], []
    for chunk in (0, 80_000):
        given = encoder.encode(scene.gaussians, EncodeConfig(chunk=chunk))
        named = evaluate_naming([(scene, 0.0)], lambda _, given=given: (given, {}), words)
        accuracies.append(naming_scores(named)["accuracy"])
        features.append(given)
    assert accuracies[0] >= 0.7
    assert accuracies[1] >= accuracies[0] - 0.01
    whole, parts = features
    assert 0 < field_error(parts, whole).centered <= 0.02
