"""Of an encoder with several teachers, the space that is asked for is the one that is evaluated."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splats import random_gaussians

from gsencoder.app.commands import evaluate as evaluate_sources
from gsencoder.core.errors import InputError
from gsencoder.evaluate.sources import FeatureSource, encoder_source, space_of_words
from gsencoder.infer.encode import Encoder
from gsencoder.text.table import TextTable, make_text_table, save_text_table
from gsencoder.text.vocabulary import with_training_names
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, Scene

WORDS = {name: make_text_table(("mug", "cup"), np.eye(2, dtype=np.float32), f"{name}-words") for name in "abc"}
TRAINED = {name: replace(table, trained=("cup",)) for name, table in WORDS.items()}


class Stub(Encoder):
    """An encoder whose features say nothing but which space they are of."""

    def __init__(self, tables: Mapping[str, TextTable] = TRAINED) -> None:
        self.voxel, self.made_by, self.tables = 0.02, {}, tables
        self.spaces = {name: FeatureSpace(name=name, channels=2, text_encoder=f"{name}-words") for name in WORDS}

    def encode_spaces(self, gaussians: Gaussians, *_: object, **__: object) -> dict[str, GaussianFeatures]:
        rows = np.ones((len(gaussians), 2), np.float32)
        return {
            name: GaussianFeatures(features=rows, weights=rows[:, 0], mean=rows[0], space=space)
            for name, space in self.spaces.items()
        }

    def encode(self, gaussians: Gaussians, *_: object, space: str, **__: object) -> GaussianFeatures:
        return self.encode_spaces(gaussians)[space]


def asked(source: FeatureSource) -> str:
    """The name of the space of a source's features."""
    features, _ = source(Scene(name="s", gaussians=random_gaussians(5), metres_per_unit=1.0))
    return features.space.name


@pytest.mark.parametrize("name", ["a", "b", "c"])
def test_the_space_is_that_which_is_named_or_that_of_the_words(name, monkeypatch, tmp_path):
    encoder: Any = Stub()
    assert asked(encoder_source(encoder, space=name)) == name
    assert space_of_words(encoder, WORDS[name]) == name
    twin: Any = Stub()
    twin.spaces["c"] = replace(twin.spaces["c"], text_encoder="a-words")
    with pytest.raises(InputError, match="those of 2 of the encoder's teachers"):
        space_of_words(twin, WORDS["a"])
    monkeypatch.setattr(evaluate_sources.Encoder, "load", lambda *_: encoder)
    source, words = evaluate_sources.teacher_or_encoder(
        evaluate_sources.EvaluateConfig(paths=("s",), weights="w", space=name)
    )
    assert asked(source) == name
    assert words.space.text_encoder == f"{name}-words"
    save_text_table(tmp_path / "words.safetensors", WORDS[name])
    own = replace(evaluate_sources.LabelsConfig(), words=str(tmp_path / "words.safetensors"))
    source, words = evaluate_sources.teacher_or_encoder(
        evaluate_sources.EvaluateConfig(paths=("s",), weights="w", teacher=own)
    )
    assert asked(source) == name
    # What the encoder was trained on is stated by the table of this space, also for words that are given.
    assert words.trained == ("cup",)


def test_words_state_the_names_trained_on_where_the_table_beside_them_does() -> None:
    assert with_training_names(WORDS["a"], TRAINED["a"]).trained == ("cup",)  # type: ignore[union-attr]
    other = replace(TRAINED["b"], trained=("mug",))
    # Words that state them themselves stay as they are.
    assert with_training_names(other, TRAINED["a"]).trained == ("mug",)  # type: ignore[union-attr]
    for table in (WORDS["a"], None):
        assert with_training_names(WORDS["a"], table).trained is None  # type: ignore[union-attr]
