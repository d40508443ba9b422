"""A server that forks runs with a fault in them; where there is no C compiler the tests are skipped, visibly."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from fault_runs import FaultServer, fault_server


@pytest.fixture(scope="session")
def server() -> Iterator[FaultServer]:
    # Not pytest's folder: paths of the runs are counted by their beginning, and are short in messages.
    with tempfile.TemporaryDirectory(prefix="gsencoder_faults_") as folder, fault_server(Path(folder)) as started:
        if started is None:
            pytest.skip("faults of files need Linux and a C compiler (gcc or cc)")
        yield started
