"""Scenes and prompts that are prepared once for all tests of training."""

from pathlib import Path

import pytest
from joint_training import Datasets, prepared_by_both
from training_scenes import Prepared, prepared
from tuning_pairs import Pairs, make_model, make_pairs


@pytest.fixture(scope="session")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Datasets:
    return prepared_by_both(tmp_path_factory.mktemp("prepared"))


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    return prepared(tmp_path_factory.mktemp("prepared"))


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model(tmp_path_factory.mktemp("vlm") / "model")


@pytest.fixture(scope="session")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Pairs:
    return make_pairs(tmp_path_factory.mktemp("prompts"))
