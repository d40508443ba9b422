"""Processes of one launcher: their devices, and what they do together."""

from pathlib import Path

import pytest
import torch
from forked_ranks import RankServer

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, rank_from_environment
from gsencoder.train.distributed import check_agreement, fail_together, gpu_index, join_processes

SLURM_TASK = {"SLURM_STEP_ID": "0", "SLURM_NTASKS": "8", "SLURM_LOCALID": "1", "SLURM_STEP_NODELIST": "gpu[03-04]"}


def test_without_a_launcher_there_is_one_process() -> None:
    assert rank_from_environment({}) == (ProcessRank(), "")
    with join_processes("cpu") as (process, device):
        assert process.is_first
        assert device.type == "cpu"


@pytest.mark.parametrize(
    ("environment", "visible", "gpu"),
    [(SLURM_TASK, 1, 0), (SLURM_TASK, 8, 1), ({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}, 1, 1)],
)
def test_a_task_of_slurm_that_sees_one_gpu_takes_it(
    environment: dict[str, str], visible: int, gpu: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: visible)
    assert gpu_index(*rank_from_environment(environment)) == gpu


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
def test_if_one_of_two_processes_fails_in_a_block_both_do(tmp_path: Path, error: str, ranks: RankServer) -> None:
    path = tmp_path / "run.py"
    path.write_text(TOGETHER.format(error=error))
    ranks.started(path).end_well()
    messages = [Path(f"{path}.{rank}").read_text() for rank in (0, 1)]
    elsewhere = "InputError: another process stopped; its own message says why"
    assert messages == [elsewhere, f"{error.partition('(')[0]}: its own"]


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
def test_processes_with_different_weights_all_stop_and_name_both_digests(tmp_path: Path, ranks: RankServer) -> None:
    path = tmp_path / "run.py"
    path.write_text(AGREE)
    ranks.started(path).end_well()
    message = (
        "InputError: training: the teacher's weights differ: their digest is 8a1f in process 0 and 77b0 in process 1; "
        "give all processes the same files"
    )
    assert [Path(f"{path}.{rank}").read_text() for rank in (0, 1)] == [message, message]


def test_one_process_agrees_with_itself() -> None:
    check_agreement("the teacher's weights", "8a1f")
