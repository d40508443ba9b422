"""Words for the classes of networks that segment pictures, and views for them."""

from collections.abc import Sequence

import numpy as np
from splats import front_camera

from gsencoder.text.table import TextTable, make_text_table
from gsencoder.text.towers import unit
from gsencoder.types import Views

NAMES = ("other", "wall", "chair, seat", "table")


def words(rng: np.random.Generator, names: Sequence[str] = ("wall", "chair", "seat", "table", "lamp")) -> TextTable:
    return make_text_table(names, unit(rng.normal(size=(len(names), 8))), "toy")


def views_of(image: np.ndarray) -> Views:
    return Views(cameras=front_camera(image.shape[1], image.shape[0]), names=("a",), images=[image])
