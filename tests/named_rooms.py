"""Word tables of built-in rooms, for a teacher that names what their label pictures show."""

from pathlib import Path

import numpy as np

from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import Scene


def write_words(path: Path, *rooms: Scene) -> Path:
    """Writes a table with a vector of its own for each kind of thing in the rooms, and returns its path."""
    names = sorted({thing.name for room in rooms for thing in room.objects if thing.name})
    save_text_table(path, make_text_table(names, np.eye(len(names), dtype=np.float32), "room-words"))
    return path
