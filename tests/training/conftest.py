"""Rooms, and what `train` made of them."""

from pathlib import Path

import pytest
from command_runs import QUICK
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rooms and the words of all that is in them."""
    folder = tmp_path_factory.mktemp("rooms")
    made = [make_room(number, objects=4, views=4, width=64, height=48) for number in range(3)]
    for number, room in enumerate(made):
        write_room(room, folder / f"room_{number}")
    write_words(folder / "words.safetensors", *made)
    return folder


@pytest.fixture(scope="session")
def trained(rooms: Path) -> Path:
    out = rooms.parent / "encoder"
    scenes = [str(rooms / f"room_{number}") for number in range(3)]
    words = f"teacher.words={rooms / 'words.safetensors'}"
    assert cli.main(["train", *scenes, "holdout=room_2", words, f"out={out}", *QUICK]) == 0
    return out
