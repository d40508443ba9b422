"""Small vision towers."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from vision_towers import save_vision_tower


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    for kind in ("clip", "dinov2", "dinov3", "sam", "llava"):
        save_vision_tower(kind, folder / kind)
    return folder


@pytest.fixture
def copied(models: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a model, to be spoiled."""

    def copy(kind: str) -> Path:
        return Path(shutil.copytree(models / kind, tmp_path / "model"))

    return copy
