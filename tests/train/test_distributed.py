"""Processes of one launcher: their devices, what they do together, and what they share."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from forked_ranks import RankServer
from training_scenes import DenseSideTeacher, prepared, small_encoder

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank, available_cores, rank_from_environment
from gsencoder.core.threads import threads_of_torch
from gsencoder.evaluate.validation import validate_names
from gsencoder.models.output_space import OutputSpaces
from gsencoder.train.distributed import cpu_share, gpu_index, join_processes
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.samples import TrainingScene

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
def test_a_task_of_slurm_that_sees_one_gpu_takes_it(environment, visible, gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: visible)
    assert gpu_index(*rank_from_environment(environment)) == gpu


def test_a_device_that_is_not_there_is_refused(no_gpu: None) -> None:
    with pytest.raises(InputError, match="no GPU"), join_processes("cuda"):
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


SCRIPT = """
import json
from pathlib import Path

from test_distributed import scores_of

from gsencoder.train.distributed import join_processes
from gsencoder.train.prepared import PreparedDataset

if __name__ == "__main__":
    with join_processes("cpu") as (process, _):
        dataset = PreparedDataset(Path({folder!r}))
        result = scores_of(dataset, {names!r})
    Path({folder!r} + f".{{process.rank}}").write_text(json.dumps(result))
"""


def scores_of(dataset: PreparedDataset, names: list[str]) -> dict[str, object]:
    """The scores of an encoder, and which pictures there are."""
    scenes = [TrainingScene([scene]) for scene in dataset.scenes(names)]
    outputs = OutputSpaces(by_teacher={"sides": dataset.load_space()[0]})
    codebooks = {"sides": dataset.load_codebook()}
    result = validate_names(scenes, small_encoder(outputs.widths), outputs, codebooks)
    return {"scores": dict(result.scores), "pictures": sorted(result.pictures)}


@pytest.mark.alone
def test_two_processes_validate_each_scene_once_and_as_one_does(tmp_path: Path, ranks: RankServer) -> None:
    dataset, names = prepared(tmp_path / "one", count=5, teacher=DenseSideTeacher())
    one = scores_of(dataset, names)
    copy = shutil.copytree(tmp_path / "one", tmp_path / "two")
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.format(folder=str(copy), names=names))
    ranks.started(script).end_well()
    first, second = (json.loads(Path(f"{copy}.{rank}").read_text()) for rank in (0, 1))
    assert first["scores"] == pytest.approx(one["scores"], rel=1e-9)
    assert second["scores"] == first["scores"]
    # All pictures are drawn by the process that logs them.
    assert (first["pictures"], second["pictures"]) == (one["pictures"], [])


def test_processes_of_a_machine_divide_its_cores_unless_threads_are_given() -> None:
    cores = available_cores()
    assert cpu_share(ProcessRank(world_size=2 * cores, local_world_size=2 * cores)) == 1
    assert cpu_share(ProcessRank(world_size=8, local_world_size=1)) == cores
    assert cpu_share(ProcessRank(world_size=8, local_world_size=8), threads=5) == 5
    with threads_of_torch(3):
        assert cpu_share(ProcessRank()) == torch.get_num_threads() == 3


@pytest.mark.parametrize(
    ("environment", "local"),
    [
        ({"RANK": "9", "WORLD_SIZE": "16", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "8"}, 8),
        ({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}, 1),
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2),1", "SLURM_TASKS_PER_NODE": "9"}, 4),
    ],
)
def test_launchers_state_the_processes_of_a_machine(environment: dict[str, str], local: int) -> None:
    task = {"SLURM_STEP_ID": "0", "SLURM_PROCID": "5", "SLURM_NTASKS": "9", "SLURM_STEP_NODELIST": "a"}
    variables = environment if "RANK" in environment else {**task, **environment}
    assert rank_from_environment(variables)[0].local_world_size == local
