"""A small room that several files of these tests reconstruct."""

from pathlib import Path

import pytest

from gsencoder.data.scenes import load_scene
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.types import Scene


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    write_room(make_room(0, objects=4, views=6, width=60, height=45), folder)
    return folder


@pytest.fixture(scope="session")
def scene(folder: Path) -> Scene:
    return load_scene(folder)
