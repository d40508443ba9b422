"""SplatDistill's way with a small random RADIO: what its commands wrote, one after the other."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import pytest
from radio_world import QUICK, SEEDS, World, run

from gsencoder.app import main as cli
from gsencoder.text.table import REFERENCE_NOUNS


@pytest.fixture(scope="module", autouse=True)
def few_nouns() -> Iterator[None]:
    """Towers embed twenty reference nouns instead of four hundred."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsencoder.text.vocabulary.REFERENCE_NOUNS", REFERENCE_NOUNS[:20])
        yield


@contextmanager
def narrower() -> Iterator[None]:
    """A small RADIO has few channels, and is fused in a basis for all that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("gsencoder.fusion.fuse"), "NARROW", 8)
        yield


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def fused(world: World) -> Path:
    out = world.folder / "fused"
    heads = "teacher.heads=[siglip, siglip.features,sam]"
    with narrower():
        run("fuse", world.room(0), *world.teacher, heads, "fusion.max_rank=6", *SEEDS, f"out={out}")
    return out


@pytest.fixture(scope="session")
def trained(world: World) -> Path:
    out = world.folder / "encoder"
    heads = ("heads=[siglip,sam]", "teacher.heads=siglip.features")
    scenes = (world.room(0), world.room(1), "holdout=room_1")
    words = ["train", *scenes, *world.teacher, *heads, "prepare.fusion.max_rank=6", *SEEDS, *QUICK, f"out={out}"]
    with narrower():
        assert cli.main(words) == 0
    return out
