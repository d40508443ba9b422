"""The weights that come with the package: small, whole, and good for what they were made for."""

from pathlib import Path

import pytest

from gsencoder.data.text_table import load_text_table
from gsencoder.evaluate.naming import evaluate_naming, naming_scores
from gsencoder.evaluate.sources import encoded, opened
from gsencoder.fusion.store import WORDS_FILE
from gsencoder.models.weights import SHIPPED, load_weights

FOLDER = SHIPPED / "house_cpu"


def test_they_take_less_than_ten_megabytes_and_say_how_they_were_made() -> None:
    assert (FOLDER / "encoder.safetensors").stat().st_size < 10e6
    _, outputs, made_by = load_weights("house_cpu")
    words = load_text_table(FOLDER / WORDS_FILE)
    assert outputs.space.text_encoder == words.space.text_encoder
    assert made_by["steps"] == made_by["settings"]["train"]["steps"]
    assert not any(Path(path).is_absolute() for path in made_by["settings"]["paths"])


@pytest.mark.parametrize("number", [40, 45])
def test_rooms_that_they_never_saw_are_named(shared: Path, number: int) -> None:
    encoder, outputs, _ = load_weights("house_cpu")
    words = load_text_table(FOLDER / WORDS_FILE)
    path = shared / "scenes" / "house" / f"train_{number:03d}"
    assert naming_scores(evaluate_naming(opened([path]), encoded(encoder, outputs), words))["accuracy"] >= 0.7
