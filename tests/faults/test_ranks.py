"""Two processes of one training: one dies, hangs, or has other settings or weights. The other ends and says so."""

import time
from pathlib import Path

import pytest
from forked_ranks import RankServer

RANKS = """
import os, sys, time
from pathlib import Path
from training_scenes import LOSSES, SHORT, prepared, samples, small_encoder
import torch
from gsencoder.core.errors import InputError
from gsencoder.train import distributed
from gsencoder.train import distributed as presence
from gsencoder.train.run import encoder_trainer
from gsencoder.train.loop import TrainerConfig

torch.set_num_threads(1)
rate_at = TrainerConfig.rate_at
folder, rank, began = Path(sys.argv[1]), int(os.environ["RANK"]), 0.0

def train(how, process, device):
    dataset, names = prepared(folder / f"{how}{rank}", count=1)
    network = small_encoder()
    if how == "weights" and rank:
        with torch.no_grad():
            next(network.parameters()).add_(1e-3)
    work = folder / f"{how}{rank}" / "work"
    work.mkdir()
    settings = {"seed": rank if how == "settings of training" else 0}
    trainer = encoder_trainer(
        network, samples(dataset, names), LOSSES, SHORT, folder=work, settings=settings, process=process, device=device
    )
    def lost(config, step, final: float):
        if step == 1 and how == "hangs":
            distributed.STEP_MINUTES = 1 / 30
        if step == 2 and rank and how in ("dies", "hangs"):
            (folder / "lost").touch()
            os._exit(9) if how == "dies" else time.sleep(60)
        return rate_at(config, step, final)

    TrainerConfig.rate_at = lost
    trainer.run()

presence.BEAT_SECONDS = 0.3
for how in sys.argv[2:]:
    said = "ended"
    try:
        if how == "settings":
            with distributed.join_processes("cpu", settings={"steps": rank, "quiet": bool(rank)}):
                pass
        elif not torch.distributed.is_initialized():
            with distributed.join_processes("cpu", settings={"steps": 3, "quiet": bool(rank)}) as (process, device):
                train(how, process, device)
        else:
            with distributed.lost_processes(process := distributed.rank_from_environment(os.environ)[0]):
                train(how, process, torch.device("cpu"))
    except InputError as error:
        said = str(error)
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
    if how == "settings":
        torch.distributed.destroy_process_group()
    (folder / f"{how}.{rank}").write_text(said)
    # A rank that joins again may not find the store of the group that the other one has not left yet.
    while how == "settings" and not (folder / f"{how}.{1 - rank}").is_file():
        time.sleep(0.01)
os._exit(0)
"""


def outcomes(ranks: RankServer, folder: Path, *hows: str) -> dict[str, list[str]]:
    """What each of two processes said of each fault; an empty text of one that said nothing while the first ran."""
    (folder / "run.py").write_text(RANKS)
    processes = ranks.started(folder / "run.py", str(folder), *hows)
    processes.ended(0, timeout=240)
    processes.kill()
    files = {how: [folder / f"{how}.{rank}" for rank in (0, 1)] for how in hows}
    return {how: [each.read_text() if each.is_file() else "" for each in pair] for how, pair in files.items()}


@pytest.mark.alone
def test_processes_that_disagree_stop_at_the_start_and_one_that_hangs_is_not_waited_for(tmp_path, ranks):
    messages = outcomes(ranks, tmp_path, "settings", "weights", "settings of training", "hangs")
    for how, what, advice in (
        ("settings", "the settings differ", "give all processes the same command"),
        ("weights", "the step and the weights that training begins with differ", "give all processes the same files"),
        ("settings of training", "the settings of training differ", "give all processes the same files"),
    ):
        for each in messages[how]:
            assert each.startswith(f"training: {what}: their digest is ")
            assert each.endswith(advice)
        assert messages[how][0] == messages[how][1]
    assert messages["hangs"] == [
        "training: process 0 of 2: another process did not answer for 0.0333333 minutes; its own message, if there "
        "is one, says why; start all of them again to continue",
        "",
    ]
    # What was done before is saved, and the next run continues it.
    assert (tmp_path / "hangs0" / "work" / "checkpoint.safetensors").is_file()


@pytest.mark.alone
def test_a_process_whose_other_dies_ends_at_once(tmp_path: Path, ranks: RankServer) -> None:
    messages = outcomes(ranks, tmp_path, "dies")["dies"]
    assert messages[0].startswith("training: process 0 of 2: process 1 ended; ")
    assert messages[1] == ""
    assert time.time() - (tmp_path / "lost").stat().st_mtime < 30
