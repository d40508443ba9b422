"""Who a process is, as its environment tells."""

import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, first_host, rank_from_environment

SLURM = {
    "SLURM_STEP_ID": "0",
    "SLURM_PROCID": "5",
    "SLURM_NTASKS": "8",
    "SLURM_LOCALID": "1",
    "SLURM_STEP_NODELIST": "gpu[03-04]",
    "SLURM_JOB_ID": "123456",
}


def test_torchrun_tells_rank_and_size() -> None:
    process, meeting = rank_from_environment({"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"})
    assert (process.rank, process.world_size, process.local_rank, process.is_first) == (3, 4, 1, False)
    assert meeting == "env://"


def test_slurm_tells_rank_and_size_and_where_to_meet() -> None:
    process, meeting = rank_from_environment(SLURM)
    assert (process.rank, process.world_size, process.local_rank) == (5, 8, 1)
    assert meeting == "tcp://gpu03:23456"


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
