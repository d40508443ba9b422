"""A small synthetic room with features of names, and photographs, that tests of the page stand on."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.page.page import MAGIC, Bundle, Container
from gsencoder.infer.page.search import SceneSearch, object_numbers, thin_for_display
from gsencoder.text.table import WORDS_FILE, TextTable, load_text_table, make_text_table, save_text_table
from gsencoder.types import FeatureSpace, GaussianFeatures, Scene

HOSTILE = "<img src=x onerror=\"document.title='harmed'\"></script><script>document.title='harmed'</script>\u202e&amp;'"
STUB = Bundle(script="'use strict';", style="body { margin: 0; }")
CHANNELS = 32
NOISE = 0.4


def room_scene() -> Scene:
    """Five objects on a table, six views, about five thousand Gaussians."""
    return make_room(0, objects=5, views=6, width=96, height=72, spacing=0.08)


def name_features(scene: Scene, rename: dict[str, str] | None = None) -> tuple[GaussianFeatures, TextTable]:
    """Features that are the vector of the name of the object that a Gaussian lies in, with some noise; of the room
    itself what lies high was seen by no view."""
    rng = np.random.default_rng(0)
    means = scene.gaussians.means
    numbers = object_numbers(means, scene.objects, scene.origin, 0.01)
    rename = rename or {}
    names = [rename.get(each.name or "room", each.name or "room") for each in scene.objects]
    known = list(dict.fromkeys([*names, "piano"]))
    vectors = np.linalg.qr(rng.normal(size=(CHANNELS, len(known))))[0].T.astype(np.float32)
    row = np.array([known.index("room"), *(known.index(name) for name in names)])[numbers]
    features = vectors[row] + NOISE * rng.normal(size=(len(means), CHANNELS)).astype(np.float32) / CHANNELS**0.5
    seen = (row != known.index("room")) | (means[:, 2] < 1.2)
    weights = np.where(seen, rng.uniform(0.1, 50, len(means)), 0).astype(np.float32)
    features[~seen] = 0
    mean = features[seen].mean(axis=0)
    space = FeatureSpace(name="names", channels=CHANNELS, teacher="labels", text_encoder="table")
    made = GaussianFeatures(features=features, weights=weights, mean=mean, space=space)
    return made, make_text_table(known, vectors, "table")


def save_viewed_room(folder: Path, rename: dict[str, str] | None = None, **changes: object) -> Scene:
    """Writes the room as a scene into `folder/room`, and its features into `folder/features`."""
    scene = room_scene()
    write_room(scene, folder / "room")
    features, table = name_features(scene, rename)
    (folder / "features").mkdir()
    save_features(folder / "features", replace(scene, **changes), features)  # type: ignore[arg-type]
    save_text_table(folder / "features" / WORDS_FILE, table)
    return scene


def search_of(folder: Path, *, max_gaussians: int = 1_000_000) -> SceneSearch:
    """The search over the features in a folder."""
    shown = thin_for_display(load_features(folder), "features", max_gaussians=max_gaussians)
    return SceneSearch(display=shown, words=load_text_table(folder / WORDS_FILE), config=LocalizeConfig())


def read_container(data: bytes) -> Container:
    """Reads what `Container.to_bytes` wrote.

    Raises:
        InputError: something else, or cut off.
    """
    begin = len(MAGIC) + 4
    if data[: len(MAGIC)] != MAGIC or len(data) < begin:
        raise InputError(f"expected {len(data)} bytes that begin with {MAGIC!r}, got {data[:8]!r}")
    (length,) = struct.unpack_from("<I", data, len(MAGIC))
    header = json.loads(data[begin : begin + length])
    arrays = {}
    for name, entry in header["arrays"].items():
        count = int(np.prod(entry["shape"], dtype=np.int64))
        kind = np.dtype(entry["type"]).newbyteorder("<")
        at = begin + length + entry["offset"]
        if at + count * kind.itemsize > len(data):
            raise InputError(f"array {name!r} ends behind the {len(data):,} bytes there are")
        arrays[name] = np.frombuffer(data, kind, count, at).reshape(entry["shape"]).astype(entry["type"])
    return Container(meta=header["meta"], arrays=arrays)
