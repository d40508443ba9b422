"""SplatDistill's way with a small random RADIO: what its commands wrote, one after the other."""

from collections.abc import Iterator
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


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def fused(world: World) -> Path:
    out = world.folder / "fused"
    basis = ("fusion.narrow=8", "fusion.max_rank=6")
    heads = "teacher.heads=[siglip, siglip.features,sam]"
    run("fuse", world.room(0), *world.teacher, heads, *basis, *SEEDS, f"out={out}")
    return out


@pytest.fixture(scope="session")
def trained(world: World) -> Path:
    out = world.folder / "encoder"
    basis = ("prepare.fusion.narrow=8", "prepare.fusion.max_rank=6")
    heads = ("heads=[siglip,sam]", "teacher.heads=siglip.features")
    scenes = (world.room(0), world.room(1), "holdout=room_1")
    assert cli.main(["train", *scenes, *world.teacher, *heads, *basis, *SEEDS, *QUICK, f"out={out}"]) == 0
    return out
