"""A server that forks runs with a fault in them; where there is no C compiler the tests are skipped, visibly."""

import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
from fault_checks import Checker
from fault_runs import FaultServer, fault_server


@pytest.fixture(scope="session")
def server() -> Iterator[FaultServer]:
    # Not pytest's folder: paths of the runs are counted by their beginning, and are short in messages.
    with tempfile.TemporaryDirectory(prefix="gsencoder_faults_") as folder, fault_server(Path(folder)) as started:
        if started is None:
            pytest.skip("faults of files need Linux and a C compiler (gcc or cc)")
        yield started


@pytest.fixture(scope="session")
def checker(server: FaultServer, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Checker]:
    """The checker of a command, whose runs without a fault are made once."""
    return cache(lambda name: Checker(server, tmp_path_factory.mktemp("faults"), name))
