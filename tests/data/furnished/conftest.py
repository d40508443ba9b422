"""The models of a library of boxes."""

import pytest
from furniture import write_library

from gsencoder.data.furnished.library import Model, load_libraries


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Model, ...]:
    return load_libraries([write_library(tmp_path_factory.mktemp("library") / "test.sh3f")])
