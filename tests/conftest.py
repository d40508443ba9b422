"""Fixtures that all tests share."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # Before torch counts the cores: small arrays are slower on two threads, and another process has the other core.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Once gsply has run a parallel kernel of numba, OpenMP, and torch with it, has as many threads as numba.
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")

# Vectors of phrases are not cached in the user's folder.
os.environ["GSENCODER_CACHE"] = "off"
# A test that needs a model names its folder: with a developer's own models in reach, it could pass for them alone.
os.environ.pop("GSENCODER_MODELS", None)

import gc
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shape_checks  # Before any module of the package.
from composed_once import compose_once
from field_scenes import FieldRoom, make_field_room
from forked_ranks import RankServer, rank_server
from hypothesis import settings
from jaxtyping import config as jaxtyping_config

# How long an example takes says something about the machine, and the first one imports half the package.
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")


# What a test sees of a sync are its errors, which tests raise in its stead; the waiting is the disk's.
os.fsync = os.fstat  # type: ignore[assignment]


def pytest_collection_finish(session: pytest.Session) -> None:
    """Modules and collected tests live to the end, so that the collector need not look at them again and again."""
    compose_once()
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


def pytest_runtest_setup(item: pytest.Item) -> None:
    shape_checks.begin_test()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scenes and models; the test is skipped where it is missing."""
    folder = Path(os.environ.get("GSENCODER_SHARED", "../shared"))
    if not (folder / "scenes").is_dir():
        pytest.skip(f"no real data at {folder} (set GSENCODER_SHARED)")
    return folder


@pytest.fixture(scope="session")
def field_room(tmp_path_factory: pytest.TempPathFactory) -> FieldRoom:
    """The small room that tests of other tools' files rewrite."""
    return make_field_room(tmp_path_factory.mktemp("field"))


@pytest.fixture
def no_jaxtyping() -> Iterator[None]:
    """Switches runtime shape checks off, so that a test can meet the package's own errors."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def ranks() -> Iterator[RankServer]:
    """Starts the processes of a training."""
    with rank_server() as started:
        yield started


@pytest.fixture
def interrupts() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, as it does at a terminal; nohup and background jobs begin with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without a GPU, whatever it has."""
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)


@pytest.fixture(scope="session")
def open3d() -> Any:
    """The package; the test is skipped where the system lacks a library that it needs."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d does not import here: {error}")
    return open3d


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
