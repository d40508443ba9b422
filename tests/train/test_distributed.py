"""Who a process is, as its environment tells."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsencoder.core.errors import InputError
from gsencoder.train.distributed import (
    ProcessRank,
    check_agreement,
    fail_together,
    first_host,
    gpu_index,
    join_processes,
    rank_from_environment,
)

SLURM = {
    "SLURM_STEP_ID": "0",
    "SLURM_PROCID": "5",
    "SLURM_NTASKS": "8",
    "SLURM_LOCALID": "1",
    "SLURM_STEP_NODELIST": "gpu[03-04]",
    "SLURM_JOB_ID": "123456",
}


def test_without_a_launcher_there_is_one_process() -> None:
    assert rank_from_environment({}) == (ProcessRank(), "")
    with join_processes("cpu") as (process, device):
        assert process.is_first
        assert device.type == "cpu"


def test_torchrun_tells_rank_and_size() -> None:
    process, meeting = rank_from_environment({"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"})
    assert (process.rank, process.world_size, process.local_rank, process.is_first) == (3, 4, 1, False)
    assert meeting == "env://"


def test_slurm_tells_rank_and_size_and_where_to_meet() -> None:
    process, meeting = rank_from_environment(SLURM)
    assert (process.rank, process.world_size, process.local_rank) == (5, 8, 1)
    assert meeting == "tcp://gpu03:23456"


@pytest.mark.parametrize(
    ("environment", "visible", "gpu"),
    [(SLURM, 1, 0), (SLURM, 8, 1), ({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}, 1, 1)],
)
def test_a_task_of_slurm_that_sees_one_gpu_takes_it(
    environment: dict[str, str], visible: int, gpu: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: visible)
    assert gpu_index(*rank_from_environment(environment)) == gpu


def test_an_address_that_is_given_is_taken() -> None:
    assert rank_from_environment({**SLURM, "MASTER_ADDR": "h", "MASTER_PORT": "9"})[1] == "tcp://h:9"


def test_a_batch_script_itself_is_one_process() -> None:
    environment = {name: value for name, value in SLURM.items() if name != "SLURM_STEP_ID"}
    assert rank_from_environment(environment) == (ProcessRank(), "")


@pytest.mark.parametrize(
    ("nodes", "host"),
    [("a", "a"), ("a,b", "a"), ("a[1,3]", "a1"), ("a[001-200]", "a001"), ("n[2-3].x.org,m", "n2.x.org")],
)
def test_the_first_machine_of_a_list(nodes: str, host: str) -> None:
    assert first_host(nodes) == host


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"RANK": "4", "WORLD_SIZE": "4"}, "RANK=4 is not below WORLD_SIZE=4"),
        ({"RANK": "x", "WORLD_SIZE": "4"}, "RANK: expected a whole number"),
        ({**SLURM, "SLURM_STEP_NODELIST": ""}, "node list"),
    ],
)
def test_an_environment_that_contradicts_itself_is_refused(environment: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        rank_from_environment(environment)


def test_a_device_that_is_not_there_is_refused(no_gpu: None) -> None:
    with pytest.raises(InputError, match="no GPU"), join_processes("cuda"):
        pass


def test_an_unknown_device_is_refused(no_jaxtyping: None) -> None:
    with pytest.raises(InputError, match="expected auto, cpu or cuda"), join_processes("tpu"):  # type: ignore[arg-type]
        pass


TOGETHER = """
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.train.distributed import fail_together, join_processes

if __name__ == "__main__":
    with join_processes("cpu") as (process, device):
        try:
            with fail_together():
                if not process.is_first:
                    raise {error}
        except Exception as error:
            Path(f"{{__file__}}.{{process.rank}}").write_text(f"{{type(error).__name__}}: {{error}}")
"""


@pytest.mark.parametrize("error", ["InputError('its own')", "MemoryError('its own')"])
@pytest.mark.alone
def test_if_one_of_two_processes_fails_in_a_block_both_do(tmp_path: Path, error: str) -> None:
    path = tmp_path / "run.py"
    path.write_text(TOGETHER.format(error=error))
    launcher = [sys.executable, "-W", "ignore", "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([*launcher, str(path)], timeout=120, env=environment, capture_output=True, check=True)
    found = [Path(f"{path}.{rank}").read_text() for rank in (0, 1)]
    elsewhere = "InputError: another process stopped; its own message says why"
    assert found == [elsewhere, f"{error.partition('(')[0]}: its own"]


def test_one_process_leaves_a_block_as_it_entered_it() -> None:
    with fail_together():
        pass
    with pytest.raises(InputError, match="its own"), fail_together():
        raise InputError("its own")


AGREE = """
from pathlib import Path

from gsencoder.train.distributed import check_agreement, join_processes

if __name__ == "__main__":
    with join_processes("cpu") as (process, device):
        check_agreement("the teacher's weights", "8a1f")
        check_agreement("the teacher's weights", "" if process.is_first else "8a1f")
        try:
            check_agreement("the teacher's weights", "8a1f" if process.is_first else "77b0")
        except Exception as error:
            Path(f"{__file__}.{process.rank}").write_text(f"{type(error).__name__}: {error}")
"""


@pytest.mark.alone
def test_processes_with_different_weights_all_stop_and_name_both_digests(tmp_path: Path) -> None:
    path = tmp_path / "run.py"
    path.write_text(AGREE)
    launcher = [sys.executable, "-W", "ignore", "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([*launcher, str(path)], timeout=120, env=environment, capture_output=True, check=True)
    message = (
        "InputError: training: the teacher's weights differ: their digest is 8a1f in process 0 and 77b0 in process 1; "
        "give all processes the same files"
    )
    assert [Path(f"{path}.{rank}").read_text() for rank in (0, 1)] == [message, message]


def test_one_process_agrees_with_itself() -> None:
    check_agreement("the teacher's weights", "8a1f")
