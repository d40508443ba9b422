"""Processes of one training that never come, end or stand still: the others name them and end; slow ones are waited
for."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest
from forked_ranks import RankServer

from gsencoder.core.errors import InputError
from gsencoder.core.process import store_address

SCRIPT = """
import os, signal, sys, time, warnings
from pathlib import Path

import torch.distributed.nn

from gsencoder.core.errors import InputError
from gsencoder.train import distributed as presence
from gsencoder.train.distributed import fail_together, join_processes, values_of_all

# A busy machine may not run a process for a second.
how, rank = sys.argv[1], int(os.environ["RANK"])
presence.BEAT_SECONDS, presence.SAY_SECONDS, presence.GRACE_SECONDS = 1 if "killed" in how else 0.3, 2, 2
presence.LOST_SECONDS = 4 if "never comes" in how else 120
warnings.simplefilter("always")
said = "ended well"
comes = [each for each in range(3) if {"first never comes": 0, "last never comes": 2}.get(how) != each]
try:
    if rank not in comes:
        raise InputError("a wrong option")
    Path(f"{__file__}.{rank}.comes").touch()
    while not all(Path(f"{__file__}.{each}.comes").exists() for each in comes):
        time.sleep(0.01)
    with join_processes("cpu") as (process, device):
        values_of_all(rank)
        if "killed" not in how:
            presence.LOST_SECONDS = 4
        if rank == 2 and how == "stands still":
            os.kill(os.getpid(), signal.SIGSTOP)
        if rank == 1 and how == "is killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if rank == 0 and how == "first is killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if rank == 1 and how == "is slow":
            with fail_together():
                time.sleep(5)
        elif rank == 0 and how == "stands still":
            time.sleep(60)  # It computes, and does not wait.
        else:
            with fail_together():
                pass
        if rank == 2 and how == "is slow":
            time.sleep(1)  # The first process, which ends before, has the store.
except InputError as error:
    said = str(error)
Path(f"{__file__}.{rank}.said").write_text(said)
os._exit(2 if said != "ended well" else 0)
"""

HOWS = ("first never comes", "last never comes", "stands still", "is killed", "first is killed", "is slow")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, ranks: RankServer) -> dict[str, list[tuple[int | None, str, str]]]:
    """The exit code, the error and the standard error of each of three processes, by what one of them does."""
    folder, started, ended = tmp_path_factory.mktemp("ranks"), {}, {}
    for how in HOWS:
        path = folder / f"{how.replace(' ', '_')}.py"
        path.write_text(SCRIPT)
        started[how] = path, ranks.started(path, how, count=3)
    for how, (path, processes) in started.items():
        codes = [processes.ended(rank, timeout=60) for rank in (0, 1)]
        with suppress(ProcessLookupError):
            if how == "stands still":
                os.kill(processes.pids[2], signal.SIGKILL)
        codes.append(processes.ended(2, timeout=60))
        said = [Path(f"{path}.{rank}.said") for rank in range(3)]
        texts = [each.read_text() if each.is_file() else "" for each in said]
        ended[how] = [
            (code, text, log.read_text()) for code, text, log in zip(codes, texts, processes.logs, strict=True)
        ]
    return ended


Runs = dict[str, list[tuple[int | None, str, str]]]


@pytest.mark.alone
def test_a_process_that_never_comes_is_named_and_not_waited_for(runs: Runs) -> None:
    last = runs["last never comes"]
    assert [code for code, _, _ in last] == [2, 2, 2]
    assert "SceneWarning: training: process 0 of 3 waits for process 2, and ends in 0.0" in last[0][2]
    assert last[0][2].count("waits for process") == 1
    assert "waits" not in last[1][2]
    for rank in (0, 1):
        assert "process 2 did not come within" in last[rank][1] or "process 0 ended" in last[rank][1]
    assert last[0][1].startswith("training: process 0 of 3: process 2 did not come within 0.0")
    for rank in (1, 2):
        code, said, log = runs["first never comes"][rank]
        assert code == 2
        assert f"training: process {rank} of 3 waits for process 0 at 127.0.0.1:" in log
        assert said.startswith(f"training: process {rank} of 3: process 0 did not come within")


@pytest.mark.alone
def test_a_process_that_is_killed_is_named_at_once(runs: Runs) -> None:
    for how, killed in (("is killed", 1), ("first is killed", 0)):
        for rank, (code, said, _) in enumerate(runs[how]):
            if rank == killed:
                assert (code, said) == (-9, "")
            else:
                assert code == 2
                assert said.startswith(f"training: process {rank} of 3: process ")
                assert " ended; its own message" in said
    assert "process 1 ended" in runs["is killed"][0][1]
    assert "process 0 ended" in runs["first is killed"][1][1]


@pytest.mark.alone
def test_a_process_that_stands_still_ends_those_that_wait_for_it_and_those_that_compute(runs: Runs) -> None:
    (code, said, log), (waiting_code, waiting_said, waiting_log), _ = runs["stands still"]
    assert (code, said) == (2, "")
    assert "SceneWarning: training: process 2 of 3 did not answer for 2 seconds" in log
    assert "error: training: process 0 of 3: process 2 did not answer for 0.067 minutes" in log
    # What waits in the main thread gets an error there, and can save its work.
    assert waiting_code == 2
    assert waiting_said.startswith("training: process 1 of 3: process 2 ended")
    assert "error:" not in waiting_log
    assert "SceneWarning" not in waiting_log


@pytest.mark.alone
def test_a_process_that_is_slow_is_waited_for_and_not_named(runs: Runs) -> None:
    for code, said, log in runs["is slow"]:
        assert (code, said) == (0, "ended well")
        assert "did not answer" not in log


def test_a_rank_set_by_hand_needs_an_address() -> None:
    assert store_address({"MASTER_ADDR": "here", "MASTER_PORT": "29500"}, "env://") == ("here", 29500)
    assert store_address({}, "tcp://node1:20007") == ("node1", 20007)
    for lacking in ({}, {"MASTER_ADDR": "here"}, {"MASTER_PORT": "29500"}):
        with pytest.raises(InputError, match="MASTER_ADDR or MASTER_PORT is not: give the host of process 0"):
            store_address(lacking, "env://")
    with pytest.raises(InputError, match="MASTER_PORT: expected a whole number"):
        store_address({"MASTER_ADDR": "here", "MASTER_PORT": "x"}, "env://")
