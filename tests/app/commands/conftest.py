"""What tests of `reconstruct` look at, and what tests of `ask` ask of."""

import shutil
from pathlib import Path

import pytest
from asked_rooms import KEY, save_room
from reconstructions import QUICK

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    write_room(make_room(0, objects=4, views=6, width=120, height=90), folder)
    return folder


@pytest.fixture(scope="session")
def built(room: Path) -> Path:
    out = room.parent / "built"
    assert cli.main(["reconstruct", str(room), f"out={out}", *QUICK]) == 0
    return out


@pytest.fixture(scope="session")
def photographs(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photographs that belong together, and one that shows nothing."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("plush") / "photographs"
    folder.mkdir()
    for path in sorted((shared / "scenes" / "plush" / "images").iterdir())[:6]:
        shutil.copy(path, folder)
    Image.new("RGB", (720, 540), (90, 90, 90)).save(folder / "grey.jpg")
    return folder


@pytest.fixture(scope="session")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "features"
    save_room(folder, step=0.12)
    return folder


@pytest.fixture
def vlm_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key and a model, as a user's shell has them."""
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setenv("GSENCODER_VLM_MODEL", "tiny")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
