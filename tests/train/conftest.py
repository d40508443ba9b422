"""Fixtures of the tests of training."""

import pytest
from joint_training import Datasets, prepared_by_both


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Datasets:
    return prepared_by_both(tmp_path_factory.mktemp("prepared"))
